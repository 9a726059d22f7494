"""The protocol of a learner, the model-free method of step 2."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn


@runtime_checkable
class Learner(Protocol):
    """A model-free method, which keeps parts of every real episode and improves π_mf from them.

    ``docs/learner.md`` shows how to write one.
    """

    policy: nn.Module
    """Policy π_mf, updated in place."""

    def store(self, episode: TensorDictBase) -> None:
        """Keep the parts of a real episode that the learner needs, whichever policy flew the episode (step 1).

        Args:
            episode: ``observation``, ``action`` (as applied) and ``("next", ...)`` of n_t control intervals.
        """

    def update(self) -> TensorDict:
        """Improve the policy (step 2).

        Returns:
            Scalars for the report of the episode, by name; there may be none.
        """

    def restart(self) -> None:
        """Forget everything that belongs to the policy's earlier weights, because the policy's weights have jumped."""

    def observations(self) -> Float[Tensor, "n n_o"]:
        """Observations on the real system, from which a clone of another architecture learns."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update depends on, except the policy's weights: tensors in plain containers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of a learner with the same configuration."""
