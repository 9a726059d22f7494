"""Tracing: one execution of torch code, for one realisation, becomes a program."""

import linecache
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from traceback import walk_stack, walk_tb
from types import FrameType, ModuleType
from typing import Any

import jaxtyping
import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from rt_torchrl.programs.program import ARITY, ELEMENTWISE, Access, Program, UntraceableError

STRAIGHT = 24
"""Greatest number of elements of a row that becomes straight-line code, unless a tracer is told another one."""
DECISIONS = frozenset({"_local_scalar_dense", "is_nonzero", "equal", "nonzero"})
"""Operators by which Python takes a number or a branch from a tensor."""
FILLS = frozenset(
    "zeros ones full empty zeros_like ones_like full_like empty_like new_zeros new_ones new_full new_empty "
    "scalar_tensor arange eye linspace empty_strided new_empty_strided".split()
)
ESCAPES = {
    getattr(Tensor, name): name
    for name in ("numpy", "tolist", "__array__", "data_ptr", "__dlpack__", "untyped_storage")
}
"""Methods by which numbers leave torch, where a tracer cannot follow them."""
TYPES = frozenset({torch.float64, torch.int64, torch.int32, torch.bool})
"""Types in which code may compute; numbers of programs are doubles, which neither round nor wrap as others do."""
BRANCHLESS, OTHERS = "use torch.where, and torch functions throughout", "write it with other operators"
GENERATED = ("<@beartype", "<string>")
"""Code that checks annotations at run time."""

Arguments = tuple[Any, ...]
Options = dict[str, Any]
Rule = Callable[["Tracer", Arguments, Options, Any], Any]


class Places:
    """The lines of the caller's code whose operators are executed.

    An operator of a backward pass has no line of its own; it has the line of the operator that it is the gradient of,
    whose number in the order of the tape it shares.
    """

    def __init__(self) -> None:
        self._internal = (*map(_folder, (torch, sys.modules[__package__], jaxtyping)), *GENERATED)
        self._lines: dict[int, str] = {}

    def note(self) -> None:
        """Note the line of an operator of a forward pass."""
        if torch.is_grad_enabled():  # operators without a gradient draw no number
            self._lines.setdefault(torch._C._autograd._get_sequence_nr() - 1, self.of(walk_stack(sys._getframe(1))))

    def now(self) -> str:
        """The line of the operator that is executed now, as the end of a message."""
        node = torch._C._current_autograd_node()
        line = self._lines.get(node._sequence_nr()) if node is not None else None
        return line or self.of(walk_stack(sys._getframe(1)))

    def of(self, frames: Iterable[tuple[FrameType, int]]) -> str:
        """The first line of the caller's code among frames, as the end of a message."""
        for frame, line in frames:
            code = frame.f_code
            if not code.co_filename.startswith(self._internal):
                text = linecache.getline(code.co_filename, line).strip()
                return f" (in {code.co_name}, {code.co_filename}:{line}: {text})"
        return ""


