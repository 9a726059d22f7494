"""The descent of a cost between bounds by L-BFGS-B."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rt_torchrl.options import check_options

DIVERGED = 1e6
"""Cost of a trial that diverges, in costs of the start: greater than any that a line search accepts."""


@dataclass(frozen=True, kw_only=True)
class BoundedDescentConfig:
    """How commands descend a cost.

    The cost is divided by its value at the start, so that no parameter depends on a plant's units.

    Args:
        iterations: greatest number of iterations.
        tolerance: relative decrease of the cost in an iteration below which the descent stops.
        gradient: greatest component of the projected gradient, of the relative cost, below which the descent stops.
        memory: number of pairs that approximate the curvature.

    Raises:
        ValueError: if a number is out of its range.
    """

    iterations: int = 1000
    tolerance: float = 1e-10
    gradient: float = 1e-8
    memory: int = 20

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("iterations", "memory"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} of the descent must be at least 1.")
        for argument in ("tolerance", "gradient"):
            if not getattr(self, argument) >= 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the descent must not be negative.")


class Minimum(NamedTuple):
    """The best point that a descent found, its cost and gradient, and the number of evaluations."""

    point: np.ndarray
    cost: float
    gradient: np.ndarray
    evaluations: int


class _Seen:
    """The function that L-BFGS-B calls; it remembers the best point."""

    def __init__(self, evaluate: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray):
        self._evaluate, self._shape = evaluate, start.shape
        cost, gradient = evaluate(start)
        if not (np.isfinite(cost) and np.isfinite(gradient).all()):
            raise FloatingPointError("the cost or its gradient is not finite at the start of the descent.")
        self.best, self._scale, self._first = Minimum(start, cost, gradient, 1), abs(cost) or 1.0, True
        self.count = 1

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        if self._first and (flat == self.best.point.ravel()).all():  # L-BFGS-B begins at the start
            cost, gradient = self.best.cost, self.best.gradient
        else:
            point = flat.reshape(self._shape)
            cost, gradient = self._evaluate(point)
            self.count += 1
            if not (np.isfinite(cost) and np.isfinite(gradient).all()):
                return DIVERGED, np.zeros_like(flat)
            if cost < self.best.cost:
                self.best = Minimum(point.copy(), cost, gradient, self.count)
        self._first = False
        return cost / self._scale, gradient.ravel() / self._scale


def descend(
    evaluate: Callable[[Float[np.ndarray, "..."]], tuple[float, Float[np.ndarray, "..."]]],
    start: Float[np.ndarray, "..."],
    config: BoundedDescentConfig,
) -> Minimum:
    """Minimise a cost over a box [0, 1] in all variables.

    Args:
        evaluate: function from a point to cost and gradient; a trial that is not finite counts as a bad one.
        start: first point, in the box.
        config: parameters of the descent.

    Raises:
        FloatingPointError: if the cost is not finite at the start.

    Source: Zhu, Byrd, Lu and Nocedal, ACM Trans. Math. Softw. 23 (1997) 550, in SciPy.
    """
    from scipy.optimize import fmin_l_bfgs_b  # here, because it takes a second to load and --help need not wait for it

    seen = _Seen(evaluate, start)
    with _libraries().limit(limits=1, user_api="blas"):
        fmin_l_bfgs_b(  # ``minimize`` converts the bounds two times more, in a tenth of a solve of a short window
            seen,
            start.ravel(),
            bounds=[(0.0, 1.0)] * start.size,
            m=config.memory,
            factr=config.tolerance / np.finfo(float).eps,
            pgtol=config.gradient,
            maxiter=config.iterations,
            maxfun=2 * config.iterations + 20,
        )
    return seen.best._replace(evaluations=seen.count)


@functools.cache
def _libraries() -> Any:
    """The linear algebra of NumPy and SciPy.

    L-BFGS-B takes scalar products of thousands of numbers. Two threads wait for each other in each of them, and on a
    machine with other work they wait for milliseconds.
    """
    from threadpoolctl import ThreadpoolController  # after SciPy, whose libraries it finds

    return ThreadpoolController()


def projected_gradient(
    point: Float[np.ndarray, "batch ..."], gradient: Float[np.ndarray, "batch ..."]
) -> Float[np.ndarray, " batch"]:
    """Norm of the part of the gradient that leads into the box [0, 1]; zero where no feasible direction descends."""
    outwards = ((point <= 0.0) & (gradient > 0.0)) | ((point >= 1.0) & (gradient < 0.0))
    inwards = np.where(outwards, 0.0, gradient)
    return np.sqrt(np.square(inwards).reshape(len(point), -1).sum(-1))
