"""Units of a log's columns, against the factors that define them."""

import math

import numpy as np
import pytest

from rt_torchrl.fit.log import converted

pytest.importorskip("pint")


@pytest.mark.parametrize(
    ("unit", "signal", "number", "expected"),
    [
        ("rpm", "rad/s", 30.0, math.pi),
        ("turn/s", "rad/s", 1.0, 2.0 * math.pi),
        ("deg", "rad", 180.0, math.pi),
        ("°F", "K", 451.0, (451.0 + 459.67) * 5.0 / 9.0),
        ("degC", "K", -40.0, 233.15),
        ("delta_degF", "K", 9.0, 5.0),
        ("kN m", "N m", 1.5, 1500.0),
        ("%", "-", 12.0, 0.12),
        ("L", "m³", 2.0, 2e-3),
        ("L/min", "m^3/s", 60.0, 1e-3),
        ("mbar", "Pa", 1013.25, 101325.0),
        ("ms", "s", 250.0, 0.25),
    ],
)
def test_units_are_converted(unit, signal, number, expected):
    # Factors of some digits are multiplied: rounding only.
    assert converted(np.array([number]), unit, signal) == pytest.approx([expected], rel=1e-13)


@pytest.mark.parametrize(
    ("unit", "signal", "message"),
    [
        ("Hz", "rad/s", r"'Hz' \(base units 1 / second\) and 'rad/s' \(radian / second\) do not measure the same"),
        ("rad", "-", "do not measure the same"),
        ("N", "N m", "do not measure the same"),
        ("furlongs_of_old", "m", "unit 'furlongs_of_old' is not known"),
        ("k*(", "m", r"unit 'k\*\(' is not understood"),
        ("5 m", "m", "unit '5 m' is not understood"),
    ],
)
def test_units_that_measure_something_else_are_refused(unit, signal, message):
    with pytest.raises(ValueError, match=message):
        converted(np.ones(2), unit, signal)
