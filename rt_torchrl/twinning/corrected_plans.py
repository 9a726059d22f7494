"""Plans on what a policy is expected to cost on the real system, where real episodes contradict the twin."""

import copy
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.evidence.paired_differences import REACH
from rt_torchrl.twinning.evidence.real_judge import RealJudge
from rt_torchrl.twinning.extreme_starts import astray
from rt_torchrl.twinning.findings import findings
from rt_torchrl.twinning.planners import Planner
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes

WAYS = 8
"""Number of random directions of the weights, from the best of which a corrected plan begins."""
STEPS = 12
"""Greatest number of trials of the distance along a direction."""
NEAR = 0.2
"""Share by which the change of the actions may differ from what is wanted."""


@runtime_checkable
class Correctable(Planner, Protocol):
    """A planner whose cost takes a correction.

    The attribute ``correction`` is a function of a policy, whose value multiplies the policy's cost on the twin in the
    descents, or None.
    """

    correction: Callable[[nn.Module], Tensor] | None


class CorrectedPlans:
    r"""Descends the cost of the twin, corrected by what real episodes have shown: :math:`\hat J(w)e^{m(w) + s^2(w)/2}`.

    m and s are mean and deviation of a Gaussian process of paired differences over the actions of policies, so that a
    few weights and many are the same to it. :math:`e^{s^2/2}` is the trust region: what differs from all that has flown
    counts as dearer. At weights that have flown, m has no slope, and at an optimum on the twin the cost has none
    either. A descent therefore begins at the best of a few weights that lie around, within reach of the evidence.

    A plan stays if it is expected to cost less than the policy does, by a belief that takes paired differences as they
    are and by one that limits them: whichever is dearer.

    Source: de Avila Ferreira et al., *Real-time optimization of uncertain process systems via modifier adaptation and
    Gaussian processes*, European Control Conference 2018.

    Args:
        planner: planner of step 5; one without the attribute ``correction`` makes no corrected plans.
        virtual: virtual episodes.
    """

    def __init__(self, planner: Planner, virtual: VirtualEpisodes):
        self.planner, self.virtual = planner, virtual

    def plan(self, planned_on: Scenario, judged_on: Scenario, judge: RealJudge | None) -> TensorDict:
        """Make a corrected plan, which stays if it is expected to cost less.

        Returns:
            ``corrected``, whether there was one that stays; nothing without evidence, or if the planner makes none.
        """
        planner, policy = self.planner, self.planner.policy
        if judge is None or not isinstance(planner, Correctable) or isinstance(policy, StateFeedback):
            return findings()
        before, tail = copy.deepcopy(policy.state_dict()), self.virtual.tail(policy, judged_on)
        usual = self.virtual.price(policy, judged_on).item()
        stays = judge.expected(policy, usual)
        self._go_around(planned_on, judge)
        if self._descended(planner, planned_on, judge):
            cost = self.virtual.price(policy, judged_on).item()
            strays = astray(self.virtual.tail(policy, judged_on), tail, cost=cost, usual=usual)
            if judge.dearest(policy, cost) < stays and not strays:
                return findings(corrected=1.0, plan_accepted=1.0)
        policy.load_state_dict(before)
        planner.refuse()
        return findings(corrected=0.0)

    @staticmethod
    def _descended(planner: Correctable, episodes: Scenario, judge: RealJudge) -> bool:
        """Descend from the present weights; False if the twin diverges with them."""
        planner.restart()
        planner.correction = judge.factor
        try:
            planner.plan(episodes)
        except FloatingPointError:
            return False
        finally:
            planner.correction = None
        return True

    @torch.no_grad()
    def _go_around(self, episodes: Scenario, judge: RealJudge) -> None:
        """Give the policy the best of its present weights and of some at the edge of what its flights tell."""
        policy, generator = self.planner.policy, self.virtual.generator
        weights = [w for w in policy.parameters() if w.requires_grad]
        origin = parameters_to_vector(weights).clone()
        found = []
        for k in range(WAYS + 1):
            if k:
                way = torch.randn(origin.shape, generator=generator, dtype=origin.dtype, device=origin.device)
                go(policy, weights, origin, way, judge.shares)
            cost = self.virtual.price(policy, episodes).item() * judge.factor(policy).item()
            found.append((cost, parameters_to_vector(weights).clone()))
        vector_to_parameters(min(found, key=lambda each: each[0])[1], weights)


def go(
    policy: nn.Module,
    weights: list[nn.Parameter],
    origin: Tensor,
    way: Tensor,
    shares: Callable[[nn.Module], Tensor],
) -> None:
    """Move weights along a way until the actions have changed by ``REACH``; as near as that comes, if they do not.

    Args:
        policy: policy with these weights.
        weights: the weights, updated in place.
        origin: their values at first, in one vector.
        way: direction.
        shares: function that gives the actions of a policy, in shares of half their ranges.
    """
    vector_to_parameters(origin, weights)
    first, distance = shares(policy), 1e-3
    for _ in range(STEPS):
        vector_to_parameters(origin + distance * way, weights)
        moved = (shares(policy) - first).square().mean().sqrt().item()
        if abs(moved / REACH - 1.0) < NEAR:
            break
        # Actions that saturate move little at first, and then all at once.
        distance *= min(10.0, max(0.1, REACH / moved)) if moved > 0.0 else 10.0
