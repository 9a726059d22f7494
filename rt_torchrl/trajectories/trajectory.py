"""Trajectories of a system, the scenarios that they start from, and their costs."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rt_torchrl.plants.plant import Plant, flight_costs


class Scenario(NamedTuple):
    """Initial states s_0 of episodes, and the exogenous inputs z of all their intervals."""

    initial_state: Float[Tensor, "*batch n_s"]
    exogenous: Float[Tensor, "*batch n n_z"]


class Trajectory(NamedTuple):
    """States and actions of a system, reported by the real system or computed by a twin, in any batch dimensions.

    Args:
        states: states s_0 ... s_n.
        actions: actions that were applied in the n intervals between the states.
        exogenous: exogenous inputs z, held over the same intervals.
        start: time of s_0 on the plant's clock [s], one for all trajectories or one for each.
        seen: whether the state of each sample was measured; None if all were. Other states, such as those between the
            rows of a slow log, are interpolated, and no fit compares them.
        from_rest: whether states that no sensor reads are at rest in s_0, as where an episode begins.
    """

    states: Float[Tensor, "*batch n+1 n_s"]
    actions: Float[Tensor, "*batch n n_a"]
    exogenous: Float[Tensor, "*batch n n_z"]
    start: float | Float[Tensor, " batch"] = 0.0
    seen: Bool[Tensor, "*batch n+1"] | None = None
    from_rest: bool = True

    def mapped(self, change: Callable[[Tensor], Tensor]) -> "Trajectory":
        """The trajectory whose tensors are changed by a function, such as one that moves them to a device."""
        parts = self._asdict().items()
        changed: dict[str, Any] = {name: change(part) for name, part in parts if isinstance(part, Tensor)}
        return self._replace(**changed)

    def part(self, first: int, last: int, dt: float) -> "Trajectory":
        """The intervals ``first`` to ``last`` − 1 of length ``dt`` [s], with the states around them."""
        states, actions, exogenous, start, seen, from_rest = self
        steps, samples = slice(first, last), slice(first, last + 1)
        return Trajectory(
            states[..., samples, :],
            actions[..., steps, :],
            exogenous[..., steps, :],
            start + first * dt,
            None if seen is None else seen[..., samples],
            from_rest and first == 0,
        )

    def segments(self, length: int, dt: float) -> "Trajectory":
        """The segments of all trajectories of a batch, as one batch; those of a trajectory are in the order of time.

        Args:
            length: number of control intervals of a segment; a shorter rest at the end is dropped.
            dt: control interval [s].
        """
        states, actions, exogenous, start, seen, _ = self

        def pieces(samples: Tensor, size: int) -> Tensor:
            return samples.unfold(1, size, length).flatten(0, 1).movedim(-1, 1).contiguous()

        times = dt * length * torch.arange(actions.shape[1] // length, dtype=torch.float64, device=states.device)
        first = torch.as_tensor(start, dtype=torch.float64, device=states.device).expand(len(states))
        return Trajectory(
            pieces(states, length + 1),
            pieces(actions, length),
            pieces(exogenous, length),
            (first.unsqueeze(-1) + times).flatten(),
            None if seen is None else pieces(seen, length + 1),
        )

    def rows(self, chosen: int | Int[Tensor, " m"]) -> "Trajectory":
        """Some trajectories of a batch, of which one may be there several times, or one by its number."""
        return self.mapped(lambda part: part[chosen])

    def each(self) -> "list[Trajectory]":
        """The trajectories of a batch, one by one."""
        starts = torch.as_tensor(self.start, dtype=torch.float64, device="cpu").expand(len(self.states)).tolist()
        return [self.rows(k)._replace(start=start) for k, start in enumerate(starts)]


class TwinFlight(Trajectory):
    """A trajectory that a twin has flown, which figures do not call real."""


def batch_of(trajectories: Sequence[Trajectory]) -> Trajectory:
    """Trajectories of equal length without batch dimensions as one batch."""
    states, actions, exogenous = map(torch.stack, zip(*(trajectory[:3] for trajectory in trajectories), strict=True))
    starts = [float(trajectory.start) for trajectory in trajectories]
    together, seen = len(set(starts)) == 1, None
    if any(trajectory.seen is not None for trajectory in trajectories):
        all_seen = torch.ones(states.shape[1], dtype=torch.bool, device=states.device)
        seen = torch.stack([all_seen if trajectory.seen is None else trajectory.seen for trajectory in trajectories])
    return Trajectory(states, actions, exogenous, starts[0] if together else states.new_tensor(starts), seen)


SHORTEST = 10
"""Least number of control intervals of a record from which much is learned."""


def pieces_of_equal_length(segments: Sequence[Trajectory], longest: int, dt: float) -> list[Trajectory]:
    """Segments of a log cut to pieces of one length, which is chosen so that most of the log stays.

    An episode that ended at once leaves few intervals, to which longer segments are not cut.

    Args:
        segments: segments of the log, oldest first.
        longest: greatest number of control intervals of a piece.
        dt: control interval [s].

    Returns:
        The pieces, oldest first; a shorter rest at the end of a segment is left out.
    """
    counts = [len(segment.actions) for segment in segments]
    lengths = {min(count, longest) for count in counts}
    length = max({n for n in lengths if n >= SHORTEST} or lengths, key=lambda n: (n * sum(c // n for c in counts), n))
    cuts = [(segment, k * length) for segment, c in zip(segments, counts, strict=True) for k in range(c // length)]
    return [segment.part(first, first + length, dt) for segment, first in cuts]


def control_cost(plant: Plant, trajectory: Trajectory) -> Float[Tensor, " batch"]:
    r"""J_a of each trajectory, :math:`\frac1{T_o}\big(\int L_a\,dt + \Phi_a(s_n)\big)` by its samples.

    Where it ends early, it costs L_e from there on, and Φ_a is that of the state in which it ended.
    """
    states, actions, exogenous, start, *_ = trajectory
    n = actions.shape[-2]
    clock = plant.dt * torch.arange(n, dtype=torch.float64, device=states.device)
    t = (start.unsqueeze(-1) if isinstance(start, Tensor) else start) + clock
    costs, end = flight_costs(plant, t, states, actions, exogenous)
    return costs.mean(-1) + plant.terminal_cost(end) / (n * plant.dt)


def until_end(plant: Plant, flown: Trajectory) -> Trajectory:
    """A trajectory without batch dimensions up to its early end, after which nothing moves whatever the actions are."""
    over = plant.ended(flown.states[1:])
    return flown.part(0, int(over.int().argmax()) + 1, plant.dt) if over.any() else flown


def between_ends(plant: Plant, flown: Trajectory) -> list[Trajectory]:
    """The parts of a log without batch dimensions, each from where the plant has not ended to its next early end."""
    over = plant.ended(flown.states)
    begins = ~over & torch.cat([torch.ones_like(over[:1]), over[:-1]])
    parts = [flown.part(k, len(flown.actions), plant.dt) for k in begins.nonzero().flatten().tolist()]
    return [until_end(plant, part) for part in parts if len(part.actions)]


def whole_cost(plant: Plant, flight: Trajectory, n: int) -> Float[Tensor, " batch"]:
    """J_a of whole episodes of n intervals; with fewer they have ended, even if readings with noise do not show it."""
    flown = flight.actions.shape[-2]
    cost = control_cost(plant, flight)
    return cost if flown == n else (flown * cost + (n - flown) * (plant.end_cost or 0.0)) / n


def continued(inputs: Float[Tensor, "n_e n_z"], n: int) -> Float[Tensor, "n n_z"]:
    """Exogenous inputs of n intervals, of which a record that ended early holds the first ones.

    The record is gone through forwards and backwards in turn, so that no input jumps where the record ends.
    """
    place = torch.arange(n, device=inputs.device) % (2 * len(inputs))
    return inputs[torch.where(place < len(inputs), place, 2 * len(inputs) - 1 - place)]


def identification_cost(
    plant: Plant,
    trajectory: Trajectory,
    measured: Float[Tensor, "batch samples n_s"],
    seen: Bool[Tensor, "batch samples"] | None = None,
) -> Float[Tensor, " batch"]:
    r"""J_p of each trajectory, :math:`\int L_p(s, \check s)\,dt` over the samples t_1 ... t_n that were seen."""
    rates = plant.discrepancy(trajectory.states[:, 1:], measured[:, 1:])
    return plant.dt * (rates if seen is None else rates * seen[:, 1:]).sum(-1)
