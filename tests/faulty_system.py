"""A real system with faults, which are injected on purpose, to try what is to survive them."""

import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import EnvBase

from rt_torchrl.options import Count, configuration
from rt_torchrl.systems.environment import AroundSystem, require_interval

CLOCK = "time"
"""Entry of the clock that a faulty system reports."""
Kind = Literal[
    "dropped",
    "late",
    "repeated",
    "frozen",
    "out_of_range",
    "nan",
    "clock_jump",
    "stuck_actuator",
    "slow_actuator",
    "raises",
    "ends_early",
]
OF_SENSORS: tuple[Kind, ...] = ("dropped", "late", "repeated", "frozen", "out_of_range", "nan", "clock_jump")
OF_ACTUATORS: tuple[Kind, ...] = ("stuck_actuator", "slow_actuator")
OF_SYSTEMS: tuple[Kind, ...] = ("raises", "ends_early")


@configuration
class Injection:
    """A fault that is injected into some intervals of an episode.

    Args:
        kind: the fault. Of sensors: ``dropped`` leaves the entry out, ``late`` waits before the reading, ``repeated``
            gives the whole last reading once more, ``frozen`` holds the component, ``out_of_range`` and ``nan`` set it,
            ``clock_jump`` moves the clock from the first interval on. Of actuators: ``stuck_actuator`` holds the
            action, ``slow_actuator`` lets it follow in part. Of the system: ``raises`` an error, ``ends_early``
            truncates the episode.
        episode: number of the episode, from 0; None for every episode.
        first: first control interval with the fault.
        last: last control interval with the fault; by default the first one alone.
        entry: entry of the observation whose sensor has the fault.
        component: component of the entry, or of the action, with the fault.
        value: value of ``out_of_range`` in the entry's unit; seconds of ``late`` and ``clock_jump``; share of the way
            to the action that ``slow_actuator`` goes in an interval.

    Raises:
        ValueError: if an option does not fit its type, or the intervals are none.
    """

    kind: Kind
    episode: int | None = None
    first: Count = 0
    last: Count | None = None
    entry: str = "state"
    component: int = 0
    value: float = 0.0

    def __post_init__(self) -> None:
        if self.last is not None and self.last < self.first:
            raise ValueError(f"first={self.first} and last={self.last} of the injected fault name no intervals.")
        if self.kind == "slow_actuator" and not 0.0 < self.value < 1.0:
            raise ValueError(f"value={self.value} of a slow actuator must lie in (0, 1), a share of the way.")

    def acts(self, episode: int, interval: int) -> bool:
        """Whether the fault is there in an interval of an episode."""
        last = self.first if self.last is None else self.last
        return self.episode in (None, episode) and self.first <= interval <= last


