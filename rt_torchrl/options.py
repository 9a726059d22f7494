"""Checks the options of a configuration against the types that its class declares."""

import dataclasses
import math
import numbers
import types
import typing
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np


def check_options(config: object, *, infinite: Sequence[str] = ()) -> None:
    """Refuse options whose values do not fit the types that their configuration declares.

    A dataclass does not check its types itself. This function checks every field that is declared as a ``Literal``, a
    number, a truth value, a text, a path or another configuration, or an optional or a tuple of these. It leaves other
    fields alone. A configuration calls it first in its ``__post_init__``, before the checks of its own ranges, which a
    nan would pass.

    Args:
        config: an instance of a dataclass.
        infinite: names of the fields that may be infinite; all other numbers are finite.

    Raises:
        ValueError: if a value does not fit; the message names the option, its value, and what is allowed.
    """
    config_class: type = type(config)
    for name, kind in _kinds(config_class).items():
        _check(name, getattr(config, name), kind, finite=name not in infinite)


def with_paths(config: object) -> None:
    """Make paths of the texts that stand for paths in a configuration, which may be frozen.

    Args:
        config: an instance of a dataclass, in its ``__post_init__``.
    """
    config_class: type = type(config)
    for name, kind in _kinds(config_class).items():
        if isinstance(getattr(config, name), str) and Path in (kind, *typing.get_args(kind)):
            object.__setattr__(config, name, Path(getattr(config, name)))


def require_widths(name: str, widths: Sequence[int]) -> None:
    """Refuse a hidden layer without units.

    Args:
        name: name of the option, for the message.
        widths: widths of the hidden layers.

    Raises:
        ValueError: if a width is below 1.
    """
    if any(width < 1 for width in widths):
        raise ValueError(f"{name}={tuple(widths)} must hold widths of layers, each at least 1.")


def choices(config_class: type, name: str) -> tuple[Any, ...]:
    """The values that a field declared as a ``Literal`` can have; none for any other field."""
    kind = _kinds(config_class)[name]
    return typing.get_args(kind) if typing.get_origin(kind) is Literal else ()


@cache
def _kinds(config_class: type) -> dict[str, Any]:
    hints = typing.get_type_hints(config_class)
    return {field.name: hints[field.name] for field in dataclasses.fields(config_class)}


def _check(name: str, value: Any, kind: Any, *, finite: bool) -> None:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value not in arguments:
            raise ValueError(f"{name}={value!r} does not exist; choose {_listed(arguments)}.")
    elif origin in (typing.Union, types.UnionType):
        others = [argument for argument in arguments if argument is not type(None)]
        if len(others) == 1 and (value is not None or len(others) == len(arguments)):
            _check(name, value, others[0], finite=finite)
    elif origin in (tuple, Sequence):
        _check_length(name, value, arguments if origin is tuple else (*arguments, Ellipsis))
        kinds = arguments if origin is tuple and arguments[-1] is not Ellipsis else arguments[:1] * len(value)
        for place, (entry, each) in enumerate(zip(value, kinds, strict=False)):
            _check(f"{name}[{place}]", entry, each, finite=finite)
    elif kind in (int, float):
        _check_number(name, value, kind, finite=finite)
    elif kind in PLAIN and not isinstance(value, (str, Path) if kind is str else kind):
        raise ValueError(f"{name}={value!r} must be {PLAIN[kind]}.")
    elif dataclasses.is_dataclass(kind) and not isinstance(value, typing.cast(type, kind)):
        raise ValueError(f"{name}={value!r} must be a {typing.cast(type, kind).__name__}.")


def _check_number(name: str, value: Any, kind: type, *, finite: bool) -> None:
    if kind is int and not _is(value, numbers.Integral):
        raise ValueError(f"{name}={value!r} must be a whole number.")
    if kind is float and not _is(value, numbers.Real):
        raise ValueError(f"{name}={value!r} must be a number.")
    if kind is float and (math.isnan(value) or (finite and math.isinf(value))):
        raise ValueError(f"{name}={value} must be {'a finite number' if finite else 'a number or infinite'}.")


