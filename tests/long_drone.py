"""The gradient of many long flights of the drone by wind and policy, in a process of its own: its time and memory."""

import json
import resource
import sys
import time

import torch
from torch import nn

from rt_torchrl import Rollout
from rt_torchrl.envs.flapping_wing.plant import FlappingWing

STEP = 1e-6


def main(realisations, n_steps):
    """Wall time [s], peak memory [GiB], and the gradient's slope along a direction beside its central difference."""
    plant, generator = FlappingWing(horizon=5e-4 * n_steps), torch.Generator().manual_seed(1)
    policy = plant.make_policy(generator)
    rollout = Rollout(plant, plant.closure, policy, engine="native")
    state, wind = plant.draw_initial_state(realisations, generator), plant.draw_exogenous(realisations, generator)
    weights = list(policy.parameters())
    rollout.costs(state, wind[:, :1]).mean().backward()  # makes the program
    start = time.perf_counter()
    by_wind, *by_weights = torch.autograd.grad(rollout.costs(state, wind.requires_grad_()).mean(), [wind, *weights])
    seconds = time.perf_counter() - start
    unit = 2**30 if sys.platform == "darwin" else 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    wind.requires_grad_(False)
    turned = [torch.randn(w.shape, generator=generator, dtype=torch.float64) for w in weights]
    slope = by_wind.sum() + sum((g * d).sum() for g, d in zip(by_weights, turned, strict=True))
    return {
        "seconds": seconds,
        "peak": peak,
        "slope": slope.item(),
        "difference": difference(rollout, state, wind, weights, turned),
    }


@torch.no_grad()
def difference(rollout, state, wind, weights, turned):
    """Central difference of the mean cost, with all winds raised and the weights moved along a direction."""
    first, direction = (nn.utils.parameters_to_vector(x) for x in (weights, turned))
    costs = []
    for sign in (1.0, -1.0):
        nn.utils.vector_to_parameters(first + sign * STEP * direction, weights)
        wind += sign * STEP
        costs.append(rollout.costs(state, wind).mean().item())
        wind -= sign * STEP
    return (costs[0] - costs[1]) / (2 * STEP)


if __name__ == "__main__":
    print(json.dumps(main(*map(int, sys.argv[1:]))))