class FaultySystem(AroundSystem):
    """An environment with injected faults; without any it is the environment itself.

    It reports the system's clock as entry ``time`` [s] if the environment reports none of that name.

    Args:
        env: environment of one system with one entry ``action``.
        injections: the faults.
        interval: control interval of the system [s], by which the clock goes on.
        sleep: function that waits for some time [s].

    Raises:
        ValueError: if a fault names an entry or a component that the environment does not have, or the interval is not
            that of a simulation.
    """

    def __init__(
        self,
        env: EnvBase,
        injections: Sequence[Injection],
        *,
        interval: float,
        sleep: Callable[[float], None] = time.sleep,
    ):
        require_interval(env, interval)
        super().__init__(device=env.device, batch_size=env.batch_size)
        self.env, self.injections, self._interval, self._sleep = env, tuple(injections), interval, sleep
        self._episode, self._own_clock = -1, CLOCK not in env.full_observation_spec
        self._count = self._since = 0
        self._offset = 0.0
        self._held: dict[Injection, Tensor] = {}
        self._sent: Tensor | None = None
        self.action_spec, self.reward_spec = env.action_spec.clone(), env.reward_spec.clone()
        self.done_spec = env.full_done_spec.clone()
        observation = env.full_observation_spec.clone()
        if self._own_clock:
            observation[CLOCK] = Unbounded(shape=(*env.batch_size, 1), dtype=torch.float64, device=env.device)
        self.observation_spec = observation
        for injection in self.injections:
            self._require(injection)
        self.injected: list[tuple[int, int, Kind]] = []
        """Episode, interval and kind of every fault so far."""

    def _require(self, injection: Injection) -> None:
        spec = self.action_spec if injection.kind in OF_ACTUATORS else self.observation_spec.get(injection.entry, None)
        if spec is None or not -spec.shape[-1] <= injection.component < spec.shape[-1]:
            raise ValueError(
                f"{injection} has no place: the system observes {sorted(map(str, self.observation_spec.keys()))} and "
                f"takes {self.action_spec.shape[-1]} actions."
            )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        asked = None if tensordict is None or "_reset" not in tensordict else tensordict.select("_reset")
        found = self.env.reset(asked, **kwargs).exclude("_reset")
        self._count, self._since, self._offset, self._held, self._sent = 0, 0, 0.0, {}, None
        self._clocked(found)
        self._reading = found.clone()
        return found

    def _count_window(self) -> None:
        self._count, self._held = 0, {}

    def _gone_on(self, found: TensorDictBase) -> TensorDictBase:
        self._clocked(found)
        found[CLOCK] = found[CLOCK] + self._offset
        self._reading = found.clone()
        return found

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._episode += self._count == 0
        active = [one for one in self.injections if one.acts(self._episode, self._count)]
        self.injected += [(self._episode, self._count, one.kind) for one in active]
        if any(one.kind == "raises" for one in active):
            self._count, self._since = self._count + 1, self._since + 1
            raise ConnectionError("no answer (injected)")
        action = self._acted(tensordict["action"], active)
        found = self.env.step(tensordict.exclude("next").set("action", action))["next"].copy()
        self._count, self._since = self._count + 1, self._since + 1
        self._clocked(found)
        return self._read(found, active)

    def _clocked(self, found: TensorDictBase) -> None:
        if self._own_clock:
            clock = torch.full((*self.batch_size, 1), self._since * self._interval, dtype=torch.float64)
            found[CLOCK] = clock.to(found.device)

    def _acted(self, asked: Tensor, active: Sequence[Injection]) -> Tensor:
        """What the actuators do of the action that is asked for."""
        action = asked.clone()
        for one in active:
            at = (..., one.component)
            last = action[at] if self._sent is None else self._sent[at]
            if one.kind == "stuck_actuator":
                action[at] = last
            elif one.kind == "slow_actuator":
                action[at] = last + one.value * (action[at] - last)
        self._sent = action.clone()
        return action

    def _read(self, found: TensorDictBase, active: Sequence[Injection]) -> TensorDictBase:
        """What the sensors report of what there is."""
        self._offset += sum(one.value for one in active if one.kind == "clock_jump" and one.first == self._count - 1)
        found[CLOCK] = found[CLOCK] + self._offset
        right, dropped = found.clone(), []
        for one in active:
            if one.kind == "dropped":
                dropped.append(one.entry)
            elif one.kind == "repeated":
                found.update(self._reading.select(*self.observation_spec.keys()))
            elif one.kind == "late":
                self._sleep(one.value)
            elif one.kind == "ends_early":
                found.update({key: torch.ones_like(found[key]) for key in ("done", "truncated")})
            elif one.kind in ("frozen", "out_of_range", "nan"):
                found[one.entry] = self._spoilt(found[one.entry], one)
        self._reading = right
        return found.exclude(*dropped)

    def _spoilt(self, reading: Tensor, injection: Injection) -> Tensor:
        """A reading with the fault in one component; a frozen one holds what was read before the fault."""
        reading, at = reading.clone(), (..., injection.component)
        if injection.kind == "frozen":
            self._held.setdefault(injection, self._reading[injection.entry][at].clone())
            reading[at] = self._held[injection]
        else:
            reading[at] = torch.nan if injection.kind == "nan" else injection.value
        return reading

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """State of the system, and the number of its episodes, on which the faults depend."""
        return {"system": self.env.state_dict(*args, **kwargs), "episode": self._episode}

    def load_state_dict(self, state: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        self.env.load_state_dict(state["system"], *args, **kwargs)
        self._episode = state["episode"]
