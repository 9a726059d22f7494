"""A plant whose policies also observe what they observed in the last control intervals."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.policies import SaturatedAffine
from rt_torchrl.plants.shapes import Hidden, Input, Observation, State, Time
from rt_torchrl.plants.signal import Signal

Named = TypeVar("Named", bound=Signal)


class StackedObservations(Extension):
    r"""A plant whose policies observe the present and the last n observations, :math:`(e_k, e_{k-1}, \dots, e_{k-n})`.

    The past observations are states that the controller computes (:attr:`Plant.controller_states`): no sensor gives
    them, an exported controller holds them, and they follow from a log. At t = 0 they are the first observation, also
    in each window of a continuous operation, :math:`e_{-j} = e_0`.

    The suspects of the plant are suspects here. Where a real system has something beside the plant, stack the
    observations of the extended plant, or extend the stacked one; both observe what sensors read.

    Args:
        base: the plant, perhaps extended.
        count: number n of past observations.

    Raises:
        ValueError: if ``count`` is not at least 1, or the plant has a state with the name of a past observation.
    """

    def __init__(self, base: Plant, count: int):
        if count < 1:
            raise ValueError(f"count={count} of past observations must be at least 1.")
        self.count, self._read = count, len(base.readings)
        past = [Signal(symbol=s.symbol, name=s.name, unit=s.unit) for s in _past(base.observations, count)]
        super().__init__(base, past)
        self.states = (*base.readings, *past, *base.states[self._read :])
        self.unread = base.unread
        self.memories = tuple(signal.name for signal in past)
        self.controller_states = (*base.controller_states, *self.memories)
        self.observations = (*base.observations, *_past(base.observations, count))
        self.observed = (*base.observed, *_past(base.observed, count))

    @property
    def own_scheme(self) -> bool:
        """That of the plant: past observations stand still between samples, whatever integrates."""
        return self.base.own_scheme

    # The past observations, which stand behind what sensors read and before what none reads

    def split(self, state: State) -> tuple[Float[Tensor, "*batch n_b"], Hidden]:
        """States of the plant and past observations."""
        n, end = self._read, self._read + self.count * len(self.base.observations)
        return torch.cat([state[..., :n], state[..., end:]], -1), state[..., n:end]

    def joined(self, base: Float[Tensor, "*batch n_b"], hidden: Hidden) -> State:
        return torch.cat([base[..., : self._read], hidden, base[..., self._read :]], -1)

    def observe(self, t: Time, state: State, exogenous: Input) -> Observation:
        """The present observation and the past ones, the latest first."""
        base, past = self.split(state)
        now = self.base.observe(t, base, exogenous)
        first = (t < 0.5 * self.dt).unsqueeze(-1)
        return torch.cat([now, torch.where(first, torch.cat([now] * self.count, -1), past)], -1)

    def memorise(self, t: Time, state: State, exogenous: Input) -> State:
        base, past = self.split(state)
        seen = self.observe(t, state, exogenous)[..., : past.shape[-1]]
        return self.joined(self.base.memorise(t, base, exogenous), seen)

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Hidden:
        """Zeros, in the place of which the first observation is taken at t = 0."""
        zero = torch.zeros_like(base[..., :1])
        return zero.expand(*base.shape[:-1], self.count * len(self.base.observations))

    def at_rest(self, read: Float[Tensor, "*batch n_r"]) -> State:
        return self.joined(self.base.at_rest(read[..., : self._read]), read[..., self._read :])

    def complete_states(self, measured: dict[str, Tensor], exogenous: Tensor, actions: Tensor) -> Tensor:
        """States of the plant from a log, and the observations that follow from them; t is 0 at its first sample."""
        base = self.base.complete_states(measured, exogenous, actions)
        samples = torch.arange(len(base), device=base.device)
        seen = self.base.observe(self.dt * samples[:-1].to(base), base[:-1], exogenous)
        before = samples.unsqueeze(-1) - torch.arange(1, self.count + 1, device=base.device)
        return self.joined(base, seen[before.clamp(min=0)].flatten(-2))

    def controller_start(self, measured: Tensor, exogenous: Tensor) -> Tensor:
        return torch.cat([self.base.controller_start(measured, exogenous), self.rest(measured)], -1)

    # The task, which is that of the plant

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Those of the plant; past observations, which follow from its states, are not compared."""
        scales, n_past = self.base.discrepancy_scales, self.count * len(self.base.observations)
        return (*scales[: self._read], *(math.inf,) * n_past, *scales[self._read :])

    def suspects(self) -> Mapping[str, Plant]:
        return {name: StackedObservations(suspect, self.count) for name, suspect in self.base.suspects().items()}

    def further_suspects(self) -> Mapping[str, Plant]:
        further = self.base.further_suspects()
        return {name: StackedObservations(suspect, self.count) for name, suspect in further.items()}

    def make_policy(self, generator: torch.Generator) -> nn.Module:
        """A saturated affine law of all observations; the plant's own policy knows the present one alone."""
        return SaturatedAffine(len(self.observations), self.actions, generator=generator)


def _past(signals: tuple[Named, ...], count: int) -> list[Named]:
    """The signals of 1 to ``count`` intervals ago, all of one moment together."""
    return [
        replace(signal, symbol=f"({signal.symbol})_{{-{k}}}", name=f"{signal.name}_{k}_ago")
        for k in range(1, count + 1)
        for signal in signals
    ]
