r"""Signals of a plant: symbol, unit and range; measurements, of which a policy observes some; bounds on states.

An observation is a measurement y from an offset, in units of a scale, so that it is of order one: :math:`(y - o)/c`.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.options import require_number
from rt_torchrl.plants.sampling import whole_multiple

Values = TypeVar("Values", Tensor, np.ndarray)


@dataclass(frozen=True, kw_only=True)
class Signal:
    r"""A component of a state, action, exogenous input or observation.

    Args:
        symbol: letter in formulas, as matplotlib mathtext without the dollars (``r"\omega_r"``).
        name: word in interfaces, a valid identifier (``"rotor_speed"``).
        unit: SI unit, or the unit a correlation is defined in (``"rad/s"``, ``"deg"``, ``"-"``).
        low: least admissible value in ``unit``.
        high: greatest admissible value in ``unit``.
        periodic: whether the range is one turn of a state such as an angle, so that ``low`` and ``high`` are the same
            place.

    Raises:
        ValueError: if the name is no identifier, the range is empty, or a periodic signal has no finite range.
    """

    symbol: str
    name: str
    unit: str
    low: float = -math.inf
    high: float = math.inf
    periodic: bool = False

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"Signal name={self.name!r} must be an identifier such as 'rotor_speed'; rename it.")
        for end in ("low", "high"):
            require_number(end, getattr(self, end), finite=False)
        if not self.low < self.high or (self.periodic and math.isinf(self.period)):
            raise ValueError(
                f"Signal {self.name!r} has low={self.low}, high={self.high} [{self.unit}]; low must be below high, and "
                "both finite, one turn apart, if it is periodic."
            )

    @property
    def period(self) -> float:
        """One turn of a periodic signal, in ``unit``."""
        return self.high - self.low

    def wrapped(self, values: Values) -> Values:
        """The values, moved into the range by whole turns if the signal is periodic."""
        return self.low + (values - self.low) % self.period if self.periodic else values

    def short_way(self, change: Values) -> Values:
        """The change, reduced to at most half a turn either way if the signal is periodic."""
        return (change + 0.5 * self.period) % self.period - 0.5 * self.period if self.periodic else change

    @property
    def label(self) -> str:
        r"""Axis label, such as ``rotor speed $\omega_r$ [rad/s]``."""
        return f"{self.name.replace('_', ' ')} ${self.symbol}$ [{self.unit}]"


def place_of(argument: str, name: str, signals: Sequence[Signal], plant: str) -> int:
    """Place of the signal of a name.

    Args:
        argument: name of the argument, for the message.
        name: name of the signal.
        signals: the signals to choose among.
        plant: name of their plant, for the message.

    Raises:
        ValueError: if there is no such signal.
    """
    names = [signal.name for signal in signals]
    if name not in names:
        known = ", ".join(names) or "(none)"
        raise ValueError(f"{argument}={name!r} of plant {plant!r} does not exist; choose one of {known}.")
    return names.index(name)


def differences(
    signals: Sequence[Signal], first: Float[Tensor, "*batch n"], second: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch n"]:
    """The differences ``first`` − ``second``, taken the short way round where a signal is periodic."""
    changes = (first - second).unbind(-1)
    return torch.stack([signal.short_way(change) for signal, change in zip(signals, changes, strict=True)], -1)


def bounds(
    signals: Sequence[Signal], *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Least and greatest admissible values of the signals, in their units."""
    low, high = (
        torch.tensor([getattr(signal, end) for signal in signals], dtype=dtype, device=device)
        for end in ("low", "high")
    )
    return low, high


Read = Callable[[Any, Tensor, Tensor, Tensor], Tensor]
"""Computes a measurement of plant, time [s], state and exogenous input, in the shape of ``state[..., 0]`` or broadcast
to it: any such function will do."""


