"""The digital twin: a plant's vector field and step under a learned closure."""

import copy
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant, require_end_cost
from rt_torchrl.plants.shapes import Actions, Costs, Inputs, Start, Starts
from rt_torchrl.programs.contract import Holdings
from rt_torchrl.trajectories.rollout import Engine, Rollout, able, require_double
from rt_torchrl.trajectories.sensitivity import Sensitivities
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory, control_cost

KEPT = 4
"""Number of policies whose rollouts a twin keeps, such as those that are judged in turn."""


class DigitalTwin:
    """Flies virtual episodes of a plant whose true closure it does not know.

    The attribute ``sensitivities`` gives replayed states with their derivatives by the closure's weights.

    Args:
        plant: the physics, which a simulated real system shares; the plant's own closure is never used here.
        closure: the learned closure g(·; w_p).
        engine: gradient engine, see :mod:`rt_torchrl.trajectories.rollout`.
        compiled: compile the engine.

    Raises:
        ValueError: if episodes of the plant end early at no cost.
    """

    def __init__(self, plant: Plant, closure: nn.Module, *, engine: Engine = "native", compiled: bool = False):
        require_end_cost(plant)
        self.plant, self.closure = plant, closure
        self._engine, self._compiled = engine, compiled
        self._replay = self._rollout(closure, None)
        self.sensitivities = Sensitivities(plant, closure)
        self._planned: list[_Planned] = []

    def of(self, plant: Plant) -> "DigitalTwin":
        """A twin of another plant under the same closure, by the same engine if it can roll the plant out."""
        return DigitalTwin(plant, self.closure, engine=able(self._engine, plant), compiled=self._compiled)

    def _rollout(self, closure: nn.Module, policy: nn.Module | None) -> Rollout:
        return Rollout(self.plant, closure, policy, engine=self._engine, compiled=self._compiled)

    def replay(self, initial_state: Starts, exogenous: Inputs, actions: Actions, *, start: Start = 0.0) -> Trajectory:
        """Virtual episodes, or parts of them, under recorded actions; see :meth:`Rollout.__call__`."""
        return self._replay(initial_state, exogenous, actions, start=start)

    @torch.no_grad()
    def replayed(self, record: Trajectory) -> Float[Tensor, "samples n_s"]:
        """States of the believed twin with the actions and inputs of a whole record, as sensors read them."""
        believed = self.believed
        begins = believed.plant.at_rest(record.states[:1])
        flown = believed.replay(begins, record.exogenous[None], record.actions[None], start=record.start)
        return flown.states[0, :, : record.states.shape[-1]]

    def control(self, policy: nn.Module, initial_state: Starts, exogenous: Inputs, *, start: Start = 0.0) -> Trajectory:
        """Virtual episodes, or parts of them, under a policy; see :meth:`Rollout.__call__`.

        The trajectory is differentiable by the policy's weights and the initial state; the closure is held constant.
        That of state feedback is not differentiable, and begins with an episode.

        Raises:
            ValueError: if state feedback is to fly a part of an episode.
        """
        if isinstance(policy, StateFeedback):
            if isinstance(start, Tensor) or start != 0.0:
                raise ValueError(
                    f"start={start} of a flight by {type(policy).__name__} must be 0, as it plans from there."
                )
            return policy.fly(initial_state, exogenous, self.closure, plant=self.plant)
        return self._planning(policy)(initial_state, exogenous, start=start)

    def cost(self, policy: nn.Module, initial_state: Starts, exogenous: Inputs) -> Float[Tensor, ""]:
        """Mean J_a of virtual episodes under a policy."""
        return self.episode_costs(policy, initial_state, exogenous).mean()

    def episode_costs(self, policy: nn.Module, initial_state: Starts, exogenous: Inputs) -> Costs:
        """J_a of each virtual episode under a policy, differentiable by its weights unless it is state feedback."""
        if isinstance(policy, StateFeedback):
            return control_cost(self.plant, self.control(policy, initial_state, exogenous))
        return self._planning(policy).costs(initial_state, exogenous)

    def retreat(self) -> None:
        """React to a flight that diverges, although the real system flew it; a twin that is alone cannot."""

    def state_dict(self) -> dict[str, Any]:
        """Weights of the trained parts, by name: those of the closure."""
        return {"closure": self.closure.state_dict()}

    @property
    def believed(self) -> "DigitalTwin":
        """The twin that is most likely to be right; a twin that is alone is."""
        return self

    @property
    def hypothesis(self) -> str | None:
        """Name of the hypothesis that :attr:`believed` is of; None if that has nothing beside the plant."""
        return None

    @property
    def believed_law(self) -> nn.Module:
        """Closure of :attr:`plant` in :attr:`believed`, without the parameters that a hypothesis has beside it."""
        return self.closure

    def explanation(self) -> str:
        """What the twin says about itself that may explain a wrong prediction; a twin that is alone says nothing."""
        return ""

    def _planning(self, policy: nn.Module) -> Rollout:
        """The rollout of a policy under the closure held constant, kept as long as both are the same."""
        for planned in self._planned:
            if planned.serves(self.plant, self.closure, policy):
                require_double("policy", policy)
                return planned.rollout
        rollout = self._rollout(constant(self.closure), policy)
        new = _Planned(self.closure, policy, rollout, Holdings(self.closure))
        self._planned = [new, *self._planned[: KEPT - 1]]
        return rollout


class _Planned(NamedTuple):
    """A rollout with a constant copy of a closure, which shares its weights and buffers, and what the closure held."""

    closure: nn.Module
    policy: nn.Module
    rollout: Rollout
    holdings: Holdings

    def serves(self, plant: Plant, closure: nn.Module, policy: nn.Module) -> bool:
        """Whether the rollout is of these, and nothing of the closure has changed but the values of its weights."""
        same = plant is self.rollout.plant and closure is self.closure and policy is self.policy
        return same and self.holdings.unchanged(closure)


def constant(module: nn.Module) -> nn.Module:
    """A copy of the module that shares its weights but asks for no gradient of them."""
    shared: dict[int, Tensor] = {id(w): nn.Parameter(w.detach(), requires_grad=False) for w in module.parameters()}
    shared |= {id(buffer): buffer for buffer in module.buffers()}
    return copy.deepcopy(module, shared)
