"""Figures against the numbers they are drawn from, on snapshots of short trainings and on flights."""

import copy
import sys
from dataclasses import replace

import matplotlib.colors
import numpy as np
import pytest
import torch
from figure_reading import draw, line, panel, snapshot_of
from linear_quadratic import LinearQuadratic
from matplotlib.axes import Axes
from small_runs import IDLE

from rt_torchrl import DigitalTwin, PlantEnv, ReinforcementTwinning, Rollout, Snapshot, figures
from rt_torchrl.envs.cryogenic_tank import figures as tank_figures
from rt_torchrl.envs.cryogenic_tank.closures import ConstantCoefficients
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing import figures as drone_figures
from rt_torchrl.envs.flapping_wing.closures import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine import figures as turbine_figures
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.figures import flights
from rt_torchrl.figures.style import ROLES
from rt_torchrl.figures.training import RESOLUTION, closure_weights, visited_observations
from rt_torchrl.runs.results import episode_record
from rt_torchrl.steps.config import AssimilationConfig, PlannerConfig, RefereeConfig, TwinningConfig

EVERYWHERE = {"states", "policy_contours", "learning_curves"}


def trained(plant, *, arm="twinning", episodes=2) -> Snapshot:
    generator = torch.Generator().manual_seed(0)
    policy = plant.make_policy(generator)
    twin = DigitalTwin(plant, plant.make_closure(generator))
    initial, reports = copy.deepcopy(twin.closure), []
    config = TwinningConfig(
        arm=arm,
        realisations=2,
        virtual_episodes=2,
        learner=IDLE,
        assimilation=AssimilationConfig(iterations=2),
        planner=PlannerConfig(iterations=1),
        referee=RefereeConfig(rule="decision_tree"),
    )
    policies = {"model_free": policy, "model_based": copy.deepcopy(policy)}
    twinning = ReinforcementTwinning(PlantEnv(plant), twin, **policies, config=config, generator=generator)
    for _ in range(episodes):
        reports.append(episode_record(twinning.episode(), episode=len(reports)))
    return Snapshot.take(twinning, initial, reports)


@pytest.fixture(scope="module")
def oscillator() -> Snapshot:
    return trained(LinearQuadratic())


@pytest.fixture(scope="module")
def turbine() -> Snapshot:
    return trained(WindTurbine(horizon=60.0))


def same(line, values) -> bool:
    return np.array_equal(line.get_ydata(), values.detach().numpy())


@pytest.mark.parametrize("name", ["oscillator", "turbine"])
def test_every_figure_is_drawn(name, request):
    snapshot = request.getfixturevalue(name)
    drawn = figures.figures_of(snapshot)
    assert set(drawn) == EVERYWHERE | {"exogenous", "learned_law"}
    for figure in drawn.values():
        assert draw(figure)
    # Nothing is left behind: no figure is registered anywhere.
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or pyplot.get_fignums() == []


@pytest.mark.parametrize("name", ["oscillator", "turbine"])
def test_states_are_record_and_replay_with_units_and_residual(name, request):
    snapshot = request.getfixturevalue(name)
    plant, figure = snapshot.plant, figures.states(snapshot)
    for k, (ax, signal) in enumerate(zip(figure.axes, plant.states, strict=True)):
        assert same(line(ax, "real"), snapshot.record.states[:, k])
        assert same(line(ax, "twin"), snapshot.replay[:, k])
        assert ax.get_title(loc="left") == signal.label
        assert line(ax, "real").get_xdata()[-1] == pytest.approx(plant.horizon, rel=1e-12)
    residual = (snapshot.replay[:, 0] - snapshot.record.states[:, 0]).square().mean().sqrt()
    assert figure.axes[0].get_title(loc="right") == f"RMS {residual:.2g} {plant.states[0].unit}"
    assert "time [s]" in draw(figure)


def test_exogenous_shows_record_mean_and_samples(turbine):
    above, below = figures.exogenous(turbine).axes
    assert same(line(above, "recorded"), turbine.record.exogenous[:, 0])
    for ax in (above, below):
        assert same(line(ax, "large scale (SVR)"), turbine.large_scale[:, 0])
        assert ax.get_title(loc="left") == turbine.plant.inputs[0].label
    assert same(line(below, "3 samples"), turbine.realisations[0, :, 0])
    assert len(below.lines) == 4