@dataclass(frozen=True)
class Named:
    """Reads the state or the exogenous input of a name.

    Args:
        name: name of its signal.
    """

    name: str

    def __call__(self, plant: Any, t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
        place = place_of("measurement", self.name, (*plant.states, *plant.acting_inputs), plant.name)
        return state[..., place] if place < len(plant.states) else exogenous[..., place - len(plant.states)]


def state_read(read: Read, states: Sequence[Signal]) -> int | None:
    """Place of the state that is read as it is; None for what is computed of several, or is no state."""
    names = [signal.name for signal in states]
    return names.index(read.name) if isinstance(read, Named) and read.name in names else None


@dataclass(frozen=True)
class Phase:
    r"""Reads the phase of something that recurs, such as the time of the day: :math:`\cos 2\pi t/T` or the sine.

    Cosine and sine together tell the phase without a jump.

    Args:
        of: cosine or sine.
        period: length T of a turn [s].

    Raises:
        ValueError: if ``of`` is something else, or the period is not positive and finite.
    """

    of: Literal["cosine", "sine"]
    period: float

    def __post_init__(self) -> None:
        if self.of not in ("cosine", "sine") or not 0.0 < self.period < math.inf:
            raise ValueError(
                f"of={self.of!r} of a Phase must be cosine or sine, and period={self.period} s positive and finite."
            )

    def __call__(self, plant: Any, t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
        turn = 2.0 * math.pi / self.period * t
        return torch.cos(turn) if self.of == "cosine" else torch.sin(turn)


@dataclass(frozen=True)
class Preview:
    """Reads an exogenous input that is to come, such as the wind that a lidar measures ahead of the rotor.

    A plant that is asked for a preview has one more exogenous input for it, which :meth:`Plant.with_previews` computes
    of the whole series.

    Args:
        index: place of the input among the inputs that act on the plant.
        lead: time ahead [s].
    """

    index: int
    lead: float

    def __call__(self, plant: Any, t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
        return exogenous[..., len(plant.acting_inputs) + plant.previews.index(self)]

    def shifted(self, exogenous: Float[Tensor, "*batch n n_b"], dt: float) -> Float[Tensor, "*batch n"]:
        """The input ``lead`` later; beyond the end of the series, its last value.

        Raises:
            ValueError: if the time ahead is no whole number of control intervals ``dt`` [s].
        """
        steps, series = whole_multiple("lead of a preview", self.lead, dt), exogenous[..., self.index]
        held = series[..., -1:].expand(*series.shape[:-1], min(steps, series.shape[-1]))
        return torch.cat([series[..., steps:], held], -1)


@dataclass(frozen=True, kw_only=True)
class Measurement(Signal):
    """A signal that the sensors of a plant give.

    Args:
        read: function ``read(plant, t, state, exogenous)`` that computes the value, in ``unit``.
        offset: value that a policy observes as zero, in ``unit``.
        scale: change that a policy observes as one, in ``unit``.

    Raises:
        ValueError: if the scale is not positive, or the offset not finite.
    """

    read: Read
    offset: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.scale > 0.0 and math.isfinite(self.scale) and math.isfinite(self.offset)):
            raise ValueError(
                f"Measurement {self.name!r} has offset={self.offset} and scale={self.scale} {self.unit}; the scale "
                "must be positive, and both finite."
            )

    @classmethod
    def of(cls, signal: Signal, read: Read | None = None, *, offset: float = 0.0, scale: float = 1.0) -> "Measurement":
        """The measurement of a state or an exogenous input.

        Args:
            signal: signal of the state or input.
            read: what reads it; None for the state or input of the signal's name.
            offset: value that a policy observes as zero, in the signal's unit.
            scale: change that a policy observes as one, in the signal's unit.
        """
        read = Named(signal.name) if read is None else read
        return cls(**dataclasses.asdict(signal), read=read, offset=offset, scale=scale)

    @property
    def signal(self) -> Signal:
        """The signal alone."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(Signal)}
        return Signal(**fields)

    @property
    def observation(self) -> Signal:
        """What a policy observes of it."""
        low, high = ((bound - self.offset) / self.scale for bound in (self.low, self.high))
        return Signal(symbol=self.symbol, name=self.name, unit="-", low=low, high=high)

    @property
    def scaling(self) -> str:
        """The observation in words; empty if the measurement is observed as it is."""
        if (self.offset, self.scale) == (0.0, 1.0):
            return ""
        return f"({self.name} - {self.offset:.9g} {self.unit}) / {self.scale:.9g} {self.unit}"


class StateBounds:
    """Least and greatest values of some states that sensors read, and by how much trajectories leave them.

    Args:
        readings: the states that sensors read.
        states: least and greatest value of each bounded state, by name, in its unit; infinite for no bound.

    Raises:
        ValueError: if there is no such state.
    """

    def __init__(self, readings: Sequence[Signal], states: Mapping[str, tuple[float, float]]):
        places = {signal.name: k for k, signal in enumerate(readings)}
        unknown = sorted(set(states) - set(places))
        if unknown:
            raise ValueError(f"bounded states {', '.join(unknown)} do not exist; the plant has {', '.join(places)}.")
        self._bounded = [(places[name], readings[places[name]], *ends) for name, ends in states.items()]

    def merit(self, states: Float[Tensor, "batch samples n_s"]) -> dict[str, Float[Tensor, " batch"]]:
        """How often each state is beyond its bounds, and how far at most, in each of some episodes."""
        merits: dict[str, Tensor] = {}
        for place, signal, low, high in self._bounded:
            values = states[:, 1:, place]
            excess = torch.relu(torch.maximum(low - values, values - high))
            merits[f"{signal.name} outside [%]"] = 100.0 * (excess > 0.0).double().mean(-1)
            merits[f"{signal.name} beyond [{signal.unit}]"] = excess.amax(-1)
        return merits
