"""Deep deterministic policy gradient, the paper's step 2, from TorchRL's parts."""

from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from rt_torchrl.plants.plant import Plant
from rt_torchrl.twinning.learners.actor_critic import ActorCritic, Critic, means
from rt_torchrl.twinning.learners.explicit.choice import iterations_of
from rt_torchrl.twinning.learners.explicit.ddpg import ExplicitDDPG


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
        iterations, critic = iterations_of(self, DDPG, ExplicitDDPG), []
        for _ in range(self.config.critic_iterations):
            critic.append(iterations.critic_step())
            iterations.move_targets()
        actor = [iterations.actor_step(batch) for batch in iterations.batches(self.config.actor_iterations)]
        return means(critic, actor, self.config.reward_scale)
