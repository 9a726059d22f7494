"""The weights of an interval, as machine code takes them."""

from functools import cached_property
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor, nn


class Weights:
    """The weights of an interval, as long as no other tensors take their places.

    Args:
        interval: the interval.
    """

    def __init__(self, interval: nn.Module):
        self._all = tuple(interval.parameters())
        self.learned = [w for w in self._all if w.requires_grad]
        self.sizes = [w.numel() for w in self.learned]

    @cached_property
    def _arrays(self) -> list[np.ndarray]:
        """The same memory in NumPy."""
        return [w.detach().numpy() for w in self._all] or [np.zeros(1)]

    def row(self) -> np.ndarray:
        """The present numbers of all weights as one row."""
        return np.concatenate(self._arrays, axis=None)

    def split(self, gradients: np.ndarray) -> list[Tensor]:
        """A row of gradients by the learned weights, in their own shapes."""
        parts = (gradients[end - n : end] for n, end in zip(self.sizes, accumulate(self.sizes), strict=True))
        return [torch.from_numpy(part.reshape(w.shape)) for part, w in zip(parts, self.learned, strict=True)]
