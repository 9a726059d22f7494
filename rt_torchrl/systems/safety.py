"""A safety layer between a policy and a real system: limits on what is sent, a watchdog on what comes back."""

import json
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from rt_torchrl.atomic_file import finite
from rt_torchrl.options import array_of, other_units, require_range
from rt_torchrl.plants.plant import Plant
from rt_torchrl.systems.config import OperatingLimitsConfig, SafetyConfig
from rt_torchrl.systems.environment import AroundSystem, layers
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory

WRONG = frozenset({"missing", "not finite", "out of range", "frozen"})
"""Faults that make an observation wrong; a late one is right, and so is one of a system beyond its limits."""
ROUNDING = 1e-9
"""Share of an interval or a rate by which rounding may exceed it."""
SLACK = 1e-6
"""Slack in comparisons of times that are sums of many intervals, as a share of an interval."""

Fallback = Sequence[float] | Callable[[TensorDictBase], Tensor] | StateFeedback


class SafetyEvent(NamedTuple):
    """One control interval in which the layer acted or saw a fault.

    ``reasons`` maps each reason to a detail. ``range`` and ``rate`` say that the action was limited, ``asked`` that the
    policy's action was not finite, and ``fallback`` that the fallback acted. ``missing``, ``not finite``, ``out of
    range``, ``frozen`` and ``late`` are faults of the observation at the end of the interval. ``limit`` says that the
    system has left its limits.
    """

    episode: int  # from 1
    step: int  # from 0
    time: float  # start of the interval, counted from the start of the episode [s]
    reasons: dict[str, str]
    asked: list[float]
    applied: list[float]
    at: float  # end of the interval on this machine's clock, counted from 1970 [s]


@dataclass
class SafetyReport:
    """Events of one episode, and where readings are wrong.

    ``wrong`` holds the intervals at whose end the observation is wrong, also those of which this became known later.
    """

    events: list[SafetyEvent] = field(default_factory=list)
    wrong: set[int] = field(default_factory=set)


class ActionLimits:
    r"""Limits that saturate an action, and then hold :math:`|a_k - a_{k-1}| \le r\,\Delta t`.

    If the last action lies outside the range, both limits cannot hold; then the range holds.

    Args:
        spec: spec of the action; its own range always holds.
        config: range and rates of the actions, and the control interval Δt.

    Raises:
        ValueError: if a number does not fit the actions, or the range is empty.
    """

    def __init__(self, spec: TensorSpec, config: SafetyConfig):
        self.spec, low, high = spec, config.low, config.high
        self.low = spec.space.low if low is None else torch.maximum(spec.space.low, self.constant("low", low))
        self.high = spec.space.high if high is None else torch.minimum(spec.space.high, self.constant("high", high))
        if not ((self.low <= self.high) & (self.low < math.inf) & (self.high > -math.inf)).all():
            raise ValueError(f"low={low} and high={high} leave no action of the system's own range {spec.space}.")
        self._increment = None if config.rates is None else config.interval * self.constant("rates", config.rates)

    def constant(self, argument: str, values: Sequence[float]) -> Tensor:
        """The action of these values, one number for each component.

        Raises:
            ValueError: if the values are too many or too few.
        """
        action = torch.as_tensor(array_of(argument, values), dtype=self.spec.dtype, device=self.spec.device)
        if action.shape != self.spec.shape[-1:]:
            raise ValueError(f"{argument}={values} must have {self.spec.shape[-1]} numbers, one for each action.")
        return action.expand(self.spec.shape)

    def sendable(self, fallback: Sequence[float]) -> Tensor:
        """The action of a constant fallback, which must lie in the range, so that it is sent without a change.

        Raises:
            ValueError: if the values are too many or too few, one is not finite, or one lies outside the range.
        """
        action = self.constant("fallback", fallback)
        if not ((action >= self.low) & (action <= self.high) & action.isfinite()).all():
            raise ValueError(
                f"fallback={fallback} must lie in the range of the actions, {self.low.flatten().tolist()} to "
                f"{self.high.flatten().tolist()}; the machine gets nothing outside it."
            )
        return action

    def __call__(self, action: Tensor, last: Tensor | None) -> tuple[Tensor, dict[str, str]]:
        """The nearest action within the limits, and the components that ``range`` and ``rate`` have changed.

        Args:
            action: finite action.
            last: action that was applied before; None leaves the rate free.
        """
        inside = torch.minimum(torch.maximum(action, self.low), self.high)
        reached = inside
        if self._increment is not None and last is not None:
            reached = torch.minimum(torch.maximum(inside, last - self._increment), last + self._increment)
        # The rate must not lead out of the range, even if the last action was outside it.
        sent = torch.minimum(torch.maximum(reached, self.low), self.high)
        held = {"range": (inside != action) | (sent != reached), "rate": reached != inside}
        places = {name: mask.flatten().nonzero().flatten().tolist() for name, mask in held.items() if mask.any()}
        return sent, {name: f"action {', '.join(map(str, found))}" for name, found in places.items()}


