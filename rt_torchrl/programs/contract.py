"""The contract of traced code: what it may read, how a change of that is seen, and that it is a function.

Machine code takes parameters and buffers in double precision as inputs, whose numbers are therefore never stale.
Whatever else code reads becomes a constant of it:

- what a module holds, in attributes and in the lists, dictionaries, objects and tensors there: :class:`Holdings` has it
  by value, so that a change gives other code;
- constants elsewhere, such as numbers, texts, tuples of these, functions and classes, which can only be replaced:
  :func:`outside_of` notices that;
- what may change in its place elsewhere, such as a dictionary at the top of a module: it is refused by its name.
"""

import argparse
import array
import collections
import contextvars
import dataclasses
import dis
import enum
import gc
import hashlib
import inspect
import operator
import os
import random
import sys
import threading
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableSequence, MutableSet
from contextlib import contextmanager
from functools import lru_cache, partial
from itertools import chain
from operator import getitem, is_, methodcaller
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
REPLACED = (type, enum.Enum, types.ModuleType, types.FunctionType, staticmethod, classmethod, property)
"""Types of objects that hold nothing, or what is judged by itself."""
WRAPPERS = (
    *(types.FunctionType, types.MethodType, staticmethod, classmethod, property),
    *(partial, type(lru_cache(max))),
)
"""Types of functions and of what holds one."""
MAPPINGS, SEQUENCES = (dict, types.MappingProxyType), (list, set, collections.deque, bytearray, array.array)
PARTS = {
    types.FunctionType: ("__code__", "__defaults__", "__kwdefaults__", "__closure__"),
    types.MethodType: ("__func__", "__self__"),
    partial: ("func", "args", "keywords"),
    types.CellType: ("cell_contents",),
}
"""Attributes that hold what an object is made of."""
FACTORIES = {"abc", "types"}
"""Modules that classes name as theirs which are made by a call, whoever calls."""
LIBRARIES = {"torch", "tensordict", "torchrl", "numpy", "scipy", "sympy", "opt_einsum", "jaxtyping", "beartype"}
FOREIGN = (sys.stdlib_module_names - FACTORIES) | LIBRARIES
"""Packages whose globals do not change."""
THIS_PACKAGE = __name__.partition(".")[0]
GENERATED = "<@beartype"
"""Files of code that checks annotations at run time."""
ATTRIBUTES = ("LOAD_ATTR", "LOAD_METHOD", "LOAD_SUPER_ATTR")
ENVIRONMENT = ("environ", "environb", "getenv", "getenvb")
MISSING = object()


def foreign(module: str | None) -> bool:
    """Whether a module belongs to a package whose globals do not change; those of this library's plants may."""
    package, _, rest = (module or "").partition(".")
    return module is None or package in FOREIGN or (package == THIS_PACKAGE and not rest.startswith("envs"))


def inputs_of(module: nn.Module) -> dict[str, Tensor]:
    """The tensors that machine code takes as inputs, by name: parameters, then buffers in double precision."""
    buffers = {name: x for name, x in module.named_buffers() if x.dtype == torch.float64 and x.layout is torch.strided}
    return dict(module.named_parameters()) | buffers


class Compared:
    """What is compared with what it was: objects by identity, numbers of tensors and arrays by value."""

    def __init__(self) -> None:
        self.mappings, self.sequences, self.instances = list[Any](), list[Any](), list[Any]()
        self.readers = list[Callable[[], object]]()
        """Functions that give an object, such as an attribute."""
        self.classes = list[Mapping[str, Any]]()
        """Attributes of classes, of which none may come or go."""
        self.tensors, self.constants = list[Tensor](), list[Any]()
        """Tensors in their memory, and tensors and arrays with their numbers."""
        self.note()

    def note(self) -> None:
        """Let everything be as it is now."""
        self._views = [x.detach() for x in self.tensors]
        self._then, self._numbers_then = [*self._objects()], self._numbers()

    def _objects(self) -> Iterator[object]:
        """All objects; as long as a list of them lives, no other object takes their addresses."""
        containers = chain(self.mappings, map(_values, self.mappings), self.sequences)
        kinds, dicts = map(type, self.instances), map(vars, self.instances)
        return chain(chain.from_iterable(containers), kinds, dicts, map(methodcaller("__call__"), self.readers))

    def _numbers(self) -> list[object]:
        sizes = map(len, chain(self.mappings, self.sequences, self.classes))
        return [*sizes, *(x.requires_grad for x in self.tensors), *map(_bytes, self.constants)]

    def same(self) -> bool:
        """Whether everything is as it was."""
        try:
            return (
                self._numbers() == self._numbers_then
                and all(map(Tensor.is_set_to, self.tensors, self._views))
                and all(map(is_, self._objects(), self._then))
            )
        except (AttributeError, KeyError, ValueError, RuntimeError):  # a value is lost, or a tensor's type is another
            return False


