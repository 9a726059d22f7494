"""A real system with faults, which are injected on purpose, to try what is to survive them."""

import time
from dataclasses import dataclass

import torch

from rt_torchrl import Reading, RealSystem
from rt_torchrl.systems.environment import AroundSystem


def as_reported(env, plant, **options):
    """A real system whose states, inputs and applied actions are reported under their names."""
    places = {name: Reading(keys=(name,)) for name in ("state", "exogenous", "applied")}
    return RealSystem(env, plant, **places | options)


@dataclass(frozen=True)
class Injection:
    """A fault that is injected into some intervals of an episode.

    Args:
        kind: the fault. Of sensors: ``dropped`` leaves the state out, ``late`` waits before the reading, ``frozen``
            holds its first component, ``out_of_range`` and ``nan`` set it. Of actuators: ``stuck_actuator`` holds the
            first action, ``slow_actuator`` lets it follow in part. Of the system: ``raises`` an error, ``ends_early``
            truncates the episode.
        first: first control interval with the fault.
        last: last control interval with the fault; by default the first one alone.
        episode: number of the episode, from 0.
        value: value of ``out_of_range`` in the entry's unit; seconds of ``late``; share of the way to the action that
            ``slow_actuator`` goes in an interval.
    """

    kind: str
    first: int = 8
    last: int | None = None
    episode: int = 1
    value: float = 0.0

    def acts(self, episode, interval):
        last = self.first if self.last is None else self.last
        return self.episode == episode and self.first <= interval <= last


class FaultySystem(AroundSystem):
    """An environment with injected faults.

    Attribute ``injected`` holds the episode, the interval and the kind of every fault so far.
    """

    def __init__(self, env, injections, *, sleep=time.sleep):
        super().__init__(device=env.device, batch_size=env.batch_size)
        self.env, self.injections, self._sleep = env, tuple(injections), sleep
        self._episode, self._count, self.injected = -1, 0, []
        self.action_spec, self.reward_spec = env.action_spec.clone(), env.reward_spec.clone()
        self.done_spec, self.observation_spec = env.full_done_spec.clone(), env.full_observation_spec.clone()

    def _reset(self, tensordict=None, **kwargs):
        self._count, self._sent = 0, None
        found = self.env.reset(**kwargs)
        self._read = found["state"].clone()
        return found

    def begin_window(self):
        self._count = 0

    def _step(self, tensordict):
        self._episode += self._count == 0
        active = {fault.kind: fault for fault in self.injections if fault.acts(self._episode, self._count)}
        self.injected += [(self._episode, self._count, kind) for kind in active]
        if "frozen" in active and active["frozen"].first == self._count:
            self._held = self._read[..., 0]
        self._count += 1
        if "raises" in active:
            raise ConnectionError("no answer (injected)")
        self._sent = self._acted(tensordict["action"].clone(), active)
        found = self.env.step(tensordict.exclude("next").set("action", self._sent.clone()))["next"].copy()
        self._read = found["state"].clone()
        state = found["state"] = found["state"].clone()
        for kind, fault in active.items():
            if kind == "late":
                self._sleep(fault.value)
            elif kind == "ends_early":
                found.update({key: torch.ones_like(found[key]) for key in ("done", "truncated")})
            elif kind in ("frozen", "out_of_range", "nan"):
                state[..., 0] = {"frozen": getattr(self, "_held", None), "nan": torch.nan}.get(kind, fault.value)
        return found.exclude("state") if "dropped" in active else found

    def _acted(self, action, active):
        """What the actuators do of an action."""
        last = action if self._sent is None else self._sent
        if "stuck_actuator" in active:
            action[..., 0] = last[..., 0]
        if "slow_actuator" in active:
            action[..., 0] = last[..., 0] + active["slow_actuator"].value * (action - last)[..., 0]
        return action
