"""The operating limits of a plant, as options."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from rt_torchrl.options import check_options


@dataclass(frozen=True, kw_only=True)
class OperatingLimitsConfig:
    """Operating limits; a safety layer holds those of actions and rates, and its fallback acts beyond those of states.

    Args:
        states: least and greatest value of states, by name, in their units.
        actions: least and greatest value of actions, by name, in their units.
        rates: greatest rate of change of actions, by name [unit/s].
        tolerated: greatest share of the control intervals of virtual episodes in which a policy may be predicted to
            leave the limits; beyond it the policy does not act.

    Raises:
        ValueError: if a number is out of its range.
    """

    states: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    actions: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rates: Mapping[str, float] = field(default_factory=dict)
    tolerated: float = 0.0

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("states", "actions"):
            for name, (low, high) in getattr(self, argument).items():
                if not low < high:
                    raise ValueError(f"limits.{argument} {name}={low} to {high} must have its least value first.")
        for name, rate in self.rates.items():
            if not rate > 0.0:
                raise ValueError(f"limits.rates {name}={rate} must be positive.")
        if not 0.0 <= self.tolerated <= 1.0:
            raise ValueError(f"limits.tolerated={self.tolerated} must lie in [0, 1], a share of control intervals.")

    def __bool__(self) -> bool:
        """Whether there is any limit."""
        return bool(self.states or self.actions or self.rates)