class Holdings(Compared):
    """What a module and everything in its attributes hold, by value.

    ``digest`` is equal where one machine code serves. :meth:`unchanged` compares all objects with those of before by
    identity, which takes a fraction of the time of a digest: a change is followed from the next call on.

    Args:
        root: the module, of which no reference is kept.
    """

    def __init__(self, root: nn.Module):
        super().__init__()
        self.objects: list[Any] = [root]
        """Everything that is read by its value; the root itself is left out in the end."""
        self.alive: list[object] = []
        """Objects that the digest knows by their address; whoever keeps the digest keeps them alive."""
        self._of_root, self._complete, self._empty = (type(root), vars(root)), True, list[Any]()
        self._numbered, self._inputs = {id(root): 0}, {*map(id, inputs_of(root).values())}
        text = repr([self._read(obj) for obj in self.objects])  # which grow meanwhile
        self.digest = hashlib.sha256(text.encode(errors="surrogatepass")).digest()
        self.objects[0] = None
        self.note()

    def _mention(self, x: Any) -> object:
        """A value by its text, and any other object by its number, under which it is read."""
        kind = type(x)
        if kind in VALUES or isinstance(x, np.generic):
            return repr(x)
        if kind in (dict, collections.OrderedDict, list, set) and not x:  # of which every module has ten, for hooks
            self._empty.append(x)
            return kind.__name__
        if id(x) not in self._numbered:
            self._numbered[id(x)] = len(self.objects)
            self.objects.append(x)
        return self._numbered[id(x)]

    def _address(self, x: object) -> list[object]:
        self.alive.append(x)
        return [type(x).__name__, id(x)]

    def _read(self, x: Any) -> list[object]:
        """What tells an object from others."""
        if isinstance(x, IDENTICAL):
            return self._address(x)
        if isinstance(x, Tensor) or (isinstance(x, np.ndarray) and not x.dtype.hasobject):
            return self._read_numbers(x)
        if isinstance(x, np.ndarray):
            self._complete = False
            contents = x.flatten().tolist()
        elif isinstance(x, contextvars.ContextVar):
            self._complete = False
            contents = [x.get(None)]
        elif isinstance(x, MAPPINGS):
            self.mappings.append(x)
            contents = [*x, *x.values()]
        else:
            self.sequences += [x] if isinstance(x, SEQUENCES) else []
            contents = [*x] if isinstance(x, (*SEQUENCES, tuple, frozenset)) else []
        for name in _parts_of(x):
            try:
                contents.append(getattr(x, name))
                self.readers.append(partial(getattr, x, name))
            except (AttributeError, ValueError):  # a slot or a variable without a value, which may get one
                self._complete = False
        if hasattr(x, "__dict__"):
            self.instances += [x] if self._numbered[id(x)] else []  # all but the root
            self.mappings.append(vars(x))
            contents += [*vars(x), *vars(x).values()]
        elif not contents and not isinstance(x, (*MAPPINGS, *SEQUENCES, tuple, frozenset)):
            return self._address(x)
        return [self._mention(type(x)), *map(self._mention, contents)]

    def _read_numbers(self, x: Any) -> list[object]:
        """Type and shape of a tensor or an array, and its numbers unless they are an input."""
        description: list[object] = [type(x).__name__, tuple(x.shape), str(x.dtype)]
        if isinstance(x, Tensor):
            description.append(x.requires_grad)
            if x.layout is not torch.strided or x.device.type != "cpu":
                self._complete = False
                return [*description, *self._address(x)]
            self.tensors.append(x)
            if id(x) in self._inputs:
                return description
        self.constants.append(x)
        return [*description, hashlib.sha256(_bytes(x)).digest()]

    def unchanged(self, root: nn.Module) -> bool:
        """Whether everything is as it was; a change that leaves the digest as it is may count as one."""
        kind, contents = self._of_root
        return self._complete and not any(self._empty) and type(root) is kind and vars(root) is contents and self.same()


_values = methodcaller("values")


