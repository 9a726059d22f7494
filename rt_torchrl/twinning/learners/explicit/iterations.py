"""The iterations of DDPG by formula, for the library's critic and any policy."""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.norm import norm_of
from rt_torchrl.twinning.learners.actor_critic import ActorCritic
from rt_torchrl.twinning.learners.explicit.formulas import Ascent, CriticShape, RowFunction, TemporalDifferences
from rt_torchrl.twinning.learners.explicit.policies import ExplicitPolicy, differentiable
from rt_torchrl.twinning.learners.long_term_memory import AT_ONCE

Batch = tuple[Float[Tensor, "n_o n"], Float[Tensor, " n"]]
"""Observations, and the share of each in the mean over the batch."""
TINY = 1e-6
"""Number that ``torch.nn.utils.clip_grad_norm_`` adds to a norm."""


class ExplicitDDPG:
    r"""Iterations that compute what TorchRL's losses of :class:`DDPG` and autograd compute.

    .. math::
        \frac{dJ_q}{dq_k} = 2 w_k (q_k - y_k), \qquad
        \frac{dR}{da_k} = w_k \frac{dq}{da}(e_k, \pi(e_k)), \qquad \sum_k w_k = 1

    The weights are those of the learner's loss and policy, and the moments those of its optimisers. The transitions are
    copied, so that an object lives for one update. No tensor of an object requires gradients.

    Args:
        learner: learner with a critic of the class :class:`Critic`.
    """

    def __init__(self, learner: ActorCritic):
        self.learner, self.memory, self.config = learner, learner.memory, learner.config
        self.middle = learner.critics[0].get_buffer("middle")
        self.half_range = learner.critics[0].get_buffer("half_range")
        self.critic = ExplicitCritic(learner, len(self.middle))
        self.shape, self.policy = self.critic.shape, differentiable(learner.policy)
        # A policy of somebody else may look at whole batches, or draw its actions.
        self._steady = isinstance(self.policy, ExplicitPolicy)
        self._ascent = RowFunction(Ascent(self.shape), learner.batch_size, self.critic.row)
        self._critic_adam, self._actor_adam = AdamSteps(learner.critic_optimiser), AdamSteps(learner.actor_optimiser)
        with torch.no_grad():
            self._rows = self._rows_of(self.memory.transitions())

    def _scaled(self, action: Float[Tensor, "n n_a"]) -> Float[Tensor, "n n_a"]:
        """Actions from their range to [−1, 1]."""
        return (action - self.middle) / self.half_range

    def _rows_of(self, transitions: TensorDictBase) -> Float[Tensor, "n_row n_stored"]:
        """Observation, scaled action, both of the next interval, reward and discount of each transition.

        The policy rests while the critic learns, so that the next actions of a steady policy are known beforehand.
        """
        following, reward = transitions["next", "observation"], transitions["next", "reward"]
        discount = self.learner.loss.value_estimator.gamma.to(reward.device)
        if "steps_to_next_obs" in transitions:
            discount = discount ** transitions["steps_to_next_obs"].view_as(reward)
        discount = discount * ~transitions["next", "terminated"]
        action = self._scaled(transitions["action"])
        next_action = self._scaled(self.policy(following)) if self._steady else torch.zeros_like(action)
        parts = (transitions["observation"], action, following, next_action, reward, discount)
        return torch.cat([part.to(self.middle.dtype).t() for part in parts])

    def critic_step(self) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`Iterations.critic_step`."""
        safe_point()
        index, weight = self.memory.draw(self.learner.batch_size)
        rows = self.critic.rows
        torch.index_select(self._rows, 1, index.to(rows.device), out=rows[:-1])
        rows[-1] = self._shares(weight)
        if not self._steady:
            following, next_action = rows[self.shape.n_x : -3].split([self.shape.n_o, self.shape.n_a])
            next_action.copy_(self._scaled(self.policy(following.t())).t())
        loss, td_error = self.critic.learn()
        self._critic_adam.step(self.critic.weights, self.critic.gradients)
        self.memory.refresh(index, td_error)
        return loss, td_error.mean(), self.critic.gradient_norm

    def move_targets(self) -> None:
        """See :meth:`Iterations.move_targets`."""
        self.critic.follow(1.0 - self.learner.target.eps)

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
        torch.cat([observation, self._scaled(action).t(), batch[1].unsqueeze(0)], out=rows)
        self._ascent(self.critic.row)
        value, slope = self._ascent.results
        weights, gradients = self.policy.gradients(slope.t() / self.half_range)
        norm = norm_of(gradients)
        torch._foreach_mul_(gradients, (self.config.gradient_limit / (norm + TINY)).clamp_(max=1.0))
        self._actor_adam.step(weights, gradients)
        return value.sum(), norm


class ExplicitCritic:
    """The critic of a loss of TorchRL and its target, with gradients by formula; the weights stay where they are.

    Args:
        learner: learner with a critic of the class :class:`Critic`.
        n_a: number of actions.
    """

    def __init__(self, learner: ActorCritic, n_a: int):
        held = dict(learner.loss.named_buffers())
        named = {
            key: weight for key, weight in learner.loss.named_parameters() if key.startswith("value_network_params.")
        }
        self.weights = list(named.values())
        self._values = [weight.detach() for weight in self.weights]
        self._targets = [held[f"target_{key}"] for key in named]
        self._flat = torch.cat([torch.zeros_like(weight).flatten() for weight in self._values])
        parts = self._flat.split([weight.numel() for weight in self._values])
        self.gradients = [part.view(weight.shape) for part, weight in zip(parts, self._values, strict=True)]
        widths = [bias.numel() for bias in self._values[1::2]]
        self.shape = CriticShape(self._values[0].shape[1] - n_a, n_a, tuple(widths[:-1]))
        self._parts = [part.view(-1) for part in self._values + self._targets]
        self._row, self._old = torch.cat(self._parts), False
        self._differences = RowFunction(TemporalDifferences(self.shape), learner.batch_size, self._row)
        self.rows = self._differences.rows
        """Rows x, x', r, γ and w of a batch, to be written before :meth:`learn`."""
        depth = len(self.shape.sizes)
        self._error, self._scale, *others = self._differences.results
        inputs = [self.rows[: self.shape.n_x], *others[: depth - 1]]
        slopes = [*others[depth - 1 :], self._scale]
        self._products = list(zip(slopes, inputs, self.gradients[::2], self.gradients[1::2], strict=True))

    @property
    def row(self) -> Float[Tensor, " n_w"]:
        """Present weights of the critic, and then those of its target."""
        if self._old:
            torch.cat(self._parts, out=self._row)
            self._old = False
        return self._row

    @property
    def gradient_norm(self) -> Tensor:
        """Norm of the gradient that :meth:`learn` has found."""
        return torch.linalg.vector_norm(self._flat)

    def learn(self) -> tuple[Tensor, Float[Tensor, " n"]]:
        """Write the gradients of the loss Σ_k w_k δ_k² of the critic, whose weights change afterwards.

        Returns:
            The loss, and |δ| of each row.
        """
        self._differences(self.row)
        self._old = True
        for slope, x, by_weight, by_bias in self._products:
            torch.mm(slope, x.t(), out=by_weight)
            torch.sum(slope, 1, out=by_bias)
        error = self._error[0]
        return 0.5 * torch.dot(self._scale[0], error), error.abs()

    def follow(self, rate: float) -> None:
        """Let the target follow at a rate."""
        self._old = True
        torch._foreach_lerp_(self._targets, self._values, rate)


