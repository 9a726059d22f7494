"""The places of a plant's vectors in an environment's report, and the place where it takes its action."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from rt_torchrl.options import array_of
from rt_torchrl.plants.signal import Signal


def joined(*entries: Tensor) -> Tensor:
    """The entries joined into one vector, one behind the other."""
    return torch.cat(entries, -1)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """The place of a plant's vector in an environment's report; the vector is offset + scale·of(entries).

    Args:
        keys: entries of the environment's TensorDict that are read.
        of: function that makes the vector of these entries. It takes them in the order of ``keys``, in double
            precision, with the features last; by default it joins them. For an angle whose sine and cosine are
            reported, it is an arc tangent.
        scale: one unit of the vector in the plant's units: a number for all signals, or one for each signal.
        offset: value in the plant's units where the vector is zero: a number for all signals, or one for each signal.

    Raises:
        ValueError: if a number of ``scale`` or ``offset`` is not finite.
    """

    keys: tuple[NestedKey, ...] = ("observation",)
    of: Callable[..., Tensor] = joined
    scale: float | Sequence[float] = 1.0
    offset: float | Sequence[float] = 0.0

    def __post_init__(self) -> None:
        require_numbers("reading", scale=self.scale, offset=self.offset)

    def read(self, reported: TensorDictBase, signals: tuple[Signal, ...], what: str) -> Float[Tensor, "1 n"]:
        """The vector in the plant's units.

        Raises:
            ValueError: if :meth:`vector` raises it, or the vector is not finite.
        """
        found = self.vector(reported, signals, what)
        if not found.isfinite().all():
            names = [signal.name for signal in signals]
            raise ValueError(f"{what} {names}, read from {list(self.keys)}, is not finite: {found[0].tolist()}.")
        return found

    def vector(self, reported: TensorDictBase, signals: tuple[Signal, ...], what: str) -> Float[Tensor, "1 n"]:
        """The vector in the plant's units, whatever its values.

        Raises:
            ValueError: if an entry is missing, or the vector does not have the shape of the signals.
        """
        self.require(reported, what)
        found = self.of(*(reported.get(key).double() for key in self.keys))
        names = [signal.name for signal in signals]
        if tuple(found.shape) != (*reported.batch_size, len(signals)):
            raise ValueError(
                f"{what}, read from {list(self.keys)}, has shape {tuple(found.shape)}; the plant needs "
                f"{(*reported.batch_size, len(signals))}, which is {names}: give the reading a function `of` them."
            )
        return in_units(found, self.scale, self.offset).reshape(1, len(signals))

    def require(self, reported: TensorDictBase, what: str) -> None:
        """Refuse a report that lacks an entry that is read.

        Raises:
            ValueError: if an entry is missing; it names the missing entries and those that are there.
        """
        missing = [key for key in self.keys if reported.get(key, None) is None]
        if missing:
            known = sorted(map(str, reported.keys(include_nested=True, leaves_only=True)))
            raise ValueError(f"{what} is read from {missing}, which the environment does not report; it has {known}.")


@dataclass(frozen=True, kw_only=True)
class Actuation:
    """The place where an environment takes its action; the plant's command is offset + scale·action.

    Args:
        key: entry of the environment's TensorDict that takes the action.
        scale: one unit of the environment's action in the plant's units: a number for all actions, or one for each.
        offset: command of the plant where the environment's action is zero: a number for all actions, or one for each.

    Raises:
        ValueError: if a number of ``scale`` or ``offset`` is not finite, or a scale is zero.
    """

    key: NestedKey = "action"
    scale: float | Sequence[float] = 1.0
    offset: float | Sequence[float] = 0.0

    def __post_init__(self) -> None:
        require_numbers("actuation", scale=self.scale, offset=self.offset)
        if not (np.asarray(self.scale) != 0.0).all():
            raise ValueError(f"scale={self.scale} of the actuation must not be zero.")

    def action(self, command: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """The environment's action for a command in the plant's units."""
        scale, offset = (
            torch.as_tensor(x, dtype=torch.float64, device=command.device) for x in (self.scale, self.offset)
        )
        return (command - offset) / scale


def require_numbers(what: str, **values: float | Sequence[float]) -> None:
    """Refuse arguments that are NaN or infinite.

    Args:
        what: object that has these arguments, as the error calls it.
        values: arguments by name.

    Raises:
        ValueError: if an argument is not finite; it names the first one.
    """
    for argument, value in values.items():
        found = array_of(argument, value)
        # A plant may have no inputs, but a reading has numbers.
        if not np.isfinite(found).all() or (found.size == 0 and argument != "exogenous"):
            raise ValueError(f"{argument}={value} of the {what} must be finite: a number, or one for each signal.")


def in_units(values: Tensor, scale: float | Sequence[float], offset: float | Sequence[float]) -> Tensor:
    """offset + scale·values, in double precision."""
    double = partial(torch.as_tensor, dtype=torch.float64, device=values.device)
    return double(offset) + double(scale) * values
