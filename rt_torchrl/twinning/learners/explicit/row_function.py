"""Formulas of rows of numbers: machine code where the processor's vectors are wide, torch elsewhere."""

import ctypes
from functools import cache
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.programs.lowering import Lowering
from rt_torchrl.programs.machine_code import Lanes, LaneWriter, ObjectCode, lanes_of_this_machine, symbol
from rt_torchrl.programs.rules import new_tracer

LEAST_LANES = 4
"""Least number of lanes with which machine code is faster than torch."""
ARGUMENTS = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)


@runtime_checkable
class Formula(Protocol):
    """A function of each row of numbers, and of weights; equal formulas compute the same."""

    @property
    def n_in(self) -> int:
        """Length of a row."""

    @property
    def sizes(self) -> list[int]:
        """Lengths of the results."""

    def __call__(self, rows: Float[Tensor, "n n_in"], weights: Float[Tensor, " n_w"]) -> list[Tensor]:
        """The results of each row, from no more than itself and the weights."""

    def __hash__(self) -> int: ...


class RowFunction:
    """A formula with memory for its rows and results, which lie in the columns of matrices.

    Args:
        formula: the formula.
        n: number of rows.
        weights: a tensor like the weights.
    """

    def __init__(self, formula: Formula, n: int, weights: Float[Tensor, " n_w"]):
        lanes = lanes_of_this_machine()
        fits = weights.device.type == "cpu" and weights.dtype == torch.float64
        self._formula, self._code = formula, None
        if fits and lanes.number >= LEAST_LANES and symbol("exp", lanes):
            self._code = code_of(formula, len(weights), lanes)
        self._groups = -(-n // lanes.number)
        self._rows = weights.new_zeros(formula.n_in, self._groups * lanes.number)
        self._results = weights.new_zeros(sum(formula.sizes), self._groups * lanes.number)
        self.rows: Float[Tensor, "n_in n"] = self._rows[:, :n]
        """The rows, to be written before a call."""
        self.results: list[Float[Tensor, "n_out n"]] = [part[:, :n] for part in self._results.split(formula.sizes)]
        """The results of the last call."""

    def __call__(self, weights: Float[Tensor, " n_w"]) -> None:
        """Compute the results of all rows."""
        if self._code is None:
            found = self._formula(self._rows.t(), weights)
            torch.cat([part.t() for part in found], out=self._results)
        else:
            self._code(self._rows.data_ptr(), self._results.data_ptr(), weights.data_ptr(), self._groups)


@cache
def code_of(formula: Formula, n_w: int, lanes: Lanes) -> ObjectCode:
    """Machine code of a formula.

    Args:
        formula: the formula.
        n_w: number of weights.
        lanes: lanes of the processor.
    """
    return ObjectCode(text_of(formula, n_w, lanes), "rows", ARGUMENTS)


def text_of(formula: Formula, n_w: int, lanes: Lanes) -> str:
    """LLVM's text of a function ``rows(x, y, w, n)`` that writes the results of n groups of rows.

    Rows ``x`` are ``n_in n lanes``, and results ``y`` are ``n_out n lanes``.
    """
    tracer, row, weights = new_tracer(), torch.zeros(1, formula.n_in).double(), torch.zeros(n_w).double()
    tracer.input(row, "x")
    tracer.weight(weights)
    with torch.no_grad(), tracer:
        found = formula(row, weights)
    outputs = [i for part in found for i in tracer.cells(part).flatten().tolist()]
    writer = LaneWriter(lanes, "rows")
    with writer.loop("%n") as k:
        places = [writer.index(0, [(j, "%n"), (1, k)]) for j in range(max(formula.n_in, len(outputs)))]
        inputs = {("x", j): writer.load("%x", places[j]) for j in range(formula.n_in)}
        for place, output in zip(places, Lowering(tracer.program, writer, inputs, "%w").write(outputs), strict=False):
            writer.store("%y", place, output)
    return writer.function("rows", "ptr noalias %x, ptr noalias %y, ptr noalias %w")
