"""The flight of a plant by its controller in C, compared with the controller in torch."""

import ctypes
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rt_torchrl.export.agreement import SEED, shares_of_range
from rt_torchrl.export.c_compiler import c_array, called
from rt_torchrl.export.controller import Controller
from rt_torchrl.plants.plant import Plant

TOLERANCE = 1e-9
"""Greatest difference of a controller in C from that in torch, as a share of the action's range."""
INTERVALS = 1000
"""Greatest number of control intervals of the flight."""


class ControllerAgreement(NamedTuple):
    """The comparison of a controller in C over the first intervals of an episode that it flies.

    Args:
        difference: greatest difference of an action from that of the controller in torch, as a share of its range.
        from_plant: greatest difference from the policy on the plant's own states, whose filters know the measured
            states within an interval too.
        intervals: number of intervals.
    """

    difference: float
    from_plant: float
    intervals: int


class Layout(NamedTuple):
    """The arrays of a controller in C: positions of the measured states and inputs that it takes, and sizes."""

    states: list[int]
    inputs: list[int]
    n_memory: int
    n_actions: int

    @property
    def n_last(self) -> int:
        """Number of signals that it takes."""
        return len(self.states) + len(self.inputs)


class CompiledController:
    """A controller in C that runs.

    Args:
        library: the loaded library.
        name: prefix of its functions.
        layout: its arrays.
    """

    def __init__(self, library: ctypes.CDLL, name: str, layout: Layout):
        sizes = {"command": layout.n_actions, "memory": layout.n_memory, "last": layout.n_last}
        fields = [("steps", ctypes.c_ulonglong), *((key, ctypes.c_double * n) for key, n in sizes.items() if n)]
        self.state: Any = type("State", (ctypes.Structure,), {"_fields_": fields})()
        self._init, self._step = (getattr(library, f"{name}_{part}") for part in ("init", "step"))
        self.layout = layout

    def start(self, measured: Tensor, inputs: Tensor) -> None:
        """Start at a measurement of all measured states and inputs."""
        called(self._init, [ctypes.byref(self.state), self._signals(measured, inputs)], 0)

    def step(self, measured: Tensor, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """The command and the action at a measurement."""
        applied = called(self._step, [ctypes.byref(self.state), self._signals(measured, inputs)], self.layout.n_actions)
        return torch.tensor([list(self.state.command)], dtype=torch.float64), applied.unsqueeze(0)

    @property
    def memory(self) -> Tensor:
        """The controller's states."""
        return torch.tensor([list(self.state.memory) if self.layout.n_memory else []], dtype=torch.float64)

    def overwrite(self, memory: Sequence[float]) -> None:
        """Overwrite the controller's states."""
        if memory:
            self.state.memory[:] = memory

    def _signals(self, measured: Tensor, inputs: Tensor) -> ctypes.Array[ctypes.c_double]:
        return c_array([*measured[0, self.layout.states].tolist(), *inputs[0, self.layout.inputs].tolist()])


@torch.no_grad()
def fly(controller: Controller, library: ctypes.CDLL, name: str, layout: Layout) -> ControllerAgreement:
    """Fly the plant by a controller in C, and give the same measurements to the controller in torch.

    Args:
        controller: the controller in torch.
        library: the loaded library.
        name: prefix of the functions in C.
        layout: arrays of the controller in C.

    Raises:
        ValueError: if the two differ by more than ``TOLERANCE``.
    """
    plant, compiled = controller.plant, CompiledController(library, name, layout)
    generator = torch.Generator().manual_seed(SEED)
    state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    measured = state[:, controller.measured]
    compiled.start(measured, exogenous[:, 0])
    started = controller.start(measured, exogenous[:, 0])
    if not torch.allclose(compiled.memory, started, rtol=TOLERANCE, atol=TOLERANCE):
        raise ValueError(f"{name}_init in C starts at {compiled.memory.tolist()} instead of {started.tolist()}.")
    compiled.overwrite(state[0, controller.held].tolist())
    found, expected, ideal = zip(*_actions(controller, compiled, state, exogenous), strict=True)
    difference, from_plant = (_greatest(found, other, plant) for other in (expected, ideal))
    if difference > TOLERANCE:
        raise ValueError(
            f"the controller {name} in C differs from that in torch by {difference:.2g} of an action's range on the "
            f"first {len(found)} intervals of an episode; at most {TOLERANCE:g} is allowed, and nothing was written."
        )
    return ControllerAgreement(difference, from_plant, len(found))


def _actions(
    controller: Controller, compiled: CompiledController, state: Tensor, exogenous: Tensor
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """The action of every interval in C, in torch, and with the plant's own states; the one in C acts."""
    plant, held, memory = controller.plant, controller.held, state[:, controller.held]
    measured, command = state[:, controller.measured], state.new_zeros(1, len(plant.actions))
    for k in range(min(plant.n_steps, INTERVALS)):
        t, inputs, following = state.new_tensor([k * plant.dt]), exogenous[:, k], state[:, controller.measured]
        if k > 0 and held:
            memory = controller.advance(t - plant.dt, memory, measured, exogenous[:, k - 1], command, following)
        measured = following
        _, expected = controller.act(t, memory, measured, inputs)
        _, ideal = controller.act(t, state[:, held], measured, inputs)
        command, applied = compiled.step(measured, inputs)
        yield applied, expected, ideal
        state = plant.step(t, state, command, inputs, plant.closure).state
        if not state.isfinite().all():  # the plant has left its range; what follows is no flight
            return


def _greatest(found: Sequence[Tensor], other: Sequence[Tensor], plant: Plant) -> float:
    return shares_of_range(torch.cat(tuple(found)), torch.cat(tuple(other)), plant).max().item()
