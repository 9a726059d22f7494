"""The norm of a vector in parts, such as the weights of a module or their gradients."""

import torch
from jaxtyping import Float
from torch import Tensor


def norm_of(parts: list[Tensor]) -> Float[Tensor, ""]:
    """The norm of a vector in parts."""
    norms = torch._foreach_norm(parts)
    return norms[0] if len(norms) == 1 else torch.linalg.vector_norm(torch.stack(norms))
