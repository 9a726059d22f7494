"""An actuator that follows its command with a lag of first order."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extensions.actuator_coefficients import ActuatorCoefficients
from rt_torchrl.plants.extensions.extension import Extension, place_of, replaced, settled
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal


class LaggedActuator(Extension):
    r"""A plant with an actuator that follows what it is asked for with a time constant τ.

    .. math:: \tau\dot x = a - x, \qquad x_{k+1} = a_k + (x_k - a_k)e^{-\Delta t/\tau}

    The mean of x over the interval acts on the plant, :math:`\bar a = a_k + (x_k - a_k)(1 - e^{-\Delta t/\tau})
    \tau/\Delta t`. Both are exact for a held a and any τ > 0; a short τ makes the plant that is extended.

    Args:
        base: the plant.
        action: name of the action that lags.
        time_constant: τ of the true system, which a twin identifies [s].

    Raises:
        ValueError: if there is no such action, or a time constant is not positive and finite.
    """

    def __init__(self, base: Plant, action: str, time_constant: float):
        self.place, self.action = place_of(base, action), action
        signal = base.actions[self.place]
        hidden = Signal(symbol=signal.symbol + "'", name=f"lagged_{action}", unit=signal.unit)
        super().__init__(base, [hidden], self._coefficients(time_constant).requires_grad_(False))

    def _coefficients(self, time_constant: float) -> ActuatorCoefficients:
        name = f"{self.action}_lag"
        return ActuatorCoefficients({name: "s"}, {name: f"time constant of {self.action}"}, [time_constant])

    def respond(
        self, hidden: Float[Tensor, "*batch 1"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> tuple[Float[Tensor, "*batch n_a"], Float[Tensor, "*batch 1"]]:
        asked, position = applied[..., self.place], hidden[..., 0]
        steps = self.dt / closure.get_submodule("own")()[0]
        left = torch.exp(-steps)
        mean = asked + (position - asked) * (1.0 - left) / steps
        end = asked + (position - asked) * left
        return replaced(applied, self.place, mean), end.unsqueeze(-1)

    def rates(
        self, hidden: Float[Tensor, "*batch 1"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> Float[Tensor, "*batch 1"]:
        return (applied[..., self.place : self.place + 1] - hidden) / closure.get_submodule("own")()[0]

    def acting(
        self, hidden: Float[Tensor, "*batch 1"], applied: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_a"]:
        return replaced(applied, self.place, hidden[..., 0])

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Float[Tensor, "*batch 1"]:
        return settled(self.base, self.place, base).unsqueeze(-1)
