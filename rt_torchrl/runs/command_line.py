"""Command lines of recipes, which are files with a ``Config`` and a ``main``; recipes and plants by their names."""

import contextlib
import dataclasses
import importlib
import inspect
import logging
import os
import pkgutil
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn, TypeVar, cast

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

import rt_torchrl.envs
from rt_torchrl.atomic_file import read_json
from rt_torchrl.options import read_options
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.console import HELP, PACKAGE
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import BESIDE, FILE, OF_THE_CALL, as_written, attribute, module_of, require_config

Configuration = TypeVar("Configuration")


SOURCES = (PACKAGE, PACKAGE.parent / "envs", PACKAGE.parent / "recipes")
"""Folders of the library, its plants and its recipes, in a checkout as in a wheel."""


def quieten_libraries() -> None:
    """Keep log lines and warnings off the terminal that concern the libraries' own code, which a user cannot mend."""
    os.environ.setdefault("RL_LOGGING_LEVEL", "ERROR")  # TorchRL sets its own level when it is loaded, which is later
    for name in ("torchrl", "torch.utils.cpp_extension"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", message=r".*torch\.jit\.script.*is deprecated", category=FutureWarning)


def main_of(config_class: type, main: Callable[[Any], None]) -> None:
    """Run a recipe's main on its command line.

    An error that this library or one of its recipes raises, or the operating system, is one line, because it says what
    to mend, and so is a package that is missing. Any other one keeps its traceback, such as one inside PyTorch or in a
    plant of the user's own.
    """
    quieten_libraries()  # recipes check plants and make real systems before they make a run, or make none
    try:
        main(from_command_line(config_class))
    except Exception as error:
        if isinstance(error, OSError) or _is_for_users(error):
            raise SystemExit(f"error: {error}") from error
        missing = error if isinstance(error, ModuleNotFoundError) else error.__cause__
        if isinstance(missing, ModuleNotFoundError):
            raise SystemExit(
                f"error: the package {missing.name} is not installed; the page of the recipe says which extra of "
                "rt_torchrl brings it, uv run --extra EXTRA."
            ) from error
        raise
    except KeyboardInterrupt:
        sys.exit(130)  # as shells report Ctrl-C


def _is_for_users(error: Exception) -> bool:
    """Whether the library or a recipe of its own has raised the error by a statement ``raise``, and says what it is.

    A ``NotImplementedError`` without words, of a method that a class lacks, tells nobody what to mend.
    """
    *_, last = traceback.extract_tb(error.__traceback__)
    in_sources = any(Path(last.filename).resolve().is_relative_to(folder) for folder in SOURCES)
    return in_sources and (last.line or "").startswith("raise ") and str(error) != ""


HELP_ALL = "--help-all"
"""Word that asks for help on all options, not on those of the recipe and its run alone."""


def from_command_line(config_class: type[Configuration], arguments: Sequence[str] | None = None) -> Configuration:
    """The configuration that a command line asks for.

    The command line of a recipe is read twice, because the defaults of some options depend on other options; see
    :meth:`RunConfig.defaults`. Those of a run that goes on are its own options. Options that are given stay as they
    are.

    Args:
        config_class: class of the configuration.
        arguments: words of the command line; by default those of this process.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if {HELP_ALL, *HELP} & set(words):
        _show_help(config_class, everything=HELP_ALL in words)
    if not issubclass(config_class, RunConfig):
        return tyro.cli(config_class, args=words)
    asked = tyro.cli(config_class, args=words)
    resumed = asked.log_dir / FILE if asked.resume and asked.log_dir is not None else None
    file = asked.config or (resumed if resumed is not None and resumed.is_file() else None)
    default = asked.defaults() if file is None else of_file(file, asked)
    # Defaults are of the class of their configuration, which run-time checks cannot read in RunConfig.
    config = tyro.cli(config_class, args=words, default=cast(Configuration, default))
    # The file has been read now.
    return dataclasses.replace(config, config=None) if isinstance(config, RunConfig) else config


def _show_help(config_class: type, *, everything: bool) -> NoReturn:
    """Show the options, those of the parts of a configuration only if everything is asked for, and leave."""
    registry = ConstructorRegistry()

    @registry.struct_rule
    def hidden(info: StructTypeInfo) -> StructConstructorSpec | None:
        if everything or info.type is config_class or not dataclasses.is_dataclass(info.type):
            return None
        return StructConstructorSpec(instantiate=lambda: info.default, fields=())

    default = config_class().defaults() if issubclass(config_class, RunConfig) else tyro.MISSING_NONPROP
    with contextlib.suppress(SystemExit):
        tyro.cli(config_class, args=["--help"], default=default, registry=registry)
    if not everything:
        print(f"{HELP_ALL} also lists the options whose names have dots, such as the parameters of the six steps.")
    raise SystemExit(0)


def of_file(path: Path, config: RunConfig) -> RunConfig:
    """The options in a file, such as ``config.json`` of a run; those that it lacks have the defaults of ``config``.

    Nothing of the file is imported or run.

    Raises:
        ValueError: if the file cannot be read, is that of another recipe, or holds an option that does not exist or a
            value that it does not take.
    """
    settings = read_json(path)
    recipe = settings.get("recipe")
    source = recipe.get("file") if isinstance(recipe, dict) else None
    file = getattr(sys.modules[type(config).__module__], "__file__", None)
    if source and file and Path(str(source)).name != Path(file).name:
        raise ValueError(f"{path} is of the recipe {Path(str(source)).name}, not of {Path(file).name}; use its recipe.")
    options = {name: value for name, value in settings.items() if name not in (*BESIDE, *OF_THE_CALL)}
    try:
        stored = read_options(type(config), _over(as_written(config.defaults()), options))
        return dataclasses.replace(stored, config=None, log_dir=None)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _over(under: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Nested options, in which those of ``above`` replace those of ``under``."""
    nested = {
        name: _over(under[name], value)
        for name, value in above.items()
        if isinstance(value, dict) and isinstance(under.get(name), dict)
    }
    return under | above | nested


def load_recipe(path: Path) -> ModuleType:
    """The module of the recipe in a file, which is imported only once.

    Raises:
        ValueError: if there is no such file, or it lacks a ``Config`` derived from ``RunConfig`` or a ``main``.
    """
    module = module_of(path)
    require_config(getattr(module, "Config", None), f"Config of recipe={path}")
    if not callable(getattr(module, "main", None)):
        raise ValueError(f"recipe={path} has no function main that takes its Config.")
    return module


def shipped_plants() -> dict[str, type[Plant]]:
    """The plant class of each folder under ``rt_torchrl.envs``, by the folder's name; ``plant.py`` there holds one."""
    plants = {}
    for folder in pkgutil.iter_modules(rt_torchrl.envs.__path__):
        if folder.ispkg:
            module = importlib.import_module(f"rt_torchrl.envs.{folder.name}.plant")
            kinds = [kind for kind in vars(module).values() if inspect.isclass(kind) and issubclass(kind, Plant)]
            (plants[folder.name],) = [kind for kind in kinds if kind.__module__ == module.__name__]
    return plants


def plant_class(name: str) -> type[Plant]:
    """The plant class that a name stands for.

    Args:
        name: folder of the plant under ``rt_torchrl.envs``, or ``FILE.py:NAME``.

    Raises:
        ValueError: if there is no such plant.
    """
    file, _, own = name.rpartition(":")
    plants = shipped_plants()
    kind = attribute(module_of(Path(file)), own) if file else plants.get(name)
    if not (inspect.isclass(kind) and issubclass(kind, Plant)):
        raise ValueError(
            f"plant={name!r} does not exist; choose one of {', '.join(plants)}, or name a class derived from Plant as "
            "FILE.py:NAME."
        )
    return kind
