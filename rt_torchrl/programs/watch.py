"""Watches: whether anything that a fingerprint was made of has changed since, told in a fraction of its time."""

import copyreg
import random
import types
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from functools import partial
from itertools import chain
from operator import attrgetter, is_
from pickle import PickleBuffer
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

GENERATORS = (torch.Generator, np.random.Generator, np.random.RandomState, random.Random)
"""Objects that change whenever they are used, and that no program depends on."""
BY_ADDRESS = (types.BuiltinFunctionType, types.ModuleType, *GENERATORS)
"""Types of objects that a fingerprint knows by their address."""
DICTIONARIES = (dict, OrderedDict)
CONSTANT = frozenset({str, int, float, complex, bool, type(None), bytes, tuple, frozenset, torch.Size, torch.dtype})
"""Types of objects that cannot change; what tuples and sets hold is noted too."""
ALSO_CONSTANT = (*BY_ADDRESS, types.MethodType, torch.device, np.dtype, np.generic, PickleBuffer)
"""The same, with all types that extend them; the buffer of an array is noted with the array."""
USUAL = ("__reduce_ex__", "__reduce__", "__getstate__")
"""Methods by which pickle reads an object."""
Readers = dict[str, Callable[[list[Any]], Iterable[object]]]
IDENTITIES: Readers = {
    "filled": chain.from_iterable,
    "functions": lambda held: chain.from_iterable(map(attrgetter("__code__", "__defaults__", "__kwdefaults__"), held)),
    "cells": partial(map, attrgetter("cell_contents")),
    "classes": partial(map, attrgetter("__mro__")),
    "instances": lambda held: chain(map(type, held), map(vars, held)),
    "names": lambda names: [held.get(name) for held, name in names],
}
"""What must be the same objects, for each kind of things that are noted."""
CONTENTS: Readers = {
    "filled": partial(map, len),
    "tensors": lambda held: chain(map(attrgetter("shape", "dtype", "requires_grad"), held), map(Tensor.stride, held)),
    "memory": partial(map, Tensor.data_ptr),
    "arrays": partial(map, attrgetter("shape", "dtype")),
    "bytes": partial(map, np.ndarray.tobytes),
}
"""What must be equal."""


class Watch:
    """Everything that the fingerprint of a module reads, as it was then.

    Objects are compared by their identity, tensors and arrays also by their content. A watch may find a change that
    leaves the fingerprint as it is, but never the other way round. Of objects that it cannot compare, such as those
    that pickle themselves in a way of their own, it always says that they have changed.

    Args:
        root: the module, of which the watch holds no reference.
    """

    def __init__(self, root: nn.Module):
        self._root, self._own, self._complete = id(root), (type(root), vars(root)), True
        self._seen: dict[int, object] = {}
        self._noted = defaultdict[str, list[Any]](list)

    def note(self, obj: Any) -> None:
        """Note an object that the fingerprint reads."""
        kind = type(obj)
        if kind in CONSTANT or id(obj) in self._seen:
            return
        if id(obj) != self._root:
            self._seen[id(obj)] = obj  # whose address no other object gets as long as this one is held
        if kind in (*DICTIONARIES, list, set):
            self._noted["collections"].append(obj)
        elif isinstance(obj, Tensor):
            self._note_tensor(obj)
        elif kind is np.ndarray and not obj.dtype.hasobject:
            self._noted["arrays"].append(obj)
            self._noted["bytes"].append(obj)
        elif isinstance(obj, types.FunctionType):
            self._noted["functions"].append(obj)
            self._noted["cells"] += obj.__closure__ or ()
        elif isinstance(obj, nn.Module) or _pickled_as_usual(kind):
            self._note_instance(obj)
        elif not isinstance(obj, ALSO_CONSTANT) and (not isinstance(obj, tuple) or hasattr(obj, "__dict__")):
            self._complete = False

    def note_name(self, held: dict[str, Any], name: str) -> None:
        """Note a global variable; its value may be noted too."""
        self._noted["names"].append((held, name))

    def note_class(self, kind: type) -> None:
        """Note the attributes of a class, as its own dictionary has them."""
        self._noted["classes"].append(kind)
        self._noted["collections"].append(vars(kind))

    def _note_tensor(self, x: Tensor) -> None:
        try:
            view = x.detach().numpy()
        except (RuntimeError, TypeError):  # on another device, or in a layout of its own
            self._complete = False
            return
        self._noted["tensors"].append(x)
        self._noted["memory"].append(x)
        if not isinstance(x, nn.Parameter):
            self._noted["bytes"].append(view)

    def _note_instance(self, obj: object) -> None:
        held = getattr(obj, "__dict__", None)
        if held is None:
            return
        if id(obj) != self._root:
            self._noted["instances"].append(obj)
        self._noted["collections"].append(held)
        for x in held.values():  # also those that are empty, which no fingerprint reads
            if type(x) in DICTIONARIES:
                self.note(x)

    def begin(self) -> None:
        """Remember everything as it is now."""
        collections = self._noted.pop("collections")
        self._empty = [held for held in collections if not held]  # such as those for hooks
        filled = [held for held in collections if held]
        self._noted["filled"] = [*filled, *(held.values() for held in filled if not isinstance(held, (list, set)))]
        try:
            self._objects = np.fromiter(self._read(IDENTITIES), object)  # which keeps their addresses for them
            self._then = self._objects.tobytes(), [*self._read(CONTENTS)]
        except ValueError:  # a variable of a function has no value yet
            self._complete = False

    def holds(self, root: nn.Module) -> bool:
        """Whether everything is as it was."""
        if not self._complete or any(self._empty) or not same((type(root), vars(root)), self._own):
            return False
        addresses, contents = self._then
        try:
            found = np.fromiter(self._read(IDENTITIES), object)
            return found.tobytes() == addresses and [*self._read(CONTENTS)] == contents
        except ValueError:  # a variable of a function has lost its value
            return False

    def _read(self, readers: Readers) -> Iterator[object]:
        return chain.from_iterable(read(self._noted[kind]) for kind, read in readers.items())


def same(objects: Collection[object], others: Collection[object]) -> bool:
    """Whether two collections hold the same objects in the same order."""
    return len(objects) == len(others) and all(map(is_, objects, others))


def _pickled_as_usual(kind: type) -> bool:
    """Whether pickle reads the dictionary of an instance, and nothing else."""
    return (
        all(getattr(kind, name, None) is getattr(object, name, None) for name in USUAL)
        and not any(hasattr(kind, name) for name in ("__getnewargs__", "__getnewargs_ex__"))
        and not any(vars(each).get("__slots__") for each in kind.__mro__)
        and not issubclass(kind, (list, dict))
        and kind not in copyreg.dispatch_table
    )
