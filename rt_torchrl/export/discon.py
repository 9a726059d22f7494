"""A turbine's controller as a shared library with the interface of Bladed, which OpenFAST, HAWC2 and ROSCO call."""

import tempfile
from enum import IntEnum
from importlib.resources import files
from math import degrees
from pathlib import Path
from sys import platform
from typing import Any

from torch import nn

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.export.agreement import detached
from rt_torchrl.export.c_controller import CController, Controller
from rt_torchrl.export.c_file import STRICT, compile_c, compiler, named
from rt_torchrl.export.fmu import SUFFIXES
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import place_of
from rt_torchrl.programs.c_source import literal


class Record(IntEnum):
    """Records of the swap array that are read or written here, numbered from 1, in rad, rad/s, m/s, N m, W and s.

    Source: OpenFAST's ``BladedInterface.f90``, and ROSCO's ``ReadSetParameters.f90`` and ``Controllers.f90``.
    """

    STATUS = 1  # 0 at the first call, 1 at the others, -1 at the end
    TIME = 2
    COMMUNICATION_INTERVAL = 3
    PITCH_1 = 4
    RATE_ACTUATOR = 10  # 0 if angles of the blades are demanded, 1 if rates are
    SHAFT_POWER = 14
    ELECTRICAL_POWER = 15
    GENERATOR_SPEED = 20
    ROTOR_SPEED = 21
    GENERATOR_TORQUE = 23
    WIND_SPEED = 27  # at the hub
    PITCH_2 = 33
    PITCH_3 = 34
    GENERATOR_ON = 35
    DEMANDED_PITCH_1 = 42  # those of the blades 2 and 3 follow
    DEMANDED_PITCH = 45  # of all blades
    DEMANDED_TORQUE = 47
    MESSAGE_LENGTH = 49
    INPUT_FILE_LENGTH = 50
    OUTPUT_NAME_LENGTH = 51
    BLADES = 61


MEASURED = {
    "rotor_speed": ("rad/s", "READ(GENERATOR_SPEED) / GEAR_RATIO"),
    "generator_speed": ("rad/s", "READ(GENERATOR_SPEED)"),
    "wind_speed": ("m/s", "READ(WIND_SPEED)"),
    "generator_torque": ("N m", "torque"),
    "blade_pitch": ("deg", "pitch"),
}
"""The signals that the swap array gives: name and unit in the plant, and expression in ``discon.c``.

The rotor speed is that of the generator over the plant's ``gear_ratio``, because controllers hold the generator speed.
"""
ACTIONS = ("generator_torque", "blade_pitch")


def export_discon(policy: nn.Module, path: Path | str, plant: Plant, *, name: str | None = None) -> float | None:
    """Write the controller of a turbine as a C99 file and as a shared library, which simulators load as a DISCON.

    The library holds the controller of :func:`export_controller`, with its filters and rate limits. It reads the
    generator speed and the wind speed at the hub, and demands the torque of the generator and the pitch of all blades.
    The first call starts the controller from what is measured and, without a bump, from the torque and the pitch that
    are applied. A call fails with a message if the communication interval is not the plant's control interval, calls do
    not follow each other in this interval, a measurement is not finite, or the simulator wants pitch rates or a
    restart.

    Note: below its cut-in speed the generator of :class:`WindTurbine` delivers a share of the torque that is demanded.
    The library demands the whole torque.

    Args:
        policy: any policy that :func:`export_controller` takes.
        path: C file to write, such as ``discon.c``; the library beside it is then ``libdiscon.so`` (.dll, .dylib).
        plant: a turbine with the policy's observations and actions.
        name: prefix of the functions and of messages; by default the name of the plant with ``_controller``.

    Returns:
        What :func:`export_controller` returns; None without a compiler, and then only the C file is written.

    Raises:
        ValueError: if the actions are not generator_torque [N m] and blade_pitch [deg], the policy needs a signal that
            the swap array does not give, or :func:`export_controller` refuses policy, path or name.
    """
    (path, name), cc = named(path, name, f"{plant.name}_controller"), compiler()
    places = places_of(plant)
    controller = CController(Controller(plant, detached(policy, plant)), name)
    words = {"NAME": name} | _words(controller, *places)
    with tempfile.TemporaryDirectory() as folder:
        inner, outer = Path(folder, "controller.c"), Path(folder, path.name)
        agreement = controller.write(inner)
        header, template = inner.with_suffix(".h"), files("rt_torchrl.export").joinpath("discon.c")
        _, _, functions = inner.read_text(encoding="utf-8").partition(f'#include "{header.name}"')
        text = template.read_text(encoding="utf-8")
        for word, value in words.items():
            text = text.replace(f"@{word}@", value)
        outer.write_text(header.read_text(encoding="utf-8") + functions + text, encoding="utf-8")
        if cc is not None:
            library = path.with_name(f"lib{path.stem}{SUFFIXES.get(platform, '.so')}")
            write_atomically(library, compile_c(cc, outer, *STRICT).read_bytes())
        write_atomically(path, outer.read_bytes())
    return agreement


def places_of(plant: Plant) -> tuple[int, int]:
    """The places of torque and pitch among the actions of a turbine.

    Raises:
        ValueError: if it lacks one of them.
    """
    torque, pitch = (place_of("action of a DISCON", name, plant.actions, plant.name) for name in ACTIONS)
    return torque, pitch


def _words(controller: CController, torque: int, pitch: int) -> dict[str, str]:
    """What the words of ``discon.c`` stand for.

    Raises:
        ValueError: if a signal is not in the swap array, or has another unit than there.
    """
    plant, signals = controller.controller.plant, controller.signals
    refused = [s for s in (*signals, *plant.actions) if MEASURED.get(s.name, ("", ""))[0] != s.unit]
    if refused:
        available = ", ".join(f"{name} [{unit}]" for name, (unit, _) in MEASURED.items())
        raise ValueError(
            f"the swap array of a DISCON does not give {', '.join(f'{s.name} [{s.unit}]' for s in refused)} of plant "
            f"{plant.name!r}; it gives {available}. Export a policy that observes nothing else."
        )
    held = [plant.states[k].name for k in controller.controller.held]
    turbine: Any = plant.innermost
    return {
        "DT": literal(plant.dt),
        "GEAR_RATIO": literal(float(turbine.gear_ratio)),
        "DEGREES": literal(degrees(1.0)),
        "RECORDS": ", ".join(f"{record.name} = {record.value}" for record in Record),
        "MEASURED": ", ".join(MEASURED[signal.name][1] for signal in signals) or "0.0",
        "START": " ".join(f"state.memory[{held.index(a)}] = {MEASURED[a][1]};" for a in ACTIONS if a in held),
        "TORQUE": str(torque),
        "PITCH": str(pitch),
    }