class Watchdog:
    """Judges the observations of a real system: are they finite, within their ranges, and in time?

    A watchdog trips at a fault and stays tripped until it has seen no fault for the hold time. A sensor that is frozen
    repeats its value.

    The attribute ``stale`` holds the number of readings before the present one that are wrong too, because a sensor was
    frozen before that could be known.

    Args:
        config: limits on observations.
    """

    def __init__(self, config: SafetyConfig):
        self.config = config
        self.begin()

    def begin(self) -> None:
        """Begin a new episode, in which nothing has been read and no fault has been seen."""
        self._until = -math.inf
        self.stale = 0
        self._values: dict[str, tuple[Tensor, Tensor]] = {}

    def faults(self, entries: Mapping[str, Tensor], elapsed: float) -> dict[str, str]:
        """Faults of an observation by kind, each with a detail; an entry that is missing is not judged.

        Args:
            entries: entries of the observation.
            elapsed: wall-clock time that the observation took to come [s].
        """
        faults: dict[str, str] = {}
        if broken := [name for name, value in entries.items() if not value.isfinite().all()]:
            faults["not finite"] = ", ".join(broken)
        finite = {name: value for name, value in entries.items() if name not in broken}
        for kind, ranges in (("out of range", self.config.ranges), ("limit", self.config.limits)):
            if outside := [name for name in ranges if name in finite and _outside(finite[name], ranges[name]).any()]:
                faults[kind] = ", ".join(outside)
        self.stale = 0
        for entry, limit in self.config.frozen.items():
            if entry in entries and (count := self._equal(entry, entries[entry], torch.as_tensor(limit))):
                faults["frozen"] = f"{entry}, {count} equal readings"
                self.stale = max(self.stale, count - 2)
        if elapsed > self.config.deadline:
            faults["late"] = f"{elapsed:.6g} s, deadline {self.config.deadline:g} s"
        return faults

    def _equal(self, entry: str, value: Tensor, limit: Tensor) -> int:
        """Number of equal readings in a row, with this one, of the component frozen for longest; 0 if none is."""
        last, counts = self._values.get(entry, (torch.full_like(value, torch.nan), torch.ones_like(value)))
        counts = torch.where(value == last, counts + 1, torch.ones_like(counts))
        self._values[entry] = value.clone(), counts
        limit = limit.to(counts)
        return int(torch.where((limit > 0.0) & (counts >= limit), counts, 0.0).max())

    def note(self, t: float, faulty: bool) -> None:
        """Take note of an observation at time t of the episode [s] and whether it was faulty."""
        if faulty:
            # Without a hold time the watchdog is tripped for the interval that begins now.
            self._until = t + max(self.config.hold, 0.5 * self.config.interval)

    def tripped(self, t: float) -> bool:
        """Whether the fallback acts in the interval that begins at t [s]."""
        return t < self._until - SLACK * self.config.interval


