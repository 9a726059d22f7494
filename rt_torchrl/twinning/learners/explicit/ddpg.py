"""DDPG's iterations by formula."""

import torch
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

    def known_actions(self, following: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_known"]:
        # A policy of somebody else may look at whole batches, or draw its actions.
        if not isinstance(self.policy, ExplicitPolicy):
            return following[:, :0]
        return self.scaled(self.policy(following))

    def next_values(self, following: Float[Tensor, "n n_following"]) -> Float[Tensor, " n"]:
        if following.shape[1] == self.n_o:
            following = torch.cat([following, self.scaled(self.policy(following))], -1)
        return self.critics.targets[0](following).squeeze(-1)
