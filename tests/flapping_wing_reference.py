"""Oracle for the forces of the flapping wing: the paper's formulas read literally, in numpy.

The misprints that the plant names are corrected: the sign of R_2(α), and ż in the place of ẏ.
"""

import numpy as np
from scipy.integrate import trapezoid

RHO, FREQUENCY = 1.225, 20.0
ROOT, LENGTH, CHORD = 0.0225, 0.05, 0.01


def reference_force(t, velocity, amplitude, stroke_angle, headwind):
    """F_x, F_z [N] of wings and body, with the paper's matrices and arc cosine, and a trapezium rule along the span."""
    a, b, c = 1.71, 0.043, 1.595
    beta = np.radians(stroke_angle)
    phase = 2 * np.pi * FREQUENCY * t
    phi = np.radians(amplitude) * np.cos(phase)
    phi_dot = -2 * np.pi * FREQUENCY * np.radians(amplitude) * np.sin(phase)
    alpha = np.radians(45.0) * np.sin(phase)
    R2_beta = np.array([[np.cos(beta), 0, np.sin(beta)], [0, 1, 0], [-np.sin(beta), 0, np.cos(beta)]])
    R3 = np.array([[np.cos(phi), np.sin(phi), 0], [-np.sin(phi), np.cos(phi), 0], [0, 0, 1]])
    R2_alpha = np.array([[np.cos(alpha), 0, -np.sin(alpha)], [0, 1, 0], [np.sin(alpha), 0, np.cos(alpha)]])
    to_wing = R2_alpha @ R3 @ R2_beta
    relative = np.array([velocity[0] + headwind, 0.0, velocity[1]])
    r = np.linspace(ROOT, ROOT + LENGTH, 20_001)
    arm = np.stack([0 * r, r, 0 * r], -1)
    U = np.cross(R2_alpha @ np.array([0.0, 0.0, phi_dot]), arm) + to_wing @ relative
    U[:, 1] = 0.0
    speed = np.linalg.norm(U, axis=1)
    alpha_e = np.arccos(U[:, 2] / speed)
    C_L, C_D = a * np.sin(2 * alpha_e), b + c * (1 - np.cos(2 * alpha_e))
    # A quarter turn from the velocity, to the side from which the chord meets the air.
    lift_direction = np.sign(U[:, :1]) * np.stack([-U[:, 2], 0 * r, U[:, 0]], -1) / speed[:, None]
    chord = 4 * CHORD / np.pi * np.sqrt(np.maximum(0.0, 1 - ((r - ROOT) / LENGTH) ** 2))
    pressure = (0.5 * RHO * chord * speed**2)[:, None]
    strip = pressure * (C_L[:, None] * lift_direction - C_D[:, None] * U / speed[:, None])
    right = to_wing.T @ trapezoid(strip, r, axis=0)
    wings = right + right * np.array([1.0, -1.0, 1.0])
    body = -0.5 * RHO * 5e-4 * np.linalg.norm(relative) * relative
    return (wings + body)[[0, 2]]
