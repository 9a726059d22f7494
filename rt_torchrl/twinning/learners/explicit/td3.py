"""TD3's iterations by formula."""

import copy

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.twinning.learners.actor_critic import ActorCritic
from rt_torchrl.twinning.learners.explicit.iterations import ExplicitIterations
from rt_torchrl.twinning.learners.explicit.policy import differentiable

ACTOR = "actor_network_params"


class ExplicitTD3(ExplicitIterations):
    """The iterations of :class:`TD3`: the lower of two targets, at a smoothed action of the delayed policy.

    Args:
        learner: learner to iterate.
    """

    def __init__(self, learner: ActorCritic):
        loss = learner.loss
        self.delayed = copy.deepcopy(learner.actor_module())
        loss.target_actor_network_params.to_module(self.delayed)
        self._next_policy = differentiable(self.delayed.module)
        held = dict(loss.named_parameters()) | dict(loss.named_buffers())
        followed = [name for name in held if name.startswith(f"{ACTOR}.")]
        self._sources = [held[name].detach() for name in followed]
        self._targets = [held[f"target_{name}"] for name in followed]
        self._generator = torch.Generator(device=learner.generator.device)
        super().__init__(learner, "qvalue_network_params")

    @property
    def steady(self) -> bool:
        return False

    def next_actions(self, following: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        loss, action = self.learner.loss, self._next_policy(following)
        noise = (self._normal(action) * loss.policy_noise).clamp(-loss.noise_clip, loss.noise_clip)
        return (action + noise).clamp(loss.min_action, loss.max_action)

    def _normal(self, like: Tensor) -> Tensor:
        """Normal numbers, the same as TorchRL draws from the global generator with the seed of :class:`TD3`."""
        seed = torch.randint(2**31, (), generator=self.learner.generator, device=like.device)
        self._generator.manual_seed(int(seed))
        return torch.randn(like.shape, generator=self._generator, dtype=like.dtype, device=like.device)

    def move_targets(self) -> None:
        super().move_targets()
        torch._foreach_lerp_(self._targets, self._sources, 1.0 - self.learner.target.eps)
