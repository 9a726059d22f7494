"""Classical controllers: laws of the measured state, with or without memory.

Learned policies are compared with them, and they act on a real system before any policy is trained.
"""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Action, Input, Inputs, Memory, Starts, State
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.rollout import drive_of, require_finite
from rt_torchrl.trajectories.state_feedback import RememberingInterval
from rt_torchrl.trajectories.trajectory import Trajectory

REMEDY = "Use a smaller dt, or gains that hold the system."


class ClassicalController(nn.Module, ABC):
    r"""A law :math:`(a_k, m_{k+1}) = c(s_k, m_k, z_k)` with a memory m, which a ``policy(observation)`` cannot have.

    A subclass defines :meth:`law`, and names its gains and the size of its memory if it has any. The controller keeps
    the logarithms of its gains, so that a search changes a gain in proportion and never its sign. It is
    :class:`StateFeedback`: :meth:`act` acts interval by interval and keeps the memory of the episode.

    Args:
        plant: the plant to control; its actuators limit range and rate.
        gains: values of the gains, in the order and the units of ``gain_units``; None for the defaults.

    Raises:
        ValueError: if the number of gains is wrong or one of them is not positive and finite.
    """

    gain_units: dict[str, str] = {}
    """Unit of each gain, by name; empty for a law without gains, such as one with a fixed matrix."""
    default_gains: tuple[float, ...] = ()
    """Values of the gains where none are given, in the order of :attr:`gain_units`."""
    memory_size: int = 0
    """Number of entries of the memory, such as an integral or whether a heater is on."""

    def __init__(self, plant: Plant, gains: tuple[float, ...] | None = None):
        super().__init__()
        values = torch.tensor(self.default_gains if gains is None else gains, dtype=torch.float64)
        if len(values) != len(self.gain_units) or not (values.isfinite() & (values > 0)).all():
            units = ", ".join(f"{name} [{unit}]" for name, unit in self.gain_units.items()) or "none"
            raise ValueError(
                f"gains={tuple(values.tolist())} of {type(self).__name__} must be positive and finite, one for each "
                f"entry of gain_units: {units}."
            )
        self.plant = plant
        self.log_gains = nn.Parameter(values.log(), requires_grad=False)
        self.low_action, self.high_action = map(nn.Buffer, bounds(plant.actions))
        self._engine = Native()
        self._memory: Tensor | None = None

    @property
    def gains(self) -> Float[Tensor, " n_g"]:
        """The gains in the order and the units of ``gain_units``, for :meth:`law`."""
        return self.log_gains.exp()

    def first_memory(self, state: State) -> Memory:
        """Memory at the start of an episode; zeros by default."""
        return state.new_zeros(len(state), self.memory_size)

    @abstractmethod
    def law(self, state: State, memory: Memory, exogenous: Input) -> tuple[Action, Memory]:
        """The command, which :meth:`respond` clamps to the ranges of the actions, and the new memory.

        Args:
            state: states that sensors read.
            memory: memory before the interval; it has no columns if :attr:`memory_size` is zero.
            exogenous: measured inputs of the interval, such as a set point or a disturbance.
        """

    def respond(self, state: State, memory: Memory, exogenous: Input) -> tuple[Action, Memory]:
        """The command within the ranges of the actions, and the new memory."""
        command, memory = self.law(state, memory, exogenous)
        return command.clamp(self.low_action, self.high_action), memory

    def begin(self) -> None:
        """Begin an episode with the first memory."""
        self._memory = None

    @torch.no_grad()
    def act(self, t: float, state: State, exogenous: Input) -> Action:
        """The command in the measured state and inputs, within the ranges of the actions; the time is not used."""
        memory = self.first_memory(state) if self._memory is None else self._memory
        command, self._memory = self.respond(state, memory, exogenous)
        return command

    def report(self) -> dict[str, float]:
        """Nothing: see :meth:`StateFeedback.report`."""
        return {}

    @torch.no_grad()
    def fly(
        self, initial_state: Starts, exogenous: Inputs, closure: nn.Module | None = None, *, plant: Plant | None = None
    ) -> Trajectory:
        """Episodes under this controller, which acts on what sensors read.

        Args:
            initial_state: initial states of the episodes.
            exogenous: exogenous inputs.
            closure: closure of the system; None for that of its plant.
            plant: physics of the system, such as a twin's, or a real one that has more states than sensors read; None
                for the controller's own plant.

        Raises:
            DivergenceError: if the system diverges.
        """
        plant = self.plant if plant is None else plant
        loop = RememberingInterval(plant, plant.closure if closure is None else closure, self)
        start = torch.cat([initial_state, self.first_memory(initial_state[..., : len(plant.readings)])], -1)
        drive = drive_of(plant, exogenous, None)
        carries = torch.cat([start.unsqueeze(0), self._engine.end_states(loop, start, drive)])
        require_finite(plant, carries[1:, :, : len(plant.states)], initial_state, [loop.closure, self], remedy=REMEDY)
        states = carries[..., : len(plant.states)].transpose(0, 1)
        command = loop.command(carries[:-1], drive).transpose(0, 1)
        return Trajectory(states, plant.actuate(states[:, :-1], command), exogenous)
