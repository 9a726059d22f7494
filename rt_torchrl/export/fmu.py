"""A policy or a twin as an FMU for co-simulation, from the exported C, for Modelica tools and Simulink."""

import sys
import tempfile
import zipfile
from importlib.resources import files
from pathlib import Path
from uuid import uuid4

import torch
from torch import nn

from rt_torchrl.export.c_compiler import compile_c, compiler
from rt_torchrl.export.c_policy import export_c
from rt_torchrl.export.c_twin import export_twin
from rt_torchrl.export.fmu_description import FMUDescription, binaries, build_description
from rt_torchrl.plants.plant import Plant

INSTANCE = "fmu_instance.c"
WRAPPERS = {"2.0": "fmi2_wrapper.c", "3.0": "fmi3_wrapper.c"}
SUFFIXES = {"win32": ".dll", "darwin": ".dylib"}


def export_policy_fmu(policy: nn.Module, path: Path | str, plant: Plant, *, version: str = "2.0") -> None:
    """Write a policy as an FMU: the observations are its inputs, the actions its outputs.

    The actions follow from the present observations in every call (direct feedthrough); a step of the master is a
    control interval.

    Args:
        policy: any ``policy(observation) -> action`` that :func:`export_c` takes.
        path: file to write, such as ``policy.fmu``.
        plant: plant with the policy's observations and actions.
        version: version of FMI, 2.0 or 3.0.

    Raises:
        ValueError: if the path does not end in ``.fmu``, the version is neither, there is no C compiler, or
            :func:`export_c` refuses the policy.
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
        _write(path, described, source, version, output=output, step="")


def export_twin_fmu(closure: nn.Module, path: Path | str, plant: Plant, *, seed: int = 0, version: str = "2.0") -> None:
    """Write a twin as an FMU: commands and exogenous inputs are its inputs, the states its outputs.

    A master's step must be a whole number of control intervals; over each interval the inputs are held. The states may
    be set before the initialisation; by default they are those of a virtual episode that the plant draws.

    Args:
        closure: the learned closure.
        path: file to write, such as ``twin.fmu``.
        plant: the physics.
        seed: seed of the default initial state.
        version: version of FMI, 2.0 or 3.0.

    Raises:
        ValueError: if the path does not end in ``.fmu``, the version is neither, there is no C compiler, or
            :func:`export_twin` refuses the twin.
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
        _write(path, described, source, version, output="(void)v;", step=step)


def _token() -> str:
    return f"{{{uuid4()}}}"


def _write(path: Path | str, described: FMUDescription, source: Path, version: str, *, output: str, step: str) -> None:
    path, found, name = Path(path), compiler(), described.name
    if path.suffix != ".fmu":
        raise ValueError(f"path={path} of an FMU must end in .fmu.")
    if version not in WRAPPERS:
        raise ValueError(f"version={version!r} of FMI must be one of {', '.join(WRAPPERS)}.")
    if found is None:
        raise ValueError("an FMU holds machine code, and there is no C compiler here; install one, such as gcc.")
    templates = [files("rt_torchrl.export").joinpath(file) for file in (INSTANCE, WRAPPERS[version])]
    text = "".join(template.read_text(encoding="utf-8") for template in templates)
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
        fmu.writestr("modelDescription.xml", described.text(version))
        fmu.write(library, f"binaries/{binaries(version)}/{name}{SUFFIXES.get(sys.platform, '.so')}")
        for file in (wrapper, source.with_suffix(".h")):
            fmu.write(file, f"sources/{file.name}")
        if version == "3.0":
            fmu.writestr("sources/buildDescription.xml", build_description(name, wrapper.name))
