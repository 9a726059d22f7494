"""The C_p(λ, β) map against scipy's splines, finite differences, the published optimum and blade-element momentum.

The theory, which made the table of the worn rotor, is held against an independent code, its balances and Glauert's
ideal rotor.
"""

import numpy as np
import pytest
import torch
from blade_element import Blade, Polar, Rotor, power_coefficients, worn_values
from scipy.interpolate import RectBivariateSpline

from rt_torchrl.envs.wind_turbine.rotor import PowerCoefficientTable

LAM = np.array([2.0, 3.0, 3.5, 5.0, 7.5, 8.0])
BETA = np.array([-2.0, 0.0, 0.5, 4.0, 9.0])


@pytest.fixture(scope="module")
def table() -> PowerCoefficientTable:
    return PowerCoefficientTable.nrel5mw()


def uneven() -> PowerCoefficientTable:
    values = 0.4 - 0.02 * (LAM[:, None] - 6.0) ** 2 - 0.003 * (BETA - 1.0) ** 2 + 0.01 * np.sin(3 * LAM[:, None] + BETA)
    return PowerCoefficientTable(LAM, BETA, values)


def features(*points) -> torch.Tensor:
    return torch.tensor(points, dtype=torch.float64)


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


POINTS = {
    "interior": (7.3, 4.4),
    "near the top": (7.6, 0.1),
    "on a row": (8.0, 3.3),
    "on a column": (6.2, 7.0),
    "on a node": (6.0, 5.0),
    "first row": (2.0, 3.0),
    "stall": (1.4, 12.2),
    "stall knot": (1.0, 5.5),
    "near standstill": (0.3, 2.0),
    "standstill": (0.0, 2.0),
    "last row": (14.5, 3.2),
    "overspeed": (21.0, 3.2),
    "negative pitch": (7.0, -9.0),
    "feathered": (7.0, 45.0),
    "all out": (30.0, 60.0),
    "stalled and feathered": (1.2, 60.0),
}


@pytest.mark.parametrize("point", POINTS.values(), ids=POINTS.keys())
def test_gradient_in_every_zone_and_across_edges(table, point):
    # Central differences over a step of 1e-6 straddle the edges; C¹ leaves an error of step times the jump of the
    # second derivative (largest at the last row), below 1e-5.
    x = features(point).requires_grad_()
    assert torch.autograd.gradcheck(table, x, eps=1e-6, atol=1e-5, rtol=1e-5, check_forward_ad=True)


@pytest.mark.parametrize("axis, at", [(0, 0.0), (0, 1.0), (0, 2.0), (0, 14.5), (1, -5.0), (1, 30.0)])
def test_continuously_differentiable_at_the_seams(table, axis, at):
    other = torch.linspace(-3, 33, 25, dtype=torch.float64)

    def value_and_slope(coordinate):
        along = torch.full_like(other, coordinate)
        x = torch.stack([along, other] if axis == 0 else [other, along], dim=-1).requires_grad_()
        value = table(x)
        return value, torch.autograd.grad(value.sum(), x)[0]

    for below, above in zip(value_and_slope(np.nextafter(at, -99)), value_and_slope(at), strict=True):
        # The two sides are one unit of rounding apart; values reach 100 and slopes 10 in the extrapolated corners.
        torch.testing.assert_close(below, above, rtol=1e-12, atol=1e-11)


def test_torque_vanishes_at_standstill(table):
    lam = torch.logspace(-1, -8, 8, dtype=torch.float64)
    beta = torch.linspace(-5, 40, 10, dtype=torch.float64)
    torque = table(torch.cartesian_prod(lam, beta)).reshape(8, 10) / lam[:, None]
    # C_p = kλ² there with k = 0.2 C_p(2, β) <= 0.016, so C_p/λ = kλ.
    assert (torque.abs() <= 0.02 * lam[:, None]).all()
    torch.testing.assert_close(torque[-1] * 1e8, torque[0] * 10, rtol=1e-12, atol=0)
    assert (table(features((-0.5, 3.0), (0.0, 3.0), (-40.0, 20.0))) == 0).all()


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


@pytest.fixture(scope="module")
def rotor() -> Rotor:
    return Rotor.nrel5mw()


