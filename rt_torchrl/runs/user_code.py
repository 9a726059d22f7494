"""Import of a user's code from a file or by an import path."""

import functools
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

PREFIX = "rt_torchrl_recipe_"
"""Prefix of the names under which files are imported."""


def module_of(file: Path) -> ModuleType:
    """The module in a file, imported only once; as a script does, it can import modules that lie beside the file.

    Raises:
        ValueError: if there is no such file, or it does not end in ``.py``.
    """
    if not file.is_file():
        raise ValueError(f"{file} does not exist; give a file with Python code.")
    return _imported(file.resolve())


@functools.cache
def _imported(file: Path) -> ModuleType:
    if str(file.parent) not in sys.path:
        sys.path.insert(0, str(file.parent))
    name = f"{PREFIX}{file.stem}"
    while name in sys.modules:  # a file of the same name in another folder
        name += "_"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{file} is no Python code, by its name; give a file that ends in .py.")
    # Known by its name, because the command line looks up the source of its options for their help.
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def named(target: str) -> Any:
    """The object that ``FILE.py:NAME`` or ``package.module:NAME`` names.

    Raises:
        ValueError: if there is no such file or module, or it does not define the name.
    """
    place, colon, name = target.rpartition(":")
    if not (colon and place and name):
        raise ValueError(f"{target!r} is not understood; write FILE.py:NAME or package.module:NAME.")
    if place.endswith(".py"):
        return attribute(module_of(Path(place)), name)
    try:
        return attribute(importlib.import_module(place), name)
    except ImportError as error:
        raise ValueError(
            f"{target!r} cannot be imported ({error}); install its package, or give its file as FILE.py:{name}."
        ) from error


def attribute(module: ModuleType, name: str) -> Any:
    """The object that a module defines under a name, which may have dots.

    Raises:
        ValueError: if the module does not define the name.
    """
    try:
        return functools.reduce(getattr, name.split("."), module)
    except AttributeError as error:
        raise ValueError(f"{module.__file__ or module.__name__} defines no {name}.") from error
