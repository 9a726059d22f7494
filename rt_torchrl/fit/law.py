"""A law that a closure has learned: where records asked for its values, and what these are worth there."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

LEAST_CHANGE = 1e-6
"""Change of an output over the features, as a share of its greatest value, below which it is a constant."""


@torch.no_grad()
def asked_features(twin: DigitalTwin, records: Sequence[Trajectory]) -> Float[Tensor, "rows f"]:
    """The features that the plant gave its closure in the intervals of records, at every stage of the scheme.

    They are those of the believed twin in the recorded states. No row is given of a closure that is not called with one
    tensor of features.
    """
    believed, asked = twin.believed, list[Tensor]()

    def keep(_: nn.Module, arguments: tuple[Tensor, ...]) -> None:
        asked.append(arguments[0].detach().flatten(0, -2))

    hook = twin.believed_law.register_forward_pre_hook(keep)
    try:
        for record in map(believed.completed, records):
            states, closure = record.states[:-1], believed.closure
            intervals = torch.arange(len(states), dtype=states.dtype, device=states.device)
            clock = record.start + believed.plant.dt * intervals
            believed.plant.step(clock, states, record.actions, record.exogenous, closure)
    finally:
        hook.remove()
    return torch.cat([rows for rows in asked if rows.shape[-1] == asked[0].shape[-1]]) if asked else torch.empty(0, 0)


def varying(values: Float[Tensor, "rows n"]) -> list[int]:
    """Places of the outputs that are no constants over rows of features."""
    if not len(values):
        return []
    change = values.amax(0) - values.amin(0)
    return (change > LEAST_CHANGE * values.abs().amax(0)).nonzero().flatten().tolist()
