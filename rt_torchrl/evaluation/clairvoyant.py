r"""The clairvoyant optimum: the best commands of a whole episode whose disturbance is known, on the exact model.

No controller costs less: it is the limit that all others are compared with.

Commands that actuators with rate limits cannot follow at once descend another cost, which ends where they can:

.. math::
    J(u) = \frac1N\sum_{k<N}\Big(L_a(t_k, s_k, c_k, z_k) + w\sum_i\big(v_{k,i} - \Pi_{k,i}(v)\big)^2\Big)
        + \frac{V(s_N)}{N\Delta t}, \qquad v_k = c_k + \mu_k

The actuators of this model apply every command c, and what a real one would hold back is charged: Π is the action that
it applies instead, and differences count in units of the range. Unlike the cost behind a clamp, this one has a
continuous gradient: with a clamp, commands at the edge of its window have one slope inside and another outside, and a
descent ends there. After each descent the shifts μ become the differences v − Π(v), so that 2wμ are the multipliers of
an augmented Lagrangian, and the commands come to be such that real actuators follow them.

Source: Rockafellar, Math. Programming 5 (1973) 354, for constraints by a projection.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.control.command_cost import (
    BoundedDescentConfig,
    CommandCost,
    PenalisedInterval,
    Plans,
    TerminalCost,
    descend,
    projected_gradient,
)
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Actions, Costs, Inputs, Starts, State
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.engines.interval import Drive
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory, control_cost
from rt_torchrl.trajectories.twin import constant

DESCENTS = 20
"""Greatest number of descents that follow each other where actuators hold commands back."""
FOLLOWED = 1e-6
"""Distance of a command from the action that is applied, in units of its range, below which it is followed."""
DRAWN_IN = 0.25
"""Share of the way to their mean over the episode that commands go before they descend again."""
FIRST_WEIGHT = 0.1
"""Weight w of the first descent, in units of L_a."""


class RelaxedInterval(PenalisedInterval):
    """A control interval whose state (s, J) sums L_a and the charge; its exogenous inputs are (z, μ)."""

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """State and cost, (s, J), at the end of the interval."""
        n_z, s, command = len(self.plant.inputs), state[..., :-1], self.low + self.span * drive.command
        z, shifted = drive.exogenous[..., :n_z], command + self.span * drive.exogenous[..., n_z:]
        excess = ((shifted - self.plant.actuate(s, shifted)) / self.span).square().sum(-1)
        cost = self.plant.running_cost(drive.t, s, command, z) + self.penalty * excess
        memorised = self.plant.memorise(drive.t, s, z)
        end = self.plant.latch(self.plant.advance(drive.t, memorised, command, z, self.closure), command)
        return torch.cat([end, (state[..., -1] + cost).unsqueeze(-1)], -1)


class RelaxedCost(CommandCost):
    """J of commands that the model applies at once, with its gradient; :meth:`charge` goes on to the next descent.

    The plant must become machine code (:attr:`CommandCost.traced`).

    Args:
        plant: the physics.
        closure: closure of the system.
        terminal: cost V after the window; None for none.

    Raises:
        ValueError: if :class:`CommandCost` refuses them.
    """

    def __init__(self, plant: Plant, closure: nn.Module, *, terminal: TerminalCost | None = None):
        super().__init__(plant, closure, terminal=terminal)
        self.closure, self.interval = closure, RelaxedInterval(plant, closure, FIRST_WEIGHT)

    def begin(self, initial_state: Starts, exogenous: Inputs, *, start: float = 0.0) -> None:
        """Set the window, without shifts; see :meth:`CommandCost.begin`."""
        self._n_z, self._charged = exogenous.shape[-1], False
        super().begin(initial_state, torch.nn.functional.pad(exogenous, (0, len(self.plant.actions))), start=start)

    def charge(self, unit: Plans, weight: float) -> None:
        """Charge what is held back by a new weight w; the shifts become the differences v − Π(v) under some commands.

        Without shifts of an earlier charge they stay zero.

        Args:
            unit: commands in [0, 1], such as those where a descent ended.
            weight: new weight w, in units of L_a.
        """
        z, shifts = self._drive.exogenous.transpose(0, 1).split([self._n_z, len(self.plant.actions)], -1)
        if self._charged:
            shifts = self._differences(unit, shifts) * (self.interval.penalty.item() / weight)
        with torch.no_grad():
            self.interval.penalty.fill_(weight)
        super().begin(self._state[:, :-1], torch.cat([z, shifts], -1), start=self._drive.t[0].item())
        self._charged = True

    def excess(self, unit: Plans) -> float:
        """Greatest distance of a command from what real actuators would make of it, in units of its range."""
        return self._differences(unit, torch.zeros(len(self.plant.actions), dtype=torch.float64)).abs().max().item()

    @torch.no_grad()
    def _differences(self, unit: np.ndarray, shifts: Tensor) -> Actions:
        """v − Π(v) in units of the range."""
        self(unit)  # which leaves the states
        each = [self._states[k, :-1, :-1, : group.live] for k, group in enumerate(self._groups)]
        states = torch.from_numpy(np.concatenate([part.transpose(2, 0, 1) for part in each]))
        low, high = bounds(self.plant.actions)
        shifted = self.commands(unit, self.n) + (high - low) * shifts
        return (shifted - self.plant.actuate(states, shifted)) / (high - low)


def held_back(plant: Plant, state: State) -> bool:
    """Whether the actuators hold back some of the commands at the ends of all ranges, such as by rate limits."""
    ends = [end.expand(len(state), -1) for end in bounds(plant.actions)]
    return not all(torch.equal(plant.actuate(state, end), end) for end in ends)


class Clairvoyant(NamedTuple):
    """The best commands that were found, and the evidence that they are an optimum.

    Args:
        costs: J_a of each episode under its best commands, without the penalty.
        flown: the episodes.
        gradient: norm of the projected gradient of J_a of each episode, by commands in units of their ranges; where
            actuators hold commands back, of the Lagrangian of that limit.
        excess: greatest distance of a command from the action that was applied, in units of its range.
        start_costs: J_a of each episode at the end of the descents from each start, by name.
        gradients: number of gradients of all episodes together.
    """

    costs: Costs
    flown: Trajectory
    gradient: Costs
    excess: float
    start_costs: dict[str, Costs]
    gradients: int

    def spread(self) -> dict[str, float]:
        """Mean J_a of each start over that of the best commands of each episode, minus one."""
        best = self.costs.mean()
        return {name: (costs.mean() / best - 1.0).item() for name, costs in self.start_costs.items()}


class _End(NamedTuple):
    """Where a descent ended: commands in [0, 1], J_a, norms of the projected gradients, and the number of gradients."""

    point: np.ndarray
    costs: Tensor
    slope: np.ndarray
    evaluations: int


_Descent = Callable[[np.ndarray, BoundedDescentConfig], _End]


def clairvoyant(
    plant: Plant,
    initial_state: Starts,
    exogenous: Inputs,
    starts: Mapping[str, Actions],
    *,
    closure: nn.Module | None = None,
    hold: int = 1,
    config: BoundedDescentConfig | None = None,
) -> Clairvoyant:
    """Descend the costs of episodes by all their commands, from several starts.

    The episodes are one problem of L-BFGS-B, because the lanes of the machine code then carry one episode each. Where
    actuators hold commands back and each interval has a command, up to twenty descents follow each other: their model
    follows every command, for a charge that becomes greater until the real actuators follow, too; see
    :class:`RelaxedCost`. No episode ends above the start.

    The optimal commands of a nonlinear plant are one of many local minima, which differ by which of two ways they take
    in some short parts of an episode. Each start therefore descends twice: from where the first descent ends, all
    commands are drawn in to their mean over the episode by a quarter and descend again, with half the iterations. The
    better commands of each episode stay.

    Args:
        plant: the plant.
        initial_state: initial states of the episodes.
        exogenous: exogenous inputs of the episodes, all known.
        starts: commands from which a descent starts, by name; see :func:`constant_starts` and :func:`random_start`.
        closure: closure of the system; None for the plant's own.
        hold: number of control intervals for which a command is held.
        config: parameters of the descents; the twenty that follow each other share the iterations.

    Raises:
        ValueError: if there is no start.
        DivergenceError: if the plant diverges from every start.
    """
    if not starts:
        raise ValueError("starts is empty; name at least one, such as the commands of a classical controller.")
    closure, config = constant(plant.closure if closure is None else closure), config or BoundedDescentConfig()
    cost = CommandCost(plant, closure, hold=hold, terminal=plant.terminal_cost)
    cost.begin(initial_state, exogenous)
    episodes = Scenario(initial_state, exogenous)
    descent: _Descent = partial(_ended, cost, episodes)
    if hold == 1 and cost.traced and held_back(plant, initial_state):
        descent = partial(_tightened, RelaxedCost(plant, closure, terminal=plant.terminal_cost), episodes)
    nowhere = torch.full((len(initial_state),), torch.inf, dtype=torch.float64)
    costs, ends = dict.fromkeys(starts, nowhere), list[_End]()
    for name, commands in starts.items():
        # A start from which the plant diverges keeps its infinite cost.
        with contextlib.suppress(FloatingPointError):
            ends.append(_again(descent, config, descent(cost.units(commands), config)))
            costs[name] = ends[-1].costs
    if not ends:
        raise DivergenceError(f"plant {plant.name!r} diverges from every start: {', '.join(starts)}.")
    best = _best(*ends)
    commands, (low, high) = cost.commands(best.point, exogenous.shape[1]), bounds(plant.actions)
    flown = Rollout(plant, closure)(initial_state, exogenous, commands)
    excess, slope = ((commands - flown.actions) / (high - low)).abs().max().item(), torch.from_numpy(best.slope)
    return Clairvoyant(control_cost(plant, flown), flown, slope, excess, costs, best.evaluations)


def constant_starts(plant: Plant, batch: int, n: int) -> dict[str, Float[Tensor, "{batch} {n} n_a"]]:
    """Constant commands at a quarter, the middle and three quarters of all ranges."""
    low, high = bounds(plant.actions)
    return {f"constant {share:g}": (low + share * (high - low)).expand(batch, n, -1) for share in (0.25, 0.5, 0.75)}


def random_start(plant: Plant, batch: int, n: int, *, generator: torch.Generator) -> Float[Tensor, "{batch} {n} n_a"]:
    """Commands that are uniform on the ranges, drawn for every interval."""
    low, high = bounds(plant.actions)
    return low + (high - low) * torch.rand(batch, n, len(plant.actions), generator=generator, dtype=torch.float64)


def _together(cost: CommandCost, point: np.ndarray) -> tuple[float, np.ndarray]:
    costs, gradient = cost(point)
    return float(costs.mean()), gradient / len(costs)


def _costs(cost: CommandCost, episodes: Scenario, point: np.ndarray) -> Costs:
    """J_a of each episode, without penalty or charge."""
    commands = cost.commands(point, episodes.exogenous.shape[1])
    return Rollout(cost.plant, cost.interval.closure).costs(*episodes, commands)


def _ended(cost: CommandCost, episodes: Scenario, start: np.ndarray, config: BoundedDescentConfig) -> _End:
    """The end of one descent."""
    found = descend(partial(_together, cost), start, config)
    slope = projected_gradient(found.point, cost(found.point)[1])
    return _End(found.point, _costs(cost, episodes, found.point), slope, found.evaluations)


def _tightened(cost: RelaxedCost, episodes: Scenario, start: np.ndarray, config: BoundedDescentConfig) -> _End:
    """The end of descents under growing charges; an episode that costs more than at the start goes back to it."""
    share = dataclasses.replace(config, iterations=max(1, config.iterations // DESCENTS))
    cost.begin(*episodes)
    point, evaluations, weight, last = start, 0, FIRST_WEIGHT, math.inf
    for _ in range(DESCENTS):
        cost.charge(point, weight)
        found = descend(partial(_together, cost), point, share)
        point, evaluations = found.point, evaluations + found.evaluations
        excess = cost.excess(point)
        if excess <= FOLLOWED:
            break
        if excess > 0.5 * last:  # the multipliers alone are too slow
            weight *= math.sqrt(10.0)
        last = excess
    before, after = (_costs(cost, episodes, each) for each in (start, point))
    point = np.where((before < after).numpy()[:, None, None], start, point)
    return _End(point, torch.minimum(before, after), projected_gradient(point, cost(point)[1]), evaluations)


def _again(descent: _Descent, config: BoundedDescentConfig, first: _End) -> _End:
    """The better of the end of a descent and that of another from there, episode by episode."""
    start = first.point + DRAWN_IN * (first.point.mean(1, keepdims=True) - first.point)
    try:
        second = descent(start, dataclasses.replace(config, iterations=max(1, config.iterations // 2)))
    except FloatingPointError:
        return first
    return _best(first, second)


def _best(*ends: _End) -> _End:
    """The best of several ends, episode by episode; of equal ones the first."""
    costs = torch.stack([end.costs for end in ends])
    chosen = list(enumerate(costs.argmin(0).tolist()))
    point = np.stack([ends[k].point[episode] for episode, k in chosen])
    slope = np.stack([ends[k].slope[episode] for episode, k in chosen])
    return _End(point, costs.amin(0), slope, sum(end.evaluations for end in ends))
