"""Step 2: critic and model-free policy by DDPG, from TorchRL's parts."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import MultiStep
from torchrl.modules import ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from rt_torchrl.interruption import safe_point
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.policies import mlp
from rt_torchrl.plants.signal import bounds
from rt_torchrl.twinning.memory import LongTermMemory

TRANSITION = ("observation", "action", *(("next", key) for key in ("observation", "reward", "done", "terminated")))


@dataclass(frozen=True, kw_only=True)
class ModelFreeConfig:
    """Parameters of step 2.

    Args:
        critic_iterations: n_Q.
        actor_iterations: n_A.
        batch_size: n_b; at most n_t transitions are sampled.
        discount: γ per control interval.
        return_steps: control intervals whose rewards a target sums before it bootstraps; 1 as in the paper. A control
            interval that is short beside the dynamics makes one action matter little, and less than the critic's error.
        reward_scale: factor on the rewards the critic learns from, so that its values are of the order of ten, which
            a perceptron reaches within an episode; a value is the mean reward over 1 − γ. What is reported is unscaled.
        target_rate: τ of the target critic.
        critic_rate: learning rate of the critic (Adam).
        actor_rate: learning rate of the policy (Adam).
        gradient_limit: greatest norm of the policy's gradient.
        critic_hidden: widths of the critic's hidden layers.
    """

    critic_iterations: int = 500
    actor_iterations: int = 1000
    batch_size: int = 128
    discount: float = 0.98
    return_steps: int = 1
    reward_scale: float = 1.0
    target_rate: float = 0.01
    critic_rate: float = 1e-3
    actor_rate: float = 2e-3
    gradient_limit: float = 1.0
    critic_hidden: Sequence[int] = field(default=(64, 64))

    def __post_init__(self):
        for argument in ("critic_iterations", "actor_iterations"):
            if getattr(self, argument) < 0:
                raise ValueError(f"{argument}={getattr(self, argument)} must not be negative.")
        for argument in ("batch_size", "return_steps"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least 1.")
        if not 0.0 <= self.discount < 1.0:
            raise ValueError(f"discount={self.discount} must lie in [0, 1); the critic bootstraps through truncation.")
        for argument in ("reward_scale", "target_rate", "critic_rate", "actor_rate", "gradient_limit"):
            if not getattr(self, argument) > 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} must be positive.")


class Critic(nn.Module):
    """q(e, a): a perceptron of the observation and of the action scaled from its range to [−1, 1].

    Args:
        plant: gives the number of observations and the ranges of the actions.
        hidden: widths of the hidden layers.
        generator: source of the initial weights.
    """

    def __init__(self, plant: Plant, hidden: Sequence[int], *, generator: torch.Generator):
        super().__init__()
        low, high = bounds(plant.actions)
        self.register_buffer("middle", 0.5 * (low + high))
        self.register_buffer("half_range", 0.5 * (high - low))
        self.network = mlp(
            len(plant.observations) + len(plant.actions), hidden, 1, generator=generator, activation=nn.SiLU
        )

    def forward(
        self, observation: Float[Tensor, "*batch n_o"], action: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch 1"]:
        return self.network(torch.cat([observation, (action - self.middle) / self.half_range], -1))


class ModelFree:
    r"""Deep deterministic policy gradient with prioritised replay (paper, section 4.1).

    .. math::
        y_k = \sum_{j<m}\gamma^jr_{k+j} + \gamma^m\,q'(e_{k+m}, \pi(e_{k+m})), \quad \delta_k = y_k - q(e_k, a_k), \quad
        J_q = \mathbb E[w_k\delta_k^2], \quad \frac{dR}{dw_a} = \mathbb E\Big[\frac{dq}{da}\frac{d\pi}{dw_a}\Big]

    with the target critic q′, the importance weights w of the sampling and, in the paper, m = 1.

    Args:
        plant: see :class:`Critic`.
        policy: π_mf, updated in place.
        config: see :class:`ModelFreeConfig`.
        generator: source of the critic's initial weights.

    Raises:
        ValueError: if ``return_steps`` exceeds an episode of the plant.
    """

    def __init__(
        self,
        plant: Plant,
        policy: nn.Module,
        config: ModelFreeConfig,
        *,
        generator: torch.Generator,
    ):
        if config.return_steps > plant.n_steps:
            raise ValueError(
                f"return_steps={config.return_steps} exceeds the {plant.n_steps} control intervals of an episode of "
                f"plant {plant.name!r}; use at most a tenth of them, or a longer horizon."
            )
        self.config, self.policy = config, policy
        self.critic = Critic(plant, config.critic_hidden, generator=generator).to(generator.device)
        self.loss = DDPGLoss(
            TensorDictModule(policy, in_keys=["observation"], out_keys=["action"]),
            ValueOperator(self.critic, in_keys=["observation", "action"]),
            loss_function="l2",
            delay_actor=False,
            delay_value=True,
        )
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=config.discount)
        self.target = SoftUpdate(self.loss, tau=config.target_rate)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), lr=config.critic_rate)
        self._returns = MultiStep(config.discount, config.return_steps)
        self.restart()

    def transitions(self, episode: TensorDictBase) -> TensorDictBase:
        """What D_L keeps of an episode, a TensorDict: (e_k, a_k, return, e_{k+m}) of the intervals with m after them.

        The last m − 1 are left out: with shorter sums, the values of where episodes end, such as a target that is
        reached, would rest on hardly anything but themselves, and drift without bound.
        """
        whole = len(episode) - self.config.return_steps + 1
        transitions = episode.select(*TRANSITION)
        transitions["next", "reward"] = self.config.reward_scale * transitions["next", "reward"]
        returns = self._returns(transitions.unsqueeze(0))[0, :whole]
        return returns.select(*TRANSITION, "steps_to_next_obs", strict=False)

    def restart(self) -> None:
        """Forget the state of the policy's optimiser, because its weights have jumped."""
        self.actor_optimiser = torch.optim.Adam(self.policy.parameters(), lr=self.config.actor_rate)

    @torch.no_grad()
    def td_errors(self, transitions: TensorDictBase) -> Float[Tensor, " n"]:
        """|δ| of transitions under the critic and target critic as they are."""
        return _critic_loss(self.loss, transitions.copy())[1]

    def update(self, memory: LongTermMemory, episode_length: int) -> TensorDict:
        """n_Q critic iterations, then n_A policy iterations.

        Args:
            memory: D_L; the TD errors of what is sampled are refreshed.
            episode_length: n_t.

        Returns:
            Means over the iterations of ``critic_loss``, ``td_error``, ``value`` and both gradient norms; the first
            three for the rewards as they are, without ``reward_scale``.
        """
        size, scale = min(self.config.batch_size, episode_length), self.config.reward_scale
        found = {key: [] for key in ("critic_loss", "td_error", "critic_gradient", "value", "actor_gradient")}
        for _ in range(self.config.critic_iterations):
            safe_point()
            batch = memory.sample(size)
            loss, td_error = _critic_loss(self.loss, batch)
            self.critic_optimiser.zero_grad(set_to_none=True)
            loss.backward()
            norm = nn.utils.get_total_norm([w.grad for w in self.critic.parameters()])
            self.critic_optimiser.step()
            self.target.step()
            memory.refresh(batch["index"], td_error)
            for key, value in zip(found, (loss.detach() / scale**2, td_error.mean() / scale, norm), strict=False):
                found[key].append(value)
        for batch in memory.samples(size, self.config.actor_iterations):
            safe_point()
            loss = _actor_loss(self.loss, batch)
            self.actor_optimiser.zero_grad(set_to_none=True)
            loss.backward()
            norm = nn.utils.clip_grad_norm_(self.policy.parameters(), self.config.gradient_limit)
            self.actor_optimiser.step()
            found["value"].append(-loss.detach() / scale)
            found["actor_gradient"].append(norm)
        return TensorDict({key: torch.stack(values).mean() for key, values in found.items() if values})


def _critic_loss(loss: DDPGLoss, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
    """J_q and |δ| of each transition; TorchRL reports δ²."""
    value, metadata = loss.loss_value(batch)
    return value, metadata["td_error"].sqrt()


def _actor_loss(loss: DDPGLoss, batch: TensorDictBase) -> Tensor:
    """−E[q(e, π(e))], with the critic's weights detached."""
    return loss.loss_actor(batch)[0]
