"""The Runge-Kutta step against torchdiffeq, a closed solution and the stability function."""

import math
import re

import pytest
import torch
from scipy.optimize import brentq
from seeds_and_numbers import double
from torchdiffeq import odeint

from rt_torchrl.plants.sampling import RK4_REAL_STABILITY, require_stable_step, rk4_step


def scalar(value):
    return torch.tensor(value, dtype=torch.float64)


def forced_pendulum(t, state):
    angle, rate = state.unbind(-1)
    return torch.stack([rate, -torch.sin(angle) - 0.2 * rate * rate.abs() + torch.cos(3.0 * t)], -1)


def test_equals_torchdiffeq():
    start = torch.randn(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    times = 0.7 + 0.1 * torch.arange(21, dtype=torch.float64)
    expected = odeint(forced_pendulum, start, times, method="rk4")
    state = start
    for t, reference in zip(times[:-1], expected[1:], strict=True):
        state = rk4_step(forced_pendulum, t, state, 0.1)
        # The same formula; only the rounding of t + h/3 and of the sums differs, over at most 20 steps.
        torch.testing.assert_close(state, reference, rtol=1e-13, atol=1e-14)


def test_is_of_fourth_order_in_time_and_state():
    """s = 1/(1 + t²) solves s' = −2ts²; adding sin t makes every stage depend on its time."""

    def field(t, state):
        return -2.0 * t * (state - torch.sin(t)) ** 2 + torch.cos(t)

    exact = 1.0 / (1.0 + 2.0**2) + math.sin(2.0)
    errors = []
    for n in (20, 40, 80, 160):
        state, h = double(1.0), 2.0 / n
        for k in range(n):
            state = rk4_step(field, scalar(k * h), state, h)
        errors.append(abs(state.item() - exact))
    orders = [math.log2(coarse / fine) for coarse, fine in zip(errors, errors[1:], strict=False)]
    # The order is 4 + O(h); at the finest steps it is seen within a tenth. A stage at a wrong time gives 1 or 2.
    assert orders[-1] == pytest.approx(4.0, abs=0.1), orders


def test_exact_where_the_quadrature_is_exact():
    """With a field of t alone the step is the 3/8 rule, exact for cubics."""
    end = rk4_step(lambda t, s: 4.0 * t**3 - 3.0 * t**2 + 0.0 * s, scalar(0.3), double(1.0), 0.9)
    # A few roundings of numbers of order one.
    assert end.item() == pytest.approx(1.0 + (1.2**4 - 1.2**3) - (0.3**4 - 0.3**3), rel=1e-14)


def test_stability_limit_is_the_root_of_the_stability_function():
    root = brentq(lambda x: -x + x**2 / 2 - x**3 / 6 + x**4 / 24, 2.0, 3.5)
    # Cut to three decimals, downwards, so that the limit itself is stable.
    assert 0.0 < root - RK4_REAL_STABILITY < 1e-3

    def amplification(rate):
        return abs(rk4_step(lambda t, s: -rate * s, scalar(0.0), double(1.0), 1.0).item())

    assert amplification(RK4_REAL_STABILITY) < 1.0 < amplification(RK4_REAL_STABILITY + 1e-3)


@pytest.mark.parametrize("rate", [10.0, 7.0, 0.0606])
def test_unstable_steps_are_refused_with_advice_that_works(rate):
    arguments = {"mode": "the valve", "remedy": "a slower valve"}
    with pytest.raises(ValueError, match="makes plant 'tank' unstable: the valve decays .* or a slower valve") as error:
        require_stable_step("tank", 3.0 / rate, rate, **arguments)
    advised = float(re.search(r"Use dt <= (\S+) s", str(error.value))[1])
    require_stable_step("tank", advised, rate, **arguments)
    # Three digits, and not over-cautious.
    assert advised * rate > 0.985 * RK4_REAL_STABILITY
