"""An actuator that does a share of what it is asked for."""

import math

from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extensions.extension import Extension, place_of, replaced
from rt_torchrl.plants.plant import Plant


class ScaledActuator(Extension):
    r"""A plant with an actuator that does :math:`\bar a = ga`, such as one whose supply voltage sags.

    It has no hidden states and no parameters that a twin identifies. What it does is not kept within the range of the
    action, because the range is that of what it is asked for.

    Args:
        base: the plant.
        action: name of the action.
        gain: gain g.

    Raises:
        ValueError: if there is no such action, or the gain is not positive and finite.
    """

    def __init__(self, base: Plant, action: str, gain: float):
        self.place, self.gain = place_of(base, action), gain
        if not 0.0 < gain < math.inf:
            raise ValueError(f"gain={gain} of {action} must be positive and finite, such as 0.95 for a loss of 5 %.")
        super().__init__(base, [])

    def respond(
        self, hidden: Float[Tensor, "*batch 0"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> tuple[Float[Tensor, "*batch n_a"], Float[Tensor, "*batch 0"]]:
        return self.acting(hidden, applied), hidden

    def acting(
        self, hidden: Float[Tensor, "*batch 0"], applied: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_a"]:
        return replaced(applied, self.place, self.gain * applied[..., self.place])
