r"""Blade-element momentum theory of the NREL 5-MW rotor, which gives the map C_p(λ, β) from its blade and its polars.

It made the table of the worn rotor that the wind turbine ships, see :func:`worn_values`.

Each blade element sees the wind :math:`V_x` along the rotor axis and :math:`V_y` in the plane of rotation. Its inflow
angle φ balances the loads of the section against the momentum of the annulus (Ning 2014),

.. math::
    R(\phi) = \frac{\sin\phi}{1-a} - \frac{V_x}{V_y}\,\cos\phi\,(1-\kappa') = 0, \quad
    \kappa = \frac{\sigma' c_n}{4F\sin^2\phi}, \quad \kappa' = \frac{\sigma' c_t}{4F\sin\phi\cos\phi}

with :math:`a = \kappa/(1+\kappa)` in the momentum region, Buhl's parabola above κ = 2/3, and Prandtl's tip and hub loss
factor F. Each element has one unknown in a known bracket, so that bisection cannot fail; it takes all elements at once.
Arrays have the dimensions tip-speed ratio, pitch, sector and element, or broadcast to them.

Sources: S. A. Ning, *A simple solution method for the blade element momentum equations with guaranteed convergence*,
Wind Energy 17 (2014) 1327-1345; M. L. Buhl, *A new empirical relationship between thrust coefficient and induction
factor for the turbulent windmill state*, NREL/TP-500-36834, 2005; Jonkman et al., NREL/TP-500-38060, 2009.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from rt_torchrl.envs.wind_turbine.rotor import PowerCoefficientTable, csv_rows

DATA = Path(__file__).parent / "data"
EDGE = 1e-6
"""Distance of the brackets from φ = 0 and φ = π, where the residual is singular [rad]."""
BISECTIONS = 48
"""Number of halvings of a bracket of at most π/2, which give φ to 6e-15 rad."""
BLADES, SECTORS = 3, 8
HUB_RADIUS, TIP_RADIUS, HUB_HEIGHT = 1.5, 63.0, 90.0
"""Distances of the blade's ends from the rotor axis, along the blade, and of the hub from the ground [m]."""
CONE, TILT = np.radians(2.5), np.radians(5.0)
SHEAR = 0.2
"""Exponent of the wind profile, u(h) = U (h/hub height)^shear [-]."""


def columns(file, *names):
    """Columns of numbers by the names in the file's header."""
    header, *rows = csv_rows(DATA / file)
    return [np.array([float(row[header.index(name)]) for row in rows]) for name in names]


def polar(name):
    """Lift and drag coefficients of a section over the angle of attack [deg], by cubics that do not overshoot."""
    alpha, cl, cd = columns(f"nrel5mw_polar_{name}.csv", "alpha_deg", "cl", "cd")
    return PchipInterpolator(alpha, np.stack([cl, cd], axis=-1))


BLADE = "nrel5mw_blade_17nodes.csv"
R, DR, CHORD, TWIST = columns(BLADE, "r_m", "dr_m", "chord_m", "twist_deg")
HEADER, *ROWS = csv_rows(DATA / BLADE)
AIRFOILS = np.array([row[HEADER.index("airfoil")] for row in ROWS])
POLARS = {name: polar(name) for name in np.unique(AIRFOILS)}
RADIUS = TIP_RADIUS * np.cos(CONE)
"""Radius of the swept disc [m]."""


class Sections(NamedTuple):
    """The rotor in a wind and at pitches, with factors of lift and drag after erosion, soiling or icing."""

    v_x: np.ndarray
    v_y: np.ndarray
    beta: np.ndarray
    lift: float
    drag: float

    def coefficients(self, alpha):
        """Lift and drag coefficient of every element at its angle of attack [deg], of any number of turns."""
        found = np.empty((*alpha.shape, 2))
        for name, curve in POLARS.items():
            at = name == AIRFOILS
            found[..., at, :] = curve((alpha[..., at] + 180.0) % 360.0 - 180.0)
        return self.lift * found[..., 0], self.drag * found[..., 1]

    def balance(self, phi):
        """Inductions a and a', the force coefficient c_t, and the residual at inflow angles φ [rad]."""
        sin, cos = np.sin(phi), np.cos(phi)
        cl, cd = self.coefficients(np.degrees(phi) - TWIST - self.beta)
        c_n, c_t = cl * cos + cd * sin, cl * sin - cd * cos
        half = 0.5 * BLADES / np.abs(sin)
        loss = prandtl(half * (TIP_RADIUS - R) / R) * prandtl(half * (R - HUB_RADIUS) / HUB_RADIUS)
        solidity = BLADES * CHORD / (2 * np.pi * R)
        kappa, kappa_t = solidity * c_n / (4 * loss * sin**2), solidity * c_t / (4 * loss * sin * cos)
        a = axial_induction(kappa, loss, phi > 0)
        # For φ < 0 (propeller brake, a > 1) the division by 1 - a would blow up inside the bracket: there a = κ/(κ-1)
        # and Ning writes 1/(1 - a) = 1 - κ.
        residual = np.where(phi > 0, sin / (1 - a), sin * (1 - kappa)) - self.v_x / self.v_y * cos * (1 - kappa_t)
        return a, kappa_t / (1 - kappa_t), c_t, residual


