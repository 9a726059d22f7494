"""Incremental TD3: critics that see the full state and what a command changes, from TorchRL's parts."""

from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import ValueOperator
from torchrl.objectives import SoftUpdate

from rt_torchrl.plants.increments import Increments
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.findings import findings, merged
from rt_torchrl.twinning.learners.actor_critic import means
from rt_torchrl.twinning.learners.candidate import Candidate
from rt_torchrl.twinning.learners.config import LearnerConfig
from rt_torchrl.twinning.learners.episode_memory import EpisodeMemory, decision_intervals
from rt_torchrl.twinning.learners.explicit.critic_formulas import symexp
from rt_torchrl.twinning.learners.explicit.incremental_td3 import ExplicitIncrementalTD3
from rt_torchrl.twinning.learners.informed_critic import IncrementalPolicy, InformedCritic, RescaledTD3Loss
from rt_torchrl.twinning.learners.innovations import count_innovations
from rt_torchrl.twinning.learners.lesson import Lesson
from rt_torchrl.twinning.learners.rescaled_iterations import RescaledIterations
from rt_torchrl.twinning.learners.twin_teacher import TwinTeacher
from rt_torchrl.twinning.learners.weights import MeanWeights, change_of_actions, step_towards, weights_of

UPDATES = 2
"""Number of updates within which values reach through the horizon; before, slopes are those of what is near."""
FASTEST = 0.5
"""Greatest rate of the targets; beyond it they are hardly others than the critics."""
WINDOW = 100
"""Number of critic iterations over which |δ| is averaged."""


