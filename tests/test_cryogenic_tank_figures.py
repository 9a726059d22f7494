"""The tank's figures against the numbers they are drawn from, on six hours in orbit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from figure_reading import draw, line, panel, snapshot_of

from rt_torchrl import Snapshot, Trajectory
from rt_torchrl.envs.cryogenic_tank import figures
from rt_torchrl.envs.cryogenic_tank.closures import ConstantCoefficients
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.figures.training import closure_weights

FOUND = {"U_s": [8.0, 46.0], "U_HX": [12.0, 70.0], "K_JT": [90e9, 480e9]}
TRUE = {"U_s": 50.0, "U_HX": 75.0, "K_JT": 500e9}


@pytest.fixture(scope="module")
def snapshot() -> Snapshot:
    """The real tank, and a twin whose coefficients are some percent off."""
    twin = ConstantCoefficients(torch.tensor([found[-1] for found in FOUND.values()], dtype=torch.float64))
    episodes = [{"closure": {name: found[k] for name, found in FOUND.items()}} for k in range(2)]
    return snapshot_of(CryogenicTank(horizon=6 * 3600.0), twin, shift=10.0, episodes=episodes)


def test_tank_is_the_record(snapshot):
    figure, plant = figures.tank(snapshot), snapshot.plant
    actions = snapshot.record.actions
    for name, states, K_JT in (("real", snapshot.record.states, 500e9), ("twin", snapshot.replay, 480e9)):
        T_s, V_l, p = states[:-1].unbind(-1)
        fluid, drop = plant.saturation(p), actions[:, 0]
        flow = (drop / K_JT).sqrt()  # tens of kPa, far above the laminar drop of 100 Pa
        expected = {
            "pressure": (1e-3 * p, 1e-12),
            "liquid mass": (V_l * fluid.rho_l, 1e-12),
            "wall-fluid temperature difference": (T_s - fluid.T, 1e-9),
            "vent flow": (1e3 * flow, 1e-5),
            "vented mass": (30.0 * (flow.cumsum(0) - flow), 1e-5),
        }
        for label, (values, tolerance) in expected.items():
            drawn = line(panel(figure, label), name).get_ydata()
            np.testing.assert_allclose(drawn, values.numpy(), rtol=tolerance, atol=1e-12, err_msg=label)
    load = panel(figure, "heat load")
    assert np.array_equal(line(load, "real").get_ydata(), snapshot.record.exogenous[:, 0].numpy())
    assert np.array_equal(line(load, "large scale (SVR)").get_ydata(), snapshot.large_scale[:, 0].numpy())
    units = [ax.get_title(loc="left").split("[")[1] for ax in figure.axes]
    assert units == ["kPa]", "kg]", "kg]", "K]", "g/s]", "W]"]
    assert load.get_xlabel() == "time [h]"
    assert load.get_xlim() == pytest.approx((0.0, 6.0), rel=1e-12)


def test_long_records_are_thinned_to_mean_and_range(snapshot):
    # Twice the six hours and a bit: groups of three, the last with one sample.
    record = snapshot.record
    n = 2 * len(record.actions) + 1
    repeated = [torch.cat([values[:720]] * 2 + [values[:1]]) for values in record[:3]]
    states = torch.cat([repeated[0], repeated[0][-1:]])
    record = Trajectory(states, *repeated[1:])
    long = replace(snapshot, record=record, replay=states, large_scale=repeated[2], realisations=None)
    figure = figures.tank(long)
    load, values = panel(figure, "heat load"), repeated[2][:, 0].numpy()
    drawn = line(load, "real").get_ydata()
    assert n % 3 == 1 and len(drawn) == (n + 2) // 3 <= figures.POINTS
    assert drawn[5] == pytest.approx(values[15:18].mean(), rel=1e-12)
    assert drawn[-1] == values[-1]
    vertices = load.collections[0].get_paths()[0].vertices[:, 1]
    assert (vertices.min(), vertices.max()) == (values.min(), values.max())
    assert any("every 1.5 min" in text for text in draw(figure))


def test_heat_exchanger_of_each_closure(snapshot):
    figure, plant = figures.heat_exchanger(snapshot), snapshot.plant
    heat, held, share = figure.axes
    closures = {"true": plant.closure, "twin": snapshot.closure, "initial twin": snapshot.initial_closure}
    calm = torch.zeros(1, 1, dtype=torch.float64)
    for name, closure in closures.items():
        drop, load = line(held, name).get_xdata()[150], line(held, name).get_ydata()[150]
        state = plant.state_at(torch.tensor([500e3], dtype=torch.float64))
        action = torch.tensor([[1e3 * drop]], dtype=torch.float64)
        assert line(heat, name).get_ydata()[150] == pytest.approx(plant.vent(state, action, closure).heat.item())
        # At the held load, which a wall with T_s - T = Q/(U_s A_s) hands to the fluid, the pressure stands still: its
        # rate is that of rounding, where the load alone makes some 1e-3 Pa/s.
        U_s = closure.named_coefficients()["U_s"].item()
        state[:, 0] += load / (U_s * plant.wall_area)
        assert abs(plant.vector_field(calm[0], state, action, calm, closure)[0, 2].item()) < 1e-8
    mean = snapshot.record.exogenous.mean().item()
    assert line(held, "mean load of the last episode").get_ydata()[0] == mean
    assert sum(bar.get_height() for bar in share.patches) == pytest.approx(100.0, rel=1e-9)
    assert all("[W]" in ax.get_title(loc="left") for ax in (heat, held))
    assert share.get_xlabel().endswith("[kPa]")


def test_closure_weights_with_truth_start_and_units(snapshot):
    figure = closure_weights(snapshot)
    for ax, (name, found) in zip(figure.axes, FOUND.items(), strict=True):
        assert list(line(ax, "twin").get_ydata()) == found
        assert line(ax, "true").get_ydata()[0] == pytest.approx(TRUE[name], rel=1e-14)
        start = snapshot.initial_closure.named_coefficients()[name].item()
        assert line(ax, "start").get_ydata()[0] == start
        assert ax.get_yscale() == "log" and ax.get_title(loc="left").splitlines()[0].endswith("]")
        assert ax.get_title(loc="right") == f"{100 * (found[-1] / TRUE[name] - 1):+.2g} %"
