"""Controllers of turbines in shared libraries with the interface of Bladed, such as ROSCO's."""

import ctypes
import math
import shutil
import sys
import tempfile
import warnings
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rt_torchrl.control.classical import REMEDY, ClassicalController
from rt_torchrl.export.discon import Record, places_of
from rt_torchrl.plants.plant import Plant, held
from rt_torchrl.plants.shapes import Action, Input, Inputs, Memory, Starts, State
from rt_torchrl.plants.signal import place_of
from rt_torchrl.trajectories.rollout import require_finite
from rt_torchrl.trajectories.trajectory import Trajectory

RECORDS = 3300
"""Size of the swap array, that of OpenFAST."""
ROOM = 1024
"""Size of the message."""
READ = ("rotor_speed", "generator_torque", "blade_pitch")
"""States of the turbine that a library is told, beside the input wind_speed."""


class DISCON(ClassicalController):
    """A controller in a shared library with the interface of Bladed, which demands torque and pitch of a turbine.

    A library is called once in every control interval with the speeds of rotor and generator, the torque and the pitch
    that are applied, the power, and the wind speed. The demands are clamped to the ranges of the actions; the plant
    limits their rates. Numbers pass in single precision.

    A library keeps its memory in global variables, so that one process holds one controller for each file. Each
    episode therefore loads a copy of the file, which is unloaded when the next episodes begin. What the copies need,
    such as the Fortran runtime, they share. The controller is no function of state and memory, so that no flight
    takes gradients. A library is code that runs in this process; load only what you trust.

    A training takes a subclass whose ``__init__(plant)`` names the files.

    Args:
        plant: a turbine with the states rotor_speed, generator_torque and blade_pitch [deg], the input wind_speed, and
            the attributes gear_ratio and generator_efficiency.
        library: the library, such as ``libdiscon.so``.
        input_file: input file that the library reads, such as ``DISCON.IN``; None for a library that reads none, such
            as that of :func:`export_discon`.

    Raises:
        ValueError: if a file does not exist, the library cannot be loaded or has no function DISCON, or the plant lacks
            a signal. Flights raise it with the message of the library if a call fails, as by a time step that does not
            suit the library.
    """

    respond: Any = None  # which a Remembering controller has: a function of state and memory

    def __init__(self, plant: Plant, library: Path | str, input_file: Path | str | None = None):
        super().__init__(plant)
        for argument, file in (("library", library), ("input_file", input_file)):
            if file is not None and not Path(file).is_file():
                raise ValueError(f"{argument}={str(file)!r} of DISCON does not exist; give the path of the file.")
        self.library = Path(library).resolve()
        self.input_file = None if input_file is None else Path(input_file).resolve()
        self._places = places_of(plant)
        self._read = [place_of("state that DISCON reads", name, plant.readings, plant.name) for name in READ]
        self._wind = place_of("input that DISCON reads", "wind_speed", plant.inputs, plant.name)
        # The original stays loaded, so that the copies find the libraries that lie beside it.
        loaded(self.library)
        self._flying: list[_Copy] = []
        self._intervals = 0

    def begin(self) -> None:
        """Begin episodes with libraries that remember nothing."""
        self._intervals = 0
        while self._flying:  # a library that fails at its end is not called again
            self._flying.pop().end()

    def law(self, state: State, memory: Memory, exogenous: Input) -> tuple[Action, Memory]:
        """The demands of the libraries in the control interval after the last one; the memory is theirs."""
        self._flying = self._flying or [_Copy(self.library, self.input_file) for _ in state]
        rows = torch.cat([state[:, self._read], exogenous[:, self._wind, None]], -1).tolist()
        command = state.new_zeros(len(state), 2)
        for k, (copy, row) in enumerate(zip(self._flying, rows, strict=True)):
            command[k, self._places] = state.new_tensor(copy.called(self._records(*row)))
        self._intervals += 1
        return command, memory

    def _records(self, rotor_speed: float, torque: float, pitch: float, wind: float) -> dict[Record, float]:
        """The records of the turbine."""
        turbine: Any = self.plant.innermost
        speed, angle = turbine.gear_ratio * rotor_speed, math.radians(pitch)
        return {
            Record.STATUS: float(self._intervals > 0),
            Record.TIME: self._intervals * self.plant.dt,
            Record.COMMUNICATION_INTERVAL: self.plant.dt,
            **dict.fromkeys((Record.PITCH_1, Record.PITCH_2, Record.PITCH_3), angle),
            Record.SHAFT_POWER: torque * speed,
            Record.ELECTRICAL_POWER: turbine.generator_efficiency * torque * speed,
            Record.GENERATOR_SPEED: speed,
            Record.ROTOR_SPEED: rotor_speed,
            Record.GENERATOR_TORQUE: torque,
            Record.WIND_SPEED: wind,
        }

    @torch.no_grad()
    def act(self, t: float, state: State, exogenous: Input) -> Action:
        """The demands within the ranges of the actions; the time is that since :meth:`begin`."""
        command, _ = self.law(state, self.first_memory(state), exogenous)
        return command.clamp(self.low_action, self.high_action)

    @torch.no_grad()
    def fly(
        self, initial_state: Starts, exogenous: Inputs, closure: nn.Module | None = None, *, plant: Plant | None = None
    ) -> Trajectory:
        """Episodes side by side, each with a copy of the library; see :meth:`ClassicalController.fly`."""
        plant = self.plant if plant is None else plant
        closure = plant.closure if closure is None else closure
        states, applied = [initial_state], list[Tensor]()
        self.begin()
        for k in range(exogenous.shape[1]):
            t, state, inputs = k * plant.dt, states[-1], exogenous[:, k]
            command = self.act(t, *plant.sensed(state, inputs))
            end, action = plant.step(state.new_full((len(state),), t), state, command, inputs, closure)
            states.append(held(plant, state, end))
            applied.append(action)
        self.begin()
        require_finite(plant, torch.stack(states[1:]), initial_state, [closure, self], remedy=REMEDY)
        return Trajectory(torch.stack(states, 1), torch.stack(applied, 1), exogenous)


