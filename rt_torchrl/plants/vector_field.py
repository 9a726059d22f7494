"""What may be beside a vector field: coefficients that act in part, and rates that a network adds."""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from rt_torchrl.options import quoted
from rt_torchrl.plants.closures import BoundedPerceptron
from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Action, Input, State, Time
from rt_torchrl.plants.signal import Signal, place_of

Range = tuple[float, float]


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

    def law(self, closure: nn.Module) -> nn.Module:
        return _Scaled(closure, self.gain)


class ResidualRates(BoundedPerceptron):
    """The network of a :class:`NeuralResidual`, whose rates are zero at first; its weights have no names."""


class NeuralResidual(Extension):
    r"""A plant with a network N in its vector field, which stands for forces or flows of a form that nobody knows.

    .. math:: \dot s_i = f_i(t, s, a, z, g(s; w_p)) + r_i c_i\tanh N_i(\hat x; w)

    It begins as the plant itself, because the last layer of N is zero at first, and no rate is ever off by more than
    r_i c_i. A plant that takes a Runge-Kutta step of its vector field takes one of the sum. The scheme of another
    plant, such as an extension with hidden states, acts between two halves of the network's own step, each by the
    midpoint rule (Strang splitting, second order).

    An angle, which is periodic, reaches the network as its cosine and sine. A name that an action shares with a state
    means the action. Hypotheses hold the weights w near their first values; see ``docs/hypotheses.md``.

    Args:
        base: the plant.
        greatest: greatest residual r_i of each state that has one, in units of :attr:`Plant.state_sizes` per second, by
            name of the state; the sizes c_i are ones in a plant that gives none.
        inputs: names of the states, actions and inputs of which N is a function.
        ranges: range of each of them that has no finite one of its own, by name; it does not limit the signal.
        hidden: width of each hidden layer of N.
        seed: seed of the first weights of N.

    Raises:
        ValueError: if a name does not exist, a residual is not positive and finite, a range is missing or empty, or a
            state is computed by the controller or read by no sensor.
    """

    def __init__(
        self,
        base: Plant,
        greatest: Mapping[str, float],
        *,
        inputs: Sequence[str],
        ranges: Mapping[str, Range] | None = None,
        hidden: Sequence[int] = (8,),
        seed: int = 0,
    ):
        if not greatest or not inputs:
            raise ValueError(
                f"greatest={dict(greatest)} and inputs={tuple(inputs)} must name a signal of the plant each."
            )
        bounds, known = _bounds(base, greatest), (*base.actions, *base.states, *base.acting_inputs)
        places = [place_of("inputs", name, known, base.name) for name in inputs]
        signals, limits = [(place, known[place]) for place in places], dict(ranges or {})
        spare = [name for name in limits if name not in inputs]
        if spare:
            raise ValueError(f"ranges: {quoted(spare)} are not among inputs={tuple(inputs)}; leave them out.")
        scaled: list[Range] = []
        for name, (_, signal) in zip(inputs, signals, strict=True):
            scaled += _scaled(signal, limits.get(name))
        network = ResidualRates(scaled, bounds, hidden=hidden, generator=torch.Generator().manual_seed(seed))
        super().__init__(base, [], network)
        self._inputs = signals
        names = list(greatest)
        self._rates = [names.index(s.name) if s.name in names else None for s in base.states]

    @property
    def own_scheme(self) -> bool:
        return self.base.own_scheme

    def residual(self, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        """What the network adds to the rates of all states [state unit / s]."""
        inputs = exogenous + torch.zeros_like(state[..., :1])
        values, features = torch.cat([action, state, inputs], -1), []
        for place, signal in self._inputs:
            value = values[..., place]
            if signal.periodic:
                phase = (2.0 * math.pi / signal.period) * value
                features += [torch.cos(phase), torch.sin(phase)]
            else:
                features.append(value)
        rates, zero = closure.get_submodule("own")(torch.stack(features, -1)), torch.zeros_like(state[..., 0])
        return torch.stack([zero if k is None else rates[..., k] for k in self._rates], -1)

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        field = self.base.vector_field(t, state, action, exogenous, self.of_base(closure))
        return field + self.residual(state, action, exogenous, closure)

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        """One Runge-Kutta step of the sum, or the plant's own scheme between two halves of the residual's step."""
        if not self.own_scheme:
            return Plant.advance(self, t, state, applied, exogenous, closure)
        half = 0.5 * self.dt

        def pushed(s: Tensor) -> Tensor:
            middle = s + 0.5 * half * self.residual(s, applied, exogenous, closure)
            return s + half * self.residual(middle, applied, exogenous, closure)

        return pushed(self.base.advance(t, pushed(state), applied, exogenous, self.of_base(closure)))


def _bounds(base: Plant, greatest: Mapping[str, float]) -> list[float]:
    """Greatest residual of each state that has one [state unit / s]."""
    read, inner = [s for s in base.readings if s.name not in base.controller_states], base.innermost
    sizes = dict(zip((state.name for state in inner.states), inner.state_sizes, strict=False))
    for name in greatest:
        place_of("greatest", name, read, base.name)  # which refuses what no sensor reads, or a controller computes
    return [value * sizes.get(name, 1.0) for name, value in greatest.items()]


def _scaled(signal: Signal, limits: Range | None) -> list[Range]:
    """Ranges of the features that a signal becomes."""
    if signal.periodic:
        return [(-1.0, 1.0), (-1.0, 1.0)]
    low, high = limits or (signal.low, signal.high)
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(
            f"{signal.name!r} of the residual goes from {low} to {high} {signal.unit}; give "
            f"ranges={{{signal.name!r}: (low, high)}} with finite numbers, low below high."
        )
    return [(low, high)]
