"""Recipes, which are files with a ``Config`` and a ``main``, and their command lines."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

import tyro

from rt_torchrl.runs.machine import quieten_libraries
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.user_code import module_of
from rt_torchrl.trajectories.rollout import DivergenceError

Configuration = TypeVar("Configuration")


def main_of(config_class: type, main: Callable[[Any], None]) -> None:
    """Run a recipe's main on its command line; an error that the user can mend is one line, without a traceback."""
    quieten_libraries()  # recipes check plants and make real systems before they make a run, or make none
    try:
        main(from_command_line(config_class))
    except (ValueError, OSError, DivergenceError) as error:
        raise SystemExit(f"error: {error}") from error
    except KeyboardInterrupt:
        sys.exit(130)  # as shells report Ctrl-C


def from_command_line(config_class: type[Configuration], arguments: Sequence[str] | None = None) -> Configuration:
    """The configuration that a command line asks for.

    The command line of a recipe is read twice, because the defaults of some options depend on other options; see
    :meth:`RunConfig.defaults`. Options that are given stay as they are.

    Args:
        config_class: class of the configuration.
        arguments: words of the command line; by default those of this process.
    """
    config = tyro.cli(config_class, args=arguments)
    if not isinstance(config, RunConfig):
        return config
    # Defaults are of the class of their configuration, which run-time checks cannot read in RunConfig.
    return tyro.cli(config_class, args=arguments, default=cast(Configuration, config.defaults()))


def load_recipe(path: Path) -> ModuleType:
    """The module of the recipe in a file, which is imported only once.

    Raises:
        ValueError: if there is no such file, or it lacks a ``Config`` derived from ``RunConfig`` or a ``main``.
    """
    if not path.is_file():
        raise ValueError(f"recipe={path} does not exist; give the file of a recipe.")
    module = module_of(path)
    found = getattr(module, "Config", None)
    if not (isinstance(found, type) and issubclass(found, RunConfig)):
        raise ValueError(f"recipe={path} has no class Config derived from RunConfig.")
    if not callable(getattr(module, "main", None)):
        raise ValueError(f"recipe={path} has no function main that takes its Config.")
    return module
