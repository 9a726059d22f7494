"""The clairvoyant optimum: the best commands of a whole episode whose disturbance is known, on the exact model.

No controller costs less: it is the limit that all others are compared with.
"""

import contextlib
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.optimal_control.bounded_descent import BoundedDescentConfig, descend, projected_gradient
from rt_torchrl.optimal_control.command_cost import PENALTY, CommandCost
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.trajectory import Trajectory, control_cost
from rt_torchrl.trajectories.twin import constant


class Clairvoyant(NamedTuple):
    """The best commands that were found, and the evidence that they are an optimum.

    Args:
        costs: J_a of each episode under its best commands, without the penalty.
        flown: the episodes.
        gradient: norm of the projected gradient of J_a of each episode, by commands in units of their ranges.
        excess: greatest distance of a command from the action that was applied, in units of its range.
        start_costs: J_a of each episode at the end of the descent from each start, by name.
        gradients: number of gradients of all episodes together.
    """

    costs: Float[Tensor, " batch"]
    flown: Trajectory
    gradient: Float[Tensor, " batch"]
    excess: float
    start_costs: dict[str, Float[Tensor, " batch"]]
    gradients: int

    def spread(self) -> dict[str, float]:
        """Mean J_a of each start over that of the best commands of each episode, minus one."""
        best = self.costs.mean()
        return {name: (costs.mean() / best - 1.0).item() for name, costs in self.start_costs.items()}


def clairvoyant(
    plant: Plant,
    initial_state: Float[Tensor, "batch n_s"],
    exogenous: Float[Tensor, "batch n n_z"],
    starts: Mapping[str, Float[Tensor, "batch n n_a"]],
    *,
    closure: nn.Module | None = None,
    hold: int = 1,
    penalty: float = PENALTY,
    config: BoundedDescentConfig | None = None,
) -> Clairvoyant:
    """Descend the costs of episodes by all their commands, from several starts.

    The episodes are one problem of L-BFGS-B, because the lanes of the machine code then carry one episode each.

    Args:
        plant: the plant.
        initial_state: initial states of the episodes.
        exogenous: exogenous inputs of the episodes, all known.
        starts: commands from which a descent starts, by name; see :func:`constant_starts` and :func:`random_starts`.
        closure: closure of the system; None for the plant's own.
        hold: number of control intervals for which a command is held.
        penalty: weight of (command − applied)² over the squared range, in units of L_a.
        config: parameters of the descents.

    Raises:
        ValueError: if there is no start.
        DivergenceError: if the plant diverges from every start.
    """
    if not starts:
        raise ValueError("starts is empty; name at least one, such as the commands of a classical controller.")
    closure = constant(plant.closure if closure is None else closure)
    cost = CommandCost(plant, closure, hold=hold, penalty=penalty, terminal=plant.terminal_cost)
    cost.begin(initial_state, exogenous)
    system, n, gradients = Rollout(plant, closure), exogenous.shape[1], 0
    points: dict[str, np.ndarray] = {}
    costs = {name: torch.full((len(initial_state),), torch.inf, dtype=torch.float64) for name in starts}
    for name, commands in starts.items():
        # A start from which the plant diverges keeps its infinite cost.
        with contextlib.suppress(FloatingPointError):
            found = descend(partial(_together, cost), cost.units(commands), config or BoundedDescentConfig())
            points[name], gradients = found.point, gradients + found.evaluations
            costs[name] = system.costs(initial_state, exogenous, cost.commands(found.point, n))
    if not points:
        raise DivergenceError(f"plant {plant.name!r} diverges from every start: {', '.join(starts)}.")
    best = _best_of_each(costs, points)
    flown = system(initial_state, exogenous, cost.commands(best, n))
    low, high = bounds(plant.actions)
    excess = ((cost.commands(best, n) - flown.actions) / (high - low)).abs().max().item()
    slope = torch.from_numpy(projected_gradient(best, cost(best)[1]))
    return Clairvoyant(control_cost(plant, flown), flown, slope, excess, costs, gradients)


def constant_starts(plant: Plant, batch: int, n: int) -> dict[str, Float[Tensor, "{batch} {n} n_a"]]:
    """Constant commands at a quarter, the middle and three quarters of all ranges."""
    low, high = bounds(plant.actions)
    return {f"constant {share:g}": (low + share * (high - low)).expand(batch, n, -1) for share in (0.25, 0.5, 0.75)}


def random_starts(
    plant: Plant, batch: int, n: int, *, generator: torch.Generator, count: int = 1
) -> dict[str, Float[Tensor, "{batch} {n} n_a"]]:
    """Commands that are uniform on the ranges, drawn for every interval."""
    low, high = bounds(plant.actions)
    draws = (torch.rand(batch, n, len(plant.actions), generator=generator, dtype=torch.float64) for _ in range(count))
    return {f"random {k}": low + (high - low) * draw for k, draw in enumerate(draws)}


def _together(cost: CommandCost, point: np.ndarray) -> tuple[float, np.ndarray]:
    costs, gradient = cost(point)
    return float(costs.mean()), gradient / len(costs)


def _best_of_each(costs: Mapping[str, Tensor], points: Mapping[str, np.ndarray]) -> np.ndarray:
    """The best commands of each episode."""
    names = list(points)
    chosen = torch.stack([costs[name] for name in names]).argmin(0).tolist()
    return np.stack([points[names[start]][episode] for episode, start in enumerate(chosen)])
