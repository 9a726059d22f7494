"""Export a trained policy from a run folder as C99, as an ONNX model or as a PyTorch program."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rt_torchrl import check_options, export_c, export_onnx, export_program, load_run, main_of
from rt_torchrl.export.onnx_model import require_packages
from rt_torchrl.runs.settings import read_settings

WRITERS: dict[str, Callable[..., float | None]] = {"c": export_c, "onnx": export_onnx, "pt2": export_program}


@dataclass(frozen=True, kw_only=True)
class Config:
    """Export a trained policy; every file is compared with the policy on random observations before it is written.

    Args:
        run: run folder of any recipe.
        role: role of the policy, model_based or model_free.
        formats: one or more of c (C99 file and header), onnx (needs the extra onnx) and pt2 (torch.export).
        output: folder for the files; by default RUN/exported.
        name: name of the files and of the C function; by default PLANT_ROLE.
        recipe: recipe that made the run, as its file or as package.module:Config; by default the recipe that the run
            names or, for a run of version 0.1, the recipe beside this file with the name of the plant.
    """

    run: Annotated[Path, Positional]
    role: str = "model_based"
    formats: tuple[str, ...] = ("c", "pt2")
    output: Path | None = None
    name: str | None = None
    recipe: str | None = None

    def __post_init__(self):
        check_options(self)
        unknown = [name for name in self.formats if name not in WRITERS]
        if unknown or not self.formats:
            raise ValueError(f"formats={self.formats} must be some of {', '.join(WRITERS)}.")
        if self.name is not None and not (self.name.isascii() and self.name.isidentifier()):
            raise ValueError(
                f"name={self.name!r} must be a name in C, such as blade_controller; give --output a folder."
            )


def main(config: Config) -> None:
    if "onnx" in config.formats:
        require_packages()
    settings = read_settings(config.run)
    beside = None if "recipe" in settings else Path(__file__).with_name(f"{settings['plant']}.py")
    run = load_run(config.run, config.recipe or beside)
    policy, name = run.policy(config.role), config.name or f"{run.plant.name}_{config.role}"
    output = config.output or config.run / "exported"
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"output={output} cannot be written ({error}); choose another.") from error
    for kind in config.formats:
        path = output / f"{name}.{kind}"
        named = {"function": name} if kind == "c" else {}
        error = WRITERS[kind](policy, path, run.plant, **named)
        found = "not checked" if error is None else f"within {error:.1e} of the actions' ranges"
        print(f"{path}: {found}")


if __name__ == "__main__":
    main_of(Config, main)