class IncrementalTD3:
    r"""TD3 for actuators with rate limits and policies that see little, with few real episodes.

    - *Increments.* The critics see an action as what it changes of the applied one, in units of the rate limit
      (:class:`Increments`).
    - *Asymmetry.* They see observation, state, exogenous input and, among the states, the applied action; the policy
      sees its observation.
    - *Decisions.* A decision lasts as many control intervals as make ``decisions`` of them last 1/(1 − γ).
    - *Rescaled values.* Rewards are counted in the mean cost of the cheapest episode, and critics give the logarithm
      of values (:func:`symlog`), which may span four orders of magnitude.
    - *Targets.* They follow the critics at least so fast that values reach through the horizon within two updates.
    - *Latest states.* The policy is improved in the states of the latest episodes alone, its new weights are a mean
      over the iterations of an update, and the actions change by no more than the trust region allows.
    - *Patience.* The policy waits after a clone until the TD errors have settled.
    - *Proof.* An update makes a candidate. The policy has its weights in the next real episode, and goes back to the
      earlier ones if this costs much more than the latest episodes of weights that were kept (:class:`Candidate`).
    - *Twin.* A twin that is trusted teaches slopes and adds transitions (:class:`TwinTeacher`).
    - *Ends.* What comes after an early end is known, so that nothing is bootstrapped there (:class:`EpisodeMemory`).

    Sums of several rewards hold for the policy that flew them; ``return_episodes`` says for how many episodes the
    present policy is near enough to it. :class:`RescaledTD3Loss` is the loss.

    Args:
        plant: plant that gives signals and actuators.
        policy: policy π_mf, updated in place.
        config: parameters of step 2.
        generator: source of the critics' initial weights and of the samples.

    Raises:
        ValueError: if a transition does not fit into an episode of the plant, or an action has no finite range.
    """

    def __init__(self, plant: Plant, policy: nn.Module, config: LearnerConfig, *, generator: torch.Generator):
        self.config, self.policy, self.generator = config, policy, generator
        device, own = generator.device, config.incremental
        intervals = decision_intervals(config.discount, own.decisions)
        self.decisions = max(1, config.return_steps // intervals)
        if self.decisions * intervals >= plant.n_steps:
            raise ValueError(
                f"return_steps={config.return_steps} in decisions of {intervals} control intervals do not fit into the "
                f"{plant.n_steps} of an episode of plant {plant.name!r}; use fewer, or a longer horizon."
            )
        self.increments = Increments(plant, intervals=intervals, device=device)
        self.memory = EpisodeMemory(
            own.episodes,
            self.increments,
            intervals=intervals,
            discount=config.discount,
            horizon=plant.n_steps,
            end_cost=plant.end_cost,
        )
        self.batch_size = min(config.batch_size, plant.n_steps)
        self.loss = self._make_loss(plant)
        self.target = SoftUpdate(self.loss, tau=self._target_rate())
        weights = [weight for weight in self.loss.qvalue_network_params.parameters() if weight.requires_grad]
        self.critic_optimiser = torch.optim.Adam(weights, lr=config.critic_rate)
        self.trust = own.trust
        self._teacher: TwinTeacher | None = None
        self.restart()

    def _target_rate(self) -> float:
        """Rate of the targets: at least so fast that values reach through the horizon within ``UPDATES`` updates.

        A target of n decisions carries values n decisions further each time that the target critics have followed.
        """
        own, config = self.config.incremental, self.config
        backups = own.decisions / self.decisions
        return min(FASTEST, max(config.target_rate, backups * own.delay / max(1, UPDATES * config.critic_iterations)))

    def _make_loss(self, plant: Plant) -> RescaledTD3Loss:
        n_x, n_a = len(plant.observations) + len(plant.states) + len(plant.inputs), len(plant.actions)
        count, one = self.config.incremental.critics, torch.ones_like(self.increments.low)
        n_y, hidden = count_innovations(len(plant.inputs), self.memory.intervals), self.config.critic_hidden
        critics = [InformedCritic(n_x, n_y, n_a, hidden, generator=self.generator) for _ in range(count)]
        operators = [ValueOperator(critic, in_keys=["features", "innovation", "action"]) for critic in critics]
        actor = self.actor_module()
        return RescaledTD3Loss(actor, operators, bounds=(-one, one), num_qvalue_nets=count, loss_function="l2")

    def actor_module(self) -> TensorDictModule:
        """The policy in the form that TorchRL's losses take, with increments as its actions."""
        actor = IncrementalPolicy(self.policy, self.increments)
        return TensorDictModule(actor, in_keys=["observation", "centre", "features"], out_keys=["action"])

    @property
    def trust(self) -> float:
        """Trust in the twin from 0 to 1: weight of its slopes and of its transitions."""
        return self._trust

    @trust.setter
    def trust(self, trust: float) -> None:
        if not 0.0 <= trust <= 1.0:
            raise ValueError(f"trust={trust} in the twin must lie in [0, 1].")
        self._trust = trust

    @property
    def asks_for_trust(self) -> bool:
        """Whether the trust is to be measured, because the twin is to teach something."""
        own = self.config.incremental
        return own.measured and (own.slopes or own.virtual > 0)

    def trust_twin(self, probability: float) -> None:
        """Trust the twin with the probability that it is right about the policy."""
        self.trust = probability

    def take_twin(self, twin: DigitalTwin) -> None:
        """Learn from this twin as far as it is trusted."""
        self._teacher = TwinTeacher(twin, self.policy, self.memory)

    def teacher(self) -> TwinTeacher:
        """What the twin teaches.

        Raises:
            ValueError: if there is no twin.
        """
        if self._teacher is None:
            raise ValueError(
                f"trust={self.trust} needs a twin; give the learner one by take_twin, as ReinforcementTwinning does in "
                "the arm twinning, or set trust to 0."
            )
        return self._teacher

    from_the_start = True
    """A twin that teaches counts the time from the first interval that is stored."""

    @property
    def shortest(self) -> int:
        """Least number of control intervals in a row that can be stored."""
        return self.decisions * self.memory.intervals + 1

    def store(self, episode: TensorDictBase) -> None:
        """See :meth:`Learner.store`; a TensorDict with ``state`` and ``exogenous``, too."""
        self.memory.store(episode)

    def adopt(self) -> None:
        """Give the policy the weights of the candidate, which is to fly a real episode or to be judged on a twin."""
        self.candidate.board()

    def flown(self, cost: float) -> None:
        """Keep the weights that the policy has flown with, or go back to the earlier ones.

        Args:
            cost: J_a of the real episode.
        """
        if not self.candidate.flown(cost):
            self._forget_actor()

    def grounded(self) -> None:
        """Go back to the proved weights, because the adopted ones have not flown a whole episode."""
        self.candidate.ground()

    def observations(self) -> Float[Tensor, "n n_o"]:
        """See :meth:`Learner.observations`."""
        return self.memory.observations()

    def restart(self) -> None:
        """Forget the policy's optimiser and past, and let the policy wait for its critics."""
        self.candidate, self._updates = Candidate(self.policy, self.config.incremental.recovery), 0
        self._forget_actor()

    def _forget_actor(self) -> None:
        self.actor_optimiser = torch.optim.Adam(self.policy.parameters(), lr=self.config.incremental.actor_rate)
        self.loss.target_actor_network_params.data.copy_(self.loss.actor_network_params.data)
        self._waiting = True

    def update(self) -> TensorDict:
        """Make n_Q iterations of the critics; every ``delay`` of them, update the policy once and move the targets.

        Returns:
            The same means as :meth:`DDPG.update <rt_torchrl.twinning.learners.ddpg.DDPG.update>`; loss and |δ| are
            those of the rescaled values.

        Raises:
            ValueError: if a trust above zero has no twin.
        """
        own, iterations = self.config.incremental, self.config.critic_iterations
        self.candidate.board()  # one that has not flown, because another policy is live
        scale = (1.0 - self.config.discount) / self.memory.cost()
        lesson = Lesson(self, scale)
        parts = (ExplicitIncrementalTD3 if self.config.update == "explicit" else RescaledIterations)(self, lesson.data)
        self.actor_optimiser.param_groups[0]["lr"] = own.actor_rate / (1.0 + self._updates / own.cooling)
        earlier, mean = weights_of(self.policy), MeanWeights(self.policy)
        critic, actor = list[tuple[Tensor, ...]](), list[tuple[Tensor, ...]]()
        for k in range(1, iterations + 1):
            critic.append(parts.critic_step(lesson.draw(), lesson.directions()))
            self._waiting = self._waiting and not settled([error for _, error, _ in critic], own.settled)
            if k % own.delay == 0:
                if not self._waiting:
                    actor.append(parts.actor_step(lesson.draw_latest()))
                    mean.add(2 * k > iterations)
                parts.move_targets()
        self._waiting, self._updates = False, self._updates + 1
        mean.install()
        self._keep_to_trust_region(earlier, lesson.latest()["observation"])
        self.candidate.nominate(earlier)
        found = means(critic, actor, 1.0)
        if actor:
            found["value"] = symexp(found["value"]) / scale
        return merged(found, findings(*lesson.refused))

    def _keep_to_trust_region(self, earlier: dict[str, Tensor], seen: Float[Tensor, "n n_o"]) -> None:
        """Go back towards earlier weights until the actions have changed by no more than the trust region allows."""
        half_range, later, share = 0.5 * (self.increments.high - self.increments.low), weights_of(self.policy), 1.0
        limit = self.config.incremental.trust_region
        while change_of_actions(self.policy, earlier, seen, half_range) > limit:
            share *= 0.8
            step_towards(self.policy, earlier, later, share)

    def state_dict(self) -> dict[str, Any]:
        """See :meth:`Learner.state_dict`."""
        parts = {name: getattr(self, name).state_dict() for name in COMPONENTS}
        own = {"waiting": self._waiting, "candidate": self.candidate.state_dict(), "trust": self._trust}
        own |= {"updates": self._updates}
        return parts | own | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See :meth:`Learner.load_state_dict`."""
        for name in COMPONENTS:
            getattr(self, name).load_state_dict(state[name])
        self._waiting, self._trust, self._updates = state["waiting"], state["trust"], state["updates"]
        self.candidate.load_state_dict(state["candidate"])
        self.generator.set_state(state["generator"].cpu())


COMPONENTS = ("loss", "critic_optimiser", "actor_optimiser", "memory")


def settled(errors: list[Tensor], ratio: float) -> bool:
    """Whether the mean |δ| no longer falls: that of the last window of iterations over that of the one before.

    Args:
        errors: mean |δ| of every iteration so far.
        ratio: ratio from which on the critics have settled; it is looked at at the end of every window.
    """
    if len(errors) % WINDOW or len(errors) < 2 * WINDOW:
        return False
    before, now = (
        torch.stack(errors[first : first + WINDOW]).mean() for first in (len(errors) - 2 * WINDOW, len(errors) - WINDOW)
    )
    return bool(now >= ratio * before)
