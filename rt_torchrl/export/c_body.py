"""The body of a C function that works on arrays of double: loops, sums, constants."""

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from rt_torchrl.export.c_operators import literal

WIDTH = 110
LONGEST_NAME = 48
"""Length to which names are cut: C99 compares 63 characters, of which some are left for a number at the end."""


@dataclass(frozen=True)
class Elements:
    """A tensor whose elements are elements of a C array; ``places`` holds their places in it."""

    array: str
    places: Int[Tensor, "*shape"]

    def moved(self, places: Int[Tensor, "*other"]) -> "Elements":
        """Other elements of the same array."""
        return Elements(self.array, places)


def counted(shape: Sequence[int]) -> Int[Tensor, "*shape"]:
    """The places of the elements of a new array, row by row."""
    return torch.arange(torch.Size(shape).numel()).view(tuple(shape))


class CBody:
    """Collects constants and statements; every result is a new array."""

    def __init__(self) -> None:
        self.constants: list[str] = []
        self.statements: list[str] = []
        self._taken = {"observation", "action"}
        self._layers: list[str] = []
        self._known: list[tuple[Tensor, Elements]] = []

    def begin(self, name: str, layer: str) -> None:
        """Name the result of the next statements, and the layer that they come from."""
        self._name = name
        if layer not in self._layers:
            self._layers.append(layer)

    def constant(self, value: Tensor, label: str) -> Elements:
        """A constant array of the file, which is written once however often it is read."""
        for known, elements in self._known:
            if known is value:
                return elements
        name = self._new(f"c_{label}")
        numbers = ", ".join(literal(number) for number in value.double().flatten().tolist())
        self._declare(f"static const double {name}[{value.numel()}] = {{", numbers)
        self._known.append((value, Elements(name, counted(value.shape))))
        return self._known[-1][1]

    def read(self, elements: Elements, shape: Sequence[int]) -> str:
        """The expression of the i-th element, broadcast to a shape and flattened."""
        return f"{elements.array}[{self._subscript(elements.places.expand(*shape).reshape(-1, 1))}]"

    def assign(self, expression: str, shape: Sequence[int]) -> Elements:
        """A new array of the shape, with the expression as its i-th element."""
        result = self._local(shape)
        self._loop(result.places.numel(), f"{result.array}[I] = {expression};")
        return result

    def finish(self, expression: str, count: int) -> None:
        """Write the elements of the action."""
        self._loop(count, f"action[I] = {expression};")

    @staticmethod
    def later(shape: Sequence[int]) -> Elements:
        """A placeholder for elements that the expression of another result will hold."""
        return Elements("", counted(shape))

    def sum(
        self, factors: Sequence[Elements], shape: Sequence[int], *, start: str = "0.0", scale: str = "1.0"
    ) -> Elements:
        """A new array, start + scale·Σ_j Π factors, where j runs over the last dimension of the factors."""
        count, rows = factors[0].places.shape[-1], torch.Size(shape).numel()
        places = [(f.array, f.places.expand(*shape, count).reshape(rows, count)) for f in factors]
        term = " * ".join(f"{array}[{self._subscript(p)}]" for array, p in places)
        result, scaled = self._local(shape), "" if scale == "1.0" else f"{scale} * "
        lines = (
            f"double sum = {start.removeprefix('1.0 * ')};",
            f"for (int j = 0; j < {count}; ++j) {{",
            f"    sum += {scaled}{term};",
            "}",
            f"{result.array}[I] = sum;",
        )
        self._loop(rows, *lines)
        return result

    def join(self, parts: Sequence[Elements], dim: int = 0) -> Elements:
        """A new array that joins several arrays as torch.cat does."""
        owner = torch.cat([torch.full_like(part.places, k) for k, part in enumerate(parts)], dim)
        places = torch.cat([part.places for part in parts], dim).flatten()
        result = self._local(owner.shape)
        for k, part in enumerate(parts):
            (to,) = torch.where(owner.flatten() == k)
            if len(to):
                source = self._subscript(places[to][:, None])
                self._loop(len(to), f"{result.array}[{self._subscript(to[:, None])}] = {part.array}[{source}];")
        return result

    def _loop(self, count: int, *lines: str) -> None:
        """Write a loop of the lines over i; [I] stands for the subscript of the element that they write."""
        if self._layers:
            self.statements.append(f"/* {', '.join(self._layers)} */")
            self._layers.clear()
        written = [line.replace("[I]", "[0]" if count == 1 else "[i]") for line in lines]
        if count == 1 and len(written) == 1:
            self.statements += written
            return
        head = "{" if count == 1 else f"for (int i = 0; i < {count}; ++i) {{"
        self.statements += [head, *(f"    {line}" for line in written), "}"]

    def _local(self, shape: Sequence[int]) -> Elements:
        places, name = counted(shape), self._new(f"v_{self._name}")
        self.statements.append(f"double {name}[{places.numel()}];")
        return Elements(name, places)

    def _subscript(self, places: Int[Tensor, "rows columns"]) -> str:
        """The subscript of the element in row i and column j: base + a·i + b·j, or a look-up if no such rule holds."""
        rows, columns = places.shape
        base = int(places[0, 0])
        a = int(places[1, 0]) - base if rows > 1 else 0
        b = int(places[0, 1]) - base if columns > 1 else 0
        if (places == base + a * torch.arange(rows)[:, None] + b * torch.arange(columns)).all():
            terms = [
                letter if factor == 1 else f"{factor} * {letter}" for factor, letter in ((a, "i"), (b, "j")) if factor
            ]
            return " + ".join([*terms, *([str(base)] if base or not terms else [])])
        name = self._new("places")
        self._declare(f"static const int {name}[{places.numel()}] = {{", ", ".join(map(str, places.flatten().tolist())))
        row = "i" if columns == 1 else f"{columns} * i + j"
        return f"{name}[{'j' if rows == 1 else row}]"

    def _declare(self, head: str, numbers: str) -> None:
        wrapped = textwrap.wrap(numbers, WIDTH - 4, break_long_words=False, break_on_hyphens=False)
        self.constants.append("\n".join([head, *(f"    {line}" for line in wrapped), "};"]))

    def _new(self, label: str) -> str:
        """A name that is not taken yet; its first letter keeps it apart from the words of C and math.h."""
        stem = re.sub(r"[^0-9A-Za-z_]", "_", label)[:LONGEST_NAME]
        name, number = stem, 1
        while name in self._taken:
            number += 1
            name = f"{stem}_{number}"
        self._taken.add(name)
        return name
