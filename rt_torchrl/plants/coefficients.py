"""Coefficients of a plant's closure that reach the system late, or as a share."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.closures import FACTOR, PositiveCoefficients
from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Action, Hidden, Input, State, Time
from rt_torchrl.plants.signal import Signal


class _Lagging(nn.Module):
    """The coefficients of a closure as the lag leaves them in one interval; it keeps what the closure said.

    Args:
        closure: the closure.
        held: lagged coefficients at the start of the interval.
        share: share of the way from the closure's to the lagged ones that is left, as a mean over the interval.
    """

    def __init__(self, closure: nn.Module, held: Tensor, share: Tensor):
        super().__init__()
        self.closure, self._held, self._share = closure, held, share
        self.said: list[Tensor] = []

    def forward(self, features: Tensor) -> Tensor:
        now = self.closure(features)
        if now.shape != self._held.shape:
            raise ValueError(
                f"the closure gives coefficients of shape {tuple(now.shape)} where {tuple(self._held.shape)} lag; say "
                "by elements at how many places of each state the plant evaluates its closure."
            )
        self.said.append(now)
        return now + (self._held - now) * self._share


class LaggedCoefficients(Extension):
    r"""A plant whose closure's coefficients reach the system with a time constant τ, such as a rotor's inflow.

    .. math:: \tau\dot c = g(s) - c

    The mean of c over the interval, for a g that is held at its mean over the stages of the step, acts in the place of
    g. A short τ makes the plant that is extended.

    Args:
        base: the plant.
        time_constant: τ of the true system [s].
        start: coefficients c at the start of an episode, of all places in turn.
        elements: shape of the places at which the plant evaluates its closure in one call for each state, such as the
            blade elements of a wing; by default it is evaluated once for each state.

    Raises:
        ValueError: if a time constant is not positive and finite, ``start`` does not hold as many coefficients for each
            place, or the base is an extension.
    """

    initial: Tensor

    def __init__(self, base: Plant, time_constant: float, start: tuple[float, ...], *, elements: tuple[int, ...] = ()):
        if isinstance(base, Extension):
            raise ValueError(
                "LaggedCoefficients changes the closure of the plant itself; extend its result, not its base."
            )
        places = math.prod(elements)
        if not start or len(start) % places:
            raise ValueError(
                f"start holds {len(start)} coefficients; it must hold as many for each of {places} places."
            )
        hidden = [Signal(symbol=f"c_{k}", name=f"lagged_coefficient_{k}", unit="-") for k in range(len(start))]
        names, meanings = {"force_lag": "s"}, {"force_lag": "time constant of the force"}
        own = PositiveCoefficients([time_constant], names=names, meanings=meanings, factor=FACTOR)
        super().__init__(base, hidden, own)
        self._shape = (*elements, len(start) // places)
        self.register_buffer("initial", torch.tensor(start, dtype=torch.float64))

    def _at_places(self, held: Hidden) -> Float[Tensor, "..."]:
        """The hidden states in the shape of what the closure gives."""
        return held.reshape(*held.shape[:-1], *self._shape)

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        base, held = self.split(state)
        lagging = _Lagging(self.of_base(closure), self._at_places(held), torch.ones_like(self.initial[0]))
        field = self.base.vector_field(t, base, action, exogenous, lagging)
        said = lagging.said[0].reshape(held.shape)
        return torch.cat([field, (said - held) / self.coefficients(closure)[0]], -1)

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        base, held = self.split(state)
        steps = self.dt / self.coefficients(closure)[0]
        left = torch.exp(-steps)
        lagging = _Lagging(self.of_base(closure), self._at_places(held), (1.0 - left) / steps)
        end = self.base.advance(t, base, applied, exogenous, lagging)
        mean = torch.stack(lagging.said).mean(0).reshape(held.shape)
        return torch.cat([end, mean + (held - mean) * left], -1)

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Hidden:
        return self.initial.expand(*base.shape[:-1], len(self.initial))


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
        self.gain = gain

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        return self.base.vector_field(t, state, action, exogenous, _Scaled(closure, self.gain))

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        return self.base.advance(t, state, applied, exogenous, _Scaled(closure, self.gain))
