"""Conversion of a log's columns to the units of a plant's signals."""

from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

EXAMPLES = "write it as in rpm, m/s^2, kN m, degC."


def converted(values: Float[np.ndarray, " rows"], unit: str, to: str) -> Float[np.ndarray, " rows"]:
    """The values in another unit, converted by the library pint.

    To pint an angle is a pure number; here it is not. Hz and rad/s, which differ by 2π, therefore measure different
    quantities.

    Args:
        values: numbers in ``unit``.
        unit: unit of the values, such as ``rpm``, ``kN m``, ``degF`` or ``%``. Temperatures are absolute;
            ``delta_degF`` is the unit of a difference.
        to: unit of the result; ``-`` is the unit of a pure number.

    Raises:
        ValueError: if a unit is unknown, the two measure different things, or pint is not installed.
    """
    registry, pint = _registry()
    try:
        have, want = (registry.Unit("" if name.strip() == "-" else name) for name in (unit, to))
        base, wanted = (str(registry.get_base_units(each)[1]) for each in (have, want))
        if base == wanted:
            return registry.Quantity(values, have).to(want).magnitude
    except pint.UndefinedUnitError as error:
        raise ValueError(f"unit {unit!r} is not known ({error}); {EXAMPLES}") from error
    except Exception as error:  # pint's parser lets errors of Python's own parser through
        raise ValueError(f"unit {unit!r} is not understood; {EXAMPLES}") from error
    raise ValueError(f"{unit!r} (base units {base}) and {to!r} ({wanted}) do not measure the same quantity.")


@cache
def _registry() -> tuple[Any, Any]:
    try:
        import pint
    except ImportError as error:
        raise ValueError("units need pint: install the extra, pip install 'rt_torchrl[logs]'.") from error
    return pint.UnitRegistry(), pint
