"""The iterations of incremental TD3 by formula."""

import copy
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int
from tensordict import TensorDictBase
from torch import Tensor

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.norm import norm_of
from rt_torchrl.twinning.learners.explicit.adam import AdamSteps
from rt_torchrl.twinning.learners.explicit.critic_formulas import RescaledAscent
from rt_torchrl.twinning.learners.explicit.iterations import TINY
from rt_torchrl.twinning.learners.explicit.policy import differentiable
from rt_torchrl.twinning.learners.explicit.row_function import RowFunction
from rt_torchrl.twinning.learners.explicit.slope_formulas import REACH, SlopeDifferences
from rt_torchrl.twinning.learners.explicit.stacked_critics import StackedCritics, members_of
from rt_torchrl.twinning.learners.explicit.td3 import ACTOR
from rt_torchrl.twinning.learners.informed_critic import drawn_anew

if TYPE_CHECKING:
    from rt_torchrl.twinning.learners.incremental_td3 import IncrementalTD3


class ExplicitIncrementalTD3:
    """Iterations that compute what :class:`RescaledTD3Loss` and autograd compute, with the weights of a learner.

    No tensor of an object requires gradients.

    Args:
        learner: learner to iterate.
        transitions: all transitions of the update.
    """

    def __init__(self, learner: "IncrementalTD3", transitions: TensorDictBase):
        loss, n = learner.loss, learner.batch_size
        self.increments, self.target = learner.increments, learner.target
        self.limit = learner.config.gradient_limit
        self.critics = StackedCritics(loss, "qvalue_network_params", transitions["action"].shape[-1], n, rescaled=True)
        members = learner.config.incremental.critics
        self._ascent = RowFunction(RescaledAscent(self.critics.shape, members), n, self.critics.row)
        self._slopes = SlopeLesson(self.critics, members, n) if "slope" in transitions else None
        self.policy = differentiable(learner.policy)
        self.delayed = copy.deepcopy(learner.actor_module())
        loss.target_actor_network_params.to_module(self.delayed)
        self._next_policy = differentiable(self.delayed.module.policy)
        held = dict(loss.named_parameters()) | dict(loss.named_buffers())
        followed = [name for name in held if name.startswith(f"{ACTOR}.") and held[name].is_floating_point()]
        self._sources = [held[name].detach() for name in followed]
        self._targets = [held[f"target_{name}"] for name in followed]
        self._critic_adam, self._actor_adam = AdamSteps(learner.critic_optimiser), AdamSteps(learner.actor_optimiser)
        self._take(transitions)

    def _take(self, transitions: TensorDictBase) -> None:
        following, action = transitions["next"], transitions["action"]
        innovation = transitions["innovation"]
        parts = [transitions["features"], innovation, action]
        parts += [following["features"], innovation, torch.zeros_like(action)]
        self._n_y = innovation.shape[-1]
        parts += [following["reward"], following["discount"], transitions["weight"]]
        self._rows = torch.cat([part.t() for part in parts])
        self._seen, self._centre = transitions["observation"], transitions["centre"]
        self._next_seen, self._next_centre = following["observation"], following["centre"]
        if self._slopes is not None:
            self._wanted, self._share = transitions["slope"], transitions["slope_weight"].squeeze(-1)

    def critic_step(
        self, index: Int[Tensor, " n"], direction: Float[Tensor, "n n_a"] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Take one iteration of the critics.

        Args:
            index: places of the transitions of the batch.
            direction: directions of the actions along which slopes are compared; None without slopes.

        Returns:
            Loss, mean |δ| and the gradient norm.
        """
        safe_point()
        rows, shape = self.critics.rows, self.critics.shape
        torch.index_select(self._rows, 1, index, out=rows)
        rows[-1] /= len(index)
        action = self._next_policy(self._next_seen[index])
        following = rows[shape.n_x :]
        innovation = following[shape.n_o - self._n_y : shape.n_o]
        innovation.copy_(drawn_anew(innovation.t()).t())
        following[shape.n_o : -3] = self._reached(self._next_centre[index], action).t()
        loss, td_error = self.critics.learn()
        if self._slopes is not None and direction is not None:
            share = self._share[index] / len(index)
            self._slopes.add(rows[: shape.n_x], direction, (self._wanted[index] * direction).sum(-1), share)
        self._critic_adam.step(self.critics.weights, self.critics.gradients)
        return loss, td_error.mean(), self.critics.gradient_norm

    def _reached(self, centre: Float[Tensor, "n n_a"], action: Float[Tensor, "n n_a"]) -> Float[Tensor, "n n_a"]:
        return self.increments.scaled(centre, action).clamp_(-1.0, 1.0)

    def actor_step(self, index: Int[Tensor, " n"]) -> tuple[Tensor, Tensor]:
        """Take one iteration of the policy.

        Args:
            index: places of the transitions of the batch.

        Returns:
            The mean value and the gradient norm.
        """
        safe_point()
        rows, shape = self._ascent.rows, self.critics.shape
        wanted = self.increments.scaled(self._centre[index], self.policy.forward(self._seen[index]))
        torch.index_select(self._rows[: shape.n_o], 1, index, out=rows[: shape.n_o])
        rows[shape.n_o : -1] = wanted.clamp(-1.0, 1.0).t()
        rows[-1] = 1.0 / len(index)
        self._ascent(self.critics.row)
        value, slope = self._ascent.results
        within = (wanted.abs() <= 1.0) / self.increments.scale
        weights, gradients = self.policy.gradients(slope.t() * within)
        norm = norm_of(gradients)
        torch._foreach_mul_(gradients, (self.limit / (norm + TINY)).clamp_(max=1.0))
        self._actor_adam.step(weights, gradients)
        return value.sum(), norm

    def move_targets(self) -> None:
        """Let the targets follow."""
        rate = 1.0 - self.target.eps
        self.critics.follow(rate)
        torch._foreach_lerp_(self._targets, self._sources, rate)


class SlopeLesson:
    """Adds the gradients of the loss of slopes to those that critics have found.

    Args:
        critics: the critics.
        members: number of critics.
        n: number of transitions in a batch.
    """

    def __init__(self, critics: StackedCritics, members: int, n: int):
        self._critics, shape = critics, critics.shape
        self._function = RowFunction(SlopeDifferences(shape, members), n, critics.row)
        depth, ends = len(shape.hidden), list[tuple[list[Tensor], list[Tensor]]]()
        width, results = 2 * depth + 1, self._function.results
        for first in range(0, len(results), width):
            ends.append((results[first : first + depth], results[first + depth : first + width]))
        self._products = []
        for k, gradients in enumerate(members_of(critics.gradients)):
            for sign, (hidden, slopes) in zip((1.0, -1.0), ends[2 * k : 2 * k + 2], strict=True):
                self._products.append((sign, hidden, slopes, gradients))

    def add(
        self,
        x: Float[Tensor, "n_x n"],
        direction: Float[Tensor, "n n_a"],
        wanted: Float[Tensor, " n"],
        share: Float[Tensor, " n"],
    ) -> None:
        """Add the gradients.

        Args:
            x: features and increments.
            direction: directions of the actions.
            wanted: slopes along them.
            share: weight of each row.
        """
        way, shape = REACH * direction.t(), self._critics.shape
        torch.cat([x, way, wanted.unsqueeze(0), share.unsqueeze(0)], out=self._function.rows)
        self._function(self._critics.row)
        self._critics.expect_change()
        for sign, hidden, slopes, gradients in self._products:
            first = torch.cat([x[: shape.n_o], x[shape.n_o :] + sign * way])
            inputs = [first, *hidden]
            for slope, left, by_weight, by_bias in zip(slopes, inputs, gradients[::2], gradients[1::2], strict=True):
                by_weight.addmm_(slope, left.t())
                by_bias.add_(slope.sum(1))
