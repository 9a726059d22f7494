"""Values of a vector for the weights of a module."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn


def place(values: Float[Tensor, " n_w"], weights: Sequence[nn.Parameter]) -> None:
    """Give weights these values; in place, because torch's ``vector_to_parameters`` would make them views of a vector.

    Call it without gradients.
    """
    for weight, part in zip(weights, values.split([w.numel() for w in weights]), strict=True):
        weight.copy_(part.view_as(weight))
