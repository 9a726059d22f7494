"""The contract of traced code: what it may read, how a change of that is seen, and that it is a function.

Machine code takes parameters and buffers in double precision as inputs, whose numbers are therefore never stale.
Whatever else code reads becomes a constant of it:

- what a module holds, in attributes and in the lists, dictionaries, objects and tensors there: :class:`Holdings` has it
  by value, so that a change gives other code;
- constants elsewhere, such as numbers, texts, tuples of these, functions and classes, which can only be replaced:
  :class:`Outside` notices that;
- what may change in its place elsewhere, such as a dictionary at the top of a module: it is refused by its name.
"""

import argparse
import collections
import contextvars
import dataclasses
import dis
import enum
import functools
import hashlib
import inspect
import os
import random
import sys
import threading
import types
from collections.abc import Iterable, Iterator, Mapping, MutableSequence, MutableSet
from contextlib import contextmanager
from functools import lru_cache
from itertools import chain
from operator import is_, methodcaller
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_hook
from torch.utils._pytree import tree_leaves, tree_map

from rt_torchrl.programs.program import UntraceableError

REMEDY = "make it an attribute or a buffer of the plant, the closure or the policy"
VALUES = frozenset({str, int, float, complex, bool, type(None), bytes, range, torch.Size, torch.dtype, torch.device})
"""Types of objects that their text describes."""
IDENTICAL = (
    *(type, enum.Enum, types.ModuleType, types.CodeType, types.BuiltinFunctionType),
    *(torch.Generator, np.random.Generator, np.random.RandomState, random.Random),
)
"""Types of objects that are known by their address: what cannot change, and generators, which no code may read."""
CHANGING = (
    *(Tensor, np.ndarray, nn.Module, Mapping, MutableSequence, MutableSet, bytearray, collections.deque),
    *(types.SimpleNamespace, argparse.Namespace, contextvars.ContextVar, threading.local),
)
"""Types of libraries whose objects hold what may change."""
MADE_BY = {"abc", "types"}
"""Modules that classes name as theirs which are made by a call, whoever calls."""
LIBRARIES = {"torch", "tensordict", "torchrl", "numpy", "scipy", "sympy", "opt_einsum", "jaxtyping", "beartype"}
FOREIGN = (sys.stdlib_module_names - MADE_BY) | LIBRARIES
"""Packages whose globals do not change."""
OWN = __name__.partition(".")[0]
GENERATED = "<@beartype"
"""Files of code that checks annotations at run time."""
ATTRIBUTES = ("LOAD_ATTR", "LOAD_METHOD", "LOAD_SUPER_ATTR")
ENVIRONMENT = ("environ", "environb", "getenv", "getenvb")
MISSING = object()


def foreign(module: str | None) -> bool:
    """Whether a module belongs to a package whose globals do not change; those of this library's plants may."""
    package, _, rest = (module or "").partition(".")
    return module is None or package in FOREIGN or (package == OWN and not rest.startswith("envs"))


def inputs_of(module: nn.Module) -> dict[str, Tensor]:
    """The tensors that machine code takes as inputs, by name: parameters, then buffers in double precision."""
    buffers = {name: x for name, x in module.named_buffers() if x.dtype == torch.float64 and x.layout is torch.strided}
    return dict(module.named_parameters()) | buffers


