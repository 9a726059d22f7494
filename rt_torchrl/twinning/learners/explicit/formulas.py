"""The formulas of a critic for each row of a batch: machine code where the processor's vectors are wide, else torch."""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.programs.lowering import Lowering
from rt_torchrl.programs.machine_code import Lanes, LaneWriter, ObjectCode, lanes_of_this_machine, symbol
from rt_torchrl.programs.rules import new_tracer

Layer = tuple[Tensor, Tensor]
"""Weights (out, in) and biases (out) of an affine map."""


@dataclass(frozen=True)
class CriticShape:
    """Numbers of a perceptron q(x) of SiLU layers.

    Args:
        n_o: number of observations.
        n_a: number of actions.
        hidden: widths of the hidden layers.
    """

    n_o: int
    n_a: int
    hidden: tuple[int, ...]

    @property
    def n_x(self) -> int:
        """Number of inputs."""
        return self.n_o + self.n_a

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Numbers of outputs and inputs of every affine map."""
        return [(n_out, n_in) for n_in, n_out in pairwise((self.n_x, *self.hidden, 1))]

    @property
    def n_w(self) -> int:
        """Number of weights and biases."""
        return sum(n_out * (n_in + 1) for n_out, n_in in self.sizes)

    def layers(self, weights: Float[Tensor, " n_w"]) -> list[Layer]:
        """The affine maps of weights and biases in turn."""
        parts = iter(weights.split([count for n_out, n_in in self.sizes for count in (n_out * n_in, n_out)]))
        return [(next(parts).view(n_out, n_in), next(parts)) for n_out, n_in in self.sizes]


def value_of(layers: Sequence[Layer], x: Float[Tensor, "n n_x"]) -> Float[Tensor, "n 1"]:
    """The value q(x)."""
    for weight, bias in layers[:-1]:
        z = torch.addmm(bias, x, weight.t())
        x = z * torch.sigmoid(z)
    return torch.addmm(layers[-1][1], x, layers[-1][0].t())


def derivatives_of(layers: Sequence[Layer], x: Float[Tensor, "n n_x"]) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    r"""The value, the outputs h_l of all hidden layers, and the slopes dq/dx and dq/dz_l.

    .. math::
        z_l = W_l h_{l-1} + b_l, \qquad h_l = z_l\sigma(z_l), \qquad
        \frac{dq}{dz_l} = h_l'(z_l) \odot W_{l+1}^\top\frac{dq}{dz_{l+1}}, \qquad h' = \sigma + h (1 - \sigma)

    SiLU and its derivative share one exponential.
    """
    hidden, rates = [], []
    for weight, bias in layers[:-1]:
        z = torch.addmm(bias, x, weight.t())
        share = torch.sigmoid(z)
        x = z * share
        hidden.append(x)
        rates.append(share + x * (1.0 - share))
    value = torch.addmm(layers[-1][1], x, layers[-1][0].t())
    slopes = [torch.ones_like(value)]
    for l in reversed(range(len(layers))):
        slope = slopes[0].mm(layers[l][0])
        if l:
            slope = slope * rates[l - 1]
        slopes.insert(0, slope)
    return value, hidden, slopes[:-1]


@dataclass(frozen=True)
class TemporalDifferences:
    r"""The formula of a critic iteration.

    .. math::
        \delta = q(x) - r - \gamma q'(x'), \qquad g = 2 w\delta

    A row holds x, x', r, γ and w; weights are those of the critic and then of its target. The results of a row are δ,
    g, h_l of all hidden layers, and g dq/dz_l.

    Args:
        shape: numbers of the critic.
    """

    shape: CriticShape

    @property
    def n_in(self) -> int:
        """Length of a row."""
        return 2 * self.shape.n_x + 3

    @property
    def sizes(self) -> list[int]:
        """Lengths of the results."""
        return [1, 1, *self.shape.hidden, *self.shape.hidden]

    def __call__(self, rows: Float[Tensor, "n n_in"], weights: Float[Tensor, " n_w"]) -> list[Tensor]:
        n_x = self.shape.n_x
        x, following, reward, discount, share = rows.split([n_x, n_x, 1, 1, 1], -1)
        critic, target = (self.shape.layers(part) for part in weights.split(self.shape.n_w))
        value, hidden, slopes = derivatives_of(critic, x)
        error = value - (reward + discount * value_of(target, following))
        scale = 2.0 * share * error
        return [error, scale, *hidden, *(scale * slope for slope in slopes[1:])]


@dataclass(frozen=True)
class Ascent:
    r"""The formula of a policy iteration: w q(x), and −w dq/da by the scaled actions.

    A row holds x and w.

    Args:
        shape: numbers of the critic.
    """

    shape: CriticShape

    @property
    def n_in(self) -> int:
        """Length of a row."""
        return self.shape.n_x + 1

    @property
    def sizes(self) -> list[int]:
        """Lengths of the results."""
        return [1, self.shape.n_a]

    def __call__(self, rows: Float[Tensor, "n n_in"], weights: Float[Tensor, " n_w"]) -> list[Tensor]:
        x, share = rows.split([self.shape.n_x, 1], -1)
        value, _, slopes = derivatives_of(self.shape.layers(weights[: self.shape.n_w]), x)
        return [share * value, -share * slopes[0][:, self.shape.n_o :]]


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
