"""The common part of learners with a critic: transitions with sums of rewards, prioritised memory, optimisers."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.utils._pytree import tree_flatten
from torchrl.data import MultiStep
from torchrl.modules import ValueOperator
from torchrl.objectives import LossModule, SoftUpdate

from rt_torchrl.interruption import safe_point
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.policies import mlp
from rt_torchrl.plants.signal import bounds
from rt_torchrl.systems.refusal import finite_errors, finite_transitions
from rt_torchrl.twinning.findings import findings
from rt_torchrl.twinning.learners.config import LearnerConfig
from rt_torchrl.twinning.learners.long_term_memory import LongTermMemory

TRANSITION = ("observation", "action", *(("next", key) for key in ("observation", "reward", "done", "terminated")))


class Critic(nn.Module):
    """The value q(e, a): a perceptron of the observation and of the action scaled from its range to [−1, 1].

    Args:
        plant: plant that gives the number of observations and the ranges of the actions.
        hidden: widths of the hidden layers.
        generator: source of the initial weights.
    """

    middle: Tensor
    half_range: Tensor

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


@runtime_checkable
class Iterations(Protocol):
    """The parts of one update: TorchRL's losses, or the formulas of ``learners/explicit``."""

    def critic_step(self) -> tuple[Tensor, Tensor, Tensor]:
        """Take one iteration of the critics; return loss, mean |δ| and the gradient norm."""

    def move_targets(self) -> None:
        """Let the targets follow."""

    def batches(self, count: int) -> Iterator[Any]:
        """Draw batches for :meth:`actor_step`."""

    def actor_step(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Take one iteration of the policy; return the mean value and the gradient norm."""


class ActorCritic(ABC):
    r"""A policy that climbs the value of one or more critics, which learn from prioritised replay.

    .. math::
        y_k = \sum_{j<m}\gamma^jr_{k+j} + \gamma^m\,q'(e_{k+m}, \pi(e_{k+m})), \qquad \delta_k = y_k - q(e_k, a_k)

    A subclass makes the loss, which is one of TorchRL's, and the order in which critics and policy are updated.

    Args:
        plant: plant that gives the number of observations and the ranges of the actions.
        policy: policy π_mf, updated in place.
        config: parameters of step 2.
        generator: source of the critics' initial weights and of the samples.

    Raises:
        ValueError: if ``return_steps`` exceeds an episode of the plant.
    """

    loss: LossModule
    target: SoftUpdate

    def __init__(self, plant: Plant, policy: nn.Module, config: LearnerConfig, *, generator: torch.Generator):
        if config.return_steps > plant.n_steps:
            raise ValueError(
                f"return_steps={config.return_steps} exceeds the {plant.n_steps} control intervals of an episode of "
                f"plant {plant.name!r}; use at most a tenth of them, or a longer horizon."
            )
        self.config, self.policy, self.generator, self._end_cost = config, policy, generator, plant.end_cost
        self.batch_size = min(config.batch_size, plant.n_steps)
        self.memory = LongTermMemory(config.memory, generator=generator)
        self.critics = nn.ModuleList(self.make_critics(plant)).to(generator.device)
        self.loss = self.make_loss(plant)
        self.critic_optimiser = torch.optim.Adam(self.critic_weights(), lr=config.critic_rate)
        self._returns = MultiStep(config.discount, config.return_steps)
        self.restart()

    @abstractmethod
    def make_critics(self, plant: Plant) -> list[Critic]:
        """The critics, with random initial weights."""

    @abstractmethod
    def make_loss(self, plant: Plant) -> LossModule:
        """TorchRL's loss of policy and critics."""

    @abstractmethod
    def critic_loss(self, batch: TensorDictBase) -> tuple[Tensor, Float[Tensor, " n"]]:
        """Loss of the critics and |δ| of each transition."""

    @abstractmethod
    def critic_value(self, pairs: TensorDict, number: int) -> Float[Tensor, "n 1"]:
        """The value of one of the critics, by its number, for pairs of observation and action."""

    @abstractmethod
    def actor_loss(self, batch: TensorDictBase) -> Tensor:
        """Loss of the policy, −E[q(e, π(e))], with the critics' weights detached."""

    @abstractmethod
    def update(self) -> TensorDict:
        """See :meth:`Learner.update`."""

    @abstractmethod
    def critic_weights(self) -> list[nn.Parameter]:
        """The weights that the critics' optimiser trains."""

    def actor_module(self) -> TensorDictModule:
        """The policy in the form that TorchRL's losses take."""
        return TensorDictModule(self.policy, in_keys=["observation"], out_keys=["action"])

    def critic_modules(self) -> list[ValueOperator]:
        """The critics in the form that TorchRL's losses take."""
        return [ValueOperator(critic, in_keys=["observation", "action"]) for critic in self.critics]

    @property
    def shortest(self) -> int:
        """Least number of control intervals in a row that can be stored."""
        return self.config.return_steps

    def store(self, episode: TensorDictBase) -> None:
        """Keep the transitions of a real episode, with their TD errors as priorities.

        Raises:
            ValueError: if a number of the episode is not finite, or a TD error, because the critic has diverged.
        """
        transitions = self.transitions(finite_transitions(episode.select(*TRANSITION)))
        self.memory.store(transitions, finite_errors(self.td_errors(transitions)))

    def transitions(self, episode: TensorDictBase) -> TensorDictBase:
        """The transitions of an episode that D_L keeps: (e_k, a_k, sum of m rewards, e_{k+m}) of each interval k.

        The last m − 1 intervals are left out. With shorter sums there, the values of the observations at the end of
        episodes, such as a target that is reached, would depend on hardly anything but themselves and drift without
        bound. Where an episode ends early they stay: their sums end with the value of its end, which is known.
        """
        over = self._end_cost is not None and bool(episode["next", "terminated"][-1].any())
        whole = len(episode) if over else len(episode) - self.config.return_steps + 1
        transitions = episode.select(*TRANSITION).clone()
        if over:
            transitions["next", "reward"][-1] += self.end_value()
        transitions["next", "reward"] = self.config.reward_scale * transitions["next", "reward"]
        returns = self._returns(transitions.unsqueeze(0))[0, :whole]
        if over:  # TorchRL moves all that is next, but not what says whether it is an end
            last = torch.arange(whole, device=returns.device) + returns["steps_to_next_obs"].flatten() == whole
            returns["next", "terminated"] = last.unsqueeze(-1)
        return returns.select(*TRANSITION, "steps_to_next_obs", strict=False)

    def end_value(self) -> float:
        r"""What comes after the last reward of an episode that ends early, :math:`-\gamma L_e/(1 - \gamma)`."""
        discount = self.config.discount
        return -discount * (self._end_cost or 0.0) / (1.0 - discount)

    def sound(self, iterate: Callable[[], TensorDict]) -> TensorDict:
        """Make the iterations of an update, and take them back if they end with numbers that are not finite.

        Such weights would stay so for good, and with them all that is learned later. The iterations run on one thread
        of torch: on several, each of their small operations waits for all threads.

        Args:
            iterate: function that makes the iterations and returns the report.

        Returns:
            The report, or the ``reason`` why the update was taken back.
        """
        parts = {"policy": self.policy} | {name: getattr(self, name) for name in UPDATED}
        before = copy.deepcopy({name: part.state_dict() for name, part in parts.items()})
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            found = iterate()
            broken = [name for name, part in parts.items() if not finite(part.state_dict())]
            if not broken:
                return found
            said = f"numbers of {' and '.join(broken)} are not finite"
        except FloatingPointError as error:
            said = str(error)
        finally:
            torch.set_num_threads(threads)
        for name, part in parts.items():
            part.load_state_dict(before[name])
        return findings(f"update of model_free taken back: {said}; use smaller learning rates or reward_scale")

    @torch.no_grad()
    def td_errors(self, transitions: TensorDictBase) -> Float[Tensor, " n"]:
        """TD errors |δ| of transitions with the present critics and target critics."""
        return self.critic_loss(transitions.copy())[1]

    def cost_to_go(self, observation: Float[Tensor, "n n_o"]) -> Float[Tensor, " n"]:
        r"""What the policy costs from observations on, :math:`-q(e, \pi(e))` for the rewards without their scale.

        With several critics it is that of the lowest value, as in the targets. It is differentiable by the observation.
        """
        pairs = TensorDict(
            {"observation": observation, "action": self.policy(observation)}, batch_size=len(observation)
        )
        values = torch.stack([self.critic_value(pairs, number) for number in range(len(self.critics))])
        return -values.amin(0).squeeze(-1) / self.config.reward_scale

    def observations(self) -> Float[Tensor, "n n_o"]:
        """See :meth:`Learner.observations`."""
        return self.memory.observations()

    def restart(self) -> None:
        """Forget the state of the policy's optimiser, because its weights have jumped."""
        self.actor_optimiser = torch.optim.Adam(self.policy.parameters(), lr=self.config.actor_rate)

    def critic_step(self) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`Iterations.critic_step`."""
        safe_point()
        batch = self.memory.sample(self.batch_size)
        loss, td_error = self.critic_loss(batch)
        self.critic_optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.get_total_norm([w.grad for w in self.critic_weights() if w.grad is not None])
        self.critic_optimiser.step()
        self.memory.refresh(batch["index"], td_error)
        return loss.detach(), td_error.mean(), norm

    def move_targets(self) -> None:
        """See :meth:`Iterations.move_targets`."""
        self.target.step()

    def batches(self, count: int) -> Iterator[TensorDictBase]:
        """See :meth:`Iterations.batches`."""
        return self.memory.samples(self.batch_size, count)

    def actor_step(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """See :meth:`Iterations.actor_step`."""
        safe_point()
        loss = self.actor_loss(batch)
        self.actor_optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), self.config.gradient_limit)
        self.actor_optimiser.step()
        return -loss.detach(), norm

    def state_dict(self) -> dict[str, Any]:
        """See :meth:`Learner.state_dict`."""
        parts = {name: getattr(self, name).state_dict() for name in COMPONENTS}
        return parts | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See :meth:`Learner.load_state_dict`."""
        for name in COMPONENTS:
            getattr(self, name).load_state_dict(state[name])
        self.generator.set_state(state["generator"].cpu())


CRITIC_FINDINGS = {"critic_loss": 2, "td_error": 1, "critic_gradient": 0}
"""What :meth:`Iterations.critic_step` returns, and the power of the rewards' scale in it that a report leaves out."""
ACTOR_FINDINGS = {"value": 1, "actor_gradient": 0}
"""The same of :meth:`Iterations.actor_step`."""
UPDATED = ("loss", "critic_optimiser", "actor_optimiser")
COMPONENTS = (*UPDATED, "memory")


def finite(state: Mapping[str, Any]) -> bool:
    """Whether all numbers of a state are finite."""
    tensors = (part for part in tree_flatten(dict(state))[0] if isinstance(part, Tensor))
    return all(bool(part.isfinite().all()) for part in tensors)


def means(critic: Sequence[tuple[Tensor, ...]], actor: Sequence[tuple[Tensor, ...]], scale: float) -> TensorDict:
    """Means over iterations for the rewards without their scale.

    Args:
        critic: results of :meth:`Iterations.critic_step`.
        actor: results of :meth:`Iterations.actor_step`.
        scale: factor on the rewards that the critics learn from.
    """
    found: dict[str, Tensor] = {}
    for powers, iterations in ((CRITIC_FINDINGS, critic), (ACTOR_FINDINGS, actor)):
        for (name, power), values in zip(powers.items(), zip(*iterations, strict=True), strict=bool(iterations)):
            found[name] = torch.stack(values).mean() / scale**power
    return TensorDict(found)
