"""Fingerprints of modules: equal where the traced programs are equal."""

import copyreg
import hashlib
import pickle
import random
import types
from collections import OrderedDict
from collections.abc import Iterator
from itertools import chain, islice
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from rt_torchrl.programs.outer_names import DATA, Name, foreign, function_of, read_by
from rt_torchrl.programs.watch import Watch

VALUES = frozenset({str, int, float, complex, bool, type(None), bytes, torch.Size, torch.dtype, torch.device})
"""Types of objects that their text describes."""
GENERATORS = (torch.Generator, np.random.Generator, np.random.RandomState, random.Random)
"""Objects that change whenever they are used, and that no program depends on."""
BY_ADDRESS = (types.BuiltinFunctionType, types.CodeType, types.ModuleType, *GENERATORS)
"""Types of objects that a fingerprint knows by their address."""
ATTRIBUTES = {
    types.FunctionType: ("__code__", "__defaults__", "__kwdefaults__", "__closure__", "__dict__"),
    types.CellType: ("cell_contents",),
}
"""Attributes that are all there is to objects of a type, apart from the globals that functions read."""
CONSTANT = (types.MethodType, np.dtype, np.generic)
"""Types of objects that pickle reads in a way of their own, and that cannot change."""
PLAIN = object().__reduce_ex__(pickle.HIGHEST_PROTOCOL)[0]
"""The function by which pickle makes objects that are nothing but their attributes."""


class Fingerprint(NamedTuple):
    """A digest of everything in a module but the values of its parameters, which a program takes when it runs.

    Args:
        digest: the digest.
        alive: objects that the digest knows by their address; whoever keeps the digest keeps them alive.
        watch: tells whether the module still has this fingerprint.
    """

    digest: bytes
    alive: tuple[object, ...]
    watch: Watch


def fingerprint(module: nn.Module) -> Fingerprint:
    """The fingerprint of a module as it is now.

    Constants and buffers become a part of a program, and so do the global variables that the code of the module reads.
    A module with another constant has another fingerprint, so that it is traced anew.
    """
    reader = Reader(module)
    text = repr(reader.text()).encode(errors="surrogatepass")
    reader.watch.begin()
    return Fingerprint(hashlib.sha256(text).digest(), tuple(reader.alive), reader.watch)


