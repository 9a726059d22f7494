"""Export from a run folder: a trained policy, the controller around it, or the twin."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import rt_torchrl as rt

rt.begin_loading(__name__)

from tyro.conf import Positional

from rt_torchrl.atomic_file import make_folder
from rt_torchrl.options import Text

FORMATS: dict[str, dict[str, Callable[..., float | None]]] = {
    "policy": {"c": rt.export_c, "onnx": rt.export_onnx},
    "controller": {"c": rt.export_controller, "discon": rt.export_discon},
    "twin": {"c": rt.export_twin},
}
"""What writes each thing in each format."""
KINDS = tuple(dict.fromkeys(kind for kinds in FORMATS.values() for kind in kinds))
SIZES = {"policy": "actions' ranges", "controller": "actions' ranges", "twin": "sizes of the states"}
"""What differences are shares of."""


@rt.configuration
class Config:
    """Export a trained policy; every file is compared with what it is made of before it is written.

    Args:
        run: run folder of any recipe.
        what: one or more of policy (from the observation to the action), controller (from the measured signals to the
            action, with filters and integrals) and twin (one control interval with the learned closure, of the
            hypothesis that explains the records best); controller and twin are written in C, a turbine's controller as
            a DISCON too.
        role: role of the policy, model_based or model_free.
        formats: one or more of c (C99 file and header), onnx (with the extra export) and discon (shared library with
            the interface of Bladed, and its C file).
        output: folder for the files; by default RUN/exported.
        name: name of the files and of the C function, to which _controller, _discon or _twin is added; by default
            PLANT_ROLE, and PLANT for the twin.
        recipe: file of the recipe that made the run; by default the one that the run names.
    """

    run: Annotated[Path, Positional]
    what: tuple[str, ...] = ("policy",)
    role: str = "model_based"
    formats: tuple[str, ...] = ("c",)
    output: Path | None = None
    name: str | None = None
    recipe: Text | None = None

    def __post_init__(self):
        for option, chosen, allowed in (("what", self.what, FORMATS), ("formats", self.formats, KINDS)):
            if not chosen or not set(chosen) <= set(allowed):
                raise ValueError(f"{option}={chosen} must be some of {', '.join(allowed)}.")
        for what in self.what:
            if not set(FORMATS[what]) & set(self.formats):
                allowed = " or ".join(FORMATS[what])
                raise ValueError(f"formats={self.formats} holds no format of the {what}; add {allowed}.")
        unused = [kind for kind in self.formats if not any(kind in FORMATS[what] for what in self.what)]
        if unused:
            raise ValueError(f"no {unused[0]} of {' and '.join(self.what)} can be written; leave it out.")


def main(config: Config) -> None:
    # ONNX is the last one, because its packages may be missing.
    formats = sorted(config.formats, key=lambda kind: kind == "onnx")
    run = rt.load_run(config.run, config.recipe)
    policy = run.policy(config.role)
    if isinstance(policy, rt.StateFeedback) and {"policy", "controller"} & set(config.what):
        raise ValueError(
            f"role={config.role!r} of this run plans its actions by model predictive control and cannot be exported; "
            "export the model-free policy, which has learned from its records, by --role model_free."
        )
    acts, finished = {"policy", "controller"} & set(config.what), (config.run / "metrics.json").is_file()
    refused = run.metrics["summary"]["may_not_act"] if acts and finished else {}
    if config.role in refused:
        print(f"warning: {refused[config.role]}", file=sys.stderr)
    output = config.output or config.run / "exported"
    make_folder("output", output)
    for kind in formats:
        for what in config.what:
            if kind in FORMATS[what]:
                print(written(config, run, output, what, kind))


def written(config: Config, run: rt.LoadedRun, output: Path, what: str, kind: str) -> str:
    """Write one file, and say how it agrees."""
    plant, beside = run.physics, None
    part, file = run.policy(config.role), config.name or f"{run.plant.name}_{config.role}"
    name = f"{file}_controller" if what == "controller" else file
    if what == "twin":
        part, plant, beside = run.twin.believed.closure, run.twin.believed.plant, run.twin.hypothesis
        name = f"{config.name or run.physics.name}_twin"
    path = output / (f"{file}_discon.c" if kind == "discon" else f"{name}.{kind}")
    named = {"function" if what == "policy" else "name": name} if kind in ("c", "discon") else {}
    error = FORMATS[what][kind](part, path, plant, **named)
    agreement = "not checked" if error is None else f"within {error:.1e} of the {SIZES[what]}"
    return f"{path}: {agreement}" + (f"; the twin with {beside}, which explains the records best" if beside else "")


if __name__ == "__main__":
    rt.main_of(Config, main)