class Holdings:
    """What a module and everything in its attributes hold, by value.

    ``digest`` is equal where one machine code serves. :meth:`unchanged` compares all objects with those of before by
    identity, which takes a fraction of the time of a digest: a change is followed from the next call on.

    Args:
        root: the module, of which no reference is kept.
    """

    def __init__(self, root: nn.Module):
        self.objects: list[Any] = [root]
        """Everything that is read by its value; the root itself is left out in the end."""
        self.alive: list[object] = []
        """Objects that the digest knows by their address; whoever keeps the digest keeps them alive."""
        self._numbers = {id(root): 0}
        self._inputs = {*map(id, inputs_of(root).values())}
        self._instances, self._mappings, self._sequences = list[Any](), list[Any](), list[Any]()
        self._empty, self._parts = list[Any](), list[tuple[Any, str]]()
        self._tensors, self._constants = list[Tensor](), list[Any]()
        self._complete = True
        text = repr([self._read(obj) for obj in self.objects])  # which grow meanwhile
        self.digest = hashlib.sha256(text.encode(errors="surrogatepass")).digest()
        self.objects[0] = None
        self._views = [x.detach() for x in self._tensors]
        self._attributes = [x for x, _ in self._parts], [name for _, name in self._parts]
        self._sizes_then, self._then = self._sizes(root), self._all(root)
        self._addresses = self._then.tobytes()
        self._graded = [x.requires_grad for x in self._tensors]
        self._bytes = [*map(_bytes, self._constants)]

    def _mention(self, x: Any) -> object:
        """A value by its text, and any other object by its number, under which it is read."""
        kind = type(x)
        if kind in VALUES or isinstance(x, np.generic):
            return repr(x)
        if kind in (dict, collections.OrderedDict, list, set) and not x:  # of which every module has ten, for hooks
            self._empty.append(x)
            return kind.__name__
        if id(x) not in self._numbers:
            self._numbers[id(x)] = len(self.objects)
            self.objects.append(x)
        return self._numbers[id(x)]

    def _address(self, x: object) -> list[object]:
        self.alive.append(x)
        return [type(x).__name__, id(x)]

    def _read(self, x: Any) -> list[object]:
        """What tells an object from others."""
        if isinstance(x, IDENTICAL):
            return self._address(x)
        if isinstance(x, Tensor):
            return self._read_tensor(x)
        if isinstance(x, np.ndarray) and not x.dtype.hasobject:
            self._constants.append(x)
            return [x.shape, str(x.dtype), hashlib.sha256(_bytes(x)).digest()]
        parts = [*self._elements(x), *self._slots(x)]
        if not isinstance(x, types.FunctionType) and hasattr(x, "__dict__"):
            self._instances += [x] if self._numbers[id(x)] else []  # all but the root
            parts += chain(vars(x), vars(x).values())
        elif not parts and not isinstance(x, (tuple, frozenset, list, dict, set)):
            return self._address(x)
        return [self._mention(type(x)), *map(self._mention, parts)]

    def _read_tensor(self, x: Tensor) -> list[object]:
        description = [type(x).__name__, tuple(x.shape), str(x.dtype), x.requires_grad]
        if x.layout is not torch.strided or x.device.type != "cpu":
            self._complete = False
            return [*description, *self._address(x)]
        self._tensors.append(x)
        if id(x) in self._inputs:
            return description
        self._constants.append(x)
        return [*description, hashlib.sha256(_bytes(x)).digest()]

    def _elements(self, x: Any) -> Iterable[object]:
        """What a collection or a function holds."""
        if isinstance(x, (dict, types.MappingProxyType)):
            self._mappings.append(x)
            return chain(x, x.values())
        if isinstance(x, (list, set, collections.deque, bytearray)):
            self._sequences.append(x)
            return x
        if isinstance(x, (tuple, frozenset)):
            return x
        if isinstance(x, np.ndarray):  # of objects
            self._complete = False
            return x.flatten().tolist()
        if isinstance(x, types.MethodType):
            return x.__func__, x.__self__
        if isinstance(x, functools.partial):
            return x.func, x.args, x.keywords
        if isinstance(x, types.FunctionType):
            self._parts += [(x, name) for name in ("__code__", "__defaults__", "__kwdefaults__")]
            cells = [cell for cell in x.__closure__ or () if cell != types.CellType()]
            self._parts += [(cell, "cell_contents") for cell in cells]
            self._complete &= len(cells) == len(x.__closure__ or ())  # a variable without a value may get one
            parts = [x.__code__, x.__defaults__, x.__kwdefaults__, x.__dict__]
            return [*parts, *(cell.cell_contents for cell in cells)]
        return ()

    def _slots(self, x: Any) -> Iterator[object]:
        """The attributes of an object that are not in its dictionary."""
        for kind in type(x).__mro__:
            for name, slot in () if foreign(kind.__module__) else vars(kind).items():
                if isinstance(slot, types.MemberDescriptorType):
                    self._complete &= hasattr(x, name)  # which may get a value
                    self._parts += [(x, name)] if hasattr(x, name) else []
                    yield getattr(x, name, None)

    # Changes

    def _sizes(self, root: nn.Module) -> list[int]:
        return [*map(len, chain(map(vars, (root, *self._instances)), self._mappings, self._sequences))]

    def _all(self, root: nn.Module) -> np.ndarray:
        """All objects, in an order that stays; as long as the array lives, no other object takes their addresses."""
        instances = [root, *self._instances]
        held = [*map(vars, instances), *self._mappings]
        objects = chain(
            map(type, instances),
            chain.from_iterable(held),
            chain.from_iterable(map(_values, held)),
            chain.from_iterable(self._sequences),
            map(getattr, *self._attributes),
        )
        return np.fromiter(objects, object)

    def unchanged(self, root: nn.Module) -> bool:
        """Whether everything is as it was; a change that leaves the digest as it is may count as one."""
        if not self._complete or any(self._empty):
            return False
        try:
            return (
                self._sizes(root) == self._sizes_then
                and self._all(root).tobytes() == self._addresses
                and all(map(Tensor.is_set_to, self._tensors, self._views))
                and [x.requires_grad for x in self._tensors] == self._graded
                and [*map(_bytes, self._constants)] == self._bytes
            )
        except (AttributeError, ValueError, RuntimeError):  # a value is lost, or a tensor has another type
            return False


