"""The C_p(λ, β) map against scipy's splines, finite differences and the published optimum."""

import numpy as np
import pytest
import torch
from scipy.interpolate import RectBivariateSpline
from seeds_and_numbers import double

from rt_torchrl.envs.wind_turbine.rotor import PowerCoefficientTable

LAM = np.array([2.0, 3.0, 3.5, 5.0, 7.5, 8.0])
BETA = np.array([-2.0, 0.0, 0.5, 4.0, 9.0])


@pytest.fixture(scope="module")
def table() -> PowerCoefficientTable:
    return PowerCoefficientTable.nrel5mw()


def uneven() -> PowerCoefficientTable:
    values = 0.4 - 0.02 * (LAM[:, None] - 6.0) ** 2 - 0.003 * (BETA - 1.0) ** 2 + 0.01 * np.sin(3 * LAM[:, None] + BETA)
    return PowerCoefficientTable(LAM, BETA, values)


def grid(lam, beta) -> torch.Tensor:
    pairs = np.meshgrid(lam, beta, indexing="ij")
    return torch.tensor(np.stack(pairs, axis=-1))


def test_optimum_at_fine_pitch(table):
    # The published figures have three digits, and C_p is flat there: within 2.1e-4 of its top from λ = 7.5 to 7.8.
    power, lam = table.optimum()
    assert power == pytest.approx(0.466, abs=5e-4)
    assert lam == pytest.approx(7.64, abs=0.02)


@pytest.mark.parametrize("make", [PowerCoefficientTable.nrel5mw, uneven])
def test_agrees_with_fitpack_between_nodes(make):
    table = make()
    lam, beta = table.tip_speed_ratio.numpy(), table.pitch.numpy()
    oracle = RectBivariateSpline(lam, beta, table.values.numpy(), s=0)  # not-a-knot, by B-splines
    x, y = np.linspace(lam[0], lam[-1], 67), np.linspace(beta[0], beta[-1], 71)
    points = grid(x, y)
    # The same spline in another basis: rounding only, on values up to 12.
    np.testing.assert_allclose(table(points).squeeze(-1).numpy(), oracle(x, y), rtol=0, atol=1e-11)
    points.requires_grad_()
    slopes = torch.autograd.grad(table(points).sum(), points)[0].numpy()
    np.testing.assert_allclose(slopes[..., 0], oracle(x, y, dx=1), rtol=0, atol=1e-10)
    np.testing.assert_allclose(slopes[..., 1], oracle(x, y, dy=1), rtol=0, atol=1e-10)


def test_gradient_in_every_zone_and_across_edges(table):
    """Standstill, stall, the table, overspeed, and pitches on both sides of the table, and the seams between them."""
    lam = torch.tensor([0.0, 0.3, 1.0, 1.4, 2.0, 6.0, 7.3, 14.5, 21.0, 30.0], dtype=torch.float64)
    beta = torch.tensor([-9.0, -5.0, 0.1, 3.2, 5.0, 12.2, 30.0, 45.0, 60.0], dtype=torch.float64)
    # Central differences over a step of 1e-6 straddle the edges; C¹ leaves an error of step times the jump of the
    # second derivative (largest at the last row), below 1e-5.
    for x in torch.cartesian_prod(lam, beta):
        x.requires_grad_()
        assert torch.autograd.gradcheck(table, x, eps=1e-6, atol=1e-5, rtol=1e-5, check_forward_ad=True)


def test_torque_vanishes_at_standstill(table):
    lam = torch.logspace(-1, -8, 8, dtype=torch.float64)
    beta = torch.linspace(-5, 40, 10, dtype=torch.float64)
    torque = table(torch.cartesian_prod(lam, beta)).reshape(8, 10) / lam[:, None]
    # C_p = kλ² there with k = 0.2 C_p(2, β) <= 0.016, so C_p/λ = kλ.
    assert (torque.abs() <= 0.02 * lam[:, None]).all()
    torch.testing.assert_close(torque[-1] * 1e8, torque[0] * 10, rtol=1e-12, atol=0)
    assert (table(double((-0.5, 3.0), (0.0, 3.0), (-40.0, 20.0))) == 0).all()


def test_stall_never_holds_the_rotor_back(table):
    # Within the table's pitch range, C_p > 0 on its first row and so must be all the way down to standstill.
    lam = torch.linspace(0.01, 2.0, 200, dtype=torch.float64)
    beta = torch.linspace(-5, 30, 211, dtype=torch.float64)
    assert table(torch.cartesian_prod(lam, beta)).min() > 0


def test_overspeed_brakes(table):
    power = table(grid(np.linspace(14.5, 60, 40), np.array([0.0, 5.0, 20.0, 40.0]))).squeeze(-1)
    assert (power.diff(dim=0) < 0).all()
    assert (power[-1] < 0).all()
    assert torch.isfinite(power).all()
