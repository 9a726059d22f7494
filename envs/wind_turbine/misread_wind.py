"""A turbine whose anemometer reads too much or too little."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extension import Extension, replaced
from rt_torchrl.plants.plant import Plant


class MisreadWind(Extension):
    r"""A turbine in a wind u of which the anemometer reads gu.

    The exogenous input of the extended plant is what the anemometer *reads*: records, previews and the filtered wind
    speed, which the controller computes, and with it the reference speed of the cost, hold the reading. The rotor turns
    in u.

    Args:
        base: the turbine, perhaps extended, whose state 2 is the filtered wind speed.
        gain: gain g of the anemometer.
        cutoff: angular frequency of the filter of the wind speed [rad/s].

    Raises:
        ValueError: if the gain is not positive and finite, or the turbine does not step by its vector field.
    """

    def __init__(self, base: Plant, gain: float, *, cutoff: float):
        if not 0.0 < gain < math.inf:
            raise ValueError(f"gain={gain} of the anemometer must be positive and finite.")
        if base.own_scheme:
            raise ValueError("MisreadWind integrates the vector field; extend its result by actuators, not its base.")
        super().__init__(base, [])
        self.gain, self.cutoff = gain, cutoff

    advance = Plant.advance

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        action: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        read = exogenous[..., 0]
        true = read / self.gain
        field = self.base.vector_field(t, state, action, replaced(exogenous, 0, true), closure)
        return replaced(field, 2, field[..., 2] + self.cutoff * (read - true))

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        """The filtered wind speed starts at what the anemometer reads of the mean wind."""
        state = self.base.draw_initial_state(batch, generator)
        return replaced(state, 2, self.gain * state[..., 2])

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps n_z"]:
        """What the anemometer reads, which is never below its least reading, and the lidar with the same gain."""
        read = self.gain * self.base.draw_exogenous(batch, generator)
        return read.clamp(min=self.inputs[0].low)
