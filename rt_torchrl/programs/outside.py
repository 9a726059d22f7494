"""What code reads outside of its arguments and attributes: it must not change without notice.

A program holds what its code has read as constants. Attributes of modules and objects are a part of the fingerprint by
their values. Of what lies elsewhere, a constant is a number, a text, a function or a tuple of such: it can only be
replaced, which a :class:`Guard` notices. What may change in its place, such as a dictionary, is refused.
"""

import argparse
import collections
import contextvars
import dataclasses
import dis
import enum
import functools
import inspect
import os
import sys
import threading
import types
from collections.abc import Iterable, Iterator, Mapping, MutableSequence, MutableSet
from contextlib import contextmanager
from functools import lru_cache
from itertools import chain
from typing import Any

import numpy as np
from torch import Tensor, nn

from rt_torchrl.programs.fingerprint import Reader
from rt_torchrl.programs.outer_names import MADE_BY, foreign
from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.programs.watch import Guard, attributes_of

REMEDY = "make it an attribute or a buffer of the plant, the closure or the policy"
ATTRIBUTES = ("LOAD_ATTR", "LOAD_METHOD", "LOAD_SUPER_ATTR")
CHANGING = (
    Tensor,
    np.ndarray,
    nn.Module,
    Mapping,
    MutableSequence,
    MutableSet,
    bytearray,
    collections.deque,
    types.SimpleNamespace,
    argparse.Namespace,
    contextvars.ContextVar,
    threading.local,
)
"""Types of libraries whose objects hold what may change."""
GENERATED = "<@beartype"
"""Files of code that checks annotations at run time."""


class Executed:
    """The functions of a user that are executed within :meth:`noted`."""

    def __init__(self) -> None:
        self.globals: dict[tuple[types.CodeType, int], dict[str, Any]] = {}
        self.environment: types.CodeType | None = None
        """Code that has read an environment variable, if there is any."""
        self.variables: dict[types.CodeType, dict[str, Any]] = {}
        """Variables of enclosing functions that code has read."""

    @contextmanager
    def noted(self) -> Iterator[None]:
        """A context in which functions are noted."""
        before = sys.getprofile()
        sys.setprofile(self._note)
        try:
            yield
        finally:
            sys.setprofile(None)
            if callable(before):
                sys.setprofile(before)
            elif before is not None:  # the profiler of Python before version 3.12
                before.enable()

    def _note(self, frame: types.FrameType, event: str, argument: object) -> None:
        if event != "call":
            return
        code, held = frame.f_code, frame.f_globals
        if code is _READS_ENVIRONMENT:
            back = frame.f_back
            while back is not None and back.f_globals.get("__name__") in ("os", "collections.abc"):
                back = back.f_back
            if back is not None and not _of_library(back.f_code, back.f_globals):
                self.environment = back.f_code
        elif (code, id(held)) not in self.globals and not _of_library(code, held):
            self.globals[code, id(held)] = held
            if code.co_freevars:
                self.variables[code] = {x: frame.f_locals[x] for x in code.co_freevars if x in frame.f_locals}


_READS_ENVIRONMENT = type(os.environ).__getitem__.__code__


def guards_of(module: nn.Module, executed: Executed, known: Iterable[Guard] = ()) -> tuple[Guard, ...]:
    """The constants that executed functions of a module read, apart from those in its fingerprint, beside known ones.

    Raises:
        UntraceableError: if a function reads what may change without notice; the message names both.
    """
    reader = Reader(module)
    reader.text()
    noticed = {(id(held), name) for held, name in reader.names}
    if executed.environment is not None:
        raise _refusal(executed.environment, "the environment (os.environ)", "")
    found = {(id(guard.holder), guard.name): guard for guard in known}
    for (code, _), held in executed.globals.items():
        _require_imported(code)
        for guard in chain(_outside(code, held, noticed), _variables(code, executed, reader)):
            found[id(guard.holder), guard.name] = guard
    attributes = {name: code for code, _ in executed.globals for name in _read(code)[1]}
    for obj in reader.met:
        _require_class_attributes(obj, attributes)
    return tuple(guard for key, guard in found.items() if key not in noticed)


def _outside(code: types.CodeType, held: dict[str, Any], noticed: set[tuple[int, str]]) -> Iterator[Guard]:
    """The globals that code reads, and the attributes of modules, classes and functions among them."""
    names, attributes, _ = _read(code)
    holders: list[tuple[Any, tuple[str, ...], str]] = [(held, names, "the global ")]
    seen = set[int]()
    while holders:
        holder, wanted, prefix = holders.pop()
        if id(holder) in seen:
            continue
        seen.add(id(holder))
        there = attributes_of(holder)
        for name in wanted:
            if name not in there:
                continue
            value = there[name]
            if isinstance(value, (Tensor, np.ndarray)) and (id(there), name) in noticed:
                continue  # by its numbers
            if isinstance(value, types.ModuleType) and foreign(value.__name__):
                continue  # such as torch
            if not _constant(value):
                raise _refusal(code, f"{prefix}{name}", _kind(value))
            yield Guard(holder, name, value)
            inner = name if prefix == "the global " else f"{prefix}{name}"
            for further in _holders(value):
                holders.append((further, attributes, f"{inner}."))


