r"""Anchored replays: virtual episodes that begin as real ones were, with what the twin did not explain added to them.

A real episode with the actions a and the inputs z leaves the increments

.. math:: e_k = s_{k+1} - \Phi(s_k, a_k, z_k; w_p)

to the twin. Added to a virtual episode from the same start under the same inputs,

.. math:: \tilde s_{k+1} = \Phi(\tilde s_k, \pi(\tilde s_k), z_k; w_p) + e_k

they make it the real episode if the policy takes the actions that were flown, whatever the twin lacks. Near them the
replay says to first order how the real system answers, by the twin's Jacobians along the *real* states.

Sources: iterative learning control (Bristow, Tharayil, Alleyne, IEEE Control Systems 26 (2006) 96); gradients of a
model along real trajectories (Abbeel, Quigley, Ng, ICML 2006).
"""

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant, Transition
from rt_torchrl.plants.shapes import Action, Costs, Input, Inputs, Starts, State, Time
from rt_torchrl.plants.signal import Signal, bounds, differences
from rt_torchrl.trajectories.trajectory import Trajectory, control_cost
from rt_torchrl.trajectories.twin import DigitalTwin

OBSERVATIONS = 64
"""Greatest number of observations of an episode in which actions are compared."""


class _Driven(Extension):
    """A plant with further inputs, after its own, which only the map of an interval reads; one for each reading.

    Args:
        base: the plant of a twin.
    """

    own_scheme = True
    """What is added to an interval as a whole has no vector field."""
    further = ""
    """What the further inputs are."""

    def __init__(self, base: Plant):
        super().__init__(base, [])
        self.count = len(base.inputs)
        added = [Signal(symbol="e", name=f"{self.further}_{signal.name}", unit=signal.unit) for signal in base.readings]
        self.inputs = (*base.inputs, *added)

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        return self.base.vector_field(t, state, action, exogenous[..., : self.count], closure)

    def ask(self, part: str, method: str, given: dict[str, Any]) -> Any:
        if "exogenous" in given:
            given["exogenous"] = given["exogenous"][..., : self.count]
        return super().ask(part, method, given)


class Anchored(_Driven):
    """A plant whose interval ends the increments e further; its inputs are those of the plant, and e."""

    further = "increment"

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        met, increments = exogenous[..., : self.count], exogenous[..., self.count :]
        end, n = self.base.advance(t, state, applied, met, closure), increments.shape[-1]
        return torch.cat([end[..., :n] + increments, end[..., n:]], -1)


class Followed(_Driven):
    """A plant whose intervals begin with the states that sensors have read; hidden states follow from them."""

    further = "measured"

    def step(self, t: Time, state: State, command: Action, exogenous: Input, closure: nn.Module) -> Transition:
        met, measured = exogenous[..., : self.count], exogenous[..., self.count :]
        began = torch.cat([measured, state[..., measured.shape[-1] :]], -1)
        return self.base.step(t, began, command, met, closure)


class AnchoredTwin:
    """A twin beside itself with increments, and with the states that sensors have read.

    Args:
        twin: the twin; of an ensemble the believed one.
    """

    def __init__(self, twin: DigitalTwin):
        self.twin, self.anchored, self.followed = twin, twin.of(Anchored(twin.plant)), twin.of(Followed(twin.plant))


