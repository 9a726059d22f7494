"""Critics of the full state, with rescaled values, and TorchRL's loss of TD3 for them."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import step_mdp
from torchrl.objectives import TD3Loss

from rt_torchrl.plants.increments import Increments
from rt_torchrl.twinning.learners.explicit.critic_formulas import FLOOR, symexp, symlog
from rt_torchrl.twinning.learners.explicit.slope_formulas import REACH


class InformedCritic(nn.Module):
    """The rescaled value f(x, ω, u): a perceptron with layer normalisation of features, innovations and increments.

    Args:
        n_features: number of features x.
        n_innovations: number of innovations ω of the inputs within a decision.
        n_actions: number of actions.
        hidden: widths of the hidden layers.
        generator: source of the initial weights.
    """

    def __init__(
        self,
        n_features: int,
        n_innovations: int,
        n_actions: int,
        hidden: Sequence[int],
        *,
        generator: torch.Generator,
    ):
        super().__init__()
        widths = (n_features + n_innovations + n_actions, *hidden, 1)
        self.linear = nn.ModuleList()
        for fan_in, fan_out in zip(widths, widths[1:], strict=False):
            layer = nn.Linear(fan_in, fan_out, dtype=torch.float64, device=generator.device)
            with torch.no_grad():
                layer.weight.normal_(0.0, fan_in**-0.5, generator=generator)
                layer.bias.zero_()
            self.linear.append(layer)

    def forward(
        self,
        features: Float[Tensor, "*batch n_x"],
        innovation: Float[Tensor, "*batch n_y"],
        action: Float[Tensor, "*batch n_a"],
    ) -> Float[Tensor, "*batch 1"]:
        h = torch.cat([features, innovation, action], -1)
        *hidden, last = self.linear
        for layer in hidden:
            z = layer(h)
            h = nn.functional.silu(nn.functional.layer_norm(z, z.shape[-1:], eps=FLOOR))
        found: Tensor = last(h)
        return found


class IncrementalPolicy(nn.Module):
    """A policy whose command is scaled to increments, within what the actuators reach.

    Args:
        policy: policy of the observation.
        increments: scales of the actions.
    """

    def __init__(self, policy: nn.Module, increments: Increments):
        super().__init__()
        self.policy, self._scales = policy, (increments,)  # a tuple, because no target follows the scales

    def forward(
        self, observation: Float[Tensor, "*batch n_o"], centre: Float[Tensor, "*batch n_a"], features: Tensor
    ) -> Float[Tensor, "*batch n_a"]:
        """Increments; the features, which only the critics see, are ignored."""
        (increments,) = self._scales
        return increments.scaled(centre, self.policy(observation)).clamp(-1.0, 1.0)


class RescaledTD3Loss(TD3Loss):
    r"""TorchRL's loss of TD3 for critics :math:`f = h(q)` of rescaled values, without smoothing.

    .. math::
        \delta_i = f_i(x, \omega, u) - h\Big(r + \gamma h^{-1}\Big(
            \frac1M\sum_j f_j'(x', \omega', \pi')\Big)\Big), \qquad
        J_q = \sum_i\mathbb E[w\,\delta_i^2], \qquad
        J_\pi = -\mathbb E\Big[\frac1M\sum_i f_i(x, \omega, \pi)\Big]

    The least of the critics, which TD3's targets take, leans to small actions, and the mean does not. The batch holds
    the discount of each transition, because their sums of rewards differ in length, and w. The innovation ω' is drawn
    anew each time (:func:`drawn_anew`), so that the mean over draws is that of all futures.
    """

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        with torch.no_grad():
            following = step_mdp(tensordict).select(*self.actor_network.in_keys)
            with self.target_actor_network_params.to_module(self.actor_network):
                following = self.actor_network(following)
            following["innovation"] = drawn_anew(tensordict["innovation"])
            value = self._values(following, self.target_qvalue_network_params).mean(0)
            discount, reward = tensordict["next", "discount"], tensordict["next", "reward"]
            target = symlog(reward + discount * symexp(value.unsqueeze(-1))).squeeze(-1)
        errors = self._values(tensordict, self.qvalue_network_params) - target
        loss = (tensordict["weight"].squeeze(-1) * errors.square()).mean(-1).sum()
        return loss, {"td_error": errors.detach().abs().amax(0)}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        acted = tensordict.select(*self.actor_network.in_keys, "innovation")
        with self.actor_network_params.to_module(self.actor_network):
            acted = self.actor_network(acted)
        value = self._values(acted, self._cached_detach_qvalue_network_params).mean(0)
        return -value.mean(), {"state_action_value_actor": value.detach()}

    def slope_loss(self, tensordict: TensorDictBase, direction: Float[Tensor, "n n_a"]) -> Tensor:
        """The loss of slopes that :class:`SlopeDifferences` describes, with the weights ``slope_weight``."""
        up, down = tensordict.clone(False), tensordict.clone(False)
        up["action"] = tensordict["action"] + REACH * direction
        down["action"] = tensordict["action"] - REACH * direction
        high, low = (self._values(pairs, self.qvalue_network_params) for pairs in (up, down))
        wanted = (tensordict["slope"] * direction).sum(-1) * torch.exp(-0.5 * (high + low).detach().abs())
        errors = (high - low) / (2.0 * REACH) - wanted
        return (tensordict["slope_weight"].squeeze(-1) * errors.square()).mean(-1).sum()

    def _values(self, pairs: TensorDictBase, weights: TensorDictBase) -> Float[Tensor, "members n"]:
        pairs = pairs.select(*self.qvalue_network.in_keys).expand(self.num_qvalue_nets, *pairs.batch_size)
        found: Tensor = self._vmap_qvalue_network00(pairs, weights).get(self.tensor_keys.state_action_value)
        return found.squeeze(-1)


def drawn_anew(innovation: Float[Tensor, "n n_y"]) -> Float[Tensor, "n n_y"]:
    """For each row of a random batch the innovation of another one, which is a draw of what may come next."""
    return innovation.roll(1, 0)
