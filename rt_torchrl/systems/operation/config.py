"""Options of an operation that goes on while the algorithm learns."""

import math
from dataclasses import dataclass
from typing import Literal

from rt_torchrl.options import check_options


@dataclass(frozen=True, kw_only=True)
class OperationConfig:
    """How the real system operates while the algorithm learns, with ``asynchronous``.

    Args:
        clock: simulated: one process, in which learning takes the time ``learning`` of operation, so that a run repeats
            to the bit; for systems in simulation. wall: the system operates in a process of its own, at the pace of the
            wall clock.
        learning: time that learning from one window takes on the simulated clock, as a share of a window. With 0 each
            window begins with what was learned from the one before, as in a run that is not asynchronous.
        speed: pace of a simulation on the wall clock, in seconds of the plant for each second; real systems keep their
            own time.
        handover: number of control intervals in which the difference between a policy and the one before it fades, if
            it is as wide as the range of the action; the actuators' own rate limits it too.
        continuous: whether only the first window begins with a reset of the system; an episode is then a window of
            operation.
        core: number of the CPU core that the acting process has for itself, on the wall clock, where the operating
            system lets a process choose; -1 takes the last core that this process may use, and -2 leaves the choice to
            the operating system.
        realtime: whether the acting process asks the operating system to run before all others, by the scheduler
            SCHED_FIFO of Linux; it needs the right to, as root or by CAP_SYS_NICE.

    Raises:
        ValueError: if an option is out of its range, or is none of its choices.
    """

    clock: Literal["simulated", "wall"] = "simulated"
    learning: float = 0.5
    speed: float = 1.0
    handover: int = 20
    continuous: bool = False
    core: int = -1
    realtime: bool = False

    def __post_init__(self) -> None:
        check_options(self)
        if not self.learning >= 0.0:
            raise ValueError(f"learning={self.learning} windows must not be negative; 0 learns in no time.")
        if not 0.0 < self.speed < math.inf:
            raise ValueError(f"speed={self.speed} must be positive, in seconds of the plant for each second.")
        if self.handover < 1:
            raise ValueError(f"handover={self.handover} control intervals must be at least 1.")
        if self.core < -2:
            raise ValueError(f"core={self.core} must be the number of a core, -1 for the last one, or -2 for any.")
