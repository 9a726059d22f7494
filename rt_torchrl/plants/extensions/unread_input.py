"""An exogenous input that is in part not read by any sensor."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extensions.extension import Extension, replaced
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal


class UnreadInput(Extension):
    r"""A plant on which more acts than its sensors read, :math:`\bar z = z + \sum_k p_k`, such as gusts beside a mean.

    .. math:: \dot p_k = -\omega_kq_k, \qquad \dot q_k = \omega_kp_k, \qquad p_k(0), q_k(0) \sim N(0, \sigma^2/K)

    Each of the K harmonics is a rotating vector with a random amplitude and phase, so that the sum is stationary with
    the deviation σ. The vectors are hidden states with their exact solution; what acts is held over an interval, as
    every input is.

    Args:
        base: the plant.
        name: name of the input.
        deviation: standard deviation σ of what no sensor reads, in the unit of the input.
        frequencies: angular frequencies ω_k [rad/s].

    Raises:
        ValueError: if there is no such input, the deviation is not positive and finite, or a frequency is not, or there
            is none.
    """

    cosine: Tensor
    sine: Tensor
    frequency: Tensor

    def __init__(self, base: Plant, name: str, deviation: float, frequencies: Sequence[float]):
        names = [signal.name for signal in base.acting_inputs]
        if name not in names:
            raise ValueError(
                f"name={name!r} is no input of plant {base.name!r}; choose one of {', '.join(names) or '(none)'}."
            )
        for argument, values in (("deviation", [deviation]), ("frequencies", frequencies)):
            if not values or not all(0.0 < value < math.inf for value in values):
                raise ValueError(f"{argument}={values} of what no sensor of {name} reads must be positive and finite.")
        self.place, self.deviation = names.index(name), deviation
        unit = base.inputs[self.place].unit
        hidden = [
            Signal(symbol=f"{part}_{{{k}}}", name=f"unread_{name}_{part}_{k}", unit=unit)
            for part in ("p", "q")
            for k in range(len(frequencies))
        ]
        super().__init__(base, hidden)
        turn = torch.tensor(frequencies, dtype=torch.float64)
        self.register_buffer("frequency", turn)
        self.register_buffer("cosine", torch.cos(turn * base.dt))
        self.register_buffer("sine", torch.sin(turn * base.dt))

    def meeting(
        self, hidden: Float[Tensor, "*batch n_x"], exogenous: Float[Tensor, "*#batch n_z"]
    ) -> Float[Tensor, "*batch n_z"]:
        """What sensors read and what they do not."""
        unread = hidden[..., : len(self.frequency)].sum(-1)
        met = exogenous + torch.zeros_like(hidden[..., :1])
        return replaced(met, self.place, met[..., self.place] + unread)

    def respond(
        self, hidden: Float[Tensor, "*batch n_x"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> tuple[Float[Tensor, "*batch n_a"], Float[Tensor, "*batch n_x"]]:
        p, q = hidden.split(len(self.frequency), -1)
        return applied, torch.cat([self.cosine * p - self.sine * q, self.sine * p + self.cosine * q], -1)

    def rates(
        self, hidden: Float[Tensor, "*batch n_x"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> Float[Tensor, "*batch n_x"]:
        p, q = hidden.split(len(self.frequency), -1)
        return torch.cat([-self.frequency * q, self.frequency * p], -1)

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Float[Tensor, "*batch n_x"]:
        """Nothing that is not read, which is the mean."""
        return torch.zeros_like(base[..., :1]).expand(*base.shape[:-1], 2 * len(self.frequency))

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        base = self.base.draw_initial_state(batch, generator)
        n = len(self.frequency)
        drawn = torch.randn(batch, 2 * n, generator=generator, dtype=torch.float64, device=generator.device)
        return torch.cat([base, self.deviation / math.sqrt(n) * drawn], -1)
