"""A policy or a twin as an FMU for co-simulation, from the exported C, for Modelica tools and Simulink."""

import platform
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
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

SUFFIXES = {"win32": ".dll", "darwin": ".dylib"}
SYSTEMS = {"win32": "win", "darwin": "darwin"}


@dataclass(frozen=True, kw_only=True)
class FMUDescription:
    """What ``modelDescription.xml`` says; a variable is called KIND.NAME, such as ``state.rotor_speed``.

    Args:
        name: name of the model and of its library.
        token: what the library knows itself by.
        dt: control interval [s].
        inputs, outputs: kind and signal of each variable, in the order of the values.
        values: values at the start.
    """

    name: str
    token: str
    dt: float
    inputs: Sequence[tuple[str, Signal]]
    outputs: Sequence[tuple[str, Signal]]
    values: Sequence[float]

    def text(self) -> str:
        """The content of the file."""
        rows = "".join(self._variable(k) for k in range(len(self.values)))
        first, kinds = len(self.inputs) + 1, [kind for kind, _ in self.outputs]
        unknowns = "".join(f'<Unknown index="{first + k}"/>' for k in range(len(kinds)))
        calculated = "".join(f'<Unknown index="{first + k}"/>' for k, kind in enumerate(kinds) if kind != "state")
        initials = f"<InitialUnknowns>{calculated}</InitialUnknowns>" if calculated else ""
        return (
            f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription fmiVersion="2.0" '
            f'modelName={quoteattr(self.name)} guid="{self.token}" generationTool="rt_torchrl" '
            f'variableNamingConvention="structured">'
            f'<CoSimulation modelIdentifier="{self.name}" canHandleVariableCommunicationStepSize="true"/>'
            f'<DefaultExperiment startTime="0" stepSize="{self.dt!r}"/><ModelVariables>{rows}</ModelVariables>'
            f"<ModelStructure><Outputs>{unknowns}</Outputs>{initials}</ModelStructure></fmiModelDescription>\n"
        )

    def _variable(self, k: int) -> str:
        kind, signal = (*self.inputs, *self.outputs)[k]
        is_input = k < len(self.inputs)
        # What a state starts with may be set; an action follows from the observation.
        initial = "" if is_input else ' initial="exact"' if kind == "state" else ' initial="calculated"'
        start = f' start="{self.values[k]!r}"' if is_input or kind == "state" else ""
        return (
            f'<ScalarVariable name={quoteattr(f"{kind}.{signal.name}")} valueReference="{k}" '
            f'causality="{"input" if is_input else "output"}" variability="continuous"{initial} '
            f"description={quoteattr(signal.unit)}><Real{start}/></ScalarVariable>"
        )


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
    name = f"{plant.name}_policy"
    n_o, n_a = len(plant.observations), len(plant.actions)
    output = f"{name}(v, v + {n_o});"
    inputs = [("observation", signal) for signal in plant.observations]
    outputs = [("action", signal) for signal in plant.actions]
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "policy.c"
        export_c(policy, source, plant, function=name)
        described = FMUDescription(
            name=name, token=_token(), dt=plant.dt, inputs=inputs, outputs=outputs, values=[0.0] * (n_o + n_a)
        )
        _write(path, described, source, output=output, step="")


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
        described = FMUDescription(
            name=name, token=_token(), dt=plant.dt, inputs=inputs, outputs=outputs, values=values
        )
        _write(path, described, source, output="(void)v;", step=step)


def _token() -> str:
    return f"{{{uuid4()}}}"


def _write(path: Path | str, described: FMUDescription, source: Path, *, output: str, step: str) -> None:
    path, found, name = Path(path), compiler(), described.name
    if path.suffix != ".fmu":
        raise ValueError(f"path={path} of an FMU must end in .fmu.")
    if found is None:
        raise ValueError("an FMU holds machine code, and there is no C compiler here; install one, such as gcc.")
    text = files("rt_torchrl.export").joinpath("fmu.c").read_text(encoding="utf-8")
    replaced = {
        "@HEADER@": source.with_suffix(".h").name,
        "@COUNT@": str(len(described.values)),
        "@VALUES@": ", ".join(repr(value) for value in described.values),
        "@INTERVAL@": repr(described.dt),
        "@OUTPUT@": output,
        "@STEP@": step or "(void)t;",
        "@GUID@": described.token,
    }
    for word, value in replaced.items():
        text = text.replace(word, value)
    # One unit of translation, so that one call of the compiler makes the library.
    wrapper = source.with_name(f"{name}_fmu.c")
    wrapper.write_text(text + source.read_text(encoding="utf-8"), encoding="utf-8")
    library = compile_c(found, wrapper)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as fmu:
        fmu.writestr("modelDescription.xml", described.text())
        fmu.write(library, f"binaries/{_binaries()}/{name}{SUFFIXES.get(sys.platform, '.so')}")
        for file in (wrapper, source.with_suffix(".h")):
            fmu.write(file, f"sources/{file.name}")


def _binaries() -> str:
    """Folder of the library for this machine."""
    return f"{SYSTEMS.get(sys.platform, 'linux')}{platform.architecture()[0].removesuffix('bit')}"