class Tracer(TorchDispatchMode):
    """Records the operators that torch executes within it.

    Every storage of torch holds cells, the values of the program that its elements have. Views and writes in place
    therefore need no rules of their own, and copies are carried out on the cells.

    Args:
        rules: operators that do not act elementwise, by name.
        decompositions: operators as torch code of simpler ones, by name; they go before those of torch.
        of_torch: the ways in which torch computes operators by simpler ones.
        straight: greatest number of elements of a row that becomes straight-line code; a longer one becomes a loop.
    """

    supports_higher_order_operators = True  # to refuse them with a message

    def __init__(
        self,
        rules: Mapping[str, Rule],
        decompositions: Mapping[str, Callable[..., Any]],
        of_torch: Callable[[], Mapping[Any, Callable[..., Any]]],
        straight: int,
    ):
        super().__init__()
        self.program = Program()
        self.places, self.straight = Places(), straight
        elementwise = {name: partial(Tracer._elementwise, name=name) for name in ELEMENTWISE}
        filled = dict.fromkeys(FILLS, lambda tracer, args, options, out: tracer._constants(out))
        self._rules: dict[str, Rule] = {**filled, **elementwise, **rules}
        self._decompositions, self._of_torch = decompositions, of_torch
        self._cells: dict[int, Tensor] = {}
        self._sizes = Counter[str]()  # of the inputs by their names, and of the weights
        self._alive: list[Tensor] = []  # a storage that is freed could give its address to another one

    # Cells

    def cells(self, x: Any) -> Tensor:
        """The values of the program that a tensor or a number holds, in the shape of the tensor."""
        if not isinstance(x, Tensor):
            return torch.tensor(self.program.constant(x))
        if x.layout is not torch.strided:
            raise self.refuse(f"a tensor of layout {x.layout}", "make it dense")
        key = _storage_of(x)
        if key not in self._cells:  # a tensor from outside is a constant
            if x.requires_grad and x.is_leaf and x.numel():
                raise self.refuse("a tensor that requires a gradient but is no parameter of the modules", "make it one")
            size = x.untyped_storage().nbytes() // x.element_size()
            self._cells[key] = self._constants(torch.as_strided(x.detach(), (size,), (1,), 0))
            self._alive.append(x)
        return torch.as_strided(self._cells[key], x.shape, x.stride(), x.storage_offset())

    def _constants(self, x: Tensor) -> Tensor:
        """The cells of known numbers."""
        if x.is_complex():
            raise self.refuse("complex numbers", "compute with real and imaginary parts")
        return in_shape([self.program.constant(v) for v in x.flatten().tolist()], x.shape)

    def assign(self, x: Tensor, cells: Tensor) -> None:
        """Let a new tensor hold values of the program; a part of a storage leaves the rest of it as it is."""
        key = _storage_of(x)
        if key not in self._cells:
            size = x.untyped_storage().nbytes() // max(1, x.element_size())
            self._cells[key] = torch.zeros(size, dtype=torch.int64)
        once = tuple(slice(1) if stride == 0 else slice(None) for stride in x.stride())
        torch.as_strided(self._cells[key], x.shape, x.stride(), x.storage_offset())[once].copy_(cells[once])
        self._alive.append(x)

    def input(self, x: Tensor, name: str) -> None:
        """Let a tensor be the next part of an input, which varies over lanes and steps."""
        places = range(self._sizes[name], self._sizes[name] + x.numel())
        self._sizes[name] = places.stop
        self.assign(x, in_shape([self.program.new("input", attributes=(name, i)) for i in places], x.shape))

    def weight(self, x: Tensor) -> None:
        """Let a tensor be the next part of the weights, which are the same for all lanes and steps."""
        if x.numel() * x.element_size() < x.untyped_storage().nbytes():
            self.cells(x.detach())  # what is beside it in its memory is constant
        array = self.program.new("weights", attributes=(self._sizes["weights"], x.numel()), kind="array")
        self._sizes["weights"] += x.numel()
        self.assign(x, self.elements(array, x.numel()).view(x.shape))

    def outputs(self, x: Tensor) -> list[int]:
        """The values of a tensor as numbers."""
        return [self.program.as_number(i) for i in self.cells(x).flatten().tolist()]

    def elements(self, array: int, count: int) -> Tensor:
        """The elements of an array as cells."""
        return torch.tensor([self.program.new("element", array, attributes=(i,)) for i in range(count)])

    def numbers(self, cells: Tensor) -> list[float] | None:
        """The numbers that all cells are known to hold; None if one of them is computed later."""
        values, known = cells.flatten().tolist(), self.program.numbers
        return [known[i] for i in values] if all(i in known for i in values) else None

    def refuse(self, what: str, remedy: str) -> UntraceableError:
        """The error of code that cannot become a program, with the line of the caller's code."""
        return UntraceableError(f"{what}{self.places.now()}; {remedy}")

    # Operators

    @contextmanager
    def following(self) -> Iterator[None]:
        """A context in which the caller's code is traced, and may take no number out of torch that varies."""
        try:
            with sdpa_kernel(SDPBackend.MATH), _Escapes(self), self:  # attention as products of matrices
                yield
        except UntraceableError:
            raise
        except Exception as error:  # code may raise anything, such as for one realisation alone
            place = self.places.of(reversed([*walk_tb(error.__traceback__)]))
            text = f"an interval of one realisation raises {type(error).__name__}: {str(error).rstrip('.')}{place}"
            raise UntraceableError(text) from error

    def __torch_dispatch__(self, func: Any, types: Any, args: Arguments = (), kwargs: Options | None = None) -> Any:
        kwargs = kwargs or {}
        if not isinstance(func, OpOverload):
            raise self.refuse(f"torch operator {func} has no translation", OTHERS)
        self.program.differentiating = torch._C._current_autograd_node() is not None
        with torch._C.DisableTorchFunction():  # the mode of escapes is for the caller's code alone
            self.places.note()
            packet = func._schema.name.split("::")[1]
            name = packet if packet.startswith("_") else packet.rstrip("_")
            if torch.Tag.nondeterministic_seeded in func.tags:
                raise self.refuse(f"{packet} draws random numbers", "they belong in draw_exogenous")
            if packet in DECISIONS:
                self.require_known("a number or a branch of Python is taken from a tensor that varies", args)
                return func(*args, **kwargs)
            has_rule = name in self._rules or name in self._decompositions
            if not has_rule and func._can_decompose():  # into views or copies, depending on the strides
                with self:
                    return func.decompose(*args, **kwargs)
            if func.is_view or torch.Tag.inplace_view in func.tags:  # a view shares the cells
                self.cells(args[0])
                out = func(*args, **kwargs)
                if any(o.dtype != args[0].dtype for o in tensors_in([out])):
                    raise self.refuse(f"{func} reads numbers as another type", OTHERS)
                return out
            if not func._schema.is_mutable and self._foldable(args):  # into known numbers, whatever the operator is
                out = func(*args, **kwargs)
                for x in tensors_in([out]):
                    self.assign(x, self._constants(x.detach()))
                return out
            in_place = func._schema.is_mutable and packet.endswith("_")
            simpler = self._simpler(func, name)
            if simpler is None:
                return self._executed(func, name, args, kwargs)
            with self:
                result = self._translated(func, simpler, *args, **kwargs)
                return args[0].copy_(result) if in_place else result

    def _simpler(self, func: Any, name: str) -> Callable[..., Any] | None:
        """An operator without a rule as torch code of simpler ones, which may also write in place."""
        if name in self._rules or name in self._decompositions:
            return self._decompositions.get(name)
        return self._of_torch().get(getattr(getattr(torch.ops.aten, name, None), func._overloadname, None))

    def _foldable(self, args: tuple[Any, ...]) -> bool:
        """Whether all tensors among arguments hold known numbers, which are those of torch."""
        exact = not self.program.differentiating  # 0·x may be NaN for torch
        return all(
            (exact or not x.is_floating_point()) and self.numbers(self.cells(x)) is not None for x in tensors_in(args)
        )

    def require_known(self, what: str, args: Iterable[Any]) -> None:
        """Refuse tensors whose numbers are not known when the program is made."""
        if any(self.numbers(self.cells(x)) is None for x in tensors_in(args)):
            raise self.refuse(what, BRANCHLESS)

    def _executed(self, func: Any, name: str, args: Arguments, kwargs: Options) -> Any:
        """What an operator returns, with the cells of what it computes."""
        out = func(*args, **kwargs)
        outs = tensors_in([out])
        if others := {o.dtype for o in outs} - TYPES:
            raise self.refuse(
                f"{func} computes in {others.pop()}", "machine code has torch.float64, int64, int32, bool"
            )
        written = args[0] if func._schema.is_mutable else out
        if name not in self._rules:
            raise self.refuse(f"torch operator {func} has no translation", OTHERS)
        result = self._translated(func, self._rules[name], self, args, kwargs, written)
        if func._schema.is_mutable:
            if not func._schema.arguments[0].is_write or len(outs) != 1:
                raise self.refuse(f"{func} writes into its argument out", "take what it returns")
            self.cells(args[0]).copy_(result.expand(args[0].shape))
            return out
        for o, cells in zip(outs, result if isinstance(result, (tuple, list)) else [result], strict=True):
            self.assign(o, cells)
        return out

    def _translated(self, func: Any, translation: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """What a translation of an operator gives; arguments for which it fails are refused."""
        try:
            return translation(*args, **kwargs)
        except UntraceableError:
            raise
        except Exception as error:
            what = f"torch operator {func} has no translation for these arguments ({error})"
            raise self.refuse(what, OTHERS) from error

    def _elementwise(self, args: Arguments, kwargs: Options, out: Tensor, name: str) -> Tensor:
        unknown = [*args[ARITY[name] :], *(key for key in kwargs if key not in ("alpha", "dtype"))]
        if unknown or (name.startswith("bitwise") and out.dtype != torch.bool):
            raise self.refuse(f"{name} of {out.dtype} with {unknown or 'bits'}", OTHERS)
        operands = [self.cells(a) for a in args[: ARITY[name]]]
        if (alpha := kwargs.get("alpha", 1)) != 1:
            operands[1] = self.pointwise("mul", [operands[1], self.cells(alpha)], operands[1].shape)
        return self.pointwise(name, operands, out.shape)

    def pointwise(self, name: str, operands: list[Tensor], shape: Iterable[int]) -> Tensor:
        """The cells of an elementwise operator on cells: straight-line code, or one loop over a long row."""
        shape, p = tuple(shape), self.program
        spread = [o.expand(shape) for o in operands]
        long = math.prod(shape) > self.straight
        if not long or all(self.numbers(o) is not None for o in spread):
            rows = zip(*(o.flatten().tolist() for o in spread), strict=True)
            return in_shape([ELEMENTWISE[name](p, *row) for row in rows], shape)
        if (shortcut := self._shortcut(name, spread)) is not None:
            return shortcut
        dims = tuple(n for n in shape if n != 1)
        return self.loop("map", [o.reshape(dims) for o in spread], dims, name).view(shape)

    def loop(self, kind: str, operands: Iterable[Tensor], dims: tuple[int, ...], what: Any) -> Tensor:
        """The cells of an array that a loop computes, see :class:`Program`."""
        accesses = [self.access(o) for o in operands]
        attributes = dims, what, tuple(x for _, x in accesses)
        array = self.program.new(kind, *(a for a, _ in accesses), attributes=attributes, kind="array")
        return self.elements(array, math.prod(dims)).view(dims)

    def _shortcut(self, name: str, operands: list[Tensor]) -> Tensor | None:
        """The result on a long row that needs no loop, such as 0·x or x + 0; None if it needs one."""
        if all(self.uniform_number(o) is None for o in operands):
            return None
        rows = list(zip(*(o.flatten().tolist() for o in operands), strict=True))
        for k, cells in enumerate(operands):  # of each element: 0/4 is its operand 0, and x/4 is not x
            if all(ELEMENTWISE[name](self.program, *row) == row[k] for row in rows):
                return cells
        return None

    def uniform_number(self, cells: Tensor) -> float | None:
        """The number that all cells are known to hold; None if they hold different or unknown ones."""
        first = cells.flatten()[0]
        return self.program.numbers.get(int(first)) if bool((cells == first).all()) else None

    def access(self, cells: Tensor) -> tuple[int, Access | None]:
        """An operand of a loop: a scalar (None), or an array with the way to walk through it."""
        flat, p = cells.flatten().tolist(), self.program
        if len(set(flat)) == 1:
            return p.as_number(flat[0]), None
        operations = [p.operations[i] for i in flat]
        if all(o.name == "element" for o in operations) and len({o.operands for o in operations}) == 1:
            walk = Access.over(torch.tensor([o.attributes[0] for o in operations]).view(cells.shape))
            if walk is not None:
                return operations[0].operands[0], walk
        if numbers := self.numbers(cells):
            table = p.new("table", attributes=tuple(x.hex() for x in numbers), kind="array")
            return table, Access(0, torch.empty(cells.shape).stride())
        array = p.new("row", *map(p.as_number, flat), attributes=(tuple(cells.shape),), kind="array")
        return array, Access(0, torch.empty(cells.shape).stride())


class _Escapes(TorchFunctionMode):
    """Refuses such methods for tensors whose numbers are not known when the program is made.

    Args:
        tracer: the tracer that knows them.
    """

    def __init__(self, tracer: Tracer):
        super().__init__()
        self._tracer = tracer

    def __torch_function__(self, func: Any, types: Any, args: Arguments = (), kwargs: Options | None = None) -> Any:
        if func in ESCAPES:
            self._tracer.require_known(f".{ESCAPES[func]}() takes a number from a tensor that varies", args)
        return func(*args, **(kwargs or {}))


def tensors_in(values: Iterable[Any]) -> list[Tensor]:
    """The tensors among arguments, also within lists."""
    return [value for value in tree_leaves(values) if isinstance(value, Tensor)]


def in_shape(values: list[int], shape: Iterable[int]) -> Tensor:
    """Values of a program as cells."""
    return torch.tensor(values, dtype=torch.int64).view(tuple(shape))


def _storage_of(x: Tensor) -> int:
    return x.untyped_storage()._cdata


def _folder(module: ModuleType) -> str:
    return str(module.__file__).removesuffix("__init__.py")