def _require_imported(code: types.CodeType) -> None:
    """Refuse code that imports a user's module itself: nothing notices what this module holds."""
    for name in _read(code)[2]:
        if not foreign(name):
            raise UntraceableError(
                f"{_where(code)} imports {name!r} inside, whose values may change unnoticed; import it at the top of "
                "the file"
            )


def _holders(value: object) -> Iterator[Any]:
    """Where attributes of a value are found that nothing else notices."""
    if isinstance(value, types.ModuleType):
        if not foreign(value.__name__):
            yield vars(value)
    elif isinstance(value, type):
        yield from (kind for kind in value.__mro__ if not foreign(kind.__module__))
    elif isinstance(value, types.FunctionType):
        if not foreign(value.__globals__.get("__name__")):
            yield vars(value)
    elif not foreign(type(value).__module__):
        yield from _holders(type(value))


def _variables(code: types.CodeType, executed: Executed, reader: Reader) -> Iterator[Guard]:
    """The variables of enclosing functions that code reads, unless the fingerprint has their values."""
    functions = [f for f in reader.functions if f.__code__ is code]
    if any(f is obj for f in functions for obj in reader.met):
        return
    for value in (x for f in functions for x in (*(f.__defaults__ or ()), *(f.__kwdefaults__ or {}).values())):
        if not _constant(value):
            raise _refusal(code, "a default of an argument", _kind(value))
    if any(code in outer.co_consts for outer, _ in executed.globals):  # the function is made when it is needed
        return
    for name, value in executed.variables.get(code, {}).items():
        if name == "__class__":  # of super()
            continue
        if not functions or not _constant(value):
            raise _refusal(code, f"the variable {name} of the function around it", _kind(value))
        for f in functions:
            yield Guard((f.__closure__ or ())[code.co_freevars.index(name)], "cell_contents", value)


def _require_class_attributes(obj: object, attributes: Mapping[str, types.CodeType]) -> None:
    """Refuse what the class of an object holds and may change, if code of a user reads an attribute of its name."""
    kind = obj if isinstance(obj, type) else type(obj)
    if foreign(kind.__module__):
        return
    own = {} if isinstance(obj, type) else getattr(obj, "__dict__", {})
    for name, code in attributes.items():
        if name in own:
            continue
        owner = next((k for k in kind.__mro__ if name in vars(k)), None)
        if owner is not None and not foreign(owner.__module__) and not _constant(value := vars(owner)[name]):
            raise _refusal(code, f"the class attribute {owner.__name__}.{name}", _kind(value))


def _constant(value: object) -> bool:
    """Whether a value can be replaced only; functions count as constants, because what they read is judged itself."""
    kind = type(value)
    if isinstance(value, (type, types.ModuleType, types.FunctionType, enum.Enum)):
        return True
    if isinstance(value, (tuple, frozenset)):
        return all(map(_constant, value)) and all(map(_constant, getattr(value, "__dict__", {}).values()))
    if isinstance(value, types.MethodType):
        return _constant(value.__self__)
    if isinstance(value, functools.partial):
        return all(map(_constant, (value.func, *value.args, *value.keywords.values())))
    if isinstance(value, (staticmethod, classmethod, property)):
        return True
    if isinstance(value, CHANGING):
        return False
    if foreign(kind.__module__):
        return True
    if dataclasses.is_dataclass(kind) and getattr(getattr(kind, "__dataclass_params__", None), "frozen", False):
        return all(_constant(getattr(value, field.name)) for field in dataclasses.fields(kind))
    return inspect.isdatadescriptor(value) or (inspect.ismethoddescriptor(value) and not hasattr(value, "__dict__"))


@lru_cache(maxsize=2**14)
def _read(code: types.CodeType) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Names of the globals, the attributes and the modules that code itself reads."""
    read = [(x.opname, x.argval) for x in dis.get_instructions(code)]
    names = tuple({name for kind, name in read if kind in ("LOAD_GLOBAL", "LOAD_NAME")})
    attributes = tuple({name for kind, name in read if kind in ATTRIBUTES})
    return names, attributes, tuple({name for kind, name in read if kind == "IMPORT_NAME"})


def _of_library(code: types.CodeType, held: dict[str, Any]) -> bool:
    name = held.get("__name__")
    if foreign(name) or name in MADE_BY or code.co_filename.startswith(GENERATED):
        return True
    return str(name).startswith("namedtuple_")


def _refusal(code: types.CodeType, what: str, kind: str) -> UntraceableError:
    return UntraceableError(f"{_where(code)} reads {what}{kind and f', {kind}'}, which may change unnoticed; {REMEDY}")


def _kind(value: object) -> str:
    name = type(value).__name__
    return f"{'an' if name[:1].lower() in 'aeiou' else 'a'} {name}"


def _where(code: types.CodeType) -> str:
    return f"{code.co_name} ({code.co_filename}:{code.co_firstlineno})"
