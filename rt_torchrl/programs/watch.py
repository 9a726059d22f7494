"""Watches: whether anything that a fingerprint was made of has changed since, told in a fraction of its time."""

import copyreg
import random
import types
from collections import OrderedDict
from collections.abc import Collection
from itertools import chain
from operator import attrgetter, is_, methodcaller
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

_values = methodcaller("values")
_function = attrgetter("__code__", "__defaults__", "__kwdefaults__")
_mro = attrgetter("__mro__")
_content = attrgetter("cell_contents")
_of_tensor = attrgetter("shape", "dtype", "requires_grad")
_of_array = attrgetter("shape", "dtype")


class Watch:
    """Everything that the fingerprint of a module reads, as it was then.

    Objects are compared by their identity, tensors and arrays also by their content. A watch may find a change that
    leaves the fingerprint as it is, but never the other way round. Of objects that it cannot compare, such as those
    that pickle themselves in a way of their own, it always says that they have changed.

    Args:
        root: the module, of which the watch holds no reference.
    """

    def __init__(self, root: nn.Module):
        self._root, self._kind, self._complete = id(root), type(root), True
        self._seen: dict[int, object] = {}
        self._names: list[tuple[dict[str, Any], str]] = []
        self._collections: list[Any] = []
        self._classes: list[type] = []
        self._instances: list[object] = []
        self._functions: list[types.FunctionType] = []
        self._cells: list[types.CellType] = []
        self._tensors: list[Tensor] = []
        self._arrays: list[np.ndarray] = []
        self._views: list[np.ndarray] = []

    def note(self, obj: Any) -> None:
        """Note an object that the fingerprint reads."""
        kind = type(obj)
        if kind in CONSTANT or id(obj) in self._seen:
            return
        if id(obj) != self._root:
            self._seen[id(obj)] = obj  # whose address no other object gets as long as this one is held
        if kind in (*DICTIONARIES, list, set):
            self._collections.append(obj)
        elif isinstance(obj, Tensor):
            self._note_tensor(obj)
        elif kind is np.ndarray and not obj.dtype.hasobject:
            self._arrays.append(obj)
        elif isinstance(obj, types.FunctionType):
            self._functions.append(obj)
            self._cells += obj.__closure__ or ()
        elif isinstance(obj, nn.Module) or _pickled_as_usual(kind):
            self._note_instance(obj)
        elif not isinstance(obj, ALSO_CONSTANT) and (not isinstance(obj, tuple) or hasattr(obj, "__dict__")):
            self._complete = False

    def note_name(self, held: dict[str, Any], name: str) -> None:
        """Note a global variable; its value may be noted too."""
        self._names.append((held, name))

    def note_class(self, kind: type) -> None:
        """Note the attributes of a class, as its own dictionary has them."""
        self._classes.append(kind)
        self._collections.append(vars(kind))

    def _note_tensor(self, x: Tensor) -> None:
        self._tensors.append(x)
        try:
            view = x.detach().numpy()
        except (RuntimeError, TypeError):  # on another device, or in a layout of its own
            self._complete = False
            return
        if not isinstance(x, nn.Parameter):
            self._views.append(view)

    def _note_instance(self, obj: object) -> None:
        if id(obj) != self._root:
            self._instances.append(obj)
        held = getattr(obj, "__dict__", {})
        self._collections.append(held)
        for x in held.values():  # also those that are empty, which no fingerprint reads
            if type(x) in DICTIONARIES:
                self.note(x)

    def begin(self) -> None:
        """Remember everything as it is now."""
        self._empty = [held for held in self._collections if not held]  # such as those for hooks
        self._filled = [held for held in self._collections if held]
        self._mappings = [held for held in self._filled if not isinstance(held, (list, set))]
        try:
            self._then = self._objects(), self._contents()
        except ValueError:  # a variable of a function has no value yet
            self._complete = False

    def holds(self, root: nn.Module) -> bool:
        """Whether everything is as it was."""
        if not self._complete or type(root) is not self._kind or any(self._empty):
            return False
        identities, contents = self._then
        try:
            objects = self._objects()
        except ValueError:  # a variable of a function has lost its value
            return False
        return same(objects, identities) and self._contents() == contents

    def _objects(self) -> list[object]:
        """What must be the same objects."""
        return [
            *chain.from_iterable(self._filled),
            *chain.from_iterable(map(_values, self._mappings)),
            *chain.from_iterable(map(_function, self._functions)),
            *map(_content, self._cells),
            *map(_mro, self._classes),
            *map(type, self._instances),
            *(held.get(name) for held, name in self._names),
        ]

    def _contents(self) -> list[object]:
        """What must be equal."""
        return [
            *map(len, self._filled),
            *map(_of_tensor, self._tensors),
            *map(Tensor.data_ptr, self._tensors),
            *map(Tensor.stride, self._tensors),
            *map(np.ndarray.tobytes, self._views),
            *map(_of_array, self._arrays),
            *map(np.ndarray.tobytes, self._arrays),
        ]


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
