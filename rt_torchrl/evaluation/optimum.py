"""The best policy of a class on the true plant."""

import copy
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from rt_torchrl.evaluation.unseen import UNSEEN_SEED, UnseenEpisodes
from rt_torchrl.optimisers.descent import Descent, DescentConfig
from rt_torchrl.optimisers.levenberg_marquardt import place
from rt_torchrl.trajectories.rollout import DivergenceError

SMALL_STEPS = tuple(DescentConfig(rate=rate, gradient_limit=0.1) for rate in (0.02, 0.005))
"""Adam's options, beside β₂ = 0.99, of the two halves of an approach."""
TO_THE_END = DescentConfig(optimiser="lbfgs", rate=1.0)
FOR_PERCEPTRONS = {"approach": 600, "iterations": 300, "polish": 150}
"""Numbers of gradients with which three starts of a small perceptron end within 3 % of each other."""
DIRECT = 20
"""Greatest number of weights that are also searched without gradients."""
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
    iterations: int | None = None,
    few: int = 10,
    polish: int | None = None,
    approach: int | None = None,
    seed: int = UNSEEN_SEED,
) -> Optimum:
    """The best policy of a class, found on the *true* plant and on the unseen episodes themselves.

    Every start descends by exact gradients on a few episodes, because a gradient over a hundred episodes takes ten
    times as long and has the same direction as one over ten. The best start goes on with all episodes. Up to twenty
    weights are then searched by the simplex of Nelder and Mead, from the best two: exact gradients stay in the next
    poor minimum of a plant with rate limits, play or stiction.

    Args:
        unseen: the unseen episodes.
        make_policy: function that draws a random policy of the class.
        starts: number of random initial policies.
        iterations: gradients of L-BFGS from each start, on the first ``few`` episodes; by default 80, or 300 for more
            than twenty weights.
        few: number of episodes on which every start descends.
        polish: gradients of the best start, on all episodes; by default 20, or 150 for more than twenty weights.
        approach: gradients of Adam from each start before those of L-BFGS; by default none, or 600 for more than twenty
            weights. L-BFGS alone takes perceptrons to the next poor minimum.
        seed: seed of the initial weights.
    """
    generator = torch.Generator(device=unseen.initial_state.device).manual_seed(seed)

    def descend(policy: nn.Module, count: int, steps: int, *, approaching: int = 0) -> float:
        rollout = unseen.rollout(policy)
        state, exogenous = unseen.initial_state[:count], unseen.exogenous[:count]

        def cost() -> Tensor:
            return rollout.costs(state, exogenous).mean()

        for config in SMALL_STEPS if approaching else ():
            Descent(policy, config, second_moment=0.99).run(cost, approaching // 2)
        return Descent(policy, TO_THE_END).run(cost, steps).best

    policies = [make_policy(generator).to(unseen.initial_state.device) for _ in range(starts)]
    count = sum(weight.numel() for weight in policies[0].parameters() if weight.requires_grad)
    usual = FOR_PERCEPTRONS if count > DIRECT else FOR_FEW_WEIGHTS
    requested = {"approach": approach, "iterations": iterations, "polish": polish}
    effort = {name: usual[name] if number is None else number for name, number in requested.items()}
    costs = [descend(policy, few, effort["iterations"], approaching=effort["approach"]) for policy in policies]
    best, *others = (policies[k] for k in sorted(range(starts), key=costs.__getitem__))
    by_gradients = descend(best, len(unseen.initial_state), effort["polish"])
    candidates = [(by_gradients, best)]
    if 0 < count <= DIRECT:
        for policy in (copy.deepcopy(best), *others[:1]):
            by_simplex(unseen.first(few), policy, count * ENOUGH, size=0.3)
            candidates.append((by_simplex(unseen, policy, count * POLISH, size=0.05), policy))
    return Optimum(*min(candidates, key=lambda pair: pair[0]), costs, by_gradients)


def by_simplex(unseen: UnseenEpisodes, policy: nn.Module, count: int, *, size: float) -> float:
    """Search the weights of a policy without gradients; it gets the best ones.

    Args:
        unseen: the episodes, whose mean J_a is searched.
        policy: the policy.
        count: greatest number of costs.
        size: size of the first simplex, as a share of each weight.
    """
    from scipy.optimize import minimize  # here, because the options of a recipe need not wait for it

    weights = [weight for weight in policy.parameters() if weight.requires_grad]
    start = parameters_to_vector(weights).detach()
    scale, rollout = size * start.abs().clamp_min(0.1), unseen.rollout(policy)

    @torch.no_grad()
    def cost(shares: np.ndarray) -> float:
        place(start + scale * torch.as_tensor(shares, device=start.device), weights)
        try:
            value = rollout.costs(unseen.initial_state, unseen.exogenous).mean().item()
        except DivergenceError:
            return math.inf
        return value if math.isfinite(value) else math.inf

    simplex = np.concatenate([np.zeros((1, len(start))), np.eye(len(start))])
    options = {"maxfev": count, "initial_simplex": simplex, "adaptive": True, "xatol": 1e-6, "fatol": 1e-12}
    minimum = minimize(cost, simplex[0], method="Nelder-Mead", options=options)
    return cost(minimum.x)
