"""Watches: whether anything that a fingerprint was made of has changed since, told in a fraction of its time."""

import types
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor, nn

Reading = tuple[Callable[[Any], object], object]
"""A function with what it reads."""


class Guard(NamedTuple):
    """A constant outside of a module: where it is read, under which name, and what it was."""

    holder: Any
    name: str
    value: object

    def now(self) -> object:
        """What is there now."""
        if isinstance(self.holder, types.CellType):
            return self.holder.cell_contents
        return attributes_of(self.holder).get(self.name)

    def holds(self) -> bool:
        """Whether it is still the same object."""
        return self.now() is self.value


def attributes_of(holder: Any) -> Mapping[str, Any]:
    """Attributes by name; those of a dictionary of globals are its entries."""
    return holder if isinstance(holder, dict) else vars(holder)


class Watch:
    """What the fingerprint of a module was made of, as it was then.

    Objects are compared by their identity, tensors and arrays also by their content. A watch may find a change that
    leaves the fingerprint as it is, but never the other way round.

    Args:
        root: the module, of which the watch holds no reference.
    """

    def __init__(self, root: nn.Module):
        self.complete = True
        """False if there is an object that cannot be compared, which then always counts as changed."""
        self._own = type(root), vars(root)
        self._empty: list[Any] = []
        self._filled: list[Any] = []
        self._named: dict[Callable[..., object], dict[tuple[int, str], Any]] = {getattr: {}, dict.get: {}}
        self._values: list[Reading] = []
        self._guards: list[Sequence[Guard]] = []

    def note_collection(self, held: Any) -> None:
        """Note a collection: what it holds must be the same objects; a new one needs a note of its own."""
        if held:
            self._filled += [held, held.values()] if isinstance(held, dict) else [held]
        else:  # such as those for hooks, of which every module has ten
            self._empty.append(held)

    def note_attributes(self, holder: object, *names: str) -> None:
        """Note attributes, or global variables in a dictionary of them, which must be the same objects."""
        read = dict.get if type(holder) is dict else getattr
        self._named[read] |= {(id(holder), name): holder for name in names}

    def note_value(self, x: object, read: Callable[[Any], object]) -> None:
        """Note a function of an object, whose value must be equal."""
        self._values.append((read, x))

    def note_numbers(self, x: np.ndarray) -> None:
        """Note an array, whose numbers must be the same."""
        x = x.transpose(sorted(range(x.ndim), key=x.strides.__getitem__, reverse=True))
        same = bytearray(x.tobytes()).__eq__  # which takes no copy, but needs numbers side by side
        self.note_value(x, same if same(x) is True else np.ndarray.tobytes)

    def note_tensor(self, x: Tensor, *, constant: bool) -> None:
        """Note a tensor, whose memory must be the same, and its numbers if it is constant."""
        now = x.detach()
        try:
            numbers = now.numpy()
        except (RuntimeError, TypeError):  # on another device, or in a layout of its own
            self.complete = False
            return
        self.note_attributes(x, "requires_grad")
        self.note_value(x, now.is_set_to)  # of the same memory, shape and strides
        if constant:
            self.note_numbers(numbers)

    def guard(self, guards: Sequence[Guard]) -> None:
        """Watch constants outside of the module too, which are as they were noted."""
        self._guards.append(guards)
        for each in guards:
            if type(each.holder) is dict:
                self.note_attributes(each.holder, each.name)
            else:
                self.note_value(each, Guard.holds)
        self.begin()

    def guarded(self, guards: Sequence[Guard]) -> bool:
        """Whether these constants are watched already."""
        return any(guards is known for known in self._guards)

    def begin(self) -> None:
        """Remember everything as it is now."""
        self._reads = [(read, [*held.values()], [name for _, name in held]) for read, held in self._named.items()]
        self._objects = self._identities()  # which keeps their addresses for them
        self._then = self._objects.tobytes(), self._contents()

    def holds(self, root: nn.Module) -> bool:
        """Whether everything is as it was."""
        kind, held = self._own
        if not self.complete or type(root) is not kind or vars(root) is not held or any(self._empty):
            return False
        addresses, contents = self._then
        try:
            return self._identities().tobytes() == addresses and self._contents() == contents
        except ValueError:  # a variable of a function has lost its value
            return False

    def _identities(self) -> np.ndarray:
        reads = (map(read, held, names) for read, held, names in self._reads)
        return np.fromiter(chain(chain.from_iterable(self._filled), *reads), object)

    def _contents(self) -> list[object]:
        return [*map(len, self._filled), *(read(x) for read, x in self._values)]
