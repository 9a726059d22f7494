"""An actuator that acts some time after it is asked."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extensions.extension import Extension, place_of, replaced, settled
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

LONGEST = 64
"""Greatest number of control intervals of a delay: each is a hidden state, which every engine carries along."""


class DelayedActuator(Extension):
    r"""A plant with an actuator that does in each interval what it was asked for n intervals ago.

    .. math:: \bar a_k = a_{k-n}

    The hidden states are the n actions under way, the oldest first.

    Args:
        base: the plant.
        action: name of the action.
        delay: dead time [s], a whole number n of control intervals, 1 to 64.

    Raises:
        ValueError: if there is no such action, or the delay is out of its range.
    """

    def __init__(self, base: Plant, action: str, delay: float):
        place, n = place_of(base, action), round(delay / base.dt)
        if not (1 <= n <= LONGEST and math.isclose(n * base.dt, delay, rel_tol=1e-9)):
            raise ValueError(
                f"delay={delay} s of {action} must be 1 to {LONGEST} control intervals of {base.dt:g} s; approximate a "
                "longer one by SlowActuator."
            )
        signal = base.actions[place]
        super().__init__(
            base,
            [
                Signal(symbol=f"{signal.symbol}_{{-{k}}}", name=f"{action}_{k}_ago", unit=signal.unit)
                for k in range(n, 0, -1)
            ],
        )
        self.place = place

    def respond(
        self, hidden: Float[Tensor, "*batch n"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> tuple[Float[Tensor, "*batch n_a"], Float[Tensor, "*batch n"]]:
        under_way = torch.cat([hidden[..., 1:], applied[..., self.place : self.place + 1]], -1)
        return self.acting(hidden, applied), under_way

    def rates(
        self, hidden: Float[Tensor, "*batch n"], applied: Float[Tensor, "*batch n_a"], closure: nn.Module
    ) -> Float[Tensor, "*batch n"]:
        """The mean rates over an interval: a dead time has no differential equation."""
        return (self.respond(hidden, applied, closure)[1] - hidden) / self.dt

    def acting(
        self, hidden: Float[Tensor, "*batch n"], applied: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_a"]:
        return replaced(applied, self.place, hidden[..., 0])

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Float[Tensor, "*batch n"]:
        n = len(self.states) - len(self.base.states)
        return settled(self.base, self.place, base).unsqueeze(-1).expand(*base.shape[:-1], n)
