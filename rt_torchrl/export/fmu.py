"""A policy or a twin as an FMU: FMI 2.0 for co-simulation, from the exported C, for Modelica tools and Simulink."""

import platform
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from uuid import uuid4
from xml.sax.saxutils import quoteattr

import torch
from torch import nn

from rt_torchrl.export.c_compiler import compile_c, compiler
from rt_torchrl.export.c_policy import export_c
from rt_torchrl.export.c_twin import export_twin
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

TEMPLATE = "fmi2_wrapper.c"
SUFFIXES = {"win32": ".dll", "darwin": ".dylib"}


def export_policy_fmu(policy: nn.Module, path: Path | str, plant: Plant) -> None:
    """Write a policy as an FMU: the observations are its inputs, the actions its outputs.

    The actions follow from the present observations in every call (direct feedthrough); a step of the master is a
    control interval.

    Args:
        policy: any ``policy(observation) -> action`` that :func:`export_c` takes.
        path: file to write, such as ``policy.fmu``.
        plant: plant with the policy's observations and actions.

    Raises:
        ValueError: if the path does not end in ``.fmu``, there is no C compiler, or :func:`export_c` refuses
            the policy.
    """
    name = f"{plant.name}_policy"
    n_o, n_a = len(plant.observations), len(plant.actions)
    output = f"{name}(v, v + {n_o});"
    inputs = [("observation", signal) for signal in plant.observations]
    outputs = [("action", signal) for signal in plant.actions]
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "policy.c"
        export_c(policy, source, plant, function=name)
        _write(path, name, source, plant.dt, inputs, outputs, [0.0] * (n_o + n_a), output=output, step="")


def export_twin_fmu(closure: nn.Module, path: Path | str, plant: Plant, *, seed: int = 0) -> None:
    """Write a twin as an FMU: commands and exogenous inputs are its inputs, the states its outputs.

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
    name = f"{plant.name}_twin"
    n_a, n_z = len(plant.actions), len(plant.inputs)
    first = plant.draw_initial_state(1, torch.Generator().manual_seed(seed))[0].tolist()
    step = f"{name}_step(t, v + {n_a + n_z}, v, v + {n_a}, v + {n_a + n_z});"
    inputs = [("command", s) for s in plant.actions] + [("exogenous", s) for s in plant.inputs]
    outputs = [("state", signal) for signal in plant.states]
    values = [0.0] * (n_a + n_z) + first
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "twin.c"
        export_twin(closure, source, plant, name=name)
        _write(path, name, source, plant.dt, inputs, outputs, values, output="(void)v;", step=step)


def _write(
    path: Path | str,
    name: str,
    source: Path,
    dt: float,
    inputs: Sequence[tuple[str, Signal]],
    outputs: Sequence[tuple[str, Signal]],
    values: Sequence[float],
    *,
    output: str,
    step: str,
) -> None:
    path, found = Path(path), compiler()
    if path.suffix != ".fmu":
        raise ValueError(f"path={path} of an FMU must end in .fmu.")
    if found is None:
        raise ValueError("an FMU holds machine code, and there is no C compiler here; install one, such as gcc.")
    guid = f"{{{uuid4()}}}"
    text = files("rt_torchrl.export").joinpath(TEMPLATE).read_text(encoding="utf-8")
    replaced = {
        "@HEADER@": source.with_suffix(".h").name,
        "@COUNT@": str(len(values)),
        "@VALUES@": ", ".join(repr(value) for value in values),
        "@INTERVAL@": repr(dt),
        "@OUTPUT@": output,
        "@STEP@": step or "(void)t;",
        "@GUID@": guid,
    }
    for word, value in replaced.items():
        text = text.replace(word, value)
    # One unit of translation, so that one call of the compiler makes the library.
    wrapper = source.with_name(f"{name}_fmu.c")
    wrapper.write_text(text + source.read_text(encoding="utf-8"), encoding="utf-8")
    library = compile_c(found, wrapper)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as fmu:
        fmu.writestr("modelDescription.xml", _description(name, guid, dt, inputs, outputs, values))
        fmu.write(library, f"binaries/{_platform()}/{name}{SUFFIXES.get(sys.platform, '.so')}")
        for file in (wrapper, source.with_suffix(".h")):
            fmu.write(file, f"sources/{file.name}")


def _platform() -> str:
    system = {"win32": "win", "darwin": "darwin"}.get(sys.platform, "linux")
    return f"{system}{platform.architecture()[0].removesuffix('bit')}"


def _description(
    name: str,
    guid: str,
    dt: float,
    inputs: Sequence[tuple[str, Signal]],
    outputs: Sequence[tuple[str, Signal]],
    values: Sequence[float],
) -> str:
    """The text of ``modelDescription.xml``; a variable is called KIND.NAME, such as ``state.rotor_speed``."""
    rows = []
    for k, (kind, signal) in enumerate((*inputs, *outputs)):
        is_input = k < len(inputs)
        causality = "input" if is_input else "output"
        # What a state starts with may be set; an action follows from the observation.
        initial = "" if is_input else ' initial="exact"' if kind == "state" else ' initial="calculated"'
        start = f' start="{values[k]!r}"' if is_input or kind == "state" else ""
        rows.append(
            f'<ScalarVariable name={quoteattr(f"{kind}.{signal.name}")} valueReference="{k}" '
            f'causality="{causality}" variability="continuous"{initial} description={quoteattr(signal.unit)}>'
            f"<Real{start}/></ScalarVariable>"
        )
    first = len(inputs) + 1
    unknowns = "".join(f'<Unknown index="{first + k}"/>' for k in range(len(outputs)))
    calculated = "".join(f'<Unknown index="{first + k}"/>' for k, (kind, _) in enumerate(outputs) if kind != "state")
    initials = f"<InitialUnknowns>{calculated}</InitialUnknowns>" if calculated else ""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="2.0" modelName={quoteattr(name)} guid="{guid}" '
        'generationTool="rt_torchrl" variableNamingConvention="structured">'
        f'<CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true"/>'
        f'<DefaultExperiment startTime="0" stepSize="{dt!r}"/>'
        f"<ModelVariables>{''.join(rows)}</ModelVariables>"
        f"<ModelStructure><Outputs>{unknowns}</Outputs>{initials}</ModelStructure>"
        "</fmiModelDescription>\n"
    )
