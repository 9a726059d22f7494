"""A policy or a twin as an FMU for co-simulation, from the exported C, for Modelica tools and Simulink."""

import io
import platform
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from uuid import uuid4
from xml.etree import ElementTree

import torch
from torch import nn

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.export.c_file import compile_c, compiler, export_c, export_twin
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

SUFFIXES = {"win32": ".dll", "darwin": ".dylib"}
SYSTEMS = {"win32": "win", "darwin": "darwin"}
Variables = Sequence[tuple[str, Signal]]
"""Kind and signal of each variable, which is called KIND.NAME, such as ``state.rotor_speed``."""


def export_policy_fmu(policy: nn.Module, path: Path | str, plant: Plant) -> None:
    """Write a policy as an FMU of FMI 2.0: the observations are its inputs, the actions its outputs.

    The actions follow from the present observations in every call (direct feedthrough); a step of the master is a
    control interval.

    Args:
        policy: any ``policy(observation) -> action`` that :func:`export_c` takes.
        path: file to write, such as ``policy.fmu``.
        plant: plant with the policy's observations and actions.

    Raises:
        ValueError: if the path does not end in ``.fmu``, there is no C compiler, or :func:`export_c` refuses the
            policy.
    """
    name, inputs = f"{plant.name}_policy", [("observation", signal) for signal in plant.observations]
    outputs = [("action", signal) for signal in plant.actions]
    values = [0.0] * (len(inputs) + len(outputs))
    calls = {"@OUTPUT@": f"{name}(v, v + {len(inputs)});", "@STEP@": "(void)t;"}
    write = partial(export_c, policy, plant=plant, function=name)
    _write(path, name, plant.dt, inputs, outputs, values, calls, write)


def export_twin_fmu(closure: nn.Module, path: Path | str, plant: Plant, *, seed: int = 0) -> None:
    """Write a twin as an FMU of FMI 2.0: commands and exogenous inputs are its inputs, the states its outputs.

    A master's step must be a whole number of control intervals; over each interval the inputs are held. The states may
    be set before the initialisation; by default they are those of a virtual episode that the plant draws.

    Args:
        closure: the learned closure.
        path: file to write, such as ``twin.fmu``.
        plant: the physics.
        seed: seed of the default initial state.

    Raises:
        ValueError: if the path does not end in ``.fmu``, there is no C compiler, or :func:`export_twin` refuses the
            twin.
    """
    name, n_a = f"{plant.name}_twin", len(plant.actions)
    inputs = [("command", s) for s in plant.actions] + [("exogenous", s) for s in plant.inputs]
    n, outputs = len(inputs), [("state", signal) for signal in plant.states]
    values = [0.0] * n + plant.draw_initial_state(1, torch.Generator().manual_seed(seed))[0].tolist()
    calls = {"@OUTPUT@": "(void)v;", "@STEP@": f"{name}_step(t, v + {n}, v, v + {n_a}, v + {n});"}
    _write(path, name, plant.dt, inputs, outputs, values, calls, partial(export_twin, closure, plant=plant, name=name))


def _write(
    path: Path | str,
    name: str,
    dt: float,
    inputs: Variables,
    outputs: Variables,
    values: Sequence[float],
    calls: dict[str, str],
    write: Callable[[Path], object],
) -> None:
    """Write an FMU around the C file that ``write`` makes.

    Raises:
        ValueError: if the path does not end in ``.fmu``, or there is no C compiler.
    """
    if Path(path).suffix != ".fmu":
        raise ValueError(f"path={path} of an FMU must end in .fmu.")
    cc, token, content = compiler(), f"{{{uuid4()}}}", io.BytesIO()
    if cc is None:
        raise ValueError("an FMU holds machine code, and there is no C compiler here; install one, such as gcc.")
    words = {"@HEADER@": f"{name}.h", "@COUNT@": str(len(values)), "@GUID@": token}
    words |= {"@INTERVAL@": repr(dt), "@VALUES@": ", ".join(map(repr, values))}
    text = files("rt_torchrl.export").joinpath("fmu.c").read_text(encoding="utf-8")
    for word, value in (words | calls).items():
        text = text.replace(word, value)
    place = f"{SYSTEMS.get(sys.platform, 'linux')}{platform.architecture()[0].removesuffix('bit')}"
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as fmu:
        source, wrapper = Path(folder, f"{name}.c"), Path(folder, f"{name}_fmu.c")
        write(source)
        # One unit of translation, so that one call of the compiler makes the library.
        wrapper.write_text(text + source.read_text(encoding="utf-8"), encoding="utf-8")
        fmu.writestr("modelDescription.xml", description(name, token, dt, inputs, outputs, values))
        fmu.write(compile_c(cc, wrapper), f"binaries/{place}/{name}{SUFFIXES.get(sys.platform, '.so')}")
        for file in (wrapper, source.with_suffix(".h")):
            fmu.write(file, f"sources/{file.name}")
    write_atomically(Path(path), content.getvalue())


def description(
    name: str, token: str, dt: float, inputs: Variables, outputs: Variables, values: Sequence[float]
) -> bytes:
    """The content of ``modelDescription.xml``.

    Args:
        name: name of the model and of its library.
        token: what the library knows itself by.
        dt: control interval [s].
        inputs: the inputs, in the order of the values.
        outputs: the outputs after them.
        values: values at the start.
    """
    node, about = ElementTree.SubElement, {"fmiVersion": "2.0", "modelName": name, "guid": token}
    about |= {"generationTool": "rt_torchrl", "variableNamingConvention": "structured"}
    model = ElementTree.Element("fmiModelDescription", about)
    node(model, "CoSimulation", modelIdentifier=name, canHandleVariableCommunicationStepSize="true")
    units = node(model, "UnitDefinitions")
    for unit in dict.fromkeys(signal.unit for _, signal in (*inputs, *outputs)):
        node(units, "Unit", name=unit)
    node(model, "DefaultExperiment", startTime="0", stepSize=repr(dt))
    variables, structure = node(model, "ModelVariables"), node(model, "ModelStructure")
    listed = node(structure, "Outputs")
    calculated = ElementTree.Element("InitialUnknowns")
    for k, (kind, signal) in enumerate((*inputs, *outputs)):
        is_output = k >= len(inputs)
        about = {"name": f"{kind}.{signal.name}", "valueReference": str(k), "variability": "continuous"}
        about["causality"] = "output" if is_output else "input"
        if is_output:
            # What a state starts with may be set; an action follows from the observation.
            about["initial"] = "exact" if kind == "state" else "calculated"
            for parent in [listed] if kind == "state" else [listed, calculated]:
                node(parent, "Unknown", index=str(k + 1))
        real = node(node(variables, "ScalarVariable", about), "Real", unit=signal.unit)
        if not is_output or kind == "state":
            real.set("start", repr(values[k]))
    if len(calculated):
        structure.append(calculated)
    return ElementTree.tostring(model, encoding="UTF-8", xml_declaration=True)
