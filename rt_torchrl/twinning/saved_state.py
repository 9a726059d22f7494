"""The state of a training, in tensors and plain containers, given back to its components."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only


def on_device(state: dict[str, Any], device: torch.device) -> dict[str, Any]:
    """The state with all its tensors on a device."""
    return tree_map_only(Tensor, lambda tensor: tensor.to(device), state)


def load_parts(parts: Mapping[str, tuple[Any, Any]]) -> None:
    """Give every component its saved state.

    Args:
        parts: the component and its state, by the name that a user knows it by.

    Raises:
        ValueError: if a state does not fit its component, with the name of the component.
    """
    for name, (part, saved) in parts.items():
        try:
            part.load_state_dict(saved)
        # Torch, tensordict and environments each have errors of their own for what does not fit.
        except (RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
            raise ValueError(f"the saved state of {name} does not fit: {error}") from error