def test_reproduces_the_published_map(rotor):
    published = PowerCoefficientTable.nrel5mw()
    lam, beta = np.arange(4.0, 11.1, 0.5), np.arange(0.0, 25.1)
    reference = published.values.numpy()[4:19, 5:31]
    error = (power_coefficients(rotor, lam, beta) - reference)[reference > 0.05]
    # CCBlade smooths the polars, takes other sectors and integrates the loads otherwise. Measured: RMS 0.0040, largest
    # error 0.0114. Without shear the RMS is 0.0086, without tip and hub loss 0.018, without Buhl's correction 0.10.
    assert error.size == 179
    assert np.sqrt(np.mean(error**2)) < 0.006
    assert np.abs(error).max() < 0.02


def glauert_optimum(x):
    """a and a' of the best rotor with a rotating wake at local speed ratio x: 16a³ − 24a² + (9 − 3x²)a + x² − 1 = 0."""
    roots = [np.roots([16.0, -24.0, 9.0 - 3.0 * s * s, s * s - 1.0]) for s in x]
    a = np.array([next(q.real for q in root if abs(q.imag) < 1e-9 and 0.25 < q.real < 1 / 3 + 1e-9) for root in roots])
    return a, (1 - 3 * a) / (4 * a - 1)


def glauert_power(lam):
    """C_p of that rotor in closed form; Manwell, McGowan, Rogers, *Wind Energy Explained*, section 3.3."""
    a = glauert_optimum(np.array([lam]))[0].item()  # at the tip
    x, y = 0.25, 1 - 3 * a

    def primitive(s):
        return 64 / 5 * s**5 + 72 * s**4 + 124 * s**3 + 38 * s**2 - 63 * s - 12 * np.log(s) - 4 / s

    return 8 / (729 * lam**2) * (primitive(x) - primitive(y))


def test_closed_form_of_the_ideal_rotor():
    # Figures that textbooks print, to three digits; Betz's limit for a fast rotor, with its 1/λ² approach.
    assert glauert_power(1.0) == pytest.approx(0.416, abs=1e-3)
    assert glauert_power(5.0) == pytest.approx(0.570, abs=1e-3)
    assert glauert_power(200.0) == pytest.approx(16 / 27, abs=1e-3)


@pytest.mark.parametrize("lam", [3.0, 7.64])
def test_glauerts_ideal_rotor(lam):
    edges = np.linspace(0.02, 1.0, 201)
    r = 0.5 * (edges[1:] + edges[:-1])
    a, a_tangential = glauert_optimum(lam * r)
    phi = np.arctan((1 - a) / (1 + a_tangential) / (lam * r))
    n_blades, lift, alpha = 3000, 0.8, 5.0  # so many narrow blades lose nothing at the tips
    chord = 8 * np.pi * r * a * np.sin(phi) ** 2 / ((1 - a) * n_blades * lift * np.cos(phi))
    blade = Blade(r=r, dr=np.diff(edges), chord=chord, twist=np.degrees(phi) - alpha, airfoil=("ideal",) * r.size)
    angles = np.arange(-180.0, 181.0, 5.0)
    ideal = Polar(alpha=angles, cl=lift * np.sin(np.radians(angles)) / np.sin(np.radians(alpha)), cd=0.0 * angles)
    rotor = Rotor(
        blade=blade, polars={"ideal": ideal}, n_blades=n_blades, hub_radius=0.01, tip_radius=1.0, hub_height=2.0,
        precone=0.0, tilt=0.0, shear=0.0, n_sectors=1,
    )  # fmt: skip
    # 3000 blades leave a tip loss of order 1/B over a band of width 1/B, the hub takes 4e-4 of the area, and 200
    # mid-points integrate to 1e-5: together below 1e-3 of C_p.
    assert power_coefficients(rotor, [lam], [0.0]).item() == pytest.approx(glauert_power(lam), rel=1e-3)


def test_the_shipped_table_of_the_worn_rotor_is_what_the_theory_makes():
    # The table is written to the last digit; another platform's sines may round otherwise.
    torch.testing.assert_close(
        PowerCoefficientTable.nrel5mw(worn=True).values, torch.from_numpy(worn_values()), rtol=0, atol=1e-11
    )