_values = methodcaller("values")


def _bytes(x: Any) -> bytes:
    """The numbers of a tensor or an array, and the shape of an array."""
    if isinstance(x, Tensor):
        return x.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
    return repr((x.shape, x.dtype)).encode() + x.tobytes()


class Outside:
    """Constants outside of a module, which can only be replaced.

    Args:
        places: dictionaries of globals and classes, each with a name of an entry; cells of functions; and classes with
            an empty name, whose attributes and bases stay the same.
    """

    def __init__(self, places: Iterable[tuple[Any, str]] = ()):
        dicts = [(holder, name) for holder, name in places if isinstance(holder, dict)]
        classes = [(holder, name) for holder, name in places if isinstance(holder, type)]
        cells = [holder for holder, _ in places if isinstance(holder, types.CellType)]
        self._globals = [holder for holder, _ in dicts], [name for _, name in dicts]
        self._entries = [vars(kind) for kind, name in classes if name], [name for _, name in classes if name]
        whole = [kind for kind, name in classes if not name]
        self._classes = [vars(kind) for kind in whole]
        self._parts = [*cells, *whole], ["cell_contents"] * len(cells) + ["__mro__"] * len(whole)
        self._then, self._names = [*self._now()], [*map(tuple, self._classes)]
        self._numbered = [x for x in self._then if isinstance(x, (Tensor, np.ndarray))]
        self._bytes = [*map(_bytes, self._numbered)]

    def _now(self) -> Iterator[object]:
        entries = map(types.MappingProxyType.get, *self._entries)
        return chain(map(dict.get, *self._globals), entries, map(getattr, *self._parts))

    def unchanged(self) -> bool:
        """Whether all of them are what they were."""
        try:
            same = all(map(is_, self._now(), self._then)) and [*map(tuple, self._classes)] == self._names
        except ValueError:  # a variable of a function has lost its value
            return False
        return same and [*map(_bytes, self._numbered)] == self._bytes


class Executed:
    """The functions of a user that are executed within :meth:`noted`."""

    def __init__(self) -> None:
        self.globals: dict[tuple[types.CodeType, int], dict[str, Any]] = {}
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
            sys.setprofile(before if callable(before) else None)
            if before is not None and not callable(before):  # the profiler of Python before version 3.12
                before.enable()

    def _note(self, frame: types.FrameType, event: str, argument: object) -> None:
        code, held = frame.f_code, frame.f_globals
        if event == "call" and (code, id(held)) not in self.globals and not _of_library(code, held):
            self.globals[code, id(held)] = held
            if code.co_freevars:
                self.variables[code] = {x: frame.f_locals[x] for x in code.co_freevars if x in frame.f_locals}


def _of_library(code: types.CodeType, held: dict[str, Any]) -> bool:
    name = held.get("__name__")
    made = name in MADE_BY or code.co_filename.startswith(GENERATED) or str(name).startswith("namedtuple_")
    return foreign(name) or made


def outside_of(root: nn.Module, holdings: Holdings, executed: Executed) -> Outside:
    """The constants that executed functions of a module read outside of it.

    Raises:
        UntraceableError: if a function reads what may change without notice; the message names both.
    """
    return Outside(_Reads(root, holdings, executed).places.values())


