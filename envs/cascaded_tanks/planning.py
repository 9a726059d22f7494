"""A controller of the level, planned on twins that are drawn from the uncertainty of an identification."""

from collections.abc import Sequence

import torch
from torch import nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.policies import SaturatedMLP
from rt_torchrl.trajectories.rollout import Rollout

VIRTUAL, UNSEEN = 20, 100
"""Numbers of virtual episodes that a plan is made on, and judged on."""


def planned_under_uncertainty(
    plant: Plant, closures: Sequence[nn.Module], *, iterations: int, seed: int = 0
) -> dict[str, float]:
    """Plan a perceptron on the mean cost over twins, and judge it on each of them with other episodes.

    Args:
        plant: the tanks.
        closures: the identified closure first, then those drawn from its uncertainty.
        iterations: gradients of L-BFGS.
        seed: seed of the policy's weights and of all episodes.

    Returns:
        J_a of the policy before and after, with the identified closure and with the worst of all.
    """
    generator = torch.Generator().manual_seed(seed)
    policy = SaturatedMLP(len(plant.observations), plant.actions, hidden=(16, 16), generator=generator)
    rollouts = [Rollout(plant, closure.requires_grad_(False), policy) for closure in closures]
    drawn = [(plant.draw_initial_state(n, generator), plant.draw_exogenous(n, generator)) for n in (VIRTUAL, UNSEEN)]

    def costs(which: int) -> torch.Tensor:
        return torch.stack([rollout.costs(*drawn[which]).mean() for rollout in rollouts])

    before = costs(1).detach()
    optimiser = torch.optim.LBFGS(policy.parameters(), max_iter=iterations, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        cost = costs(0).mean()
        cost.backward()
        return cost

    optimiser.step(closure)
    after = costs(1).detach()
    return {
        "J_a before [V^2]": before[0].item(),
        "J_a after [V^2]": after[0].item(),
        "J_a after, worst twin [V^2]": after.max().item(),
        "J_a after, least twin [V^2]": after.min().item(),
    }
