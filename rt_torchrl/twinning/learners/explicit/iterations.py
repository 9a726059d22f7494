"""The iterations of step 2 by formula, for the library's critics and any policy."""

from abc import ABC, abstractmethod
from collections.abc import Iterator

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.norm import norm_of
from rt_torchrl.twinning.learners.actor_critic import ActorCritic
from rt_torchrl.twinning.learners.explicit.adam import AdamSteps
from rt_torchrl.twinning.learners.explicit.critic_formulas import Ascent
from rt_torchrl.twinning.learners.explicit.policy import differentiable
from rt_torchrl.twinning.learners.explicit.row_function import RowFunction
from rt_torchrl.twinning.learners.explicit.stacked_critics import StackedCritics
from rt_torchrl.twinning.learners.long_term_memory import AT_ONCE

Batch = tuple[Float[Tensor, "n_o n"], Float[Tensor, " n"]]
"""Observations, and the share of each in the mean over the batch."""
TINY = 1e-6
"""Number that ``torch.nn.utils.clip_grad_norm_`` adds to a norm."""


class ExplicitIterations(ABC):
    r"""Iterations of a learner's critics and policy that compute what TorchRL's losses and autograd compute.

    .. math::
        \frac{dJ_q}{dq_k} = 2 w_k (q_k - y_k), \qquad
        \frac{dR}{da_k} = w_k \frac{dq}{da}(e_k, \pi(e_k)), \qquad \sum_k w_k = 1

    The weights are those of the learner's loss and policy, and the moments those of its optimisers. The transitions are
    copied, so that an object lives for one update. No tensor of an object requires gradients.

    Args:
        learner: learner with critics of the class :class:`Critic`.
        critics: name of the critics' weights in the learner's loss.
    """

    def __init__(self, learner: ActorCritic, critics: str):
        self.learner, self.memory, self.config = learner, learner.memory, learner.config
        self.middle = learner.critics[0].get_buffer("middle")
        self.half_range = learner.critics[0].get_buffer("half_range")
        self.critics = StackedCritics(learner.loss, critics, len(self.middle), learner.batch_size)
        self.shape, self.policy = self.critics.shape, differentiable(learner.policy)
        self._ascent = RowFunction(Ascent(self.shape), learner.batch_size, self.critics.row)
        self._critic_adam, self._actor_adam = AdamSteps(learner.critic_optimiser), AdamSteps(learner.actor_optimiser)
        with torch.no_grad():
            self._rows = self._rows_of(self.memory.transitions())

    @property
    @abstractmethod
    def steady(self) -> bool:
        """Whether the actions at the next observations stay the same in all critic iterations."""

    @abstractmethod
    def next_actions(self, following: Float[Tensor, "n n_o"]) -> Float[Tensor, "n n_a"]:
        """Actions a' at the next observations, whose values the targets bootstrap from."""

    def scaled(self, action: Float[Tensor, "n n_a"]) -> Float[Tensor, "n n_a"]:
        """Actions from their range to [−1, 1]."""
        return (action - self.middle) / self.half_range

    def _rows_of(self, transitions: TensorDictBase) -> Float[Tensor, "n_row n_stored"]:
        """Observation, scaled action, both of the next interval, reward and discount of each transition."""
        following, reward = transitions["next", "observation"], transitions["next", "reward"]
        discount = self.learner.loss.value_estimator.gamma.to(reward.device)
        if "steps_to_next_obs" in transitions:
            discount = discount ** transitions["steps_to_next_obs"].view_as(reward)
        discount = discount * ~transitions["next", "terminated"]
        action = self.scaled(transitions["action"])
        next_action = self.scaled(self.next_actions(following)) if self.steady else torch.zeros_like(action)
        parts = (transitions["observation"], action, following, next_action, reward, discount)
        return torch.cat([part.to(self.middle.dtype).t() for part in parts])

    def critic_step(self) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`Iterations.critic_step`."""
        safe_point()
        index, weight = self.memory.draw(self.learner.batch_size)
        rows = self.critics.rows
        torch.index_select(self._rows, 1, index.to(rows.device), out=rows[:-1])
        rows[-1] = self._shares(weight)
        if not self.steady:
            following, next_action = rows[self.shape.n_x : -3].split([self.shape.n_o, self.shape.n_a])
            next_action.copy_(self.scaled(self.next_actions(following.t())).t())
        loss, td_error = self.critics.learn()
        self._critic_adam.step(self.critics.weights, self.critics.gradients)
        self.memory.refresh(index, td_error)
        return loss, td_error.mean(), self.critics.gradient_norm

    def move_targets(self) -> None:
        """See :meth:`Iterations.move_targets`."""
        self.critics.follow(1.0 - self.learner.target.eps)

    def batches(self, count: int) -> Iterator[Batch]:
        """See :meth:`Iterations.batches`; all are drawn as :meth:`LongTermMemory.samples` draws them."""
        n = self.learner.batch_size
        for left in range(count, 0, -AT_ONCE):
            index, weight = self.memory.draw(min(left, AT_ONCE) * n)
            observations = self._rows[: self.shape.n_o, index.to(self._rows.device)]
            yield from zip(observations.split(n, 1), self._shares(weight.view(-1, n)), strict=True)

    def _shares(self, weight: Float[Tensor, "*batches n"]) -> Float[Tensor, "*batches n"]:
        """Shares in the means over batches, by the importance weights."""
        return (weight.to(self._rows.dtype) / weight.sum(-1, keepdim=True)).to(self._rows.device)

    def actor_step(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """See :meth:`Iterations.actor_step`."""
        safe_point()
        observation, rows = batch[0], self._ascent.rows
        action = self.policy.forward(observation.t())
        torch.cat([observation, self.scaled(action).t(), batch[1].unsqueeze(0)], out=rows)
        self._ascent(self.critics.row)
        value, slope = self._ascent.results
        weights, gradients = self.policy.gradients(slope.t() / self.half_range)
        norm = norm_of(gradients)
        torch._foreach_mul_(gradients, (self.config.gradient_limit / (norm + TINY)).clamp_(max=1.0))
        self._actor_adam.step(weights, gradients)
        return value.sum(), norm