class _Reads:
    """What executed functions read outside of a module."""

    def __init__(self, root: nn.Module, holdings: Holdings, executed: Executed):
        self.places: dict[tuple[int, str], tuple[Any, str]] = {}
        self._held = {id(root), *map(id, holdings.objects)}  # whose changes the holdings notice
        self._functions: dict[types.CodeType, list[types.FunctionType]] = collections.defaultdict(list)
        self._codes = {code for code, _ in executed.globals}
        named = {name: code for code in self._codes for name in _names(code).attributes}
        for x in holdings.objects:
            self._note_function(x)
        classes = {kind for x in (root, *holdings.objects) for kind in (x if isinstance(x, type) else type(x)).__mro__}
        for kind in (kind for kind in classes if not foreign(kind.__module__)):
            self.places[id(kind), ""] = kind, ""
            for value in vars(kind).values():
                self._note_function(value)
        for (code, _), held in executed.globals.items():
            self._globals(code, held)
        for x in (root, *holdings.objects):
            self._class_attributes(x, named)
        for code in self._codes:
            self._variables(code, executed.variables.get(code, {}))

    def _globals(self, code: types.CodeType, held: dict[str, Any]) -> None:
        names = _names(code)
        for module in names.imports:  # nothing notices what this module holds
            if not foreign(module):
                raise UntraceableError(
                    f"{_where(code)} imports {module!r} inside, whose values may change unnoticed; import it at the "
                    "top of the file"
                )
        for name in names.globals:
            if name in held:
                self._take(code, held, name, "the global ")

    def _take(self, code: types.CodeType, holder: Any, name: str, prefix: str) -> None:
        """Judge what code reads from a dictionary of globals, a class or a function, and its attributes."""
        value = (holder if isinstance(holder, dict) else vars(holder))[name]
        if value is os.environ or value is os.getenv or (value is os and {*ENVIRONMENT} & {*_names(code).attributes}):
            raise _refusal(code, "the environment (os.environ)")
        if isinstance(value, types.ModuleType) and foreign(value.__name__):
            return  # such as torch
        followed = isinstance(value, (Tensor, np.ndarray)) and isinstance(holder, dict)  # by its numbers
        if not followed and not self._constant(value):
            raise _refusal(code, f"{prefix}{name}", value)
        self._note_function(value)
        seen = (id(holder), name) in self.places
        self.places[id(holder), name] = holder, name
        inner = name if prefix == "the global " else f"{prefix}{name}"
        for further in _holders(value):
            there = further if isinstance(further, dict) else vars(further)
            for attribute in _names(code).attributes:
                if attribute in there and not (seen and (id(further), attribute) in self.places):
                    self._take(code, further, attribute, f"{inner}.")

    def _class_attributes(self, x: object, named: dict[str, types.CodeType]) -> None:
        """Judge what the class of an object holds, if executed code has it or reads an attribute of its name."""
        kind = x if isinstance(x, type) else type(x)
        if foreign(kind.__module__):
            return
        attributes = {} if isinstance(x, type) else getattr(x, "__dict__", {})
        for name in attributes.keys() & named.keys():
            if isinstance(attributes[name], contextvars.ContextVar):  # of which nothing is known but its address
                raise _refusal(named[name], f"the attribute {name}", attributes[name])
        functions = {name: _function_of(f) for owner in kind.__mro__ for name, f in vars(owner).items()}
        methods = {name: f.__code__ for name, f in functions.items() if f is not None and f.__code__ in self._codes}
        for name, code in {name: code for name, code in (methods | named).items() if name not in attributes}.items():
            owner = next((k for k in kind.__mro__ if name in vars(k)), None)
            if owner is not None and not foreign(owner.__module__) and (id(owner), name) not in self.places:
                self._take(code, owner, name, f"the class attribute {owner.__name__}.")

    def _variables(self, code: types.CodeType, variables: Mapping[str, object]) -> None:
        """Judge the defaults of a function, and the variables of the functions around it."""
        functions = [f for f in self._functions[code] if id(f) not in self._held]
        if not functions and self._functions[code]:
            return
        for value in (x for f in functions for x in (*(f.__defaults__ or ()), *(f.__kwdefaults__ or {}).values())):
            if not self._constant(value):
                raise _refusal(code, "a default of an argument", value)
        if any(code in outer.co_consts for outer in self._codes):  # the function is made when it is needed
            return
        for name, value in variables.items():
            if name == "__class__":  # of super()
                continue
            if not functions or not self._constant(value):
                raise _refusal(code, f"the variable {name} of the function around it", value)
            for cell in ((f.__closure__ or ())[code.co_freevars.index(name)] for f in functions):
                self.places[id(cell), ""] = cell, ""

    def _note_function(self, x: object) -> None:
        """Note a function, and those that it wraps."""
        f = _function_of(x)
        if f is None or foreign(f.__globals__.get("__name__")) or f in self._functions[f.__code__]:
            return
        self._functions[f.__code__].append(f)
        self._note_function(getattr(f, "__wrapped__", None))
        for cell in f.__closure__ or ():
            if cell != types.CellType():
                self._note_function(cell.cell_contents)

    def _constant(self, value: object) -> bool:
        """Whether a value can only be replaced; functions count, because what they read is judged itself."""
        kind = type(value)
        if isinstance(value, (type, types.ModuleType, types.FunctionType, enum.Enum)):
            return True
        if isinstance(value, (tuple, frozenset)):
            return all(map(self._constant, (*value, *getattr(value, "__dict__", {}).values())))
        if isinstance(value, types.MethodType):
            return self._constant(value.__self__)
        if isinstance(value, functools.partial):
            return all(map(self._constant, (value.func, *value.args, *value.keywords.values())))
        if isinstance(value, (staticmethod, classmethod, property)):
            return True
        if isinstance(value, CHANGING):
            return False
        if foreign(kind.__module__):
            return True
        if dataclasses.is_dataclass(kind) and getattr(getattr(kind, "__dataclass_params__", None), "frozen", False):
            return all(self._constant(getattr(value, field.name)) for field in dataclasses.fields(kind))
        return inspect.isdatadescriptor(value) or (inspect.ismethoddescriptor(value) and not hasattr(value, "__dict__"))


