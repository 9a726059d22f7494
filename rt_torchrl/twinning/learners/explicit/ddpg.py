"""DDPG's iterations by formula."""

from jaxtyping import Float
from torch import Tensor

from rt_torchrl.twinning.learners.actor_critic import ActorCritic
from rt_torchrl.twinning.learners.explicit.iterations import ExplicitIterations
from rt_torchrl.twinning.learners.explicit.policy import ExplicitPolicy


class ExplicitDDPG(ExplicitIterations):
    """The iterations of :class:`DDPG`, whose policy rests while the critic learns.

    Args:
        learner: learner to iterate.
    """

    def __init__(self, learner: ActorCritic):
        super().__init__(learner, "value_network_params")

    @property
    def steady(self) -> bool:
        # A policy of somebody else may look at whole batches, or draw its actions.
        return isinstance(self.policy, ExplicitPolicy)

    def next_actions(self, following: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        return self.policy(following)
