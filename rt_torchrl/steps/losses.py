"""Losses of TorchRL that step 2 learns by, and their networks: a policy with scaled actions, and critics."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import torch
from jaxtyping import Float
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import BatchRenorm1d, ProbabilisticActor, ValueOperator
from torchrl.objectives import CrossQLoss, DDPGLoss, LossModule, REDQLoss, SACLoss, TD3Loss

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.policies import mlp
from rt_torchrl.plants.signal import bounds


class LearningMethod(NamedTuple):
    """A model-free method: the loss, and what it needs.

    Args:
        make_loss: function of actor and critics, in the form that TorchRL's losses take, that makes the loss. Actions
            are scaled to [−1, 1].
        critics: number of critics.
        stochastic: whether the actor is a distribution around π_mf, whose spread is learned, too.
        delay: number of critic iterations for each iteration of policy and targets; 0 makes all iterations of the
            critic first, each with one of its target, and then those of the policy, as the paper does.
        squared: whether the loss reports δ² as ``td_error``, and not |δ|.
        normalised: whether the layers of the critics are normalised over a batch.
        relaxed: whether a critic without targets takes only the share τ of each of its steps.
        draws: whether the loss draws random numbers.
        gradient_limit: greatest norm of the policy's gradient.
        correction: exponent of the importance weights; 1 removes the bias of the prioritised sampling.
    """

    make_loss: Callable[[TensorDictModuleBase, list[ValueOperator]], LossModule]
    critics: int = 1
    stochastic: bool = False
    delay: int = 1
    squared: bool = True
    normalised: bool = False
    relaxed: bool = False
    draws: bool = True
    gradient_limit: float = 1.0
    correction: float = 0.4


def ddpg_loss(actor: TensorDictModuleBase, critics: list[ValueOperator], *, target: bool = True) -> LossModule:
    """DDPG, the paper's method (section 4.1), with a target of the critic or without one, as its line 17 has it."""
    return DDPGLoss(actor, critics[0], loss_function="l2", delay_value=target)


def td3_loss(actor: TensorDictModuleBase, critics: list[ValueOperator]) -> LossModule:
    """TD3: the lower of two values at smoothed target actions (Fujimoto, van Hoof, Meger, ICML 2018)."""
    return TD3Loss(actor, critics, bounds=(-1.0, 1.0), num_qvalue_nets=len(critics), loss_function="l2")


def entropic(loss: Callable[..., LossModule]) -> Callable[[TensorDictModuleBase, list[ValueOperator]], LossModule]:
    """A loss that prices the entropy of scaled actions: SAC, CrossQ or REDQ."""

    def make(actor: TensorDictModuleBase, critics: list[ValueOperator]) -> LossModule:
        n_a = cast(ProbabilisticActor, actor).spec["action"].shape[-1]
        options = {"num_qvalue_nets": len(critics), "loss_function": "l2", "target_entropy": -float(n_a)}
        instance = loss(actor, critics, alpha_init=0.1, **options)
        float(instance.target_entropy)  # REDQ registers it when it is first read, too late for a state that is loaded
        return instance

    return make


METHODS: dict[str, LearningMethod] = {
    "ddpg": LearningMethod(ddpg_loss, delay=0, draws=False),
    "relaxed_ddpg": LearningMethod(
        functools.partial(ddpg_loss, target=False),
        delay=0,
        relaxed=True,
        draws=False,
        gradient_limit=math.inf,
        correction=0.0,
    ),
    "td3": LearningMethod(td3_loss, critics=2, delay=2),
    "sac": LearningMethod(entropic(SACLoss), critics=2, stochastic=True, squared=False),
    "crossq": LearningMethod(entropic(CrossQLoss), critics=2, stochastic=True, squared=False, normalised=True),
    "redq": LearningMethod(entropic(REDQLoss), critics=4, stochastic=True),
}
"""The methods that a configuration can name."""


class Critic(nn.Module):
    """The value q(e, a): a perceptron of the observation and of the action scaled to [−1, 1].

    Args:
        widths: numbers of inputs and of units of each hidden layer.
        normalised: whether the inputs of each layer are normalised over a batch.
        generator: source of the initial weights.
    """

    def __init__(self, widths: Sequence[int], *, normalised: bool = False, generator: torch.Generator):
        super().__init__()
        self.network = mlp(widths[0], widths[1:], 1, generator=generator, activation=nn.SiLU)
        if normalised:
            layers, device = list(self.network), generator.device
            norms = iter([BatchRenorm1d(width).to(device, torch.float64) for width in widths])
            parts = [[next(norms), layer] if isinstance(layer, nn.Linear) else [layer] for layer in layers]
            self.network = nn.Sequential(*(part for group in parts for part in group))

    def forward(
        self, observation: Float[Tensor, "*batch n_o"], action: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch 1"]:
        return self.network(torch.cat([observation, action], -1))


class ScaledPolicy(nn.Module):
    """A policy with its actions scaled to [−1, 1] or, as a distribution, location and spread before the tanh.

    Args:
        plant: plant that gives the ranges of the actions.
        policy: the policy.
        stochastic: whether it is a distribution around the policy.
        device: device of the ranges.
    """

    middle: Tensor
    half_range: Tensor
    LEAST, GREATEST = -5.0, 1.0
    """Bounds on the logarithm of the spread."""
    EDGE = 1.0 - 1e-6
    """Greatest scaled action whose location is finite enough."""

    def __init__(self, plant: Plant, policy: nn.Module, *, stochastic: bool, device: torch.device):
        super().__init__()
        low, high = bounds(plant.actions, device=device)
        self.register_buffer("middle", 0.5 * (low + high))
        self.register_buffer("half_range", 0.5 * (high - low))
        self.policy = policy
        self.log_spread = None
        if stochastic:
            self.log_spread = nn.Linear(len(plant.observations), len(low), dtype=torch.float64, device=device)
            nn.init.zeros_(self.log_spread.weight)
            nn.init.constant_(self.log_spread.bias, -1.0)

    def scaled(self, action: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_a"]:
        """Actions from their range to [−1, 1]."""
        return (action - self.middle) / self.half_range

    def forward(self, observation: Float[Tensor, "*batch n_o"]) -> Tensor | tuple[Tensor, Tensor]:
        share = self.scaled(self.policy(observation))
        if self.log_spread is None:
            return share
        spread = self.log_spread(observation).clamp(self.LEAST, self.GREATEST).exp()
        return torch.atanh(share.clamp(-self.EDGE, self.EDGE)), spread
