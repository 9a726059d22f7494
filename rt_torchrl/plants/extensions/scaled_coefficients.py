"""A force that is a share of what the closure says."""

import math

from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extensions.extension import Extension
from rt_torchrl.plants.plant import Plant


class _Scaled(nn.Module):
    """A closure times a gain.

    Args:
        closure: the closure.
        gain: the gain.
    """

    def __init__(self, closure: nn.Module, gain: float):
        super().__init__()
        self.closure, self.gain = closure, gain

    def forward(self, features: Tensor) -> Tensor:
        return self.gain * self.closure(features)


class ScaledCoefficients(Extension):
    """A plant on which a share of its closure's coefficients acts, such as a rotor with losses in its shaft.

    It has no hidden states, and its closure is that of the plant, which can take all of it.

    Args:
        base: the plant, perhaps extended by what has no parameters of its own.
        gain: share of all coefficients.

    Raises:
        ValueError: if the gain is not positive and finite, or the base has parameters of its own.
    """

    def __init__(self, base: Plant, gain: float):
        if not 0.0 < gain < math.inf:
            raise ValueError(f"gain={gain} of the coefficients must be positive and finite.")
        if isinstance(base, Extension) and base.of_base(base.closure) is not base.closure:
            raise ValueError("ScaledCoefficients changes the closure of the plant itself; extend its result.")
        super().__init__(base, [])
        self.gain, self.own_scheme = gain, base.own_scheme

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        action: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        return self.base.vector_field(t, state, action, exogenous, _Scaled(closure, self.gain))

    def advance(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        return self.base.advance(t, state, applied, exogenous, _Scaled(closure, self.gain))
