r"""Step 2: a policy that climbs the value which critics learn from prioritised replay, by any loss of TorchRL.

.. math::
    y_k = \sum_{j<m}\gamma^jr_{k+j} + \gamma^m\,q'(e_{k+m}, \pi(e_{k+m})), \qquad \delta_k = y_k - q(e_k, a_k)

One iteration (loss, gradients, optimiser, targets) is traced once and replayed as a flat graph: the numbers of TorchRL
to the bit, without the time that it takes to find out what to compute.
"""

import contextlib
import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector
from torch.utils._pytree import tree_flatten
from torchrl.data import Bounded, MultiStep
from torchrl.modules import BatchRenorm1d, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SoftUpdate

from rt_torchrl.interruption import safe_point
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.policies import mlp
from rt_torchrl.plants.signal import bounds
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.config import LearnerConfig
from rt_torchrl.steps.losses import ACTOR, BATCH, METHODS, TRANSITION, LearningMethod, traced
from rt_torchrl.steps.memory import CORRECTION, LongTermMemory
from rt_torchrl.steps.report import Step, merged, metrics, same_architecture, weight_change


@runtime_checkable
class Learner(Protocol):
    """A model-free method, which keeps parts of every real episode and improves π_mf from them.

    ``docs/learner.md`` shows how to write one.
    """

    policy: nn.Module
    """Policy π_mf, updated in place."""

    def store(self, episode: TensorDictBase) -> None:
        """Keep the parts of a real episode that the learner needs, whichever policy flew the episode (step 1).

        Args:
            episode: ``observation``, ``action`` (as applied) and ``("next", ...)`` of n_t control intervals.
        """

    def update(self) -> TensorDict:
        """Improve the policy (step 2).

        Returns:
            Scalars for the report of the episode, by name; there may be none.
        """

    def restart(self) -> None:
        """Forget everything that belongs to the policy's earlier weights, because the policy's weights have jumped."""

    def observations(self) -> Float[Tensor, "n n_o"]:
        """Observations on the real system, from which a clone of another architecture learns."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update depends on, except the policy's weights: tensors in plain containers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of a learner with the same configuration."""


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


AT_ONCE = 50
"""Number of batches drawn in one call, between which priorities rest: a draw takes as long as half an iteration."""


