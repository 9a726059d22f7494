"""The signals of the drone, and what its sensors give."""

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rt_torchrl.plants.signal import Measurement, Signal

if TYPE_CHECKING:
    from rt_torchrl.envs.flapping_wing.plant import FlappingWing

STATES = (
    Signal(symbol="x", name="forward_position", unit="m"),
    Signal(symbol="z", name="height", unit="m"),
    Signal(symbol=r"\dot x", name="forward_speed", unit="m/s"),
    Signal(symbol=r"\dot z", name="climb_speed", unit="m/s"),
)
ACTIONS = (
    Signal(symbol=r"A_\phi", name="flapping_amplitude", unit="deg", low=50.0, high=88.0),
    Signal(symbol=r"\beta_w", name="stroke_plane_angle", unit="deg", low=-30.0, high=30.0),
)
INPUTS = (Signal(symbol=r"u_\infty", name="headwind", unit="m/s"),)
FILTERED = (
    Signal(symbol="x_F", name="filtered_position", unit="m"),
    Signal(symbol="z_F", name="filtered_height", unit="m"),
)
"""States that a drone has if one of ``OF_FILTERED`` is observed."""
POSITION_FILTER = 50.0
"""ω_F [rad/s]; its lag of 20 ms is short for a flight of seconds."""


def error_x(plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The way forwards to the target [m]."""
    return plant.target[0] - state[..., 0]


def error_z(plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The way upwards to the target [m]."""
    return plant.target[1] - state[..., 1]


def error_rate_x(plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The rate of the way forwards [m/s]."""
    return -state[..., 2]


def error_rate_z(plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The rate of the way upwards [m/s]."""
    return -state[..., 3]


def phase_cosine(plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The cosine of the phase of the wing beat, 1 where the wings are furthest forwards."""
    return torch.cos(2.0 * math.pi * plant.frequency * t)


def phase_sine(plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The sine of the phase of the wing beat, as which the wings pitch."""
    return torch.sin(2.0 * math.pi * plant.frequency * t)


def filtered_rate_x(plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The rate of the way forwards [m/s], as the filter of the position tells it."""
    return POSITION_FILTER * (state[..., -2] - state[..., 0])


def filtered_rate_z(plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The rate of the way upwards [m/s], as the filter of the height tells it."""
    return POSITION_FILTER * (state[..., -1] - state[..., 1])


STROKE_PLANE = Measurement.of(ACTIONS[1], scale=30.0)
"""The stroke plane angle that was applied last, of a drone that remembers it."""
OF_FILTERED = (
    Measurement(symbol=r"\dot e_{x,F}", name="filtered_rate_x", unit="m/s", read=filtered_rate_x),
    Measurement(symbol=r"\dot e_{z,F}", name="filtered_rate_z", unit="m/s", read=filtered_rate_z),
)
# ℓ = 2 m and v = 1 m/s: with these, good policies have weights of 1 to 2, which suit one learning rate.
MEASUREMENTS = (
    Measurement(symbol="e_x", name="error_x", unit="m", read=error_x, scale=2.0),
    Measurement(symbol="e_z", name="error_z", unit="m", read=error_z, scale=2.0),
    Measurement(symbol=r"\dot e_x", name="error_rate_x", unit="m/s", read=error_rate_x),
    Measurement(symbol=r"\dot e_z", name="error_rate_z", unit="m/s", read=error_rate_z),
    Measurement.of(INPUTS[0], offset=1.0),
    Measurement(symbol=r"\cos 2\pi ft", name="phase_cosine", unit="-", low=-1.0, high=1.0, read=phase_cosine),
    Measurement(symbol=r"\sin 2\pi ft", name="phase_sine", unit="-", low=-1.0, high=1.0, read=phase_sine),
    STROKE_PLANE,
    *OF_FILTERED,
)
ERRORS = tuple(measurement.name for measurement in MEASUREMENTS[:4])
POSITION = (*ERRORS[:2], *(measurement.name for measurement in OF_FILTERED))
PHASE = ("phase_cosine", "phase_sine")
OBSERVATION_SETS = {
    "paper": ERRORS,
    "errors": ERRORS,
    "wind": (*ERRORS, "headwind"),
    "phase": (*ERRORS, *PHASE),
    "measured": (*ERRORS, *PHASE),
    "measured+wind": (*ERRORS, *PHASE, "headwind"),
    "position": (*POSITION, *PHASE),
    "position+wind": (*POSITION, *PHASE, "headwind"),
}
"""Names of measurements: the paper's errors of position and speed; these with the wind; with the phase of the wing
beat; with both; and what a sensor of the position alone tells, with the phase, and with the wind."""
