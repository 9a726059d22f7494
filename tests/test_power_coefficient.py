"""The C_p(λ, β) map against scipy's splines, finite differences and the published optimum."""

import inspect

import numpy as np
import pytest
import torch
from scipy.interpolate import RectBivariateSpline

from rt_torchrl.envs.wind_turbine.power_coefficient import PowerCoefficientTable

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
    power, lam, beta = table.maximum()
    assert power == pytest.approx(0.466, abs=5e-4)
    assert lam == pytest.approx(7.64, abs=0.02)
    assert beta == 0.0


@pytest.mark.parametrize("pitch", [0.0, None])
def test_maximum_is_stationary(table, pitch):
    power, lam, beta = table.maximum(pitch)
    slope_lam, slope_beta = torch.func.jacrev(table)(features(lam, beta))[0].tolist()
    # An error of 1e-7 in the location times a curvature of order 0.01…0.1.
    assert abs(slope_lam) < 1e-7
    assert pitch is not None or abs(slope_beta) < 1e-7
    assert power >= table.values[:, 5 if pitch == 0.0 else slice(None)].max().item()


@pytest.mark.parametrize("make", [PowerCoefficientTable.nrel5mw, uneven])
def test_reproduces_the_table(make):
    table = make()
    nodes = table(grid(table.tip_speed_ratio.numpy(), table.pitch.numpy())).squeeze(-1)
    # Each node is the origin of its own cell: exact but for the spline solver's rounding (values up to 12).
    torch.testing.assert_close(nodes, table.values, rtol=0, atol=1e-12)


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


def test_batches_compiles_and_maps(table):
    x = features(*POINTS.values())
    expected = torch.stack([table(point) for point in x])
    # The same additions and products in the same order; a fused multiply-add may differ in the last bit.
    for result in (table(x), table(x.reshape(2, -1, 2)).reshape(-1, 1), torch.func.vmap(table)(x)):
        torch.testing.assert_close(result, expected, rtol=1e-14, atol=1e-14)
    # Under test the annotations are checked at run time, which the tracer cannot follow: trace the bare function.
    bare = inspect.unwrap(PowerCoefficientTable.forward)
    traced = torch.compile(lambda point: bare(table, point), fullgraph=True, backend="aot_eager")(x)
    torch.testing.assert_close(traced, expected, rtol=1e-14, atol=1e-14)
    tangents = torch.ones_like(x)
    forward = torch.func.jvp(table, (x,), (tangents,))[1]
    x.requires_grad_()
    reverse = torch.autograd.grad(table(x).sum(), x)[0].sum(dim=-1, keepdim=True)
    torch.testing.assert_close(forward, reverse, rtol=1e-12, atol=1e-12)


def test_single_precision_module(table):
    x = features((7.3, 4.4), (1.2, 3.0), (16.0, 2.0))
    single = PowerCoefficientTable.nrel5mw().float()(x.float())
    torch.testing.assert_close(single.double(), table(x), rtol=1e-4, atol=1e-5)  # seven digits, differences lose two


@pytest.mark.parametrize(
    "change, message",
    [
        ({"tip_speed_ratio": LAM[::-1]}, r"tip_speed_ratio goes from 8.0 to 7.5.*increase"),
        ({"tip_speed_ratio": LAM - 2.0}, r"tip_speed_ratio starts at 0.0.*positive"),
        ({"tip_speed_ratio": LAM[:3]}, r"tip_speed_ratio has shape \(3,\).*at least 4"),
        ({"pitch": [-2.0, 0.0, np.nan, 4.0, 9.0]}, r"pitch\[2\]=nan deg must be finite"),
        ({"pitch": [-2.0, 0.0, 0.0, 4.0, 9.0]}, r"pitch goes from 0.0 to 0.0 deg.*duplicates"),
        ({"values": np.zeros((5, 6))}, r"values has shape \(5, 6\).*\(6, 5\).*transpose"),
        ({"values": np.full((6, 5), np.inf)}, r"values\[0, 0\]=inf must be finite"),
        ({"values": np.full((6, 5), 46.6)}, r"values reaches 46.6.*16/27.*per cent"),
    ],
)
def test_refuses_bad_tables(change, message):
    arguments = {"tip_speed_ratio": LAM, "pitch": BETA, "values": np.zeros((6, 5))} | change
    with pytest.raises(ValueError, match=message):
        PowerCoefficientTable(**arguments)


@pytest.mark.parametrize(
    "text, message",
    [
        ("# nothing\n", "holds 0 rows"),
        ("x,0,1,2,3\n2,0,0,0,0\n3,0,0,0\n", r"rows of \[4, 5\] entries under a header of 5"),
        ("x,0,1,2,3\n2,0,0,zero,0\n", "'zero'.*must hold numbers"),
    ],
)
def test_refuses_bad_files(tmp_path, text, message):
    path = tmp_path / "table.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        PowerCoefficientTable.from_csv(path)


def test_maximum_refuses_a_pitch_outside(table):
    with pytest.raises(ValueError, match=r"pitch=31.0 deg lies outside.*-5.0…30.0"):
        table.maximum(31.0)