def _parts_of(x: object) -> list[str]:
    """Names of the attributes of an object that are not in its dictionary."""
    names = [name for kind, names in PARTS.items() if isinstance(x, kind) for name in names]
    for kind in type(x).__mro__:
        if not foreign(kind.__module__):
            names += [name for name, slot in vars(kind).items() if isinstance(slot, types.MemberDescriptorType)]
    return names


def _bytes(x: Any) -> bytes:
    """The numbers of a tensor or an array, and the shape of an array."""
    if isinstance(x, Tensor):
        return x.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
    return repr((x.shape, x.dtype)).encode() + x.tobytes()


class Executed:
    """The functions of a user that are executed within :meth:`noted`."""

    def __init__(self) -> None:
        self.globals: dict[tuple[types.CodeType, int], dict[str, Any]] = {}
        self.variables: dict[types.CodeType, dict[str, Any]] = {}
        """Variables of enclosing functions that code has read."""

    @contextmanager
    def noted(self) -> Iterator[None]:
        """A context in which functions are noted."""
        before, collects = sys.getprofile(), gc.isenabled()
        gc.disable()  # other libraries, such as JAX, call functions of theirs in each collection
        sys.setprofile(self._note)
        try:
            yield
        finally:
            sys.setprofile(before if callable(before) else None)
            if before is not None and not callable(before):  # the profiler of Python before version 3.12
                before.enable()
            if collects:
                gc.enable()

    def _note(self, frame: types.FrameType, event: str, argument: object) -> None:
        code, namespace = frame.f_code, frame.f_globals
        if event == "call" and (code, id(namespace)) not in self.globals and not _of_library(code, namespace):
            self.globals[code, id(namespace)] = namespace
            if code.co_freevars:
                self.variables[code] = {x: frame.f_locals[x] for x in code.co_freevars if x in frame.f_locals}


def _of_library(code: types.CodeType, namespace: dict[str, Any]) -> bool:
    name = namespace.get("__name__")
    generated = name in FACTORIES or code.co_filename.startswith(GENERATED) or str(name).startswith("namedtuple_")
    return foreign(name) or generated


def outside_of(root: nn.Module, holdings: Holdings, executed: Executed) -> Compared:
    """The constants that executed functions of a module read outside of it, and the methods of its classes.

    Raises:
        UntraceableError: if a function reads what may change without notice; the message names both.
    """
    return _Reads((root, *holdings.objects), executed).outside


