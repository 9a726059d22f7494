"""Checks of the early end of an episode."""

from collections.abc import Iterator

import torch

from rt_torchrl.contract.calls import Calls
from rt_torchrl.plants.plant import require_end_cost


@torch.no_grad()
def ends(calls: Calls) -> Iterator[str]:
    """Violations in what says that an episode has ended, and in what that costs."""
    plant, state = calls.plant, calls.arguments["state"]
    try:
        require_end_cost(plant)
    except ValueError as error:
        yield f"end_cost: {error}"
        return
    found = plant.ended(state)
    if found.dtype != torch.bool or found.shape != state.shape[:-1]:
        yield (
            f"ended: returns {found.dtype} of shape {tuple(found.shape)} for states of shape {tuple(state.shape)}; "
            f"expected torch.bool of shape {tuple(state.shape[:-1])}, one answer for each state."
        )