class SafetyLayer(AroundSystem):
    r"""An environment with one continuous ``action``, and limits in front of it.

    Range and rate, :math:`|a_k - a_{k-1}| \le r\,\Delta t`, limit every action. They limit the fallback too, because
    they are limits of the machine. The fallback acts while the watchdog is tripped. The layer passes observations on;
    it replaces only values that are missing or not finite, by the last finite ones, because a policy cannot use NaN,
    and the event says so. It passes the system's reward on and never takes it for a fault. It adds three entries:

    ==================  ======  ======================================================================================
    ``applied``         n_a     the action sent to the system; where the system has an entry of that name, it is kept
    ``tripped``         1       whether this observation trips the watchdog, or the watchdog is still tripped
    ``refused``         1       whether this observation is wrong, and so not to be learned from, see ``WRONG``
    ==================  ======  ======================================================================================

    A learner learns from ``("next", "applied")``, not from the ``action`` that the policy asked for.
    ``ReinforcementTwinning`` learns nothing from the intervals before and after a refused observation.

    The layer runs in the process that steps the system. It notices a late observation only when the observation
    arrives, and it cannot end a call that never returns. A machine needs its own protection behind it.

    Args:
        env: environment of one real system, with batch size () or (1,).
        config: limits on actions and observations.
        fallback: action within the range; a function that makes an action from the TensorDict of the last observation;
            or state feedback, where ``state`` and ``exogenous`` are observed. It is asked in every interval, so that
            its memory goes on while the policy acts and its action is not used.

    Raises:
        ValueError: if there is more than one system or action entry, the action is not continuous, the interval is not
            that of a simulation behind it, a number does not fit the actions, or a constant ``fallback`` lies outside
            their range.
    """

    clock = staticmethod(time.monotonic)
    """Wall clock [s]."""

    def __init__(self, env: EnvBase, config: SafetyConfig, *, fallback: Fallback):
        if env.batch_size.numel() != 1:
            raise ValueError(f"env has batch_size={tuple(env.batch_size)}; a safety layer guards one system.")
        if list(env.action_keys) != ["action"] or not env.action_spec.dtype.is_floating_point:
            raise ValueError(
                f"env has the action entries {list(env.action_keys)} of {env.action_spec}; a safety layer guards one "
                "continuous entry 'action'."
            )
        plant = getattr(env, "plant", None)
        if isinstance(plant, Plant) and not abs(config.interval - plant.dt) <= ROUNDING * plant.dt:
            raise ValueError(
                f"interval={config.interval} s must be the control interval of plant {plant.name!r}, {plant.dt:g} s; "
                f"check its unit: {other_units('s')}."
            )
        super().__init__(device=env.device, batch_size=env.batch_size)
        self.env, self.config = env, config
        self.report, self._episodes = SafetyReport(), 0
        """Report of the present episode; between two episodes, that of the last one."""
        self._good: dict[str, Tensor] = {}
        self._make_specs()
        self.watchdog, self.limits = Watchdog(config), ActionLimits(env.action_spec, config)
        self._fallback: Any = fallback
        if not (isinstance(fallback, StateFeedback) or callable(fallback)):
            self._fallback = self.limits.sendable(fallback)
        if config.log is not None:
            config.log.parent.mkdir(parents=True, exist_ok=True)
            config.log.touch()

    def _make_specs(self) -> None:
        observation, action = self.env.full_observation_spec.clone(), self.env.action_spec
        for argument in ("ranges", "limits", "frozen"):
            if unknown := set(getattr(self.config, argument)) - set(observation.keys()):
                raise ValueError(f"{argument} has {sorted(unknown)}; the system observes {sorted(observation.keys())}.")
        if "applied" not in observation:
            observation["applied"] = Unbounded(shape=action.shape, dtype=action.dtype, device=self.device)
        for flag in ("tripped", "refused"):
            observation[flag] = Binary(n=1, shape=(*self.batch_size, 1), dtype=torch.bool, device=self.device)
        self.observation_spec, self.done_spec = observation, self.env.full_done_spec.clone()
        self.action_spec, self.reward_spec = action.clone(), self.env.reward_spec.clone()
        self._watched = [k for k in self.env.full_observation_spec if observation[k].dtype.is_floating_point]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        reading = self.env.reset(**kwargs)
        self.watchdog.begin()
        if isinstance(self._fallback, StateFeedback):
            self._fallback.begin()
        faults = self._faults(reading, 0.0)
        if faults.pop("limit", None):
            self.watchdog.note(0.0, True)  # the fallback begins
        if faults:
            raise ValueError(f"the system begins with a fault, {faults}, and nothing was sent to it: {dict(reading)}.")
        self._step_count, self._passed, self._last, self._good = 0, 0, None, {}
        if getattr(self.env, "reads_applied", False):
            self._last = reading["applied"].clone()  # of a machine in operation
        reading = self._remember(reading)
        if "applied" not in reading:  # the machine need not say what it has applied
            reading["applied"] = self.action_spec.zero()
        reading["tripped"], reading["refused"] = self._flag(self.watchdog.tripped(0.0)), self._flag(False)
        return reading

    def begin_window(self) -> None:
        """Begin the next window of an operation; the limits and the watchdog go on, and the report begins anew."""
        self._passed, self._step_count = self._passed + self._step_count, 0

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._step_count == 0:
            # The report begins with the first step, because a reset need not be followed by a step.
            self.report, self._episodes = SafetyReport(), self._episodes + 1
        past = self._passed + self._step_count
        t, end = (self.config.interval * k for k in (past, past + 1))
        applied, reasons = self._chosen(t, tensordict)
        start = self.clock()
        sent = tensordict.exclude("next", "tripped", "refused").set("action", applied.clone())
        reading = self.env.step(sent)["next"]
        faults = self._faults(reading, self.clock() - start)
        self.watchdog.note(end, bool(faults))
        reading = self._remember(reading.copy())
        if "applied" not in self.env.full_observation_spec:
            reading["applied"] = applied.clone()
        reading["tripped"] = self._flag(self.watchdog.tripped(end))
        reading["refused"] = self._flag(not WRONG.isdisjoint(faults))
        if reading["refused"].any():
            first = max(0, self._step_count - self.watchdog.stale)
            self.report.wrong.update(range(first, self._step_count + 1))
        self._note(reasons | faults, tensordict["action"], applied)
        self._last, self._step_count = applied, self._step_count + 1
        return reading

    def _chosen(self, t: float, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, str]]:
        """The action to be sent to the system, and the reasons why it is not the one that was asked for."""
        action, reasons = tensordict["action"].to(self.action_spec.dtype), {}
        if not action.isfinite().all():
            reasons["asked"] = "not finite"
            self.watchdog.note(t, True)
        tripped = self.watchdog.tripped(t)
        other = self._fallback
        if isinstance(other, StateFeedback):  # which remembers also while it does not act; a window has its own clock
            clock = self._step_count * self.config.interval
            other = other.act(clock, tensordict["state"], tensordict["exogenous"])
        elif tripped and callable(other):
            other = other(tensordict)
        if tripped:
            action, reasons["fallback"] = other, "watchdog tripped"
            if action.shape != self.action_spec.shape or not action.isfinite().all():
                raise ValueError(
                    f"fallback gave {action} at t = {t:g} s; it must be finite, of shape {self.action_spec.shape}."
                )
        applied, held = self.limits(action, self._last)
        return applied, reasons | held

    def _faults(self, reading: TensorDictBase, elapsed: float) -> dict[str, str]:
        """Faults of an observation by kind, each with a detail."""
        read = {key: reading[key] for key in self._watched if key in reading}
        faults = self.watchdog.faults(read, elapsed)
        if missing := [key for key in self._watched if key not in read]:
            faults["missing"] = ", ".join(missing)
        reasons: dict[str, str] = getattr(self.env, "reasons", {})  # of a machine that says why
        if reasons and "not finite" in faults:
            faults["not finite"] += f" ({'; '.join(f'{tag}: {why}' for tag, why in reasons.items())})"
        return faults

    def _remember(self, reading: TensorDictBase) -> TensorDictBase:
        """Replace values that are missing or not finite by the last finite ones."""
        for key in self._watched:
            value = reading[key] if key in reading else torch.full_like(self._good[key], torch.nan)
            good = self._good.get(key, torch.zeros_like(value))
            self._good[key] = torch.where(value.isfinite(), value, good)
            reading[key] = self._good[key]
        return reading

    def _note(self, reasons: dict[str, str], requested: Tensor, applied: Tensor) -> None:
        if not reasons:
            return
        command, sent = requested.flatten().tolist(), applied.flatten().tolist()
        t = self._step_count * self.config.interval
        event = SafetyEvent(self._episodes, self._step_count, t, reasons, command, sent, time.time())
        self.report.events.append(event)
        if self.config.log is not None:
            try:
                with self.config.log.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(finite(event._asdict())) + "\n")
            except OSError as error:  # such as a full disk, which must not stop the control of a machine that moves
                warnings.warn(f"events are missing in {self.config.log}: {error}", stacklevel=2)

    def _flag(self, value: bool) -> Tensor:
        return torch.full((*self.batch_size, 1), value, dtype=torch.bool, device=self.device)


