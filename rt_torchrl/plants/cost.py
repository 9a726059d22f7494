"""Running costs that a plant takes as an argument: what is wanted of it."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from rt_torchrl.options import check_options


@runtime_checkable
class RunningCost(Protocol):
    """A running cost L_a of a plant, of any batch dimensions; it must not be negative."""

    def __call__(
        self,
        plant: Any,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch"]: ...


def require_weights(cost: RunningCost) -> None:
    """Refuse options of a cost that do not fit their types, and weights that are negative.

    Args:
        cost: a dataclass whose numbers are its weights.

    Raises:
        ValueError: if an option is of another type, or a weight is negative or not finite.
    """
    check_options(cost)
    for name, weight in vars(cost).items():
        if isinstance(weight, int | float) and weight < 0.0:
            raise ValueError(f"{name}={weight} of {type(cost).__name__} must not be negative.")