class Reader:
    """Reads a module and everything that it holds, as pickle does, and notes it in a watch."""

    def __init__(self, root: nn.Module):
        self.watch, self.alive = Watch(root), list[object]()
        self.met = list[Any]([root])
        """The module and all objects that it holds, which are read by their values."""
        self.names, self.functions = list[Name](), set[types.FunctionType]()
        """The globals that code of the module may read, and the functions among this code."""
        self._root, self._numbers = root, {id(root): 0}  # an object is read once
        self._functions: list[object] = []  # of classes and modules, which read globals

    def text(self) -> list[list[object]]:
        """What tells the module from others."""
        found = [self._read(obj) for obj in self.met]  # which grows meanwhile
        count = len(found)
        self.names, self.functions = read_by(*self._functions)
        for held, name in self.names:
            self.watch.note_attributes(held, name)
            x = held.get(name)
            found.append([self._mention(x)] if isinstance(x, DATA) else self._address(x))
        return [*found, *map(self._read, islice(self.met, count, None))]

    def _mention(self, obj: object) -> object:
        """A value by its text, and any other object by its number, under which it is read later."""
        if type(obj) in VALUES:
            return repr(obj)
        if id(obj) not in self._numbers:
            self._numbers[id(obj)] = len(self.met)
            self.met.append(obj)
        return self._numbers[id(obj)]

    def _address(self, obj: object) -> list[object]:
        self.alive.append(obj)
        return [type(obj).__name__, id(obj)]

    def _read(self, obj: Any) -> list[object]:
        """What tells an object from others."""
        if type(obj) in VALUES:
            return [repr(obj)]
        if isinstance(obj, BY_ADDRESS):
            return self._address(obj)
        if isinstance(obj, type):
            return self._of_class(obj)
        if isinstance(obj, Tensor):
            return self._of_tensor(obj)
        if type(obj) is np.ndarray and not obj.dtype.hasobject:
            self.watch.note_attributes(obj, "dtype")
            self.watch.note_value(obj, np.shape)
            self.watch.note_numbers(obj)
            return [obj.shape, str(obj.dtype), _digest(obj)]
        return self._of_parts(obj)

    def _of_tensor(self, x: Tensor) -> list[object]:
        found = [type(x).__name__, tuple(x.shape), str(x.dtype), x.requires_grad]
        self.watch.note_tensor(x, constant=not isinstance(x, nn.Parameter))
        if not isinstance(x, nn.Parameter):
            found.append(_digest(x.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy()))
        return found

    def _of_parts(self, obj: Any) -> list[object]:
        kind = type(obj)
        if kind in (dict, OrderedDict, list, set):
            self.watch.note_collection(obj)
        if kind in (dict, OrderedDict):
            return [kind.__name__, *map(self._mention, chain(obj, obj.values()))]
        if kind in (list, set, frozenset) or (isinstance(obj, tuple) and not hasattr(obj, "__dict__")):
            return [self._mention(kind), *map(self._mention, obj)]
        if kind is types.CellType and obj == types.CellType():  # a variable that has no value yet, and may get one
            self.watch.complete = False
            return []
        if kind in ATTRIBUTES:
            self._functions += [obj] if kind is types.FunctionType else []
            self.watch.note_attributes(obj, *ATTRIBUTES[kind])
            return [kind.__name__, *(self._mention(getattr(obj, name)) for name in ATTRIBUTES[kind])]
        return self._of_instance(obj)

    def _of_class(self, kind: type) -> list[object]:
        """A class by its address, and what it says itself."""
        if foreign(kind.__module__):
            return self._address(kind)
        self.watch.note_attributes(kind, "__mro__")
        self.watch.note_collection(vars(kind).values())
        self._functions += map(function_of, vars(kind).values())
        mentioned = map(self._mention, kind.__mro__[1:])
        return [*self._address(kind), *map(self._address, vars(kind).values()), *mentioned]

    def _of_instance(self, obj: Any) -> list[object]:
        """An object by its attributes and by the parts that pickle takes; by its address if it has neither."""
        kind, held = type(obj), getattr(obj, "__dict__", None)
        if obj is not self._root and held is not None:
            self.watch.note_attributes(obj, "__class__", "__dict__")
        if isinstance(obj, nn.Module):
            return [*map(self._mention, (kind, held))]
        slots = (
            [] if foreign(kind.__module__) else [x for base in kind.__mro__ for x in vars(base).get("__slots__", ())]
        )
        own = [held, [getattr(obj, x, None) for x in slots]] if not foreign(kind.__module__) else []
        try:
            reduced = copyreg.dispatch_table.get(kind, _reduced)(obj)
        except Exception:  # an object may refuse with any error
            self.watch.complete &= not slots
            return [*self._address(obj), *map(self._mention, own)]
        if isinstance(reduced, str):  # the name of a global, which may not be there, as in a function
            return [*self._address(obj), *map(self._mention, own)]
        made, given, state, *elements = (*reduced, None, None)[:5]
        plain = made is PLAIN and given == (kind,) and state is (held or None) and elements == [None, None]
        self.watch.complete &= plain or isinstance(obj, CONSTANT)
        parts = (list(part) if isinstance(part, Iterator) else part for part in (*reduced, *([] if plain else own)))
        return [*map(self._mention, parts)]


def _reduced(obj: Any) -> Any:
    return obj.__reduce_ex__(pickle.HIGHEST_PROTOCOL)


def _digest(numbers: np.ndarray) -> bytes:
    return hashlib.sha256(numbers.tobytes()).digest()
