"""The best policy of a class on the true plant."""

import contextlib
import copy
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from rt_torchrl.evaluation.unseen import UNSEEN_SEED, UnseenEpisodes
from rt_torchrl.optimisers.descent import Descent, DescentConfig
from rt_torchrl.optimisers.simplex import by_simplex, searched
from rt_torchrl.trajectories.rollout import DivergenceError

SMALL_STEPS = tuple(DescentConfig(rate=rate, gradient_limit=0.1) for rate in (0.02, 0.005))
"""Adam's options, beside β₂ = 0.99, of the two halves of an approach."""
TO_THE_END = DescentConfig(optimiser="lbfgs", rate=1.0)
FOR_PERCEPTRONS = {"approach": 600, "iterations": 300, "polish": 150}
"""Numbers of gradients with which three starts of a small perceptron end within 3 % of each other."""
FOR_FEW_WEIGHTS = {"approach": 0, "iterations": 80, "polish": 20}
"""Numbers of gradients of a policy with no more weights."""
ENOUGH, POLISH = 80, 20
"""Numbers of costs for each weight of that search, on a few episodes and on all."""


class Optimum(NamedTuple):
    """Best mean J_a found, its policy, the cost that each start reached on the first few episodes, and by gradients.

    ``by_gradients`` is the mean J_a that exact gradients reach alone. It is greater where the plant is not smooth.
    """

    cost: float
    policy: nn.Module
    costs: list[float]
    by_gradients: float


def exact_optimum(
    unseen: UnseenEpisodes,
    make_policy: Callable[[torch.Generator], nn.Module],
    *,
    starts: int = 3,
    few: int = 10,
    **gradients: int,
) -> Optimum:
    """The best policy of a class, found on the *true* plant and on the unseen episodes themselves.

    Every start descends by exact gradients on a few episodes, because a gradient over a hundred episodes takes ten
    times as long and has the same direction as one over ten. The best start goes on with all episodes. Few weights are
    then searched by the simplex of Nelder and Mead, from the best two: exact gradients stay in the next poor minimum of
    a plant with rate limits, play or stiction. Where episodes may end early, which gradients do not see, so are the
    output layers of policies with more weights.

    Args:
        unseen: the unseen episodes.
        make_policy: function that draws a random policy of the class.
        starts: number of random initial policies.
        few: number of episodes on which every start descends.
        gradients: other numbers of gradients than those of ``FOR_FEW_WEIGHTS`` and ``FOR_PERCEPTRONS``: ``approach`` by
            Adam from each start, because L-BFGS alone takes perceptrons to the next poor minimum, ``iterations`` by
            L-BFGS after these, and ``polish`` from the best start on all episodes.

    Raises:
        DivergenceError: if the plant diverges under every initial policy.
    """
    generator = torch.Generator(device=unseen.initial_state.device).manual_seed(UNSEEN_SEED)

    def cost_of(policy: nn.Module, count: int | None = None) -> Callable[[], Tensor]:
        rollout, state, exogenous = unseen.rollout(policy), unseen.initial_state[:count], unseen.exogenous[:count]
        return lambda: rollout.costs(state, exogenous).mean()

    def descend(policy: nn.Module, count: int, steps: int, *, approaching: int = 0) -> float:
        cost = cost_of(policy, count)
        with contextlib.suppress(FloatingPointError):  # the plant diverges at this start, and may not at others
            for config in SMALL_STEPS if approaching else ():
                Descent(policy, config, second_moment=0.99).run(cost, approaching // 2)
            return Descent(policy, TO_THE_END).run(cost, steps).best
        return math.inf

    policies = [make_policy(generator).to(unseen.initial_state.device) for _ in range(starts)]
    trained = [weight for weight in policies[0].parameters() if weight.requires_grad]
    all_searched = len(searched(policies[0])) == len(trained)
    usual = FOR_FEW_WEIGHTS if all_searched else FOR_PERCEPTRONS
    if unknown := gradients.keys() - usual.keys():
        raise TypeError(f"{', '.join(sorted(unknown))} of the optimum must be some of {', '.join(usual)}.")
    effort = usual | gradients
    costs = [descend(policy, few, effort["iterations"], approaching=effort["approach"]) for policy in policies]
    sound = [k for k in sorted(range(starts), key=costs.__getitem__) if math.isfinite(costs[k])]
    if not sound:
        raise DivergenceError(f"plant {unseen.plant.name!r} diverges under each of the {starts} first policies.")
    best, *others = (policies[k] for k in sound)
    by_gradients = descend(best, len(unseen.initial_state), effort["polish"])
    candidates = [(by_gradients, best)]
    if searched(best) and (all_searched or unseen.plant.end_cost is not None):
        for policy in (copy.deepcopy(best), *others[:1]):
            weights = searched(policy)
            by_simplex(weights, cost_of(policy, few), ENOUGH, size=0.3)
            candidates.append((by_simplex(weights, cost_of(policy), POLISH, size=0.05), policy))
    return Optimum(*min(candidates, key=lambda pair: pair[0]), costs, by_gradients)
