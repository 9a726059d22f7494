"""Deep deterministic policy gradient, the paper's step 2, from TorchRL's parts."""

import warnings

from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from rt_torchrl.plants.plant import Plant
from rt_torchrl.twinning.learners.actor_critic import ActorCritic, Critic, Iterations, means
from rt_torchrl.twinning.learners.explicit.iterations import ExplicitDDPG
from rt_torchrl.twinning.learners.explicit.policies import activation_of

COVERED = ("make_loss", "critic_loss", "actor_loss", "critic_step", "actor_step", "batches", "move_targets")
"""The methods whose computations the formulas replace."""
TOLD: set[str] = set()
"""The obstacles of which a notice has been given."""


class DDPG(ActorCritic):
    r"""Deep deterministic policy gradient with prioritised replay (paper, section 4.1).

    .. math::
        J_q = \mathbb E[w_k\delta_k^2], \qquad
        \frac{dR}{dw_a} = \mathbb E\Big[\frac{dq}{da}\frac{d\pi}{dw_a}\Big]

    It has one critic q with its target q′; w are the importance weights of the sampling. An update makes n_Q iterations
    of the critic, then n_A iterations of the policy. :class:`ActorCritic` describes the arguments and δ.
    """

    def make_critics(self, plant: Plant) -> list[Critic]:
        return [Critic(plant, self.config.critic_hidden, generator=self.generator)]

    def make_loss(self, plant: Plant) -> DDPGLoss:
        (critic,) = self.critic_modules()
        loss = DDPGLoss(self.actor_module(), critic, loss_function="l2", delay_actor=False, delay_value=True)
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.config.discount)
        self.target = SoftUpdate(loss, tau=self.config.target_rate)
        return loss

    @property
    def critic(self) -> nn.Module:
        """The critic q."""
        return self.critics[0]

    def critic_weights(self) -> list[nn.Parameter]:
        return list(self.critic.parameters())

    def critic_loss(self, batch: TensorDictBase) -> tuple[Tensor, Float[Tensor, " n"]]:
        value, metadata = self.loss.loss_value(batch)
        return value, metadata["td_error"].sqrt()  # TorchRL reports δ²

    def critic_value(self, pairs: TensorDict, number: int) -> Float[Tensor, "n 1"]:
        return self.critics[number](pairs["observation"], pairs["action"])

    def actor_loss(self, batch: TensorDictBase) -> Tensor:
        return self.loss.loss_actor(batch)[0]

    def update(self) -> TensorDict:
        """Make n_Q iterations of the critic, then n_A iterations of the policy.

        Returns:
            Means of ``critic_loss``, ``td_error``, ``value`` and both gradient norms over the iterations; the first
            three are for the rewards without ``reward_scale``. Of an update that leaves numbers that are not finite,
            and so is taken back, the ``reason`` instead.
        """
        return self.sound(self._iterate)

    def _iterate(self) -> TensorDict:
        iterations, critic = self._iterations(), []
        for _ in range(self.config.critic_iterations):
            critic.append(iterations.critic_step())
            iterations.move_targets()
        actor = [iterations.actor_step(batch) for batch in iterations.batches(self.config.actor_iterations)]
        return means(critic, actor, self.config.reward_scale)

    def _iterations(self) -> Iterations:
        """The iterations of an update: by formula where the formulas hold, else those of TorchRL's loss."""
        if self.config.update == "torchrl":
            return self
        found = self._obstacle()
        if found is None:
            return ExplicitDDPG(self)
        if found not in TOLD:
            TOLD.add(found)
            warnings.warn(f"Step 2 uses TorchRL's losses, which are slower, because {found}.", stacklevel=3)
        return self

    def _obstacle(self) -> str | None:
        """Why the formulas do not hold for a learner; None if they do."""
        own = type(self)
        changed = [name for name in COVERED if getattr(own, name) is not getattr(DDPG, name)]
        if changed:
            return f"{own.__name__} has its own {' and '.join(changed)}"
        for critic in self.critics:
            if type(critic) is not Critic or activation_of(critic.network) is not nn.SiLU:
                return f"the critic {type(critic).__name__} is no Critic of SiLU layers"
            if not all(weight.requires_grad for weight in critic.parameters()):
                return f"some weights of the critic {type(critic).__name__} are frozen"
        return None