class AnchoredReplays:
    """The anchored replays of whole real episodes on a twin with its present closure.

    Args:
        twins: the twin.
        records: what was flown, with the states that sensors read.
        inputs: exogenous inputs of each episode to its horizon, which a record that ended early does not reach.
        costs: J_a of each episode as it was measured, which may be of more than what sensors read.
        policies: what flew each episode.

    Attributes:
        flown: the actions of each of these policies, as :meth:`actions` gives them.
        explored: mean square of the actions that each episode had beside those of its policy, in the same unit.
    """

    def __init__(
        self,
        twins: AnchoredTwin,
        records: Sequence[Trajectory],
        inputs: Inputs,
        costs: Costs,
        policies: Sequence[nn.Module],
    ):
        self.twins, self.twin, plant = twins, twins.twin, twins.twin.plant
        self.start: Starts = plant.at_rest(torch.stack([record.states[0] for record in records]))
        self.low, self.high = bounds(plant.actions, device=inputs.device)
        n, increments, counted = inputs.shape[1], [], []
        for record, met in zip(records, inputs, strict=True):
            states, missed = self._followed(record)
            increments.append(torch.cat([missed, missed.new_zeros(n - len(missed), missed.shape[-1])]))
            rest = n - len(record.actions)  # the state in which it ended early
            states, actions = (torch.cat([x, x[-1:].expand(rest, -1)]) for x in (states, record.actions))
            counted.append(control_cost(plant, Trajectory(states[None], actions[None], met[None])))
        self.inputs, self.anchored = inputs, torch.cat([inputs, torch.stack(increments)], -1)
        self.offsets: Costs = _log_ratio(costs, torch.cat(counted))
        self._seen = [self._observed(record) for record in records]
        with torch.no_grad():
            self.flown = torch.stack([self.actions(policy) for policy in policies])
            applied = torch.cat([actions for _, _, actions in self._seen])
            beside = self.flown - self._scaled(applied)
        counts = [len(actions) for _, _, actions in self._seen]
        own = [rows.split([n * applied.shape[-1] for n in counts])[k] for k, rows in enumerate(beside)]
        self.explored: Costs = torch.stack(
            [row.square().sum() * len(applied) / n for row, n in zip(own, counts, strict=True)]
        )

    def latest(self, count: int) -> "AnchoredReplays":
        """Those of the last episodes, at most as many."""
        if count >= len(self.start):
            return self
        found = copy.copy(self)
        found.start, found.inputs, found.anchored = (x[-count:] for x in (self.start, self.inputs, self.anchored))
        found.offsets, found.flown, found.explored = (x[-count:] for x in (self.offsets, self.flown, self.explored))
        return found

    @torch.no_grad()
    def _followed(self, record: Trajectory) -> tuple[State, Float[Tensor, "n n_r"]]:
        """The states of an episode, hidden ones as the twin has them, and what the twin does not explain of each."""
        plant, read = self.twin.plant, record.states
        driven = torch.cat([record.exogenous, read[:-1]], -1)
        begins, rows = plant.at_rest(read[:1]), (driven[None], record.actions[None])
        flown = self.twins.followed.replay(begins, *rows, start=record.start).states[0]
        r = read.shape[-1]
        return torch.cat([read, flown[:, r:]], -1), differences(plant.readings, read[1:], flown[1:, :r])

    def _observed(self, record: Trajectory) -> tuple[State, Tensor, Action]:
        """Some states of an episode, what policies observe there, and the actions that were flown there."""
        plant, n = self.twin.plant, len(record.actions)
        at = torch.linspace(0, n - 1, min(n, OBSERVATIONS), device=record.states.device).round().long()
        states = record.states[at]
        t = record.start + at.double() * plant.dt
        hidden = plant.at_rest(states)
        return hidden, plant.observe(t, hidden, record.exogenous[at]), record.actions[at]

    def corrections(self, policy: nn.Module) -> Costs:
        r"""The log :math:`c_i = \log\tilde J_i - \log\hat J_i` of what each anchored replay costs over the twin's own.

        What an episode cost beyond what sensors read of it counts, too. A cost that is not positive has no log, and is
        not corrected.

        Raises:
            DivergenceError: if a replay diverges under the policy.
        """
        anchored = self.twins.anchored.episode_costs(policy, self.start, self.anchored)
        return _log_ratio(anchored, self.twin.episode_costs(policy, self.start, self.inputs)) + self.offsets

    def actions(self, policy: nn.Module) -> Float[Tensor, " m"]:
        """A policy's actions in some observations of the episodes, of which the squared difference is the mean square.

        They are those that the actuators make of its commands, in shares of half their ranges.
        """
        states, observed = (torch.cat(parts) for parts in list(zip(*self._seen, strict=True))[:2])
        return self._scaled(self.twin.plant.actuate(states, policy(observed)))

    def distances(self) -> Float[Tensor, "episodes episodes"]:
        """Mean square of the difference between the actions of what flew each two episodes."""
        return (self.flown.unsqueeze(1) - self.flown).square().sum(-1)

    def _scaled(self, actions: Float[Tensor, "k n_a"]) -> Float[Tensor, " m"]:
        return (2.0 * actions / (self.high - self.low)).flatten() / math.sqrt(len(actions))


def _log_ratio(costs: Costs, others: Costs) -> Costs:
    """The log of the ratio of costs, zero where one is not positive."""
    positive = (costs > 0.0) & (others > 0.0)
    return torch.where(positive, costs, 1.0).log() - torch.where(positive, others, 1.0).log()
