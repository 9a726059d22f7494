"""What a training begins with instead of random weights: a controller, a recorded log, or an earlier training."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.steps.config import Arm, Role
from rt_torchrl.steps.hypotheses.ensemble import TwinEnsemble
from rt_torchrl.steps.interact import Flight
from rt_torchrl.steps.report import same_architecture
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

Fly = Callable[[nn.Module], Flight]
"""Function that lets a policy or state feedback fly one episode on the real system, without exploration."""


class Start:
    """What a training begins with instead of random weights; the algorithm asks in the order of the methods.

    Attributes:
        live: role that acts in the first episode, where both policies are trained.
        teacher: policy or state feedback that policies imitate; None where only the flights show what it did.
    """

    live: Role = "model_based"
    teacher: nn.Module | None = None

    def take(self, policies: Mapping[Role, nn.Module], closure: nn.Module) -> list[Role]:
        """Load the weights that are known into policies and closure, in place; by default none are.

        Returns:
            The roles of the policies whose weights are not known: they imitate.
        """
        return list(policies)

    def flights(self, fly: Fly) -> list[Flight]:
        """Episodes of the real system, oldest first and of equal length, from which twin and policies learn.

        Args:
            fly: function that flies one on the real system, by default the teacher; nothing is flown if enough is known
                without it.
        """
        assert self.teacher is not None
        return [fly(self.teacher)]


def first_live(arm: Arm, first: Start | None) -> Role:
    """The role that acts in the first episode: the only one that an arm trains or, of both, the one that begins."""
    if arm != "twinning":
        return arm
    return "model_free" if first is None else first.live


class FirstController(Start):
    """A controller flies one episode before all others, and policies imitate it.

    Args:
        controller: the controller, as :class:`StateFeedback`, such as a :class:`ClassicalController`,
            or :class:`PredictiveControl` on the closure of the twin.
    """

    def __init__(self, controller: nn.Module):
        self.teacher = controller


class EarlierPolicies(Start):
    """Policies and twin of an earlier training begin a new one.

    The weights of a policy of the same architecture are taken as they are: those of its own role, or else those of the
    policy that was live. Where a policy has another architecture, the live one flies one episode, and
    the other architecture imitates it.

    Args:
        policies: policies that were trained, by role; the live one is among them.
        closure: trained closure of the twin.
        live: role that was live at the end of that training, and begins live.
        hypotheses: closures and weights of the hypotheses, as :meth:`TwinEnsemble.load_hypotheses` takes them.
    """

    def __init__(
        self,
        policies: Mapping[Role, nn.Module],
        closure: nn.Module,
        live: Role,
        hypotheses: Mapping[str, Any] | None = None,
    ):
        self.policies, self.closure, self.live, self.hypotheses = policies, closure, live, hypotheses
        self.teacher: nn.Module = policies[live]

    def hand_over(self, twin: DigitalTwin) -> None:
        """Give the new training's twin the hypotheses, if both have some, before the algorithm takes it.

        Raises:
            ValueError: if they are not those of the twin.
        """
        if self.hypotheses is not None and isinstance(twin, TwinEnsemble):
            twin.load_hypotheses(self.hypotheses)

    def take(self, policies: Mapping[Role, nn.Module], closure: nn.Module) -> list[Role]:
        """See :meth:`Start.take`.

        Raises:
            RuntimeError: if the closures are not of the same architecture.
        """
        closure.load_state_dict(self.closure.state_dict())
        pupils: list[Role] = []
        for role, policy in policies.items():
            earlier_policy = self.policies.get(role, self.teacher)
            source = next((earlier for earlier in (earlier_policy, self.teacher) if takes(policy, earlier)), None)
            if source is not None:
                policy.load_state_dict(source.state_dict())
            elif not isinstance(policy, StateFeedback):  # which plans on the closure and needs no weights
                pupils.append(role)
        return pupils


def takes(policy: nn.Module, earlier: nn.Module) -> bool:
    """Whether a policy takes the weights of an earlier one as they are."""
    if isinstance(policy, StateFeedback) or isinstance(earlier, StateFeedback):
        return type(policy) is type(earlier)
    return same_architecture(policy, earlier)


class RecordedFlights(Start):
    """Records of the real system under any controller: policies imitate its actions.

    Args:
        plant: plant of the records.
        records: records of equal length, oldest first; at least one. Nothing tells whether they begin from rest.
    """

    def __init__(self, plant: Plant, records: Sequence[Trajectory]):
        self.plant, self.records = plant, [record._replace(from_rest=False) for record in records]

    def flights(self, fly: Fly) -> list[Flight]:
        flown = [(transitions_of(self.plant, record), record) for record in self.records]
        n, end_cost = self.plant.n_steps, self.plant.end_cost or 0.0
        afters = [(n - len(t) if t["next", "terminated"][-1] else 0, end_cost) for t, _ in flown]
        return [Flight(t, record, [t], after=after) for (t, record), after in zip(flown, afters, strict=True)]


def transitions_of(plant: Plant, record: Trajectory) -> TensorDict:
    """The transitions of a record, as a learner stores those of a real episode.

    The last one is truncated, unless the episode ends there early, and pays the terminal cost if it ends there or the
    record is as long as an episode.
    """
    states, actions, inputs, start, *_ = record
    n = len(actions)
    t = start + plant.dt * torch.arange(n + 1, dtype=torch.float64, device=states.device)
    # There is no input after the last interval; the last input takes its place.
    observation = plant.observe(t, states, torch.cat([inputs, inputs[-1:]]))
    reward = -plant.running_cost(t[:-1], states[:-1], actions, inputs)
    done = torch.zeros(n, 1, dtype=torch.bool, device=states.device)
    done[-1] = True
    over = done & plant.ended(states[1:]).unsqueeze(-1)
    if n == plant.n_steps or over.any():
        reward = torch.cat([reward[:-1], reward[-1:] - plant.terminal_cost(states[-1:]) / plant.dt])
    ends = {"reward": reward.unsqueeze(-1), "done": done, "truncated": done & ~over, "terminated": over}
    entries = {"observation": observation[:-1], "action": actions, "next": {"observation": observation[1:], **ends}}
    return TensorDict(entries, batch_size=[n], device=states.device)