class _Reads:
    """What executed functions read outside of a module, whose objects are given."""

    def __init__(self, objects: Iterable[object], executed: Executed):
        self.outside, self._kinds = Compared(), set[type]()
        self._held = {*map(id, objects)}  # whose changes the holdings notice
        self._functions: dict[types.CodeType, list[types.FunctionType]] = collections.defaultdict(list)
        self._codes, self._judged = {code for code, _ in executed.globals}, set[tuple[int, str]]()
        for x in objects:
            self._note_function(x)
            for kind in (x if isinstance(x, type) else type(x)).__mro__:
                if not foreign(kind.__module__) and self._is_new(kind):
                    for value in vars(kind).values():
                        self._note_function(value)
        for (code, _), namespace in executed.globals.items():
            self._globals(code, namespace)
        named = {name: code for code in self._codes for name in _names(code).attributes}
        for x in objects:
            self._class_attributes(x, named)
        for code in self._codes:
            self._variables(code, executed.variables.get(code, {}))
        self.outside.note()

    def _is_new(self, kind: type) -> bool:
        """Whether a class is a new one, whose bases and methods are to stay the same from now on."""
        if kind in self._kinds:
            return False
        self._kinds.add(kind)
        attributes, outside = vars(kind), self.outside
        outside.classes.append(attributes)
        methods = (name for name, value in attributes.items() if isinstance(value, WRAPPERS))
        outside.readers += [partial(getattr, kind, "__mro__"), *(partial(getitem, attributes, x) for x in methods)]
        return True

    def _globals(self, code: types.CodeType, namespace: dict[str, Any]) -> None:
        names = _names(code)
        for module in names.imports:  # nothing notices what this module holds
            if not foreign(module):
                raise UntraceableError(
                    f"{_where(code)} imports {module!r} inside, whose values may change unnoticed; import it at the "
                    "top of the file"
                )
        for name in names.globals & namespace.keys():
            self._take(code, namespace, name, "the global ")

    def _take(self, code: types.CodeType, holder: Any, name: str, prefix: str) -> None:
        """Judge what code reads from a dictionary of globals, a class or a function, and its attributes."""
        namespace, attributes = holder if isinstance(holder, dict) else vars(holder), _names(code).attributes
        value = namespace[name]
        if value is os.environ or value is os.getenv or (value is os and attributes & {*ENVIRONMENT}):
            raise _refusal(code, "the environment (os.environ)")
        if isinstance(value, types.ModuleType) and foreign(value.__name__):
            return  # such as torch
        followed = isinstance(value, (Tensor, np.ndarray)) and isinstance(holder, dict)  # by its numbers
        if not followed and not self._constant(value):
            raise _refusal(code, f"{prefix}{name}", value)
        judged = (id(holder), name) in self._judged
        if not judged:
            self._judged.add((id(holder), name))
            self._note_function(value)
            if isinstance(holder, type):
                self._is_new(holder)
            self.outside.readers.append(partial(getitem, namespace, name))
            self.outside.constants += [value] if followed else []
        inner = name if prefix == "the global " else f"{prefix}{name}"
        for further in _holders(value):
            for attribute in attributes & vars(further).keys():
                if not (judged and (id(further), attribute) in self._judged):
                    self._take(code, further, attribute, f"{inner}.")

    def _class_attributes(self, x: object, named: dict[str, types.CodeType]) -> None:
        """Judge what the class of an object holds under names of attributes that executed code reads."""
        kind, attributes = (x, {}) if isinstance(x, type) else (type(x), getattr(x, "__dict__", {}))
        for name in () if foreign(kind.__module__) else named.keys() - attributes.keys():
            owner = next((k for k in kind.__mro__ if name in vars(k)), object)
            if not foreign(owner.__module__) and (id(owner), name) not in self._judged:
                self._take(named[name], owner, name, f"the class attribute {owner.__name__}.")

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
        for name in variables.keys() - {"__class__"}:  # which is of super()
            if not functions or not self._constant(variables[name]):
                raise _refusal(code, f"the variable {name} of the function around it", variables[name])
            cells = ((f.__closure__ or ())[code.co_freevars.index(name)] for f in functions)
            self.outside.readers += [partial(getattr, cell, "cell_contents") for cell in cells]

    def _note_function(self, x: object) -> None:
        """Note a function, those that it wraps, and those in variables around it."""
        if not isinstance(x, WRAPPERS):
            return
        if isinstance(x, types.FunctionType):
            if foreign(x.__globals__.get("__name__")) or x in self._functions[x.__code__]:
                return
            self._functions[x.__code__].append(x)
            for cell in x.__closure__ or ():
                self._note_function(cell.cell_contents if cell != types.CellType() else None)
        for name in ("fget", "func", "__func__", "__wrapped__"):
            self._note_function(getattr(x, name, None))

    def _constant(self, value: object) -> bool:
        """Whether a value can only be replaced; functions count, because what they read is judged itself."""
        kind = type(value)
        if isinstance(value, REPLACED):
            return True
        if isinstance(value, (tuple, frozenset)):
            return all(map(self._constant, (*value, *getattr(value, "__dict__", {}).values())))
        if isinstance(value, types.MethodType):
            return self._constant(value.__self__)
        if isinstance(value, partial):
            return all(map(self._constant, (value.func, *value.args, *value.keywords.values())))
        if isinstance(value, CHANGING):
            return False
        if foreign(kind.__module__):
            return True
        if dataclasses.is_dataclass(kind) and getattr(getattr(kind, "__dataclass_params__", None), "frozen", False):
            return all(self._constant(getattr(value, field.name)) for field in dataclasses.fields(kind))
        return inspect.isdatadescriptor(value) or (inspect.ismethoddescriptor(value) and not hasattr(value, "__dict__"))


class _Names(NamedTuple):
    """What a code reads by name."""

    globals: frozenset[str]
    attributes: frozenset[str]
    imports: frozenset[str]


@lru_cache(maxsize=2**14)
def _names(code: types.CodeType) -> _Names:
    """Names of the globals, the attributes and the modules that code itself reads."""
    by_opcode = collections.defaultdict[str, set[str]](set)
    for instruction in dis.get_instructions(code):
        by_opcode[instruction.opname].add(instruction.argval)
    names = by_opcode["LOAD_GLOBAL"] | by_opcode["LOAD_NAME"]
    texts = {x for x in code.co_consts if isinstance(x, str)} if "getattr" in names else set()
    attributes = texts.union(*(by_opcode[kind] for kind in ATTRIBUTES))
    return _Names(frozenset(names), frozenset(attributes), frozenset(by_opcode["IMPORT_NAME"]))