Moments = tuple[list[Tensor], list[Tensor], list[Tensor]]
ORDINARY = {"amsgrad": False, "maximize": False, "capturable": False, "differentiable": False}


class AdamSteps:
    """The steps of an optimiser, with its rates and its state, which stay where they are.

    On the CPU one fused kernel takes the step. On another device, with another optimiser or with unusual options, the
    optimiser takes it itself, as it does for the first one, which makes its state.

    Args:
        optimiser: optimiser of the weights.
    """

    def __init__(self, optimiser: torch.optim.Optimizer):
        self._optimiser = optimiser
        self._weights: list[torch.nn.Parameter] = []
        self._moments: Moments | None = None
        self._rates: dict[str, Any] = {}

    def step(self, weights: list[torch.nn.Parameter], gradients: list[Tensor]) -> None:
        """Change weights by their gradients.

        Args:
            weights: weights of the optimiser; those that are left out are not changed.
            gradients: gradient of each of them.
        """
        if weights is not self._weights:
            self._take(weights)
        if self._moments is None:
            self._ordinary_step(gradients)
            self._take(weights)
            return
        first, second, steps = self._moments
        self._count.add_(1.0)
        torch._fused_adam_(self._values, gradients, first, second, [], steps, **self._rates)

    def _take(self, weights: list[torch.nn.Parameter]) -> None:
        self._weights, self._moments = weights, moments(self._optimiser, weights)
        self._values = [weight.detach() for weight in weights]
        group = self._optimiser.param_groups[0]
        if self._moments is not None:
            beta1, beta2 = group["betas"]
            self._rates = {"lr": group["lr"], "beta1": beta1, "beta2": beta2, "eps": group["eps"]}
            self._rates |= {"weight_decay": group["weight_decay"], "amsgrad": False, "maximize": False}
            # One addition counts the steps of all weights.
            self._count = torch.stack(self._moments[2])
            self._moments = (*self._moments[:2], list(self._count))
            for weight, steps in zip(weights, self._moments[2], strict=True):
                self._optimiser.state[weight]["step"] = steps

    def _ordinary_step(self, gradients: Sequence[Tensor]) -> None:
        self._optimiser.zero_grad(set_to_none=True)
        for weight, gradient in zip(self._weights, gradients, strict=True):
            weight.grad = gradient
        self._optimiser.step()


def moments(optimiser: torch.optim.Optimizer, weights: list[torch.nn.Parameter]) -> Moments | None:
    """Both moments and the numbers of steps of weights; None if the optimiser has to take the step itself."""
    if type(optimiser) is not torch.optim.Adam or len(optimiser.param_groups) != 1:
        return None
    (group,) = optimiser.param_groups
    ordinary = all(group[name] == value for name, value in ORDINARY.items())
    if not ordinary or any(weight.device.type != "cpu" or weight not in optimiser.state for weight in weights):
        return None
    first, second, steps = (
        [optimiser.state[weight][name] for weight in weights] for name in ("exp_avg", "exp_avg_sq", "step")
    )
    return first, second, steps
