"""A law that a closure has learned: where records asked for its values."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant, replaying
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

LEAST_CHANGE = 1e-6
"""Change of an output over the features, as a share of its greatest value, below which it is a constant."""


@torch.no_grad()
def visited_features(plant: Plant, closure: nn.Module, law: nn.Module, record: Trajectory) -> list[Tensor]:
    """The features of every call of a law in the intervals of a record, at all stages of the plant's scheme in turn.

    Args:
        plant: the plant.
        closure: its closure.
        law: the closure itself, or the part of it whose calls count.
        record: the record, with all states of the plant.
    """
    visited = list[Tensor]()
    hook = law.register_forward_pre_hook(lambda _, arguments: visited.append(arguments[0]))
    states = record.states[:-1]
    clock = torch.arange(len(states), dtype=states.dtype, device=states.device)
    try:
        replaying(plant).step(record.start + plant.dt * clock, states, record.actions, record.exogenous, closure)
    finally:
        hook.remove()
    return visited


def asked_features(twin: DigitalTwin, records: Sequence[Trajectory]) -> Float[Tensor, "rows f"]:
    """The features for which the believed twin asked its closure in records; no row of a closure that is not called."""
    believed, law = twin.believed, twin.believed_law
    visited = [
        features.flatten(0, -2)
        for record in map(believed.completed, records)
        for features in visited_features(believed.plant, believed.closure, law, record)
    ]
    return torch.cat([rows for rows in visited if rows.shape[-1] == visited[0].shape[-1]] or [torch.empty(0, 0)])


def name_of(names: Sequence[str], k: int, kind: str) -> str:
    """Name and unit of the k-th input or output of a closure, or its number, as in ``feature 2``."""
    return names[k] if k < len(names) else f"{kind} {k + 1}"


def varying(values: Float[Tensor, "rows n"]) -> list[int]:
    """Places of the outputs that are no constants over rows of features."""
    if not len(values):
        return []
    change = values.amax(0) - values.amin(0)
    return (change > LEAST_CHANGE * values.abs().amax(0)).nonzero().flatten().tolist()