def _holders(value: object) -> Iterator[Any]:
    """Where attributes of a value are found that nothing else notices."""
    for x in (value, *(value if isinstance(value, type) else type(value)).__mro__):
        if isinstance(x, (type, types.ModuleType, types.FunctionType)):
            module = x.__name__ if isinstance(x, types.ModuleType) else x.__module__
            if not foreign(module):
                yield x


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
    "Policy, closure and plant must be pure functions that change none of their arguments: call .eval() on a module "
    "with dropout or batch normalisation; what is to be remembered must be a state of the plant, or part of the "
    "observation; random numbers belong in draw_exogenous"
)


class ImpureError(ValueError):
    """A policy, a closure or a plant is no function of its arguments; the message names it and says what to do."""


def require_pure(module: nn.Module, *arguments: Any) -> None:
    """Refuse a module that gives two answers to one question, or mixes realisations.

    Args:
        module: the module, such as a control interval.
        arguments: tensors, and tuples of tensors, for several realisations, no two of which are equal.

    Raises:
        ImpureError: if a second answer or buffer is another one, although none but other questions were asked in
            between; or if the answer for a realisation depends on the others.
    """
    answers = _answers(module, arguments)
    module(*tree_map(lambda x: x[-1:].expand_as(x).clone(), arguments))
    again = _answers(module, arguments)
    # Parts are asked only of a module that gives something else: theirs may be tensors of a transform that has ended.
    pairs = [] if _equal(answers[-1][2], again[-1][2]) else zip(answers, again, strict=False)
    for (part, asked, answer), (_, asked_again, other) in pairs:
        if (part is module or _equal(asked, asked_again)) and not _equal(answer, other):
            raise ImpureError(
                f"{_called(module, part)} gives something else when it is called again with the same arguments. {PURE}."
            )
    first = answers[-1][2][0]  # of the module itself
    for row in (slice(-1, None), slice(1)):  # a loop may run until one of both has converged
        try:
            alone = module(*tree_map(operator.itemgetter(row), arguments)).detach()
        except Exception as error:
            raise ImpureError(
                f"one realisation alone raises {type(error).__name__}: {str(error).rstrip('.')}; {len(first)} at once "
                "do not. Policy, closure and plant must take any number of rows."
            ) from error
        if not _equal([alone], [first[row]]):
            raise ImpureError(
                "the result for a realisation depends on the other realisations that are computed with it: it is "
                f"{alone[0].tolist()} alone and {first[row][0].tolist()} beside others. Rows are systems of their own: "
                "no sum, mean, norm or branch over a leading dimension in policy, closure or plant."
            )


def _answers(module: nn.Module, arguments: tuple[Any, ...]) -> list[tuple[nn.Module, list[Tensor], list[Tensor]]]:
    """A module and those within it, the inner ones first: what they were asked, their answers and their buffers."""
    answers, here = list[tuple[nn.Module, list[Tensor], list[Tensor]]](), threading.get_ident()

    def note(part: nn.Module, asked: object, answer: object) -> None:
        if threading.get_ident() == here:
            answers.append((part, _copies(asked), _copies((answer, list(part.buffers(recurse=part is module))))))

    handle = register_module_forward_hook(note)
    try:
        module(*arguments)
    finally:
        handle.remove()
    return answers


def _copies(values: object) -> list[Tensor]:
    tensors = (x for x in tree_leaves(values) if isinstance(x, Tensor) and x.layout is torch.strided)
    return [x.detach().double().clone() for x in tensors]


def _equal(some: list[Tensor], others: list[Tensor]) -> bool:
    """Whether answers are equal but for rounding, wherever both are numbers."""

    def close(x: Tensor, y: Tensor) -> bool:
        numbers = x.isfinite() & y.isfinite()
        gap = torch.where(numbers, (x - y).abs(), 0.0)
        return bool((gap <= GAP * torch.where(numbers, x.abs() + y.abs(), 0.0).amax(0)).all())

    return [x.shape for x in some] == [y.shape for y in others] and all(map(close, some, others))


def _called(module: nn.Module, part: nn.Module) -> str:
    """A part of an interval in words; the interval itself is what its plant makes of it."""
    path = next((path.replace("interval.", "") for path, submodule in module.named_modules() if submodule is part), "")
    if path in ("", "interval"):
        plant = next((submodule for name, submodule in module.named_modules() if name.endswith("plant")), None)
        return f"a method of plant {getattr(plant, 'name', type(module).__name__)!r}"
    return f"{path} ({type(part).__name__})"
