"""An actuator of second order, which overshoots."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extensions.actuator_coefficients import ActuatorCoefficients
from rt_torchrl.plants.extensions.extension import Extension, place_of, replaced, settled
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal


class ResonantActuator(Extension):
    r"""A plant with an actuator that follows what it is asked for as an underdamped oscillator.

    .. math:: \ddot x + 2\zeta\omega\dot x + \omega^2x = \omega^2a, \qquad \zeta = \frac{d}{1 + d} < 1

    Between samples x has its exact solution for a held a. Its mean over the interval acts on the plant; the integral of
    the equation over Δt gives it, :math:`\bar a = a - (\Delta\dot x + 2\zeta\omega\Delta x)/(\omega^2\Delta t)`.

    Args:
        base: the plant.
        action: name of the action.
        frequency: natural frequency ω of the true system [rad/s].
        damping: damping ratio ζ of the true system [-], in (0, 1).

    Raises:
        ValueError: if there is no such action, ω is not positive and finite, or ζ is out of its range.
    """

    def __init__(self, base: Plant, action: str, frequency: float, damping: float):
        self.place, self.action = place_of(base, action), action
        signal = base.actions[self.place]
        position = Signal(symbol=signal.symbol + "'", name=f"resonant_{action}", unit=signal.unit)
        rate = Signal(symbol=rf"\dot{{{signal.symbol}}}'", name=f"rate_of_{action}", unit=f"{signal.unit}/s")
        super().__init__(base, [position, rate], self._coefficients(frequency, damping).requires_grad_(False))

    def _coefficients(self, frequency: float, damping: float) -> ActuatorCoefficients:
        if not 0.0 < damping < 1.0:
            raise ValueError(f"damping={damping} of {self.action} must lie in (0, 1); use LaggedActuator beyond.")
        names = {f"{self.action}_frequency": "rad/s", f"{self.action}_damping_odds": "-"}
        meanings = dict(zip(names, (f"natural frequency of {self.action}", "zeta/(1 - zeta) of it"), strict=True))
        return ActuatorCoefficients(names, meanings, [frequency, damping / (1.0 - damping)])

    def respond(
        self, hidden: Float[Tensor, "*batch 2"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> tuple[Float[Tensor, "*batch n_a"], Float[Tensor, "*batch 2"]]:
        asked, (x, v) = applied[..., self.place], hidden.unbind(-1)
        omega, odds = closure.get_submodule("own")().unbind()
        zeta = odds / (1.0 + odds)
        decay, ringing = zeta * omega, omega * torch.sqrt(1.0 - zeta * zeta)
        left, turn = torch.exp(-decay * self.dt), ringing * self.dt
        cosine, sine = left * torch.cos(turn), left * torch.sin(turn) / ringing
        off = x - asked
        end = off * (cosine + decay * sine) + v * sine
        rate = v * (cosine - decay * sine) - omega * omega * off * sine
        mean = asked - (rate - v + 2.0 * decay * (end - off)) / (omega * omega * self.dt)
        return replaced(applied, self.place, mean), torch.stack([asked + end, rate], -1)

    def rates(
        self, hidden: Float[Tensor, "*batch 2"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> Float[Tensor, "*batch 2"]:
        x, v = hidden.unbind(-1)
        omega, odds = closure.get_submodule("own")().unbind()
        zeta = odds / (1.0 + odds)
        pull = omega * omega * (applied[..., self.place] - x)
        return torch.stack([v, pull - 2.0 * zeta * omega * v], -1)

    def acting(
        self, hidden: Float[Tensor, "*batch 2"], applied: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_a"]:
        return replaced(applied, self.place, hidden[..., 0])

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Float[Tensor, "*batch 2"]:
        position = settled(self.base, self.place, base)
        return torch.stack([position, torch.zeros_like(position)], -1)