class _Names(NamedTuple):
    """What a code reads by name."""

    globals: tuple[str, ...]
    attributes: tuple[str, ...]
    imports: tuple[str, ...]


@lru_cache(maxsize=2**14)
def _names(code: types.CodeType) -> _Names:
    """Names of the globals, the attributes and the modules that code itself reads."""
    read = [(x.opname, x.argval) for x in dis.get_instructions(code)]
    names = {name for kind, name in read if kind in ("LOAD_GLOBAL", "LOAD_NAME")}
    attributes = {name for kind, name in read if kind in ATTRIBUTES}
    if "getattr" in names:
        attributes |= {x for x in code.co_consts if isinstance(x, str)}
    return _Names(tuple(names), tuple(attributes), tuple({name for kind, name in read if kind == "IMPORT_NAME"}))


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


def _function_of(x: Any) -> types.FunctionType | None:
    """The function behind an attribute of a class, a bound method or a cache; None if there is none."""
    x = x.fget if isinstance(x, property) else getattr(x, "__func__", x)
    x = x.func if isinstance(x, functools.partial) else x
    x = getattr(x, "__wrapped__", x) if isinstance(x, functools._lru_cache_wrapper) else x
    return x if isinstance(x, types.FunctionType) else None


def _refusal(code: types.CodeType, what: str, value: object = MISSING) -> UntraceableError:
    kind = type(value).__name__
    called = "" if value is MISSING else f", {'an' if kind[:1].lower() in 'aeiou' else 'a'} {kind}"
    return UntraceableError(f"{_where(code)} reads {what}{called}, which may change unnoticed; {REMEDY}")


def _where(code: types.CodeType) -> str:
    return f"{code.co_name} ({code.co_filename}:{code.co_firstlineno})"


# Functions of their arguments

GAP = 1e-8
"""Greatest difference of two answers, relative to the largest of a signal: sums may be taken in another order."""
PURE = (
    "Policy, closure and plant must be pure functions: call .eval() on a module with dropout or batch normalisation; "
    "what is to be remembered must be a state of the plant, or part of the observation; random numbers belong in "
    "draw_exogenous"
)


