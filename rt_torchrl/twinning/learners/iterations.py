"""The protocol of the iterations that an update consists of."""

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

from torch import Tensor


@runtime_checkable
class Iterations(Protocol):
    """The parts of one update: TorchRL's losses, or the formulas of ``rt_torchrl.twinning.learners.explicit``."""

    def critic_step(self) -> tuple[Tensor, Tensor, Tensor]:
        """Take one iteration of the critics; return loss, mean |δ| and the gradient norm."""

    def move_targets(self) -> None:
        """Let the targets follow."""

    def batches(self, count: int) -> Iterator[Any]:
        """Draw batches for :meth:`actor_step`."""

    def actor_step(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Take one iteration of the policy; return the mean value and the gradient norm."""
