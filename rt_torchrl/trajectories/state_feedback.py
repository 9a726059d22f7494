"""State feedback: a controller of time, state and measured inputs, which may plan and remember."""

from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Action, Actions, Input, Inputs, Memory, Starts, State
from rt_torchrl.trajectories.engines.interval import Drive, Interval
from rt_torchrl.trajectories.trajectory import Trajectory


@runtime_checkable
class StateFeedback(Protocol):
    """A module that acts in the place of a policy, but from more than the observation.

    A policy is a function of the observation, so that one call takes many observations at once and a rollout can trace
    it. State feedback acts interval by interval, in the order of time, and keeps what it needs from one to the next.
    """

    def begin(self) -> None:
        """Begin an episode; everything that takes long is done here, before the first action is due."""

    def act(self, t: float, state: State, exogenous: Input) -> Action:
        """The command of the control interval at t [s]; the intervals follow each other.

        Args:
            t: start of the interval, in the episode [s].
            state: states that sensors read.
            exogenous: measured exogenous inputs of the interval.
        """

    def fly(
        self, initial_state: Starts, exogenous: Inputs, closure: nn.Module | None = None, *, plant: Plant | None = None
    ) -> Trajectory:
        """Episodes of a simulated system, side by side, with no regard to wall-clock time.

        Args:
            initial_state: initial states of the episodes.
            exogenous: exogenous inputs, of which each action sees the present one.
            closure: closure of the system; None for that of ``plant``.
            plant: physics of the system; None for that of the controller's model.

        Raises:
            DivergenceError: if the system diverges.
        """

    def report(self) -> dict[str, float]:
        """Numbers about the episode in which it acted last, for the report of that episode."""


@runtime_checkable
class Remembering(Protocol):
    """State feedback that is a function of state, memory and inputs alone, so that an interval with it is traced."""

    def first_memory(self, state: State) -> Memory:
        """Memory at the start of an episode."""

    def respond(self, state: State, memory: Memory, exogenous: Input) -> tuple[Action, Memory]:
        """The command, within the ranges of the actions, and the new memory."""


class RememberingInterval(Interval):
    """One control interval under a controller with a memory m; its state is (s, m), its policy :class:`Remembering`."""

    policy: Any

    def answer(self, carry: Tensor, drive: Drive) -> tuple[Action, Memory]:
        """The command and the new memory; a subclass may read the drive's command, of any width."""
        state, memory = carry[..., : len(self.plant.states)], carry[..., len(self.plant.states) :]
        readings, exogenous = self.plant.sensed(state, drive.exogenous)
        command, memory = self.policy.respond(readings, memory, exogenous)
        return command, memory

    def command(self, state: Tensor, drive: Drive) -> Tensor:
        """The commands in the states and memories of whole episodes, whose first dimension is the time."""
        rows = drive._replace(command=drive.command.flatten(0, 1), exogenous=drive.exogenous.flatten(0, 1))
        command, _ = self.answer(state.flatten(0, 1), rows)
        return command.unflatten(0, state.shape[:2])

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """State and memory, (s, m), at the end of the interval."""
        command, memory = self.answer(state, drive)
        return torch.cat([self.end(state[..., : len(self.plant.states)], command, drive), memory], -1)


@torch.no_grad()
def commands_along(controller: StateFeedback, flown: Trajectory, dt: float) -> Actions:
    """The commands of a controller in states that another one has reached.

    Args:
        controller: controller that is asked for its commands.
        flown: episodes of the other one, from the beginning of an episode.
        dt: control interval [s].
    """
    controller.begin()
    inputs = flown.exogenous.unbind(1)
    states = flown.states.unbind(1)[: len(inputs)]
    samples = enumerate(zip(states, inputs, strict=True))
    return torch.stack([controller.act(k * dt, state, exogenous) for k, (state, exogenous) in samples], 1)