@pytest.mark.parametrize("name", ["oscillator", "turbine"])
def test_contours_are_the_policies(name, request, monkeypatch):
    snapshot, filled, original = request.getfixturevalue(name), [], Axes.contourf

    def contourf(ax, x, y, values, **options):
        filled.append((x, y, values, options["levels"]))
        return original(ax, x, y, values, **options)

    monkeypatch.setattr(Axes, "contourf", contourf)
    figure = figures.policy_contours(snapshot)
    assert len(filled) == 2 * len(snapshot.plant.actions)
    seen = visited_observations(snapshot)
    for j, (x, y, values, levels) in enumerate(filled):
        k, role = j // 2, ("model_based", "model_free")[j % 2]
        for column, row in ((0, 0), (7, 60), (RESOLUTION - 1, 3)):
            observation = torch.tensor([x[column], y[row]])
            # A batch may round differently from a single point.
            expected = snapshot.policies[role](observation)[k].item()
            assert values[row, column] == pytest.approx(expected, rel=1e-12, abs=1e-12)
        assert levels[0] <= values.min() and values.max() <= levels[-1]
        # Both policies share the scale, and no visited point lies outside the axes.
        assert np.array_equal(levels, filled[2 * k][3])
        assert x[0] <= seen[:, 0].min() and seen[:, 1].max() <= y[-1]
    labels = draw(figure)
    assert {signal.label for signal in (*snapshot.plant.actions, *snapshot.plant.observations)} <= labels


def test_learning_curves_and_timeline(oscillator):
    live = ["model_free", "model_free", "model_based", "model_based"]
    twin = {"J_a_model_based": 1.0, "J_a_model_free": 2.0}
    costs = [twin | {"real_cost": 4.0 - k, "J_a_unseen": 3.0, "J_p_before": 1.0, "J_p": 0.1**k} for k in range(4)]
    episodes = [cost | {"live": role} for cost, role in zip(costs, live, strict=True)]
    figure = figures.learning_curves(replace(oscillator, episodes=episodes))
    control, identification, strip = figure.axes
    curve = line(control, "real system, live")
    assert (list(curve.get_xdata()), list(curve.get_ydata())) == ([1, 2, 3, 4], [4.0, 3.0, 2.0, 1.0])
    # J_a spans less than a decade and J_p spans three.
    assert (control.get_yscale(), identification.get_yscale()) == ("linear", "log")
    assert [label.get_text() for label in strip.get_yticklabels()] == ["model-free", "model-based"]
    assert "Policies after episode 4" in str(draw(figures.policy_contours(replace(oscillator, episodes=episodes))))
    assert draw(figure)


@pytest.mark.parametrize("arm", ["model_free", "model_based"])
def test_arms_leave_out_what_they_do_not_have(arm):
    snapshot = trained(LinearQuadratic(horizon=2.0), arm=arm, episodes=1)
    drawn = figures.figures_of(snapshot)
    assert set(drawn) == EVERYWHERE | ({"exogenous", "learned_law"} if arm == "model_based" else set())
    assert len(drawn["learning_curves"].axes) == (2 if arm == "model_free" else 3)
    for figure in drawn.values():
        draw(figure)
    bare = replace(snapshot, episodes=[])
    assert set(figures.figures_of(bare)) == set(drawn) - {"learning_curves"}


def test_power_and_speed_against_their_references(turbine):
    wind, speed, power, torque, pitch = turbine_figures.power_and_speed(turbine).axes
    state, action = turbine.record.states[:-1], turbine.record.actions
    assert same(line(wind, "wind"), turbine.record.exogenous[:, 0])
    assert same(line(speed, "real"), 97.0 * state[:, 0])
    assert same(line(speed, "filtered"), state[:, 1])
    # The generator is far above its cut-in speed, so its power is torque times speed.
    np.testing.assert_allclose(line(power, "real").get_ydata(), 97e-6 * state[:, 0] * action[:, 0], rtol=1e-12)
    assert line(power, r"reference $\tilde P$").get_ydata().max() <= 5.0
    assert line(speed, r"reference $\tilde\omega_g$").get_ydata().max() <= 122.9096
    assert same(line(torque, "applied"), 1e-3 * action[:, 0]) and same(line(pitch, "applied"), action[:, 1])


def flown(plant, count=1, n=40):
    generator = torch.Generator().manual_seed(3)
    policy = plant.make_policy(generator)
    start = plant.draw_initial_state(count, generator)
    with torch.no_grad():
        return Rollout(plant, plant.closure, policy)(start, plant.draw_exogenous(count, generator)[:, :n])


