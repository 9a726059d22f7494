"""Parameters of model predictive control."""

import math
from dataclasses import dataclass

from rt_torchrl.control.bounded_descent import BoundedDescentConfig
from rt_torchrl.control.command_cost import PENALTY
from rt_torchrl.options import check_options


@dataclass(frozen=True, kw_only=True)
class RecedingHorizonConfig:
    """Parameters of model predictive control.

    Args:
        horizon: length of the window over which a plan is made [s].
        period: time between two plans [s]; None for the time that a command is held.
        hold: time for which a command of a plan is held [s]; None for a control interval.
        ends: whether a window ends with the episode, whose last intervals cost nothing after it; otherwise it rolls on.
        penalty: weight of (command − applied)² over the squared range, in units of L_a; see :class:`CommandCost`.
        iterations: greatest number of iterations of L-BFGS-B in a solve.
        tolerance: relative decrease of the cost in an iteration below which a solve ends.
        memory: number of pairs that approximate the curvature.
        deadline: longest wall-clock time of a solve [s]; after it the last plan goes on.

    Raises:
        ValueError: if a number is out of its range.
    """

    horizon: float
    period: float | None = None
    hold: float | None = None
    ends: bool = False
    penalty: float = PENALTY
    iterations: int = 20
    tolerance: float = 1e-4
    memory: int = 10
    deadline: float = math.inf

    def __post_init__(self) -> None:
        check_options(self, infinite=("deadline",))
        for argument in ("horizon", "period", "hold", "deadline"):
            value = getattr(self, argument)
            if value is not None and not value > 0.0:
                raise ValueError(f"{argument}={value} s of the receding horizon must be positive.")
        if not self.penalty >= 0.0:
            raise ValueError(f"penalty={self.penalty} of the receding horizon must not be negative.")
        self.descent()  # which has ranges of its own

    def descent(self) -> BoundedDescentConfig:
        """The parameters of a solve."""
        return BoundedDescentConfig(
            iterations=self.iterations, tolerance=self.tolerance, gradient=0.0, memory=self.memory
        )
