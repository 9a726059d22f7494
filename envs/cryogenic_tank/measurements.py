"""The signals of the tank, and what its sensors and its clock give."""

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rt_torchrl.plants.signal import Measurement, Signal

if TYPE_CHECKING:
    from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank

STATES = (
    Signal(symbol="T_s", name="wall_temperature", unit="K", low=0.0),
    Signal(symbol="V_l", name="liquid_volume", unit="m³", low=0.0, high=60.0),
    Signal(symbol="p", name="pressure", unit="Pa", low=80e3, high=900e3),
)
INPUTS = (Signal(symbol="Q_h", name="heat_load", unit="W", low=0.0),)
SET_POINT, ERROR_UNIT = 500e3, 10e3
"""Pressure p̃ that is wanted, and unit of the pressure error [Pa]."""


def pressure_error(plant: "CryogenicTank", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The error p − p̃ [Pa]."""
    return state[..., 2] - plant.set_point


def superheat(plant: "CryogenicTank", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The wall's temperature above that of the fluid, T_s − T(p) [K]."""
    return state[..., 0] - plant.saturation(state[..., 2]).T


def clock(plant: "CryogenicTank", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The share of the episode that has passed."""
    return t / plant.horizon


def orbit_cosine(plant: "CryogenicTank", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The cosine of the phase of the orbit, −1 at the peak of the load."""
    return torch.cos(2.0 * math.pi / plant.orbit * t)


def orbit_sine(plant: "CryogenicTank", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The sine of the phase of the orbit, positive while the load rises."""
    return torch.sin(2.0 * math.pi / plant.orbit * t)


MEASUREMENTS = (
    Measurement(symbol="e", name="pressure_error", unit="Pa", read=pressure_error, scale=ERROR_UNIT),
    Measurement(symbol="T_s - T", name="superheat", unit="K", read=superheat, scale=0.05),
    Measurement.of(STATES[1], offset=42.0, scale=6.0),
    Measurement(symbol="t/T_o", name="clock", unit="-", low=0.0, high=1.0, read=clock, offset=0.5, scale=0.5),
    Measurement(symbol=r"\cos 2\pi t/T_h", name="orbit_cosine", unit="-", low=-1.0, high=1.0, read=orbit_cosine),
    Measurement(symbol=r"\sin 2\pi t/T_h", name="orbit_sine", unit="-", low=-1.0, high=1.0, read=orbit_sine),
    Measurement.of(INPUTS[0], offset=130.0, scale=100.0),
)
MEASURED = ("pressure_error", "superheat", "liquid_volume")
OBSERVATION_SETS = {
    "paper": ("pressure_error",),
    "errors": ("pressure_error",),
    "clock": ("pressure_error", "clock"),
    "phase": ("pressure_error", "orbit_cosine", "orbit_sine"),
    "measured": MEASURED,
    "measured+load": (*MEASURED, "clock", "orbit_cosine", "orbit_sine", "heat_load"),
}
"""Names of measurements: the paper's error; this with the time of the episode; with the phase of the orbit; all states;
and all states with both times and the load."""
