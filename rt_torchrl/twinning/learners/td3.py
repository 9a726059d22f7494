"""Twin delayed deep deterministic policy gradient, from TorchRL's parts."""

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate, TD3Loss, ValueEstimators

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.twinning.learners.actor_critic import ActorCritic, Critic, means

CRITICS = 2


class TD3(ActorCritic):
    r"""TD3 with prioritised replay and sums of rewards.

    .. math::
        y_k = \sum_{j<m}\gamma^jr_{k+j} + \gamma^m\min_i q_i'(e_{k+m}, \pi'(e_{k+m}) + \epsilon), \qquad
        \epsilon \sim \mathrm{clip}(\mathcal N(0, \sigma^2), -c, c)

    DDPG's policy goes where its one critic errs upwards. TD3 takes the lower value of two critics, averages a target
    over neighbouring actions, and lets policy and targets follow the critics with a delay. The priority of a transition
    is the greater |δ| of the two critics. :class:`ActorCritic` describes the arguments.

    Source: Fujimoto, van Hoof, Meger, *Addressing function approximation error in actor-critic methods*, ICML 2018.
    """

    def make_critics(self, plant: Plant) -> list[Critic]:
        return [Critic(plant, self.config.critic_hidden, generator=self.generator) for _ in range(CRITICS)]

    def make_loss(self, plant: Plant) -> TD3Loss:
        low, high = bounds(plant.actions, device=self.generator.device)
        half_range, config = 0.5 * (high - low), self.config.td3
        loss = TD3Loss(
            self.actor_module(),
            self.critic_modules(),
            bounds=(low, high),
            num_qvalue_nets=CRITICS,
            policy_noise=config.smoothing * half_range,
            noise_clip=config.smoothing_limit * half_range,
            loss_function="l2",
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.config.discount)
        self.target = SoftUpdate(loss, tau=self.config.target_rate)
        return loss

    def critic_weights(self) -> list[nn.Parameter]:
        return [w for w in self.loss.qvalue_network_params.parameters() if w.requires_grad]

    def critic_loss(self, batch: TensorDictBase) -> tuple[Tensor, Float[Tensor, " n"]]:
        # TorchRL draws the smoothing from the global generator, which this learner's own generator seeds here.
        device = self.generator.device
        seed = torch.randint(2**31, (), generator=self.generator, device=device)
        with torch.random.fork_rng(devices=[device] if device.type != "cpu" else []):
            torch.manual_seed(seed.item())
            loss, metadata = self.loss.value_loss(batch)
        return loss, metadata["td_error"].detach().max(0).values.sqrt()

    def critic_value(self, pairs: TensorDict, number: int) -> Float[Tensor, "n 1"]:
        network = self.loss.qvalue_network
        with self.loss.qvalue_network_params[number].to_module(network):
            return network(pairs.copy())["state_action_value"]

    def actor_loss(self, batch: TensorDictBase) -> Tensor:
        return self.loss.actor_loss(batch)[0]

    def update(self) -> TensorDict:
        """Make n_Q iterations of the critics; every ``delay`` of them, update the policy once and move the targets.

        Returns:
            The same means as :meth:`DDPG.update <rt_torchrl.twinning.learners.ddpg.DDPG.update>`.
        """
        return self.sound(self._iterate)

    def _iterate(self) -> TensorDict:
        critic, actor = [], []
        for iteration in range(1, self.config.critic_iterations + 1):
            critic.append(self.critic_step())
            if iteration % self.config.td3.delay == 0:
                actor += [self.actor_step(batch) for batch in self.batches(1)]
                self.move_targets()
        return means(critic, actor, self.config.reward_scale)
