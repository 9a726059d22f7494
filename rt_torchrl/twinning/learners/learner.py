"""The learners of step 2: their protocol, and those that a configuration can name."""

from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.twinning.learners.config import LearnerConfig, LearnerName
from rt_torchrl.twinning.learners.ddpg import DDPG
from rt_torchrl.twinning.learners.td3 import TD3


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


LEARNERS: dict[LearnerName, type[DDPG] | type[TD3]] = {"ddpg": DDPG, "td3": TD3}


def make_learner(plant: Plant, policy: nn.Module, config: LearnerConfig, *, generator: torch.Generator) -> Learner:
    """The learner that a configuration names; :class:`ActorCritic` describes the arguments."""
    return LEARNERS[config.algorithm](plant, policy, config, generator=generator)
