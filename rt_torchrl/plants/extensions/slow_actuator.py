"""An actuator with a long dead time, as a chain of equal lags."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extensions.actuator_coefficients import ActuatorCoefficients
from rt_torchrl.plants.extensions.extension import Extension, place_of, replaced, settled
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal


class SlowActuator(Extension):
    r"""A plant with an actuator behind n equal lags, each with the time constant D/n.

    .. math:: \frac Dn\dot x_j = x_{j-1} - x_j, \quad j = 1 \dots n, \quad x_0 = a

    The chain is a dead time D whose response rises within some :math:`D/\sqrt n`. Its parameter is continuous, so that
    a twin identifies it. Each stage has its exact solution for the mean of the stage before it over the interval.

    Args:
        base: the plant.
        action: name of the action.
        delay: dead time D of the true system [s].
        stages: number n of lags.

    Raises:
        ValueError: if there is no such action, a dead time is not positive and finite, or there is no stage.
    """

    def __init__(self, base: Plant, action: str, delay: float, *, stages: int = 6):
        if stages < 1:
            raise ValueError(f"stages={stages} of {action} must be at least 1.")
        self.place, self.action, self.stages = place_of(base, action), action, stages
        signal = base.actions[self.place]
        hidden = [
            Signal(symbol=f"{signal.symbol}_{{({k})}}", name=f"{action}_stage_{k}", unit=signal.unit)
            for k in range(1, stages + 1)
        ]
        super().__init__(base, hidden, self._coefficients(delay).requires_grad_(False))

    def _coefficients(self, delay: float) -> ActuatorCoefficients:
        name = f"{self.action}_delay"
        return ActuatorCoefficients({name: "s"}, {name: f"dead time of {self.action}"}, [delay])

    def respond(
        self, hidden: Float[Tensor, "*batch n"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> tuple[Float[Tensor, "*batch n_a"], Float[Tensor, "*batch n"]]:
        delay = closure.get_submodule("own")()[0]
        steps = self.dt * self.stages / delay
        left = torch.exp(-steps)
        share = (1.0 - left) / steps
        mean, ends = applied[..., self.place], []
        for x in hidden.unbind(-1):
            off = x - mean
            ends.append(mean + off * left)
            mean = mean + off * share
        return replaced(applied, self.place, mean), torch.stack(ends, -1)

    def rates(
        self, hidden: Float[Tensor, "*batch n"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> Float[Tensor, "*batch n"]:
        before = torch.cat([applied[..., self.place : self.place + 1], hidden[..., :-1]], -1)
        return (before - hidden) * self.stages / closure.get_submodule("own")()[0]

    def acting(
        self, hidden: Float[Tensor, "*batch n"], applied: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_a"]:
        return replaced(applied, self.place, hidden[..., -1])

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Float[Tensor, "*batch n"]:
        return settled(self.base, self.place, base).unsqueeze(-1).expand(*base.shape[:-1], self.stages)
