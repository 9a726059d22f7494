"""Classical controllers: laws of the measured state, with or without memory, and the search for their gains.

Learned policies are compared with them, and they act on a real system before any policy is trained.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Action, Input, Inputs, Memory, Starts, State
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.rollout import DivergenceError, drive_of, require_finite
from rt_torchrl.trajectories.state_feedback import RememberingInterval
from rt_torchrl.trajectories.trajectory import Trajectory, control_cost

REMEDY = "Use a smaller dt, or gains that hold the system."


class ClassicalController(nn.Module, ABC):
    r"""A law :math:`(a_k, m_{k+1}) = c(s_k, m_k, z_k)` with a memory m, which a ``policy(observation)`` cannot have.

    A subclass defines :meth:`law`, and names its gains and the size of its memory if it has any. The controller keeps
    the logarithms of its gains, so that a search changes a gain in proportion and never its sign. It is
    :class:`StateFeedback`: :meth:`act` acts interval by interval and keeps the memory of the episode.

    Args:
        plant: the plant to control; its actuators limit range and rate.
        gains: values of the gains, in the order and the units of ``gain_units``; None for the defaults.
        compiled: whether flights are compiled.

    Raises:
        ValueError: if the number of gains is wrong or one of them is not positive and finite.
    """

    gain_units: dict[str, str] = {}
    """Unit of each gain, by name; empty for a law without gains, such as one with a fixed matrix."""
    default_gains: tuple[float, ...] = ()
    """Values of the gains where none are given, in the order of :attr:`gain_units`."""
    placed_gains: tuple[float, ...] | None = None
    """Gains by a rule of thumb, if a search should start from them instead of the defaults."""
    memory_size: int = 0
    """Number of entries of the memory, such as an integral or whether a heater is on."""
    low_action: Tensor
    high_action: Tensor

    def __init__(self, plant: Plant, gains: tuple[float, ...] | None = None, *, compiled: bool = False):
        super().__init__()
        values = torch.tensor(self.default_gains if gains is None else gains, dtype=torch.float64)
        if len(values) != len(self.gain_units) or not (values.isfinite() & (values > 0)).all():
            wanted = ", ".join(f"{name} [{unit}]" for name, unit in self.gain_units.items()) or "none"
            given = f"default_gains={self.default_gains}" if gains is None else f"gains={gains}"
            raise ValueError(
                f"{given} of {type(self).__name__} must be positive and finite: {wanted}, one for each entry of "
                "gain_units."
            )
        self.plant = plant
        self.log_gains = nn.Parameter(values.log(), requires_grad=False)
        low, high = bounds(plant.actions)
        self.register_buffer("low_action", low)
        self.register_buffer("high_action", high)
        self._engine = Native(compiled=compiled)
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


class Tuned(NamedTuple):
    """Mean J_a at the first gains and at the gains that the search found, and the number of its evaluations."""

    start: float
    best: float
    evaluations: int


def tune(
    controller: ClassicalController,
    initial_state: Starts,
    exogenous: Inputs,
    *,
    evaluations: int = 80,
    plant: Plant | None = None,
) -> Tuned:
    """Minimise the mean J_a of the episodes over the logarithms of the gains by Nelder and Mead's simplex.

    Between corners of the first simplex one gain doubles.

    Args:
        controller: the controller; the search starts from its present gains and leaves the best ones in it.
        initial_state: initial states of the episodes.
        exogenous: exogenous inputs of the episodes.
        evaluations: greatest number of evaluations; each flies all episodes.
        plant: physics of the system that is flown; None for the controller's own plant.

    Raises:
        ValueError: if the controller has no gains, or an argument is out of its range.
    """
    from scipy.optimize import minimize  # here, because it takes a second to load and --help need not wait for it

    if not len(controller.log_gains):
        raise ValueError(f"controller {type(controller).__name__} has no gains to tune.")
    if evaluations < 1:
        raise ValueError(f"evaluations={evaluations} must be at least 1.")

    system = controller.plant if plant is None else plant

    @torch.no_grad()
    def cost(log_gains: np.ndarray) -> float:
        controller.log_gains.copy_(torch.as_tensor(log_gains, device=controller.log_gains.device))
        try:
            value = control_cost(system, controller.fly(initial_state, exogenous, plant=system)).mean().item()
        except DivergenceError:
            return np.inf  # a flight that leaves the finite numbers is worse than any other
        return value if np.isfinite(value) else np.inf

    first = controller.log_gains.detach().cpu().numpy().copy()
    simplex = np.vstack([first, first + np.log(2.0) * np.eye(len(first))])
    options = {"initial_simplex": simplex, "maxfev": evaluations, "xatol": 1e-2, "fatol": 1e-4}
    start = cost(first)
    found = minimize(cost, first, method="Nelder-Mead", options=options)
    with torch.no_grad():
        controller.log_gains.copy_(torch.as_tensor(found.x, device=controller.log_gains.device))
    return Tuned(start=start, best=float(found.fun), evaluations=int(found.nfev) + 1)
