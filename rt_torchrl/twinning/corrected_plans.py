"""Plans on what a policy is expected to cost on the real system, where real episodes contradict the twin."""

import copy
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from rt_torchrl.optimisers.placement import place
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.evidence.paired_differences import REACH
from rt_torchrl.twinning.evidence.real_judge import RealJudge
from rt_torchrl.twinning.extreme_starts import astray
from rt_torchrl.twinning.findings import findings
from rt_torchrl.twinning.planners import Planner
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes

WAYS = 8
"""Number of random directions of the weights, from the best of which a corrected plan begins."""
KNOWN = 0.25
"""Standard deviation of log J_real below which flights say what a policy costs; one that has not flown has 0.5."""
PROMISED = 0.95
"""Share of what the policy is expected to cost, below which a corrected plan must be: each one costs a flight."""
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

    A plan that the twin has just made flies first: there is nothing to correct at a policy of which no flight tells. A
    corrected plan stays if it is expected to cost less than the policy does, by two beliefs: one that takes paired
    differences as they are, and one that limits those by which other policies become cheaper.

    Source: de Avila Ferreira et al., *Real-time optimization of uncertain process systems via modifier adaptation and
    Gaussian processes*, European Control Conference 2018.

    Args:
        planner: planner of step 5, whose cost takes a correction.
        virtual: virtual episodes.

    Raises:
        ValueError: if the planner takes none.
    """

    def __init__(self, planner: Planner, virtual: VirtualEpisodes):
        if not isinstance(planner, Correctable):
            raise ValueError(
                f"corrected_descents=True needs a planner with the attribute correction; {type(planner).__name__} has "
                "none. docs/planner.md says what it does; or leave corrected_descents out."
            )
        self.planner: Correctable = planner
        self.virtual = virtual

    def plan(self, planned_on: Scenario, judged_on: Scenario, judge: RealJudge) -> TensorDict:
        """Make a corrected plan, which stays if it is expected to cost less.

        Returns:
            ``corrected``, whether there was one that stays; nothing without evidence about the policy, or if it costs
            nothing or less, of which there is no ratio.
        """
        policy = self.planner.policy
        usual = self.virtual.price(policy, judged_on).item()
        if not usual > 0.0 or judge.deviation(policy) > KNOWN:
            return findings()
        before, tail = copy.deepcopy(policy.state_dict()), self.virtual.tail(policy, judged_on)
        stays = judge.expected(policy, usual)
        self._go_around(planned_on, judge)
        if self._descended(planned_on, judge):
            cost = self.virtual.price(policy, judged_on).item()
            strays = astray(self.virtual.tail(policy, judged_on), tail, cost=cost, usual=usual)
            if judge.dearest(policy, cost) < PROMISED * stays and not strays:
                return findings(corrected=1.0, plan_accepted=1.0)
        policy.load_state_dict(before)
        self.planner.refuse()
        return findings(corrected=0.0)

    def _descended(self, episodes: Scenario, judge: RealJudge) -> bool:
        """Descend from the present weights; False if the twin diverges with them."""
        self.planner.restart()
        self.planner.correction = judge.factor
        try:
            self.planner.plan(episodes)
        except FloatingPointError:
            return False
        finally:
            self.planner.correction = None
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
        place(min(found, key=lambda each: each[0])[1], weights)


@torch.no_grad()
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
    place(origin, weights)
    first, distance = shares(policy), 1e-3
    for _ in range(STEPS):
        place(origin + distance * way, weights)
        moved = (shares(policy) - first).square().mean().sqrt().item()
        if abs(moved / REACH - 1.0) < NEAR:
            break
        # Actions that saturate move little at first, and then all at once.
        distance *= min(10.0, max(0.1, REACH / moved)) if moved > 0.0 else 10.0