PLAIN = {bool: "True or False", str: "a text", Path: "a path"}
"""Kinds of values that have no range, with the words for them in errors."""


def _check_length(name: str, value: Any, arguments: tuple[Any, ...]) -> None:
    """Refuse what is no tuple, or has another number of entries than its declaration."""
    if not isinstance(value, (tuple, list)):
        raise ValueError(f"{name}={value!r} must be a tuple.")
    if arguments[-1:] != (Ellipsis,) and len(value) != len(arguments):
        raise ValueError(f"{name}={value!r} must have {len(arguments)} entries.")


def require_number(name: str, value: Any, *, whole: bool = False, finite: bool = True) -> None:
    """Refuse a value that is no number, as :func:`check_options` does for an option.

    Args:
        name: name of the argument, for the message.
        value: value of the argument.
        whole: whether the number must be a whole one.
        finite: whether it must be finite; NaN is never a number.

    Raises:
        ValueError: if the value is something else.
    """
    _check(name, value, int if whole else float, finite=finite)


OTHER_UNITS = {
    "-": "16 % is 0.16",
    "s": "1 ms is 0.001 s, 1 h is 3600 s",
    "m": "1 mm is 0.001 m",
    "m³": "1 L is 0.001 m³",
    "m/s": "1 km/h is 0.278 m/s",
    "kg": "1 g is 0.001 kg",
    "K": "0 °C is 273.15 K, 1 mK is 0.001 K",
    "Pa": "1 kPa is 1000 Pa",
    "W": "1 kW is 1000 W, 1 mW is 0.001 W",
    "N m": "1 kN m is 1000 N m",
    "N m/s": "1 kN m/s is 1000 N m/s",
    "rad": "1 deg is 0.0175 rad",
    "deg": "1 rad is 57.3 deg",
    "rad/s": "1 rpm is 0.105 rad/s, 1 deg/s is 0.0175 rad/s",
    "deg/s": "1 rad/s is 57.3 deg/s",
}
"""For a unit, what others are in it."""


def require_range(name: str, value: float, least: float, greatest: float, *, unit: str, of: str) -> None:
    """Refuse a number beyond what is physically possible, which in most cases is in another unit.

    Args:
        name: name of the argument, for the message.
        value: value of the argument.
        least: least possible value.
        greatest: greatest possible value.
        unit: unit of the argument.
        of: what has the argument.

    Raises:
        ValueError: if the value lies outside, or is NaN.
    """
    require_number(name, value, finite=False)
    if not least <= value <= greatest:
        raise ValueError(
            f"{name}={value:g} {unit} of {of} must lie in {least:g} to {greatest:g} {unit}; check its unit"
            f"{f': {OTHER_UNITS[unit]}' if unit in OTHER_UNITS else ''}."
        )


def array_of(name: str, values: Any) -> np.ndarray:
    """The values as an array in double precision.

    Args:
        name: name of the argument, for the message.
        values: numbers in an array or in nested sequences.

    Raises:
        ValueError: if they are no numbers, or the rows differ in length.
    """
    try:
        found = np.asarray(values)
        if found.dtype.kind not in "fiu" and found.size:
            raise ValueError(f"its entries are of type {found.dtype}")
        return found.astype(np.float64)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name} must be an array of numbers: {error}.") from error


def quoted(names: Iterable[str]) -> str:
    """Names in quotes, because some contain commas."""
    return ", ".join(repr(name) for name in names)


def _is(value: Any, kind: type) -> bool:
    """Whether a value is a number of that kind; a truth value is none, although Python counts it as one."""
    return isinstance(value, kind) and not isinstance(value, bool)


def _listed(values: Sequence[Any]) -> str:
    *others, last = map(str, values)
    return f"{', '.join(others)} or {last}" if others else last
