"""Operating limits of a plant: bounds on states, actions and the rates of actions, which hold for every policy."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor
from torchrl.envs import EnvBase

from rt_torchrl.options import require_range
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal
from rt_torchrl.systems.operating_limits_config import OperatingLimitsConfig
from rt_torchrl.systems.safety import SafetyLayer
from rt_torchrl.trajectories.trajectory import Trajectory

ROUNDING = 1e-9
"""Share of a rate by which rounding may exceed it."""


class OperatingLimits:
    """The limits of a plant as numbers for every signal.

    Args:
        plant: plant that gives the signals.
        config: the limits.

    Raises:
        ValueError: if the plant has no such state or action, a limit lies beyond the signal's own range, where it would
            limit nothing, or the limits leave no action of its range.
    """

    def __init__(self, plant: Plant, config: OperatingLimitsConfig):
        self.config, self._dt, self._read = config, plant.dt, len(plant.readings)
        self.states = _ends("states", plant.readings, config.states)
        self.actions = _ends("actions", plant.actions, config.actions)
        for action, low, high in zip(plant.actions, *self.actions, strict=True):
            if not max(low, action.low) < min(high, action.high):
                raise ValueError(
                    f"limits.actions {action.name}={low:g} to {high:g} leave nothing of the action's range "
                    f"{action.low:g} to {action.high:g} {action.unit}."
                )
        _known("rates", plant.actions, config.rates)
        _require_range("states", plant.readings, config.states)
        _require_range("actions", plant.actions, config.actions)
        # A greater rate than that of the whole range in an interval limits nothing.
        for action in (one for one in plant.actions if one.name in config.rates):
            whole, unit = (action.high - action.low) / plant.dt, f"{action.unit}/s"
            require_range(
                f"limits.rates {action.name}", config.rates[action.name], 0.0, whole, unit=unit, of="the plant"
            )
        self.rates = [config.rates.get(action.name, math.inf) for action in plant.actions]

    def broken(self, flown: Trajectory) -> dict[str, Bool[Tensor, "*batch n"]]:
        """Whether a limit of ``states``, ``actions`` or ``rates`` is left in the control intervals of trajectories."""
        states, actions = flown.states[..., 1:, : self._read], flown.actions
        steps = torch.cat([torch.zeros_like(actions[..., :1, :]), actions.diff(dim=-2)], -2).abs()
        greatest = self._dt * actions.new_tensor(self.rates) * (1.0 + ROUNDING)
        return {
            "states": _outside(states, self.states),
            "actions": _outside(actions, self.actions),
            "rates": (steps > greatest).any(-1),
        }

    def safety(self) -> dict[str, Any]:
        """Options of a :class:`SafetyConfig` that hold these limits on a system in the plant's own units."""
        options: dict[str, Any] = {"low": self.actions[0], "high": self.actions[1], "rates": tuple(self.rates)}
        return options | ({"limits": {"state": self.states}} if self.config.states else {})


def require_layer(env: EnvBase) -> None:
    """Refuse a real system without a safety layer, which alone can hold limits.

    Raises:
        ValueError: if there is none.
    """
    inner: Any = env
    while inner is not None and not isinstance(inner, SafetyLayer):
        inner = getattr(inner, "env", None)
    if inner is None:
        raise ValueError(
            "limits are given, and the real system has no safety layer that holds them: put a SafetyLayer around the "
            "environment, with SafetyConfig(interval=plant.dt, **OperatingLimits(plant, limits).safety())."
        )


def _ends(
    what: str, signals: tuple[Signal, ...], given: Mapping[str, tuple[float, float]]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    _known(what, signals, given)
    free = (-math.inf, math.inf)
    low, high = (tuple(given.get(signal.name, free)[end] for signal in signals) for end in (0, 1))
    return low, high


def _require_range(what: str, signals: tuple[Signal, ...], given: Mapping[str, tuple[float, float]]) -> None:
    """Refuse ends beyond the range of a signal, which limit nothing."""
    for signal in signals:
        for end in filter(math.isfinite, given.get(signal.name, ())):
            name = f"limits.{what} {signal.name}"
            require_range(name, end, signal.low, signal.high, unit=signal.unit, of="the plant")


def _known(what: str, signals: tuple[Signal, ...], given: Mapping[str, Any]) -> None:
    names = [signal.name for signal in signals]
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise ValueError(f"limits.{what} has {', '.join(unknown)}; the plant has {', '.join(names)}.")


def _outside(values: Tensor, ends: tuple[tuple[float, ...], tuple[float, ...]]) -> Bool[Tensor, "*batch n"]:
    low, high = (values.new_tensor(end) for end in ends)
    return ~((values >= low) & (values <= high)).all(-1)