class ActorCritic:
    """A policy that learns by a loss of TorchRL and prioritised replay (paper, section 4.1).

    Args:
        plant: plant that gives the number of observations and the ranges of the actions.
        policy: policy π_mf, updated in place.
        config: parameters of step 2.
        generator: source of the critics' initial weights and of the samples.
        method: the method, for a loss of one's own; by default the one that ``config.algorithm`` names.
        replay: function of ``correction=`` of the method and ``generator=`` that makes the memory, with the methods of
            :class:`LongTermMemory`.

    Raises:
        ValueError: if ``return_steps`` exceeds an episode of the plant.
    """

    critic_hidden: Sequence[int] = (64, 64)
    """Widths of the critics' hidden layers."""
    critic_rate = 1e-3
    """Learning rate of the critics (Adam). ``reward_scale`` suits it to the costs of a system."""

    def __init__(
        self,
        plant: Plant,
        policy: nn.Module,
        config: LearnerConfig,
        *,
        generator: torch.Generator,
        method: LearningMethod | None = None,
        replay: "Callable[..., LongTermMemory] | None" = None,
    ):
        if config.return_steps > plant.n_steps:
            raise ValueError(
                f"return_steps={config.return_steps} exceeds the {plant.n_steps} control intervals of an episode of "
                f"plant {plant.name!r}; use at most a tenth of them, or a longer horizon."
            )
        self.config, self.policy, self.generator, self._end_cost = config, policy, generator, plant.end_cost
        self.method = method or METHODS[config.algorithm]
        self.batch_size = min(config.batch_size, plant.n_steps)
        correction = 0.0 if self.method.relaxed else CORRECTION
        self.memory = (replay or LongTermMemory)(correction=correction, generator=generator)
        stochastic, n_a = self.method.stochastic, len(plant.actions)
        self.actor = ScaledPolicy(plant, policy, stochastic=stochastic, device=generator.device)
        widths, pair = (len(plant.observations) + n_a, *self.critic_hidden), ["observation", "action"]
        networks = [
            Critic(widths, normalised=self.method.normalised, generator=generator) for _ in range(self.method.critics)
        ]
        critics = [ValueOperator(network, in_keys=pair) for network in networks]
        module = TensorDictModule(self.actor, ["observation"], ["loc", "scale"] if stochastic else ["action"])
        if stochastic:
            spec = Bounded(-1.0, 1.0, (n_a,), dtype=torch.float64, device=generator.device)
            distribution = {"distribution_class": TanhNormal, "return_log_prob": True}
            module = ProbabilisticActor(module, in_keys=["loc", "scale"], spec=spec, **distribution)
        self.loss = self.method.make_loss(module, critics)
        self.loss.make_value_estimator(gamma=config.discount)
        targets = any(name.startswith("target_") for name, _ in self.loss.named_buffers())
        self.target = SoftUpdate(self.loss, tau=config.target_rate) if targets else None
        named = [(name, w) for name, w in self.loss.named_parameters() if w.requires_grad]
        self.critic_adam = Adam([w for name, w in named if not name.startswith(ACTOR)], self.critic_rate)
        self.actor_adam = Adam([w for name, w in named if name.startswith(ACTOR)], config.actor_rate)
        self.shortest = config.return_steps
        """Least number of control intervals in a row that can be stored."""
        self._returns = MultiStep(config.discount, config.return_steps)
        self._iterations: dict[str, Callable[..., dict[str, Tensor]]] = {}
        self._traced = copy.deepcopy(policy)

    def store(self, episode: TensorDictBase) -> None:
        """Keep the transitions of a real episode, with their TD errors as priorities."""
        transitions = self.transitions(episode)
        self.memory.store(transitions, self.td_errors(transitions))

    def transitions(self, episode: TensorDictBase) -> TensorDictBase:
        """The transitions of an episode that D_L keeps: (e_k, a_k, sum of m rewards, e_{k+m}) of each interval k.

        Actions are scaled to [−1, 1]. The last m − 1 intervals are left out. With shorter sums there, the values of the
        observations at the end of episodes, such as a target that is reached, would depend on hardly anything but
        themselves and drift without bound. Where an episode ends early they stay: their sums end with the value of its
        end, which is known.
        """
        over = self._end_cost is not None and bool(episode["next", "terminated"][-1].any())
        whole = len(episode) if over else len(episode) - self.config.return_steps + 1
        transitions = episode.select(*TRANSITION).clone()
        transitions["action"] = self.actor.scaled(transitions["action"])
        if over:
            discount = self.config.discount  # what comes after the last reward, −γ L_e/(1 − γ)
            transitions["next", "reward"][-1] -= discount * (self._end_cost or 0.0) / (1.0 - discount)
        transitions["next", "reward"] = self.config.reward_scale * transitions["next", "reward"]
        returns = self._returns(transitions.unsqueeze(0))[0, :whole]
        if over:  # TorchRL moves all that is next, but not what says whether it is an end
            last = torch.arange(whole, device=returns.device) + returns["steps_to_next_obs"].flatten() == whole
            returns["next", "terminated"] = last.unsqueeze(-1)
        return returns.select(*BATCH[:-1])

    @torch.no_grad()
    def td_errors(self, transitions: TensorDictBase) -> Float[Tensor, " n"]:
        """TD errors |δ| of transitions with the present critics and target critics."""
        batch = transitions.copy()
        with self._drawing():
            self.loss(batch)
        return self.sizes(batch["td_error"])

    def sizes(self, td_error: Tensor) -> Float[Tensor, " n"]:
        """|δ| of each transition, from what the loss reports."""
        return (td_error.sqrt() if self.method.squared else td_error).flatten()

    @contextlib.contextmanager
    def _drawing(self) -> Iterator[None]:
        """Let a loss of TorchRL draw from the global generator, which the learner's own generator seeds."""
        if not self.method.draws:
            yield
            return
        device = self.generator.device
        seed = torch.randint(2**31, (), generator=self.generator, device=device)
        with torch.random.fork_rng(devices=[device] if device.type != "cpu" else []):
            torch.manual_seed(seed.item())
            yield

    def update(self) -> TensorDict:
        """Make the iterations of an update, and take them back if they end with numbers that are not finite.

        Such weights would stay so for good, and with them all that is learned later. The iterations run on one thread
        of torch: on several, each of their small operations waits for all threads.

        Returns:
            Means of ``critic_loss``, ``td_error``, ``value`` and both gradient norms over the iterations; the first
            three are for the rewards without ``reward_scale``. Of an update that is taken back, the ``reason`` instead.
        """
        if not same_architecture(self._traced, self.policy):  # a graph has read the policy's settings once
            self._iterations.clear()
            self._traced = copy.deepcopy(self.policy)
        parts = {name: getattr(self, name) for name in UPDATED}
        before = copy.deepcopy({name: part.state_dict() for name, part in parts.items()})
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            with self._drawing():
                report = self._iterate()
            broken = [name for name, part in parts.items() if not finite(part.state_dict())]
            if not broken:
                return report
            reason = f"numbers of {' and '.join(broken)} are not finite"
        except FloatingPointError as error:
            reason = str(error)
        finally:
            torch.set_num_threads(threads)
        for name, part in parts.items():
            part.load_state_dict(before[name])
        message = f"update of model_free taken back: {reason}; use smaller learning rates or reward_scale"
        return TensorDict().set_non_tensor("reason", message)

    @torch.no_grad()
    def _iterate(self) -> TensorDict:
        config, delay = self.config, self.method.delay
        results_by_name: dict[str, list[Tensor]] = {}
        phases = [("critic", config.critic_iterations)] + ([] if delay else [("actor", config.actor_iterations)])
        for kind, count in phases:
            for first in range(0, count, AT_ONCE):
                drawn = self.memory.sample(min(AT_ONCE, count - first) * self.batch_size).to(self.generator.device)
                errors = list[Tensor]()
                for k, batch in enumerate(zip(*(drawn[key].split(self.batch_size) for key in BATCH), strict=True)):
                    safe_point()
                    what = "both" if delay and (first + k + 1) % delay == 0 else kind
                    if what not in self._iterations:
                        self._iterations[what] = traced(self, what, batch)
                    results = self._iterations[what](*batch)
                    errors += [results.pop("errors")] if "errors" in results else []
                    for entry, value in results.items():
                        results_by_name.setdefault(entry, []).append(value)
                if errors:
                    self.memory.refresh(drawn["index"], torch.cat(errors))
        scale = config.reward_scale
        return TensorDict({name: torch.stack(v).mean() / scale ** POWERS[name] for name, v in results_by_name.items()})

    def observations(self) -> Float[Tensor, "n n_o"]:
        """See :meth:`Learner.observations`."""
        return self.memory.observations().to(self.generator.device)

    def restart(self) -> None:
        """Forget the state of the policy's optimiser, because its weights have jumped."""
        self.actor_adam.restart()

    def state_dict(self) -> dict[str, Any]:
        """See :meth:`Learner.state_dict`."""
        parts = {name: getattr(self, name).state_dict() for name in COMPONENTS}
        return parts | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See :meth:`Learner.load_state_dict`."""
        for name in COMPONENTS:
            getattr(self, name).load_state_dict(state[name])
        self.generator.set_state(state["generator"].cpu())


POWERS = {"critic_loss": 2, "td_error": 1, "critic_gradient": 0, "value": 1, "actor_gradient": 0}
"""What a report holds, and the power of the rewards' scale in it that the report leaves out."""
UPDATED = ("policy", "loss", "critic_adam", "actor_adam")
COMPONENTS = ("loss", "critic_adam", "actor_adam", "memory")


