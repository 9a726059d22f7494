"""Classes of options, whose declarations say what is allowed, and checks of arguments."""

import dataclasses
import functools
import inspect
import json
import math
import numbers
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import pydantic
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError
from typing_extensions import dataclass_transform

Options = TypeVar("Options")


def _no_nan(value: float) -> float:
    if math.isnan(value):
        raise PydanticCustomError("nan", "Input should be a number or infinite")
    return value


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=0)]
AtLeastOne = Annotated[int, Field(ge=1)]
Limit = Annotated[float, Field(gt=0, allow_inf_nan=True)]
"""A positive number, or infinity for no limit."""
Unbounded = Annotated[float, Field(allow_inf_nan=True), AfterValidator(_no_nan)]
"""A number, or infinity in either direction."""
Widths = Annotated[tuple[AtLeastOne, ...], Field(strict=False)]
"""Widths of hidden layers."""
File = Annotated[Path, Field(strict=False)]
"""A path, for which a text may stand."""
Text = Annotated[str, BeforeValidator(lambda value: str(value) if isinstance(value, Path) else value)]
"""A text, for which a path may stand."""

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
"""No option beside those that are declared; no text or truth value for a number; finite numbers, if nothing else."""


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(dataclasses.field,))
def configuration(options: type[Options]) -> type[Options]:
    """Make a frozen dataclass of a class, whose options are checked against what it declares.

    The declarations are those of pydantic: ``Annotated[int, Field(ge=1)]``, or :data:`AtLeastOne` for it. A command
    line and ``config.json`` are read by the same declarations. What concerns several options is checked in
    ``__post_init__``, which raises a ``ValueError``. A class that derives from one of options is decorated, too; an
    option that it declares anew by the bare type, such as ``episodes: int = 6``, keeps what its base allows.

    Args:
        options: class with an annotation for each option.

    Raises:
        ValueError: when an instance is made, if an option does not exist, or a value is not allowed; the message names
            the option, its value, and what is allowed.
    """
    for name, declared in inspect.get_annotations(options).items():
        base = next((base for base in options.__mro__[1:] if name in inspect.get_annotations(base)), None)
        if base is not None and typing.get_type_hints(base)[name] == declared:  # which are without what is allowed
            options.__annotations__[name] = inspect.get_annotations(base)[name]
    model: Any = pydantic.dataclasses.dataclass(frozen=True, kw_only=True, config=STRICT)(options)
    validated = model.__init__

    @functools.wraps(validated)
    def init(self: Any, /, *args: Any, **kwargs: Any) -> None:
        try:
            validated(self, *args, **kwargs)
        except ValidationError as error:
            raise ValueError(in_words(error, type(self))) from None

    model.__init__ = init
    return model


def read_options(options: type[Options], values: dict[str, Any]) -> Options:
    """The options of a class that were read from JSON; an option that is missing there has its default.

    Raises:
        ValueError: if there is no such option, or a value is not allowed.
    """
    try:
        return TypeAdapter(options).validate_json(json.dumps(values))
    except ValidationError as error:
        raise ValueError(in_words(error, options)) from None


def in_words(error: ValidationError, options: type) -> str:
    """A sentence for each thing that pydantic refuses."""
    return " ".join(_sentence(entry, options) for entry in error.errors(include_url=False))


def _sentence(entry: Any, options: type) -> str:
    kind, place = entry["type"], entry["loc"]
    if place and isinstance(place[0], int):  # an option that was given by its place
        place = [field.name for field in dataclasses.fields(options)][place[0]], *place[1:]
    name = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).removeprefix(".")
    if kind == "value_error":  # in words of its own
        return ": ".join(filter(None, (name, str(entry["ctx"]["error"]))))
    if kind == "unexpected_keyword_argument":
        return f"{options.__name__} has no option {name}; it is of another version or recipe."
    if kind == "missing":
        return f"{name} is missing."
    if kind == "literal_error":
        return f"{name}={entry['input']!r} does not exist; choose {entry['ctx']['expected'].replace(chr(39), '')}."
    _, _, allowed = entry["msg"].replace("should", "must").partition(" ")  # such as: Input should be greater than 0
    allowed = allowed.replace("greater than or equal to", "at least").replace("less than or equal to", "at most")
    return f"{name}={entry['input']!r} {allowed}."