def loaded(library: Path) -> ctypes.CDLL:
    """A library with a function DISCON.

    Raises:
        ValueError: if it is none.
    """
    try:
        dll = ctypes.CDLL(str(library))
    except OSError as error:
        raise ValueError(
            f"library={str(library)!r} of DISCON cannot be loaded here: {error}. Give a shared library for this system."
        ) from error
    if not hasattr(dll, "DISCON"):
        raise ValueError(f"library={str(library)!r} has no function DISCON; give a controller in the style of Bladed.")
    return dll


class _Copy:
    """A copy of a library, with its swap array and a folder for what the library writes.

    Args:
        library: the library.
        input_file: its input file; None if it reads none.
    """

    def __init__(self, library: Path, input_file: Path | None):
        folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        copy = loaded(Path(shutil.copy(library, folder.name)))
        self._unload = weakref.finalize(self, _unload, copy, folder)
        self._call, self._name = copy.DISCON, library.name
        self._swap, self._failed = (ctypes.c_float * RECORDS)(), ctypes.c_int()
        texts = (str(input_file or ""), str(Path(folder.name, "discon")))
        read, written = (ctypes.create_string_buffer(text.encode()) for text in texts)
        self._texts = read, written, ctypes.create_string_buffer(ROOM)
        lengths = {Record.INPUT_FILE_LENGTH: len(read), Record.OUTPUT_NAME_LENGTH: len(written)}
        self._tell({Record.MESSAGE_LENGTH: ROOM, Record.BLADES: 3, **lengths})

    def called(self, records: Mapping[Record, float]) -> tuple[float, float]:
        """The torque [N m] and the pitch [deg] that the library demands.

        Raises:
            ValueError: if the call fails.
        """
        self._tell(records)
        self._failed.value = 0
        self._call(self._swap, ctypes.byref(self._failed), *self._texts)
        message = self._texts[-1].value.decode(errors="replace").strip() or "it does not say why"
        if self._failed.value < 0:
            raise ValueError(f"{self._name} failed at t = {records[Record.TIME]:g} s: {message}")
        if self._failed.value > 0:
            warnings.warn(f"{self._name}: {message}", stacklevel=2)
        return self._swap[Record.DEMANDED_TORQUE - 1], math.degrees(self._swap[Record.DEMANDED_PITCH - 1])

    def end(self) -> None:
        """Tell the library, unless it has failed, that the simulation ends, and unload it."""
        if self._failed.value >= 0:
            self.called({Record.STATUS: -1.0, Record.TIME: self._swap[Record.TIME - 1]})
        self._unload()

    def _tell(self, records: Mapping[Record, float]) -> None:
        for record, value in records.items():
            self._swap[record - 1] = value


def _unload(library: ctypes.CDLL, folder: "tempfile.TemporaryDirectory[str]") -> None:
    handle = ctypes.c_void_p(library._handle)
    if sys.platform == "win32":
        ctypes.windll.kernel32.FreeLibrary(handle)
    else:
        ctypes.CDLL(None).dlclose(handle)
    folder.cleanup()