def test_every_controller_is_drawn_and_the_setpoint_once():
    plant = WindTurbine(horizon=20.0)
    one = flown(plant)
    other = JonkmanController(plant).fly(one.states[:, 0], one.exogenous)
    figure = flights(plant, {"model_based": one.each()[0], "Jonkman": other.each()[0]})
    assert len(figure.axes) == 2 + len(plant.actions)
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert labels == ["model-based", "setpoint", "Jonkman"]
    speed = figure.axes[0].lines[2]
    assert speed.get_ydata() == pytest.approx(97.0 * other.states[0, :-1, 0].numpy())
    assert matplotlib.colors.same_color(figure.axes[0].lines[0].get_color(), ROLES["model_based"])
    assert figure.axes[2].lines[0].get_ydata() == pytest.approx(one.actions[0, :, 0].numpy())


# The tank's figures against the numbers they are drawn from, on six hours in orbit.


FOUND = {"U_s": [8.0, 46.0], "U_HX": [12.0, 70.0], "K_JT": [90e9, 480e9]}
TRUE = {"U_s": 50.0, "U_HX": 75.0, "K_JT": 500e9}


@pytest.fixture(scope="module")
def tank() -> Snapshot:
    """The real tank, and a twin whose coefficients are some percent off."""
    twin = ConstantCoefficients(torch.tensor([found[-1] for found in FOUND.values()], dtype=torch.float64))
    episodes = [{"closure": {name: found[k] for name, found in FOUND.items()}} for k in range(2)]
    return snapshot_of(CryogenicTank(horizon=6 * 3600.0), twin, shift=10.0, episodes=episodes)


def test_tank_is_the_record(tank):
    figure, plant = tank_figures.tank(tank), tank.plant
    actions = tank.record.actions
    for name, states, K_JT in (("real", tank.record.states, 500e9), ("twin", tank.replay, 480e9)):
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
    assert np.array_equal(line(load, "real").get_ydata(), tank.record.exogenous[:, 0].numpy())
    assert np.array_equal(line(load, "large scale (SVR)").get_ydata(), tank.large_scale[:, 0].numpy())
    assert load.get_xlabel() == "time [h]"
    assert load.get_xlim() == pytest.approx((0.0, 6.0), rel=1e-12)


def test_policies_of_one_observation_are_curves(tank):
    curve = line(figures.policy_contours(tank).axes[0], "model-based")
    expected = tank.policies["model_based"](torch.from_numpy(curve.get_xdata()).unsqueeze(-1))[:, 0]
    np.testing.assert_allclose(curve.get_ydata(), expected.detach().numpy(), rtol=1e-12)


def test_closure_weights_with_truth_start_and_units(tank):
    figure = closure_weights(tank)
    low, high = figure.axes[0].get_xlim()
    assert low < 1 and high > len(tank.episodes)
    for ax, (name, found) in zip(figure.axes, FOUND.items(), strict=True):
        assert list(line(ax, "twin").get_ydata()) == found
        assert line(ax, "true").get_ydata()[0] == pytest.approx(TRUE[name], rel=1e-14)
        start = tank.initial_closure.named_coefficients()[name].item()
        assert line(ax, "start").get_ydata()[0] == start
        assert ax.get_yscale() == "log" and ax.get_title(loc="left").splitlines()[0].endswith("]")
        assert ax.get_title(loc="right") == f"{100 * (found[-1] / TRUE[name] - 1):+.2g} %"


# The drone's figures against the numbers they are drawn from, on a short flight.


@pytest.fixture(scope="module")
def drone() -> Snapshot:
    """Four beats of the real drone, and of a twin that has half the lift."""
    twin = QuasiSteadyPolar(torch.tensor([0.86, 0.05, 1.5], dtype=torch.float64))
    return snapshot_of(FlappingWing(horizon=0.2), twin, shift=0.1, realisations=False)


def test_collectors_path_is_the_record(drone):
    path = panel(drone_figures.flight_path(drone), "vertical plane")
    for name, states in (("real", drone.record.states), ("twin", drone.replay)):
        assert np.array_equal(line(path, name).get_xydata(), states[:, :2].numpy())
    assert line(path, "target").get_xydata().tolist() == [[5.0, 5.0]]
    assert path.get_aspect() == 1.0


def test_laws_of_the_twins_are_drawn(tank, drone):
    for figure in (tank_figures.heat_exchanger(tank), drone_figures.polars(drone)):
        assert {"true", "twin", "initial twin"} <= draw(figure)


def test_control_surfaces_lie_over_an_error_and_its_rate(drone):
    figure = drone_figures.control_surfaces(drone)
    contours = [ax for ax in figure.axes if ax.get_title(loc="left") in ("model-based", "model-free")]
    assert len(contours) == 8
    planes = {(ax.get_xlabel(), ax.get_ylabel()) for ax in contours if ax.get_ylabel()}
    e_x, e_z, de_x, de_z = (signal.label for signal in drone.plant.observations)
    assert planes == {(e_x, de_x), (e_z, de_z)}