def require_checked(options: type) -> None:
    """Refuse a class of options whose own declarations nobody checks.

    Raises:
        ValueError: if the class was made a dataclass by ``dataclasses.dataclass``.
    """
    if "__dataclass_fields__" in vars(options) and "__pydantic_validator__" not in vars(options):
        raise ValueError(
            f"the options of {options.__name__} are not checked; decorate it by @rt_torchrl.configuration."
        )


def require_number(name: str, value: Any, *, whole: bool = False, finite: bool = True) -> None:
    """Refuse a value that is no number; a truth value is none, although Python counts it as one.

    Args:
        name: name of the argument, for the message.
        value: value of the argument.
        whole: whether the number must be a whole one.
        finite: whether it must be finite; NaN is never a number.

    Raises:
        ValueError: if the value is something else.
    """
    if not isinstance(value, numbers.Integral if whole else numbers.Real) or isinstance(value, bool):
        raise ValueError(f"{name}={value!r} must be {'a whole number' if whole else 'a number'}.")
    if math.isnan(value) or (finite and math.isinf(value)):
        raise ValueError(f"{name}={value} must be {'a finite number' if finite else 'a number or infinite'}.")


OTHER_UNITS: dict[str, tuple[tuple[str, float, float], ...]] = {
    "rad": (("deg", math.pi / 180.0, 0.0),),
    "rad/s": (("deg/s", math.pi / 180.0, 0.0), ("rpm", math.pi / 30.0, 0.0)),
    "deg": (("rad", 180.0 / math.pi, 0.0),),
    "deg/s": (("rad/s", 180.0 / math.pi, 0.0),),
    "K": (("°C", 1.0, 273.15), ("°F", 5.0 / 9.0, 459.67 * 5.0 / 9.0)),
    "°C": (("K", 1.0, -273.15), ("°F", 5.0 / 9.0, -32.0 * 5.0 / 9.0)),
    "Pa": (("kPa", 1e3, 0.0), ("bar", 1e5, 0.0)),
    "s": (("ms", 1e-3, 0.0), ("h", 3600.0, 0.0)),
    "m": (("cm", 1e-2, 0.0), ("mm", 1e-3, 0.0)),
    "m/s": (("km/h", 1.0 / 3.6, 0.0),),
    "m³": (("L", 1e-3, 0.0),),
    "kg": (("g", 1e-3, 0.0),),
    "W": (("kW", 1e3, 0.0), ("mW", 1e-3, 0.0)),
    "N": (("kN", 1e3, 0.0),),
    "N m": (("kN m", 1e3, 0.0),),
    "N m/s": (("kN m/s", 1e3, 0.0),),
    "-": (("%", 1e-2, 0.0),),
}
"""For a unit, others in which a value may come, with their size in it and their zero."""


def other_units(unit: str) -> str:
    """What other units are in a unit, in words; empty where none is known."""
    return ", ".join(
        f"0 {name} is {zero:.5g} {unit}" if zero else f"1 {name} is {float(f'{size:.3g}'):g} {unit}"
        for name, size, zero in OTHER_UNITS.get(unit, ())
    )


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
        words = other_units(unit)
        raise ValueError(
            f"{name}={value:g} {unit} of {of} must lie in {least:g} to {greatest:g} {unit}; check its unit"
            f"{f': {words}' if words else ''}."
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
        array = np.asarray(values)
        if array.dtype.kind not in "fiu" and array.size:
            raise ValueError(f"its entries are of type {array.dtype}")
        return array.astype(np.float64)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name} must be an array of numbers: {error}.") from error


def quoted(names: Iterable[str]) -> str:
    """Names in quotes, because some contain commas."""
    return ", ".join(repr(name) for name in names)