def power_coefficients(tip_speed_ratio, pitch, *, lift=1.0, drag=1.0):
    r"""Map of the rotor, :math:`C_p = \lambda\,Q / (\tfrac12\rho\pi R^3 U^2)` [-], with the mean torque Q over azimuth.

    The loads of an element are constant over its length dr.
    """
    lam, beta = np.asarray(tip_speed_ratio, dtype=np.float64), np.asarray(pitch, dtype=np.float64)
    v_x, v_y = wind(lam)
    sections = Sections(v_x, v_y, beta[:, None, None], lift, drag)
    low, high = bracket(sections, (lam.size, beta.size, SECTORS, R.size))
    sign = np.sign(sections.balance(low)[-1])
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        left = np.sign(sections.balance(middle)[-1]) == sign
        low, high = np.where(left, middle, low), np.where(left, high, middle)
    a, a_tangential, c_t, _ = sections.balance(0.5 * (low + high))
    force = CHORD * ((v_x * (1 - a)) ** 2 + (v_y * (1 + a_tangential)) ** 2) * c_t  # per ½ρ and unit length, one blade
    torque = BLADES * (force.mean(axis=2) * R * np.cos(CONE) * DR).sum(axis=-1)
    return lam[:, None] * torque / (np.pi * RADIUS**3)


def worn_values():
    """The shipped table of the NREL 5-MW rotor after its polars have lost 10 % of their lift and gained 50 % of drag.

    The clean rotor's table is lowered by the difference that the theory finds between the clean and the worn blade, so
    that the theory's own error, RMS 0.004, does not count as wear.
    """
    table = PowerCoefficientTable.nrel5mw()
    axes = table.tip_speed_ratio.numpy(), table.pitch.numpy()
    return table.values.numpy() + power_coefficients(*axes, lift=0.9, drag=1.5) - power_coefficients(*axes)


def wind(lam):
    """Undisturbed wind along the rotor axis and in the direction of rotation, over the wind speed at hub height.

    The element is at azimuth ψ (0: blade up) of a coned and tilted rotor, as in Ning's CCBlade without yaw.
    """
    psi = (2 * np.pi / SECTORS * np.arange(SECTORS))[:, None]
    along, outward = -R * np.sin(CONE), R * np.cos(CONE)
    height = outward * np.cos(psi) * np.cos(TILT) - along * np.sin(TILT)
    speed = (1 + height / HUB_HEIGHT) ** SHEAR
    v_x = speed * (np.sin(TILT) * np.cos(psi) * np.sin(CONE) + np.cos(TILT) * np.cos(CONE))
    omega = lam[:, None, None, None] / RADIUS
    return v_x[None, None], omega * outward + speed * np.sin(TILT) * np.sin(psi)


def bracket(sections, shape):
    """Interval of φ [rad] in which the residual changes sign, per element (Ning 2014, section 3.4).

    The bracket is the windmill range (0, π/2] if the sign changes there, else the propeller brake [-π/4, 0) if it
    changes there, else (π/2, π).
    """

    def residual(phi):
        return sections.balance(np.full(shape, phi))[-1]

    windmill = residual(EDGE) * residual(np.pi / 2) <= 0
    brake = (residual(-np.pi / 4) < 0) & (residual(-EDGE) > 0)
    low = np.where(windmill, EDGE, np.where(brake, -np.pi / 4, np.pi / 2))
    high = np.where(windmill, np.pi / 2, np.where(brake, -EDGE, np.pi - EDGE))
    return low, high


def prandtl(factor):
    """Loss factor of one end of the blade, (2/π) arccos e^{-f}."""
    return 2 / np.pi * np.arccos(np.exp(-factor))


def axial_induction(kappa, loss, windmill):
    r"""Axial induction a from κ: momentum theory up to κ = 2/3, Buhl's parabola above, propeller brake for φ < 0.

    Buhl's parabola is :math:`C_T = \tfrac89 + (4F - \tfrac{40}9)a + (\tfrac{50}9 - 4F)a^2`, and the blade gives
    :math:`C_T = 4F\kappa(1-a)^2`.
    """
    g1 = 2 * loss * kappa - (10 / 9 - loss)
    g2 = loss * (2 * kappa - (4 / 3 - loss))
    g3 = 2 * loss * kappa - (25 / 9 - 2 * loss)
    root = np.sqrt(np.maximum(g2, 0.0))
    near = np.abs(g3) < 1e-6  # the quadratic equation becomes linear: its limit is taken
    buhl = np.where(near, 1 - 0.5 / np.where(near, root, 1.0), (g1 - root) / np.where(near, 1.0, g3))
    momentum = kappa / (1 + np.where(kappa == -1, EDGE, kappa))
    brake = np.where(kappa > 1, kappa / np.where(kappa == 1, EDGE, kappa - 1), 0.0)
    return np.where(windmill, np.where(kappa <= 2 / 3, momentum, buhl), brake)
