"""Tracing: one execution of torch code, for one realisation, becomes a program."""

import math
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from rt_torchrl.programs.elementwise import ARITY, ELEMENTWISE, IN_LOOPS
from rt_torchrl.programs.program import CONSTANT, UNIFORM, VARYING, Access, Program, UntraceableError

STRAIGHT = 24
"""Greatest number of elements of a row that becomes straight-line code; a longer one becomes a loop."""
DECISIONS = frozenset({"_local_scalar_dense", "is_nonzero", "equal", "nonzero"})
"""Operators by which Python takes a number or a branch from a tensor."""
FILLS = frozenset(
    "zeros ones full empty zeros_like ones_like full_like empty_like new_zeros new_ones new_full new_empty "
    "scalar_tensor arange eye linspace empty_strided new_empty_strided zero".split()
)

CHECKERS = {"jaxtyping", "beartype"}
"""Packages that stand between a function and its caller when they check annotations at run time."""

Rule = Callable[["Tracer", tuple[Any, ...], dict[str, Any], Any], Any]


class Tracer(TorchDispatchMode):
    """Records the operators that torch executes within it.

    Every storage of torch holds cells, the values of the program that its elements have. Views and writes in place
    therefore need no rules of their own, and copies are carried out on the cells.

    Args:
        rules: operators that neither copy nor act elementwise, by name.
    """

    def __init__(self, rules: dict[str, Rule]):
        super().__init__()
        self.program = Program()
        self._rules = rules
        self._cells: dict[int, Tensor] = {}
        self._alive: list[Tensor] = []  # a storage that is freed could give its address to another one

    # Cells

    def cells(self, x: Any) -> Tensor:
        """The values of the program that a tensor or a number holds, in the shape of the tensor."""
        if not isinstance(x, Tensor):
            return torch.tensor(self.program.constant(x))
        key = _storage_of(x)
        if key not in self._cells:  # a tensor from outside is a constant
            size = x.untyped_storage().nbytes() // x.element_size()
            values = torch.as_strided(x.detach(), (size,), (1,), 0).tolist()
            if x.is_complex():
                raise self.refuse("complex numbers")
            self._cells[key] = torch.tensor([self.program.constant(v) for v in values], dtype=torch.int64)
            self._alive.append(x)
        return torch.as_strided(self._cells[key], x.shape, x.stride(), x.storage_offset())

    def assign(self, x: Tensor, cells: Tensor) -> None:
        """Let a new tensor hold values of the program."""
        cell = torch.zeros(x.untyped_storage().nbytes() // max(1, x.element_size()), dtype=torch.int64)
        torch.as_strided(cell, x.shape, x.stride(), x.storage_offset()).copy_(cells)
        self._cells[_storage_of(x)] = cell
        self._alive.append(x)

    def input(self, x: Tensor, name: str, first: int = 0) -> None:
        """Let a tensor be a part of an input that varies over lanes and steps, from its element ``first`` on."""
        places = range(first, first + x.numel())
        found = [self.program.new("input", attributes=(name, i), level=VARYING) for i in places]
        self.assign(x, torch.tensor(found, dtype=torch.int64).view(x.shape))

    def weight(self, x: Tensor, offset: int) -> None:
        """Let a tensor be a part of the weights, which are the same for all lanes and steps."""
        array = self.program.new("weights", attributes=(offset, x.numel()), kind="array", level=UNIFORM)
        self.assign(x, self.elements(array, x.numel()).view(x.shape))

    def elements(self, array: int, count: int) -> Tensor:
        """The elements of an array as cells."""
        return torch.tensor([self.program.new("element", array, attributes=(i,)) for i in range(count)])

    def numbers(self, cells: Tensor) -> list[float] | None:
        """The numbers that all cells are known to hold; None if one of them is computed later."""
        found = [self.program.number(i) for i in cells.flatten().tolist()]
        return None if None in found else [x for x in found if x is not None]

    def refuse(self, what: str) -> UntraceableError:
        """The error of code that cannot become a program, with the line of the caller's code."""
        return UntraceableError(f"{what}{_place()}")

    # Operators

    def __torch_dispatch__(
        self, func: Any, types: Iterable[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        self.program.differentiating = torch._C._current_autograd_node() is not None
        packet = func._schema.name.split("::")[1]
        name = packet if packet.startswith("_") else packet.rstrip("_")
        if packet in DECISIONS:
            if self.numbers(self.cells(args[0])) is None:
                raise self.refuse("a number or a branch of Python is taken from a tensor that varies")
            return func(*args, **kwargs)
        if torch.Tag.nondeterministic_seeded in func.tags:
            raise self.refuse(f"{packet} draws random numbers")
        if func.is_view:  # a view shares the cells
            self.cells(args[0])
            return func(*args, **kwargs)
        known = name in ELEMENTWISE or name in FILLS or name in self._rules
        in_place = func._schema.is_mutable and packet.endswith("_")
        if not known and not in_place and (decomposition := _decomposition(func)):
            with self:
                return decomposition(*args, **kwargs)
        out = func(*args, **kwargs)
        if func._schema.is_mutable:
            cells = self._computed(func, name, args, kwargs, args[0])
            self.cells(args[0]).copy_(cells.expand(args[0].shape))
            return out
        outs = [o for o in ([out] if isinstance(out, Tensor) else out) if isinstance(o, Tensor)]
        found = self._computed(func, name, args, kwargs, out)
        for o, cells in zip(outs, found if isinstance(found, (tuple, list)) else [found], strict=True):
            self.assign(o, cells)
        return out

    def _computed(self, func: Any, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], out: Any) -> Any:
        """The cells of what an operator computes."""
        if name in FILLS:
            values = torch.zeros(()) if name == "zero" else out
            found = [self.program.constant(v) for v in values.flatten().tolist()]
            return torch.tensor(found, dtype=torch.int64).view(values.shape)
        if name in self._rules:
            return self._rules[name](self, args, kwargs, out)
        if name in ELEMENTWISE:
            return self._elementwise(name, args, kwargs, out)
        raise self.refuse(f"torch operator {func} has no translation")

    def _elementwise(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], out: Tensor) -> Tensor:
        if out.is_floating_point() and out.dtype != torch.float64:
            raise self.refuse(f"{name} computes in {out.dtype}; trajectories need torch.float64")
        operands = [self.cells(a) for a in args[: ARITY[name]]]
        alpha = kwargs.get("alpha", 1) if name in ("add", "sub") else 1
        if alpha != 1:
            operands[1] = self.pointwise("mul", [operands[1], self.cells(alpha)], operands[1].shape)
        found = self.pointwise(name, operands, out.shape)
        rounding = kwargs.get("rounding_mode")
        return self.pointwise(rounding, [found], out.shape) if rounding else found

    def pointwise(self, name: str, operands: list[Tensor], shape: Iterable[int]) -> Tensor:
        """The cells of an elementwise operator on cells: straight-line code, or one loop over a long row."""
        shape, p = tuple(shape), self.program
        spread = [o.expand(shape) for o in operands]
        values = {i for o in spread for i in o.flatten().tolist()}
        long = math.prod(shape) > STRAIGHT and name in IN_LOOPS and {p.kinds[i] for i in values} == {"number"}
        if not long or all(p.levels[i] == CONSTANT for i in values):
            rows = zip(*(o.flatten().tolist() for o in spread), strict=True)
            found = [ELEMENTWISE[name](p, *row) for row in rows]
            return torch.tensor(found, dtype=torch.int64).view(shape)
        shortcut = self._shortcut(name, spread)
        if shortcut is not None:
            return shortcut
        dims = tuple(n for n in shape if n != 1)
        accesses = [self.access(o.reshape(dims)) for o in spread]
        attributes = name, dims, tuple(x for _, x in accesses)
        array = p.new("map", *(a for a, _ in accesses), attributes=attributes, kind="array", level=VARYING)
        return self.elements(array, math.prod(shape)).view(shape)

    def _shortcut(self, name: str, operands: list[Tensor]) -> Tensor | None:
        """The result of an operator on a long row that needs no loop, such as 1·x; None if it needs one."""
        numbers = [self.uniform_number(o) for o in operands]
        if name == "mul" and self.program.differentiating and 0.0 in numbers:
            return operands[numbers.index(0.0)]
        for plain, neutral in (("mul", 1.0), ("add", 0.0)):
            if name == plain and neutral in numbers:
                return operands[1 - numbers.index(neutral)]
        return operands[0] if (name, numbers[-1]) in (("sub", 0.0), ("div", 1.0)) else None

    def uniform_number(self, cells: Tensor) -> float | None:
        """The number that all cells are known to hold; None if they hold different or unknown ones."""
        first = cells.flatten()[0]
        return self.program.number(int(first)) if bool((cells == first).all()) else None

    def access(self, cells: Tensor) -> tuple[int, Access | None]:
        """An operand of a loop: a scalar (None), or an array with the way to walk through it."""
        flat, p = cells.flatten().tolist(), self.program
        if len(set(flat)) == 1:
            return flat[0], None
        found = [p.operations[i] for i in flat]
        if all(o.name == "element" for o in found) and len({o.operands for o in found}) == 1:
            walk = _walk(torch.tensor([o.attributes[0] for o in found]).view(cells.shape))
            if walk is not None:
                return found[0].operands[0], walk
        numbers = self.numbers(cells)
        if numbers is not None:
            array = self.table(numbers)
        else:
            array = p.new("row", *(p.as_number(i) for i in flat), kind="array", level=VARYING)
        return array, Access(0, torch.empty(cells.shape).stride())

    def table(self, numbers: list[float]) -> int:
        """An array of constants."""
        return self.program.new("table", attributes=tuple(x.hex() for x in numbers), kind="array")


def tensors_in(values: Iterable[Any]) -> Iterator[Tensor]:
    """The tensors among arguments, also within lists."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, (list, tuple)):
            yield from tensors_in(value)


def _walk(places: Tensor) -> Access | None:
    """The base and the strides of places on an even grid; None if they are on no such grid."""
    base = int(places.flatten()[0])
    strides = tuple(
        int(places.movedim(d, 0)[1].flatten()[0]) - base if n > 1 else 0 for d, n in enumerate(places.shape)
    )
    grid = torch.tensor(base)
    for d, (n, stride) in enumerate(zip(places.shape, strides, strict=True)):
        grid = grid + (torch.arange(n) * stride).view([-1 if e == d else 1 for e in range(places.ndim)])
    return Access(base, strides) if torch.equal(grid.expand(places.shape), places) else None


def _storage_of(x: Tensor) -> int:
    return x.untyped_storage()._cdata


@cache
def _decomposition(func: Any) -> Callable[..., Any] | None:
    """The way to compute an operator by simpler ones; None if torch knows none."""
    if func._can_decompose():
        own: Callable[..., Any] = func.decompose
        return own
    return _decompositions().get(func)


@cache
def _decompositions() -> dict[Any, Callable[..., Any]]:
    # These tables take a third of a second to import, and most code needs none of them.
    from torch._decomp import core_aten_decompositions, decomposition_table

    return {**decomposition_table, **core_aten_decompositions(), torch.ops.prims.var.default: _variance}


def _variance(x: Tensor, dims: list[int], correction: float = 1.0, **options: Any) -> Tensor:
    squares = (x - x.mean(dims, keepdim=True)) ** 2
    return squares.sum(dims) / (math.prod(x.shape[d] for d in dims) - correction)


def _place() -> str:
    """The innermost line outside of torch and this room, for a message."""
    own = (str(_folder(torch)), str(_folder(sys.modules[__package__])))
    for frame in reversed(traceback.extract_stack()):
        if not frame.filename.startswith(own) and not CHECKERS & set(Path(frame.filename).parts):
            return f" (in {frame.name}, {frame.filename}:{frame.lineno}: {frame.line})"
    return ""


def _folder(module: ModuleType) -> str:
    return str(module.__file__).removesuffix("__init__.py")
