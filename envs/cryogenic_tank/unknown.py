"""What a real tank may have beside its twin: systems by name, and what the plant suspects.

Parameters without a source are engineering guesses.
"""

import math
from collections.abc import Mapping
from functools import partial

import torch
from torch import Tensor, nn

from rt_torchrl.plants.actuators import LaggedActuator
from rt_torchrl.plants.extension import Extension, System, combined, require_systems
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sensors import BiasedSensor
from rt_torchrl.plants.shapes import Action, Hidden, Input, State, Time
from rt_torchrl.plants.signal import Signal
from rt_torchrl.plants.vector_field import NeuralResidual

HOUR = 3600.0
EPISODE = 120.0 * HOUR
"""Time in which a drift reaches its size [s]."""
PRESSURE_ERROR = 10e3
"""Size of an offset of the sensor that counts as one [Pa], 2 % of the set point."""
FIRST_VALVE_LAG = 600.0
"""Time constant of the valve with which the identification begins [s]."""
UNKNOWN_RATE = 0.2
"""Size of an unknown rate [Pa/s]; about the standard deviation of the pressure's rate under a moving valve."""


class TwoZones(Extension):
    r"""A tank that nobody stirs: its surface warms and cools before the rest of the liquid does.

    The pressure p over the surface zone stands beside the pressure p_h of the same tank when it is stirred.

    .. math:: p = p_h + (r - 1)(p_h - x), \qquad T_m\dot x = p_h - x

    A fast change of p_h is r times as great at the surface, and after the mixing time T_m the zones are one. The
    balances of the plant are those of the stirred tank; sensor and cost see the pressure p. The hidden state x has its
    exact solution for the mean of p_h over the interval.

    Args:
        base: the tank, whose state 2 is the pressure.
        ratio: ratio r of the rates of pressure.
        mixing_time: T_m [s].

    Raises:
        ValueError: if the ratio is below 1, the mixing time is not positive and finite, or the base is an extension.
    """

    def __init__(self, base: Plant, ratio: float, mixing_time: float):
        if not 1.0 <= ratio < math.inf or not 0.0 < mixing_time < math.inf:
            raise ValueError(
                f"ratio={ratio} of the zones must be at least 1, and mixing_time={mixing_time} s positive; both finite."
            )
        if base.innermost is not base:
            raise ValueError(f"base={type(base).__name__} of TwoZones must be the tank itself; extend the result.")
        super().__init__(base, [Signal(symbol="x", name="mixed_pressure", unit="Pa")])
        self.ratio, self.mixing_time = ratio, mixing_time
        self._left = math.exp(-base.dt / mixing_time)

    def stirred(self, read: State, mixed: Hidden) -> State:
        """States of the stirred tank."""
        pressure = (read[..., 2:3] + (self.ratio - 1.0) * mixed) / self.ratio
        return torch.cat([read[..., :2], pressure], -1)

    def at_surface(self, stirred: State, mixed: Hidden) -> Tensor:
        """All states of the tank with its surface zone, or their rates from the rates of the arguments."""
        pressure = self.ratio * stirred[..., 2:3] - (self.ratio - 1.0) * mixed
        return torch.cat([stirred[..., :2], pressure, mixed], -1)

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        read, mixed = self.split(state)
        stirred = self.stirred(read, mixed)
        field = self.base.vector_field(t, stirred, action, exogenous, closure)
        return self.at_surface(field, (stirred[..., 2:3] - mixed) / self.mixing_time)

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        read, mixed = self.split(state)
        start = self.stirred(read, mixed)
        end = self.base.advance(t, start, applied, exogenous, closure)
        mean = 0.5 * (start[..., 2:3] + end[..., 2:3])
        return self.at_surface(end, mean + (mixed - mean) * self._left)

    def rest(self, base: State) -> Hidden:
        """Zones that are one."""
        return base[..., 2:3]


def misread(plant: Plant, *, offset: float = 0.0, drift: float = 0.0) -> Plant:
    """A pressure sensor with an offset [Pa], and a drift that reaches its size [Pa] in 120 h.

    Offset and drift: engineering guesses, 1 to 5 % of the set point; data sheets of cryogenic transducers state 0.25 to
    1 % of the full scale, without thermal shift.
    """
    return BiasedSensor(plant, "pressure", offset, drift / EPISODE, scale=PRESSURE_ERROR)


def slow_valve(plant: Plant, lag: float = HOUR) -> Plant:
    """A valve whose drop or duty cycle changes slowly.

    Time constant 1 h: engineering guess, the lines behind the valve have to cool down first.
    """
    (valve,) = plant.actions
    return LaggedActuator(plant, valve.name, lag)


def two_zones(plant: Plant) -> Plant:
    """A tank that nobody stirs.

    Ratio 2: engineering guess; tanks on the ground rise up to a few times as fast as the stirred model. Mixing time
    5 h: engineering guess, a pump that turns the liquid over a few times a day.
    """
    return TwoZones(plant, 2.0, 5.0 * HOUR)


PARTS = ("mixture", "valve", "pressure sensor")
"""Parts of the tank, in the order in which they are changed."""
SYSTEMS: Mapping[str, System] = {
    "bias_5": {"pressure sensor": partial(misread, offset=5e3)},
    "bias_15": {"pressure sensor": partial(misread, offset=15e3)},
    "bias_minus_15": {"pressure sensor": partial(misread, offset=-15e3)},
    "drift_10": {"pressure sensor": partial(misread, drift=10e3)},
    "drift_25": {"pressure sensor": partial(misread, drift=25e3)},
    "valve_lag": {"valve": slow_valve},
    "two_zones": {"mixture": two_zones},
    "all": {"mixture": two_zones, "valve": slow_valve, "pressure sensor": partial(misread, offset=5e3)},
}
"""What the real tank has beside its twin, by the names of ``--unknown``."""


require_unknown = partial(require_systems, systems=SYSTEMS)
"""Refuses names that do not exist, or change the same part."""
unknown = partial(combined, systems=SYSTEMS, parts=PARTS)
"""``unknown(plant, names)`` is the real tank that has all that the names say; its twin is ``plant``."""


def suspects(plant: Plant) -> Mapping[str, Plant]:
    """An offset and drift of the pressure sensor, a lag of the valve, and both."""
    return {
        "pressure sensor": misread(plant),
        "valve lags": slow_valve(plant, FIRST_VALVE_LAG),
        "pressure sensor, valve lags": slow_valve(misread(plant), FIRST_VALVE_LAG),
    }


def further_suspects(plant: Plant) -> Mapping[str, Plant]:
    """A rate of the pressure of unknown form that depends on pressure, liquid, valve and heat load."""
    (valve,) = plant.actions
    rate = NeuralResidual(
        plant,
        {"pressure": UNKNOWN_RATE},
        inputs=("pressure", "liquid_volume", valve.name, "heat_load"),
        ranges={"heat_load": (0.0, 400.0)},
    )
    return {"unknown heat": rate}
