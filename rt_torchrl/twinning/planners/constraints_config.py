"""Constraints of plans, as options."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from rt_torchrl.options import check_options


@dataclass(frozen=True, kw_only=True)
class ConstraintsConfig:
    r"""Bounds on states that plans shall keep.

    They price what the twin predicts; a safety layer holds ``limits`` on the real system.

    Args:
        states: least and greatest value of states, by name, in their units; inf or -inf for no bound.
        method: augmented_lagrangian for a price whose multipliers grow with every episode after whose plans the policy
            leaves the bounds, until plans keep them; penalty for a fixed price of the squared excess, which bends plans
            back but leaves some.
        weight: weight of the price, in units of J_a of the first policy that is planned.

    Raises:
        ValueError: if a number is out of its range.
    """

    states: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    method: Literal["augmented_lagrangian", "penalty"] = "augmented_lagrangian"
    weight: float = 100.0

    def __post_init__(self) -> None:
        check_options(self)
        for name, (low, high) in self.states.items():
            if not low < high:
                raise ValueError(f"constraints.states {name}={low} to {high} must have its least value first.")
        if not self.weight > 0.0:
            raise ValueError(f"constraints.weight={self.weight} must be positive.")