def report_of(env: EnvBase) -> SafetyReport | None:
    """The report of the safety layer of a real system about its last episode; None if there is none."""
    return next((layer.report for layer in layers(env) if isinstance(layer, SafetyLayer)), None)


class OperatingLimits:
    """The limits of a plant as numbers for every signal: bounds on states, actions and rates for every policy.

    Args:
        plant: plant that gives the signals.
        config: the limits.

    Raises:
        ValueError: if the plant has no such state or action, or a limit lies beyond the signal's own range, where it
            would limit nothing.
    """

    def __init__(self, plant: Plant, config: OperatingLimitsConfig):
        self.config, self._dt, self._read = config, plant.dt, len(plant.readings)
        for what, signals in (("states", plant.readings), ("actions", plant.actions), ("rates", plant.actions)):
            given, known = getattr(config, what), {signal.name: signal for signal in signals}
            if unknown := sorted(set(given) - set(known)):
                raise ValueError(f"limits.{what} has {', '.join(unknown)}; the plant has {', '.join(known)}.")
            for name, ends in given.items():
                low, high, unit = known[name].low, known[name].high, known[name].unit
                if what == "rates":  # a greater rate than that of the whole range in an interval limits nothing
                    ends, low, high, unit = (ends,), 0.0, (high - low) / plant.dt, f"{unit}/s"
                for end in filter(math.isfinite, ends):
                    require_range(f"limits.{what} {name}", end, low, high, unit=unit, of="the plant")
        free = (-math.inf, math.inf)
        self.states, self.actions = (
            tuple(tuple(given.get(signal.name, free)[end] for signal in signals) for end in (0, 1))
            for signals, given in ((plant.readings, config.states), (plant.actions, config.actions))
        )
        self.rates = [config.rates.get(action.name, math.inf) for action in plant.actions]

    def broken(self, flown: Trajectory) -> dict[str, Bool[Tensor, "*batch n"]]:
        """Whether a limit of ``states``, ``actions`` or ``rates`` is left in the control intervals of trajectories."""
        states, actions = flown.states[..., 1:, : self._read], flown.actions
        steps = torch.cat([torch.zeros_like(actions[..., :1, :]), actions.diff(dim=-2)], -2).abs()
        greatest = self._dt * actions.new_tensor(self.rates) * (1.0 + ROUNDING)
        beyond = {"states": _outside(states, self.states), "actions": _outside(actions, self.actions)}
        return {kind: signals.any(-1) for kind, signals in (beyond | {"rates": steps > greatest}).items()}

    def safety(self) -> dict[str, Any]:
        """Options of a :class:`SafetyConfig` that hold these limits on a system in the plant's own units."""
        options: dict[str, Any] = {"low": self.actions[0], "high": self.actions[1], "rates": tuple(self.rates)}
        return options | ({"limits": {"state": self.states}} if self.config.states else {})


def require_layer(env: EnvBase) -> None:
    """Refuse a real system without a safety layer, which alone can hold limits.

    Raises:
        ValueError: if there is none.
    """
    if report_of(env) is None:
        raise ValueError(
            "limits are given, and the real system has no safety layer that holds them: put a SafetyLayer around the "
            "environment, with SafetyConfig(interval=plant.dt, **OperatingLimits(plant, limits).safety())."
        )


def _outside(values: Tensor, ends: Sequence[float | Sequence[float]]) -> Bool[Tensor, "*batch n"]:
    """Where values do not lie between their ends, as NaN never does."""
    low, high = (torch.as_tensor(end, dtype=values.dtype, device=values.device) for end in ends)
    return ~((values >= low) & (values <= high))
