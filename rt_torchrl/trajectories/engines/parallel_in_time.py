r"""Engine ``parallel_in_time``: trajectories and their exact discrete adjoint without a loop over time.

The engine ``parallel`` marches interval by interval and goes back by a loop of small products. Here Newton's method
finds the states of all intervals at once (:class:`NewtonMarch`), and an odd-even reduction finds the co-states. With j
sweeps and I iterations, the forward pass takes about

.. math:: j + I\,\big(1 + c + \tfrac8m\log_2 n\big)

evaluations of Φ in a row, instead of n. Here c is the time of the Jacobians of all intervals, 4 to 6 evaluations, m the
number of operations of one evaluation, some hundreds, and 8 that of a level of the reduction. The work is that of
:math:`j + I\,(1 + c\,n_s)` trajectories at most. This pays where time passes between operations rather than in them: on
a GPU with few realisations over thousands of intervals.

Note: this engine is untested on a GPU. ``docs/engines.md`` gives the iterations and operations counted on a CPU.
"""

import math

from torch import Tensor

from rt_torchrl.trajectories.engines.linear_recurrence import linear_recurrence
from rt_torchrl.trajectories.engines.newton_march import NewtonMarch
from rt_torchrl.trajectories.engines.parallel import Parallel

MEMORY = 2.0**30
"""Bytes of the Jacobians of a window; with four states, those of two million intervals of all realisations together."""
LEAST_MEMORY = 2.0**20
AT_ONCE = 2**16
"""Number of Jacobians by one call, without compilation: they come by forward mode, which keeps no tape."""


class ParallelInTime(Parallel):
    """Computes trajectories and their exact discrete adjoint in parallel over time; the module describes it.

    The trajectory is that of marching to rounding, and so is the gradient. Where Newton's method does not converge, the
    engine marches, and warns once for a plant and a number of intervals. Untested on a GPU.

    Args:
        compiled: compile what the engine ``parallel`` compiles; the reduction and Newton's method stay in Python.
        tolerance: greatest residual Φ(s_k) − s_{k+1} from which the last step of Newton's method is taken, as a share
            of the greatest absolute value that the state has had until then.
        iterations: greatest number of iterations of Newton's method on a window.
        sweeps: number of fixed-point sweeps before Newton's method, and after a step that does not help.
        memory: bytes that the Jacobians of a window of Newton's method may take. The gradient holds those of all
            intervals, 8 n B n_s² bytes, as the engine ``parallel`` does.

    Raises:
        ValueError: if an argument is out of its range.
    """

    def __init__(
        self,
        *,
        compiled: bool,
        tolerance: float = 1e-10,
        iterations: int = 12,
        sweeps: int = 32,
        memory: float = MEMORY,
    ):
        super().__init__(compiled=compiled)
        for argument, value, fits, allowed in (
            ("tolerance", tolerance, 0.0 < tolerance <= 1e-6, "positive and at most 1e-6"),
            ("iterations", iterations, iterations >= 1, "at least 1"),
            ("sweeps", sweeps, sweeps >= 0, "at least 0"),
            ("memory", memory, LEAST_MEMORY <= memory < math.inf, f"finite and at least {LEAST_MEMORY:.0f} bytes"),
        ):
            if not fits:
                raise ValueError(f"{argument}={value} of engine 'parallel_in_time' must be {allowed}.")
        self.march = NewtonMarch(
            self.intervals,
            self.linearise,
            self.march,
            tolerance=tolerance,
            iterations=iterations,
            sweeps=sweeps,
            memory=memory,
            at_once=None if compiled else AT_ONCE,
        )
        self.costates = costates_by_reduction


def costates_by_reduction(jacobians: Tensor, cost_gradient: Tensor) -> Tensor:
    """The co-states λ_1 ... λ_n of :func:`~rt_torchrl.trajectories.engines.parallel.costates`, all at once."""
    return linear_recurrence(jacobians.mT.flip(0), cost_gradient.flip(0)).flip(0)
