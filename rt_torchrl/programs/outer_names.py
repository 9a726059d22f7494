"""Outer names: the globals that the code of classes and functions reads, which traced programs depend on."""

import sys
import types
from functools import lru_cache
from typing import Any

import numpy as np
from torch import Tensor

DATA = (bool, int, float, complex, str, Tensor, np.ndarray, np.generic)
MADE_BY = {"abc", "types"}
"""Modules that classes name as theirs which are made by a call, whoever calls."""
LIBRARIES = {"torch", "tensordict", "torchrl", "numpy", "scipy", "jaxtyping", "beartype"}
FOREIGN = (sys.stdlib_module_names - MADE_BY) | LIBRARIES
"""Packages whose globals do not change."""
OWN = __name__.partition(".")[0]

Name = tuple[dict[str, Any], str]


def read_by(*functions: object) -> tuple[list[Name], set[types.FunctionType]]:
    """The globals that functions read, also through the functions and modules among them; and all these functions."""
    found: dict[tuple[int, str], Name] = {}
    stack, seen = [*functions], set[types.FunctionType]()
    while stack:
        f = stack.pop()
        if not isinstance(f, types.FunctionType) or f in seen:
            continue
        seen.add(f)
        stack.append(getattr(f, "__wrapped__", None))
        if foreign(f.__globals__.get("__name__")):
            continue
        names = _names(f.__code__)
        modules = (x for x in map(f.__globals__.get, names) if isinstance(x, types.ModuleType))
        for held in [f.__globals__, *(vars(module) for module in modules if not foreign(module.__name__))]:
            here = [name for name in names if name in held and not isinstance(held[name], types.ModuleType)]
            found |= {(id(held), name): (held, name) for name in here}
            stack += [function_of(held[name]) for name in here]
    return list(found.values()), seen


@lru_cache(maxsize=2**14)
def _names(code: types.CodeType) -> tuple[str, ...]:
    """The names in a code and in the functions within it."""
    inner = (name for x in code.co_consts if isinstance(x, types.CodeType) for name in _names(x))
    return (*code.co_names, *inner)


def function_of(attribute: object) -> types.FunctionType | None:
    """The function behind an attribute of a class; None if there is none."""
    attribute = attribute.fget if isinstance(attribute, property) else getattr(attribute, "__func__", attribute)
    return attribute if isinstance(attribute, types.FunctionType) else None


def foreign(module: str | None) -> bool:
    """Whether a module belongs to a package whose globals do not change; those of this library's plants may."""
    package, _, rest = (module or "").partition(".")
    return module is None or package in FOREIGN or (package == OWN and not rest.startswith("envs"))
