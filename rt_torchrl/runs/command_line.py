"""A recipe as a module: what a file with a ``Config`` and a ``main`` defines."""

import importlib.util
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import tyro

from rt_torchrl.runs.run_config import RunConfig

Configuration = TypeVar("Configuration")


def from_command_line(config_class: type[Configuration], arguments: Sequence[str] | None = None) -> Configuration:
    """The configuration of a command line, by default of this process.

    That of a recipe is read twice: some of its options have other defaults for others, see :meth:`RunConfig.defaults`;
    what is given stays.
    """
    config = tyro.cli(config_class, args=arguments)
    if isinstance(config, RunConfig):
        config = tyro.cli(config_class, args=arguments, default=config.defaults())
    return config


@cache
def load_recipe(path: Path) -> ModuleType:
    """The recipe in a file, imported once.

    Raises:
        ValueError: if there is no such file, or it defines no ``Config`` derived from ``RunConfig``, or no ``main``.
    """
    if not path.is_file():
        raise ValueError(f"recipe={path} does not exist; give the file of a recipe.")
    name = f"rt_torchrl_recipe_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    # Known by its name, because the command line looks up the source of its options for their help.
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = getattr(module, "Config", None)
    if not (isinstance(found, type) and issubclass(found, RunConfig)):
        raise ValueError(f"recipe={path} has no class Config derived from RunConfig.")
    if not callable(getattr(module, "main", None)):
        raise ValueError(f"recipe={path} has no function main that takes its Config.")
    return module
