"""Outer names: the globals that the code of classes and functions reads, which traced programs depend on."""

import inspect
import types
from collections.abc import Callable, Iterator
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from torch import Tensor

from rt_torchrl.programs.watch import same

DATA = (bool, int, float, complex, str, Tensor, np.ndarray, np.generic)
FOREIGN = frozenset("torch tensordict torchrl numpy scipy jaxtyping beartype builtins typing abc math".split())
"""Packages whose globals do not change."""

Name = tuple[dict[str, Any], str]


class ReadByClass:
    """What the methods of a class read, as long as nobody changes an attribute of the class.

    ``version`` counts the changes. The attributes are kept, so that none of a new one has the address of an old one.
    """

    def __init__(self) -> None:
        self.version, self.names = -1, list[Name]()
        self._attributes: list[object] = []
        self._values: list[object] = []

    def refresh(self, kind: type) -> None:
        """Bring it up to date; a global that is another function now reads other names."""
        attributes = list(vars(kind).values())
        changed = not same(attributes, self._attributes)
        if changed or not same(self._present(), self._values):
            self.version += changed
            self.names = _unique(name for f in attributes for name in read_by(_function(f)))
            self._attributes, self._values = attributes, self._present()

    def _present(self) -> list[object]:
        return [held.get(name) for held, name in self.names]


_classes: "WeakKeyDictionary[type, ReadByClass]" = WeakKeyDictionary()


def own_classes(kind: type) -> Iterator[type]:
    """A class and those that it extends, without those of foreign packages."""
    return (each for each in kind.__mro__ if not _foreign(each.__module__))


def read_by_class(kind: type) -> ReadByClass:
    """What the methods that a class itself defines read now."""
    found = _classes.setdefault(kind, ReadByClass())
    found.refresh(kind)
    return found


def read_by(function: Callable[..., Any] | None) -> list[Name]:
    """The globals that a function reads, also through the functions and modules among them."""
    found: list[Name] = []
    stack, seen = [function], set()
    while stack:
        f = stack.pop()
        if not isinstance(f, types.FunctionType) or f.__code__ in seen or _foreign(f.__module__):
            continue
        seen.add(f.__code__)
        names = list(_names(f.__code__))
        for held in [f.__globals__, *_modules(f.__globals__, names)]:
            for name in names:
                if name in held and not isinstance(held[name], types.ModuleType):
                    found.append((held, name))
                    stack.append(_function(held[name]))
    return _unique(found)


def _modules(held: dict[str, Any], names: list[str]) -> list[dict[str, Any]]:
    modules = [held[name] for name in names if isinstance(held.get(name), types.ModuleType)]
    return [vars(module) for module in modules if not _foreign(module.__name__)]


def _names(code: types.CodeType) -> Iterator[str]:
    """The names in a code and in the functions within it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names(constant)


def _function(attribute: object) -> Any:
    """The function behind an attribute of a class."""
    attribute = attribute.fget if isinstance(attribute, property) else getattr(attribute, "__func__", attribute)
    return inspect.unwrap(attribute) if isinstance(attribute, types.FunctionType) else None


def _foreign(module: str | None) -> bool:
    return module is None or module.partition(".")[0] in FOREIGN


def _unique(names: Iterator[Name] | list[Name]) -> list[Name]:
    return list({(id(held), name): (held, name) for held, name in names}.values())
