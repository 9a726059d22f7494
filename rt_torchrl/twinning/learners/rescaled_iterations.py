"""The iterations of incremental TD3 by TorchRL's loss and autograd."""

from typing import TYPE_CHECKING

from jaxtyping import Float, Int
from tensordict import TensorDictBase
from torch import Tensor, nn

from rt_torchrl.interruption import safe_point

if TYPE_CHECKING:
    from rt_torchrl.twinning.learners.incremental_td3 import IncrementalTD3


class RescaledIterations:
    """Iterations by :class:`RescaledTD3Loss`; :class:`ExplicitIncrementalTD3` computes the same sooner.

    Args:
        learner: learner to iterate.
        transitions: all transitions of the update.
    """

    def __init__(self, learner: "IncrementalTD3", transitions: TensorDictBase):
        self.learner, self.transitions = learner, transitions

    def critic_step(
        self, index: Int[Tensor, " n"], direction: Float[Tensor, "n n_a"] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`ExplicitIncrementalTD3.critic_step`."""
        safe_point()
        batch, optimiser = self.transitions[index], self.learner.critic_optimiser
        loss, found = self.learner.loss.value_loss(batch)
        lesson = self.learner.loss.slope_loss(batch, direction) if direction is not None else 0.0
        optimiser.zero_grad(set_to_none=True)
        (loss + lesson).backward()
        norm = nn.utils.get_total_norm([weight.grad for weight in optimiser.param_groups[0]["params"]])
        optimiser.step()
        return loss.detach(), found["td_error"].mean(), norm

    def actor_step(self, index: Int[Tensor, " n"]) -> tuple[Tensor, Tensor]:
        """See :meth:`ExplicitIncrementalTD3.actor_step`."""
        safe_point()
        loss, _ = self.learner.loss.actor_loss(self.transitions[index])
        self.learner.actor_optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.learner.policy.parameters(), self.learner.config.gradient_limit)
        self.learner.actor_optimiser.step()
        return -loss.detach(), norm

    def move_targets(self) -> None:
        """Let the targets follow."""
        self.learner.target.step()
