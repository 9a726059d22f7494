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
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extension import FurtherInputs
from rt_torchrl.plants.plant import Transition
from rt_torchrl.plants.shapes import Action, Costs, Input, Inputs, Starts, State, Time
from rt_torchrl.plants.signal import bounds, differences
from rt_torchrl.trajectories.trajectory import Trajectory, whole_cost
from rt_torchrl.trajectories.twin import DigitalTwin

OBSERVATIONS = 64
"""Greatest number of observations of an episode in which actions are compared."""


class Anchored(FurtherInputs):
    """A plant whose interval ends the increments e further; its inputs are those of the plant, and e.

    Args:
        base: the plant of a twin.
    """

    symbol, kind = "e", "increment"

    def step(self, t: Time, state: State, command: Action, exogenous: Input, closure: nn.Module) -> Transition:
        inputs, increments = exogenous[..., : self.count], exogenous[..., self.count :]
        (end, applied), n = self.base.step(t, state, command, inputs, closure), increments.shape[-1]
        return Transition(torch.cat([end[..., :n] + increments, end[..., n:]], -1), applied)


class AnchoredReplays:
    """The anchored replays of whole real episodes on a twin with its present closure.

    Args:
        twin: the twin, whose costs are corrected.
        anchored: the twin of the :class:`Anchored` plant of ``twin.believed``, under its closure.
        records: what was flown, with the states that sensors read.
        inputs: exogenous inputs of each episode to its horizon, which a record that ended early does not reach.
        costs: J_a of each episode as it was measured, which may be of more than what sensors read.
        policy_of: function that gives the policy that flew an episode, by its place among the records.

    Attributes:
        flown: the actions of each of these policies, as :meth:`actions` gives them.
        explored: mean square of the actions that each episode had beside those of its policy, in the same unit.

    Raises:
        DivergenceError: if the believed twin diverges within an interval that begins with what was read.
    """

    def __init__(
        self,
        twin: DigitalTwin,
        anchored: DigitalTwin,
        records: Sequence[Trajectory],
        inputs: Inputs,
        costs: Costs,
        policy_of: Callable[[int], nn.Module],
    ):
        self.twin, self.twin_anchored, believed = twin, anchored, twin.believed
        self.starts: Starts = torch.stack([record.states[0] for record in records])
        self.low, self.high = bounds(twin.plant.actions, device=inputs.device)
        n, increments, counted = inputs.shape[1], [], []
        for record, exogenous in zip(records, inputs, strict=True):
            ends, r = believed.followed(record), record.states.shape[-1]
            missed = differences(twin.plant.readings, record.states[1:], ends[1:, :r])
            increments.append(torch.cat([missed, missed.new_zeros(n - len(missed), r)]))
            full = torch.cat([record.states, ends[:, r:]], -1)[None]
            flight = Trajectory(full, record.actions[None], exogenous[None, : len(missed)])
            counted.append(whole_cost(believed.plant, flight, n))
        self.inputs, self.anchored = inputs, torch.cat([inputs, torch.stack(increments)], -1)
        self.offsets: Costs = _log_ratio(costs, torch.cat(counted))
        self._seen = list[tuple[State, Tensor, Action]]()
        """Some states of each episode, what policies observe there, and the actions that were flown there."""
        for record in records:
            last = len(record.actions) - 1
            at = torch.linspace(0, last, min(last + 1, OBSERVATIONS), device=inputs.device).round().long()
            states, t = twin.plant.at_rest(record.states[at]), record.start + at.double() * twin.plant.dt
            self._seen.append((states, twin.plant.observe(t, states, record.exogenous[at]), record.actions[at]))
        with torch.no_grad():
            self.flown = torch.stack([self.actions(policy_of(k)) for k in range(len(records))])
        counts = [len(actions) for _, _, actions in self._seen]
        applied = self._scaled(torch.cat([actions for _, _, actions in self._seen]))
        deviations = [row.split([n * len(self.low) for n in counts])[k] for k, row in enumerate(self.flown - applied)]
        self.explored: Costs = torch.stack(
            [row.square().sum() * sum(counts) / n for row, n in zip(deviations, counts, strict=True)]
        )

    def latest(self, count: int) -> "AnchoredReplays":
        """Those of the last episodes, at most as many."""
        if count >= len(self.starts):
            return self
        last = copy.copy(self)
        last.starts, last.inputs, last.anchored = (x[-count:] for x in (self.starts, self.inputs, self.anchored))
        last.offsets, last.flown, last.explored = (x[-count:] for x in (self.offsets, self.flown, self.explored))
        return last

    def corrections(self, policy: nn.Module) -> Costs:
        r"""The log :math:`c_i = \log\tilde J_i - \log\hat J_i` of what each anchored replay costs over the twin's own.

        What an episode cost beyond what sensors read of it counts, too. A cost that is not positive has no log, and is
        not corrected.

        Raises:
            DivergenceError: if a replay diverges under the policy.
        """
        rest, alone = self.twin_anchored.plant.at_rest(self.starts), self.twin.plant.at_rest(self.starts)
        anchored = self.twin_anchored.episode_costs(policy, rest, self.anchored)
        return _log_ratio(anchored, self.twin.episode_costs(policy, alone, self.inputs)) + self.offsets

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