def finite(state: Mapping[str, Any]) -> bool:
    """Whether all numbers of a state are finite."""
    tensors = (part for part in tree_flatten(dict(state))[0] if isinstance(part, Tensor))
    return all(bool(part.isfinite().all()) for part in tensors)


class Adam(torch.optim.Adam):
    """Adam by torch's fused kernel, with moments that stay where they are, so that a traced graph may hold them.

    Args:
        weights: weights that it trains.
        rate: learning rate.
    """

    def __init__(self, weights: list[nn.Parameter], rate: float):
        super().__init__(weights, lr=rate, fused=True)
        self.weights, self.parts = weights, list[Tensor]()
        for weight in weights:
            step = torch.zeros((), dtype=torch.float32, device=weight.device)
            moments = [torch.zeros_like(weight, requires_grad=False) for _ in range(2)]
            self.state[weight] = dict(zip(("step", "exp_avg", "exp_avg_sq"), (step, *moments), strict=True))
            self.parts += [step, *moments]

    def descend(self, gradients: list[Tensor]) -> None:
        """Change the weights by their gradients, whose layout in memory may differ from that of the weights."""
        for weight, gradient in zip(self.weights, gradients, strict=True):
            # The fused kernel reads gradients in the order of the weights; those of several critics have another one.
            same = gradient.stride() == weight.stride()
            weight.grad = gradient if same else torch.empty_like(weight).copy_(gradient)
        self.step()
        self.zero_grad()

    def restart(self) -> None:
        """Forget all steps."""
        for part in self.parts:
            part.zero_()

    def state_dict(self) -> dict[str, Any]:
        return {"parts": [part.clone() for part in self.parts]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for part, saved in zip(self.parts, state["parts"], strict=True):
            part.copy_(saved)


class Learn(Step):
    """Step 2: the learner improves π_mf; while π_mf acts, an update that is expected to cost more is taken back.

    Reads ``transitions`` and ``live``. Writes ``weight_changes/model_free``, ‖w − w_before‖/‖w‖, and what the learner
    reports.

    Note: the paper keeps every update. A critic knows the value of actions near those that were taken. Where a training
    begins with a controller it explores little, and an actor that climbs the critic leaves those actions within one
    update. An idle policy may pass through worse weights to better ones; the referee compares it before it acts.

    Args:
        learner: the learner. One that needs more than one interval in a row says so by ``shortest``.
        belief: what policies cost; without a twin yet, or where it does not correct, every update stays.
        count: number of virtual episodes on which an update is judged.
    """

    in_keys = ["transitions", "live"]
    out_keys = [("weight_changes", "model_free")]

    def __init__(self, learner: Learner, belief: Belief, count: int):
        super().__init__(learner=learner)
        self.learner, self.belief, self.count = learner, belief, count

    def store(self, parts: Iterable[TensorDictBase]) -> None:
        """Give the learner the transitions of the sound parts of an episode that it can use."""
        shortest = getattr(self.learner, "shortest", 1)
        for transitions in parts:
            over = bool(transitions["next", "terminated"][-1].any())  # with an end, few intervals are enough
            if over or len(transitions) >= shortest:
                self.learner.store(transitions)

    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        policy, virtual = self.learner.policy, self.belief.virtual
        self.store(episode["transitions"].values())
        before, weights = copy.deepcopy(policy.state_dict()), parameters_to_vector(policy.parameters()).detach()
        report = self.learner.update()
        if episode["live"] == "model_free" and self.belief.corrects and virtual.processes:
            judged_on, after = virtual.draw(self.count), copy.deepcopy(policy.state_dict())
            judgement = self.belief.judge(policy, judged_on)
            policy.load_state_dict(before)
            judgement_before = self.belief.judge(policy, judged_on)
            if judgement > judgement_before:
                self.learner.restart()
                costs = f"to cost {judgement.expected:.4g} with it, and {judgement_before.expected:.4g} without"
                refused = f"update refused: model_free is expected {costs}"
                report = merged(report, metrics(refused, update_accepted=0.0))
            else:
                policy.load_state_dict(after)
                report = merged(report, metrics(update_accepted=1.0))
        return merged(episode, report).set(("weight_changes", "model_free"), weight_change(policy, weights))
