"""Fingerprints of modules: equal where the traced programs are equal."""

import copyreg
import hashlib
import io
import pickle
import types
from collections import OrderedDict
from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from rt_torchrl.programs.outer_names import DATA, Name, function_of, own_classes, read_by
from rt_torchrl.programs.watch import BY_ADDRESS, DICTIONARIES, Watch

PLAIN = frozenset({str, int, float, bool, type(None), tuple, list, dict, OrderedDict, bytes, torch.Size})


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
    text, watch = io.BytesIO(), Watch(module)
    pickler = _Pickler(text, watch)
    pickler.dump(module)
    pickler.dump_classes()
    watch.begin()
    return Fingerprint(hashlib.sha256(text.getvalue()).digest(), tuple(pickler.alive), watch)


class _Pickler(pickle.Pickler):
    """Pickles a module with short names for what is large, shared or cannot be pickled."""

    def __init__(self, file: io.BytesIO, watch: Watch):
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self.alive: list[object] = []
        self._watch = watch
        self._parameters: dict[int, int] = {}
        self._classes: dict[type, None] = {}

    def dump_classes(self) -> None:
        """Pickle what the methods of all classes read."""
        kinds = dict.fromkeys(base for each in self._classes for base in own_classes(each))
        attributes = [attribute for kind in kinds for attribute in vars(kind).values()]
        for kind in kinds:
            self._watch.note_class(kind)
        self.dump([*map(self._by_address, attributes), *self._values(read_by(*map(function_of, attributes)))])

    def persistent_id(self, obj: Any) -> Any:
        if isinstance(obj, type):
            self._classes[obj] = None
            return self._by_address(obj)
        self._watch.note(obj)
        if type(obj) in PLAIN:
            return None
        if isinstance(obj, BY_ADDRESS):
            return self._by_address(obj)
        if isinstance(obj, nn.Parameter):  # one that is shared is one input of a program
            number = self._parameters.setdefault(id(obj), len(self._parameters))
            return "parameter", number, tuple(obj.shape), str(obj.dtype), obj.requires_grad
        if isinstance(obj, Tensor):
            content = obj.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
            return "tensor", tuple(obj.shape), str(obj.dtype), obj.requires_grad, hashlib.sha256(content).digest()
        return None

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, nn.Module):  # most of its dictionaries are for hooks, and empty
            self._classes[type(obj)] = None
            held = {k: v for k, v in vars(obj).items() if type(v) not in DICTIONARIES or v}
            return _Known, self._by_address(type(obj)), held
        if isinstance(obj, types.FunctionType):
            own = [_content(cell) for cell in obj.__closure__ or ()], obj.__defaults__, obj.__kwdefaults__
            return _Known, self._by_address(obj.__code__), [*own, vars(obj), *self._values(read_by(obj))]
        try:
            reduce = copyreg.dispatch_table.get(type(obj))
            reduced = reduce(obj) if reduce else obj.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
        except Exception:  # an object may refuse with any error
            return _Known, self._by_address(obj)
        # A text names a global, which may not be there, as in a function.
        return (_Known, self._by_address(obj)) if isinstance(reduced, str) else reduced

    def _values(self, names: Iterable[Name]) -> list[object]:
        """The present values of outer names: data by their content, anything else by its address."""
        found: list[object] = []
        for held, name in names:
            self._watch.note_name(held, name)
            x = held.get(name)
            found.append(x if isinstance(x, DATA) else self._by_address(x)[1])
        return found

    def _by_address(self, obj: object) -> tuple[str, int]:
        self.alive.append(obj)
        return type(obj).__name__, id(obj)


def _content(cell: types.CellType) -> object:
    try:
        return cell.cell_contents
    except ValueError:  # the variable has no value yet
        return None


class _Known(tuple[str, int]):
    """Stands for an object that is known by its address."""