class ImpureError(ValueError):
    """A policy, a closure or a plant is no function of its arguments; the message names it and says what to do."""


def require_pure(module: nn.Module, *arguments: Any) -> None:
    """Refuse a module that gives two answers to one question, or mixes realisations.

    Args:
        module: the module, such as a control interval.
        arguments: tensors, and tuples of tensors, for several realisations, no two of which are equal.

    Raises:
        ImpureError: if a second answer is another one, although none but other questions were asked in between; if a
            question changes a buffer; or if the answer for a realisation depends on the others.
    """
    last = tree_map(lambda x: x[-1:], arguments)
    other = tree_map(lambda x: x[-1:].expand_as(x).clone(), arguments)
    strided = {name: x for name, x in module.named_buffers() if x.layout is torch.strided}
    kept = {name: (buffer, buffer.clone()) for name, buffer in strided.items()}
    first = module(*arguments).detach()
    module(*other)
    second = module(*arguments).detach()
    changed = [name for name, (now, before) in kept.items() if not torch.allclose(now, before, 0, 0, equal_nan=True)]
    with torch.no_grad():
        for name in changed:
            kept[name][0].copy_(kept[name][1])
    if changed:
        owner, _, buffer = changed[0].rpartition(".")
        raise ImpureError(f"{_called(module, owner)} changes its buffer {buffer!r} when it is called. {PURE}.")
    if not _close(first, second):
        raise ImpureError(
            f"{_culprit(module, arguments, other)} gives something else when it is called again with the same "
            f"arguments. {PURE}."
        )
    try:
        alone = module(*last).detach()
    except Exception as error:
        raise ImpureError(
            f"an interval of one realisation alone raises {type(error).__name__}: {str(error).rstrip('.')}; one of "
            f"{len(first)} realisations does not. Policy, closure and plant must take any number of rows."
        ) from error
    if not _close(alone, first[-1:]):
        raise ImpureError(
            "the end of an interval depends on the other realisations that are computed with it: it is "
            f"{alone[-1].tolist()} alone and {first[-1].tolist()} beside others. Rows are systems of their own: no "
            "sum, mean, norm or branch over a leading dimension in policy, closure or plant."
        )


def _close(x: Tensor, y: Tensor) -> bool:
    """Whether two answers are equal but for rounding, wherever both are numbers."""
    if x.shape != y.shape:
        return False
    numbers = x.isfinite() & y.isfinite()
    gap = torch.where(numbers, (x - y).abs(), 0.0)
    return bool((gap <= GAP * torch.where(numbers, x.abs() + y.abs(), 0.0).amax(0)).all())


def _culprit(module: nn.Module, arguments: tuple[Any, ...], other: tuple[Any, ...]) -> str:
    """The innermost module that answers one question differently; the plant if none does by itself."""
    asked: list[list[tuple[nn.Module, list[Tensor], list[Tensor]]]] = []
    here = threading.get_ident()

    def note(asked_module: nn.Module, given: object, answer: object) -> None:
        if threading.get_ident() == here:
            asked[-1].append((asked_module, _tensors(given), _tensors(answer)))

    handle = register_module_forward_hook(note)
    try:
        for question in (arguments, other, arguments):
            asked.append([])
            module(*question)
    finally:
        handle.remove()
    for (inner, given, answer), (again, given_again, answer_again) in zip(asked[0], asked[2], strict=False):
        if inner is again and _equal(given, given_again) and not _equal(answer, answer_again):
            paths = [path for path, held in module.named_modules() if held is inner]
            return _called(module, paths[0] if paths else "")
    return _called(module, "")


def _called(module: nn.Module, path: str) -> str:
    """A part of an interval in words; the interval itself is what its plant makes of it."""
    short = path.replace("interval.", "")
    if short in ("", "interval"):
        plant = next((held for name, held in module.named_modules() if name.endswith("plant")), None)
        return f"a method of plant {getattr(plant, 'name', type(module).__name__)!r}"
    return f"{short} ({type(module.get_submodule(path)).__name__})"


def _tensors(values: object) -> list[Tensor]:
    return [x.clone() for x in tree_leaves(values) if isinstance(x, Tensor)]


def _equal(some: list[Tensor], others: list[Tensor]) -> bool:
    return len(some) == len(others) and all(map(_close, some, others))
