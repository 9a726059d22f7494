"""Figures against the numbers they are drawn from, on snapshots of short trainings and on flights."""

import copy
import sys
from dataclasses import replace

import matplotlib.colors
import numpy as np
import pytest
import torch
from figure_reading import clipped_texts, collisions, draw, line
from linear_quadratic import LinearGain, LinearQuadratic
from matplotlib.axes import Axes

from rt_torchrl import DigitalTwin, PlantEnv, ReinforcementTwinning, Rollout, Signal, Snapshot, figures
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine import figures as turbine_figures
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.unknown import unknown
from rt_torchrl.evaluation.unseen import Judged
from rt_torchrl.figures import flights
from rt_torchrl.figures.style import ROLES
from rt_torchrl.figures.training import RESOLUTION, visited_observations
from rt_torchrl.runs.results import episode_record
from rt_torchrl.steps.config import AssimilationConfig, LearnerConfig, PlannerConfig, RefereeConfig, TwinningConfig

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
        learner=LearnerConfig(critic_iterations=2, actor_iterations=2, batch_size=8),
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
def test_every_figure_is_drawn_within_its_canvas(name, request):
    snapshot = request.getfixturevalue(name)
    drawn = figures.figures_of(snapshot)
    assert set(drawn) == EVERYWHERE | {"exogenous"}
    for figure in drawn.values():
        assert draw(figure)
        assert clipped_texts(figure) == [] and not collisions(figure)
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


class Observing(LinearQuadratic):
    """The oscillator seen through the first of its states."""

    observations = (Signal(symbol="e", name="error", unit="-", low=-1.0, high=1.0),)

    def observe(self, t, state, exogenous):
        return state[..., :1]


def test_policies_of_one_observation_are_curves(oscillator):
    gain = torch.tensor([[0.5]], dtype=torch.float64)
    policies = {"model_based": LinearGain(gain), "model_free": LinearGain(0.0 * gain)}
    figure = figures.policy_contours(replace(oscillator, plant=Observing(), policies=policies))
    curve = line(figure.axes[0], "model-based")
    np.testing.assert_allclose(curve.get_ydata(), -0.5 * curve.get_xdata(), rtol=1e-15)


def test_learning_curves_and_timeline(oscillator):
    live = ["model_free", "model_free", "model_based", "model_based"]
    twin = {"J_a_model_based": 1.0, "J_a_model_free": 2.0}
    costs = [twin | {"real_cost": 4.0 - k, "J_a_unseen": 3.0, "J_p_before": 1.0, "J_p": 0.1**k} for k in range(4)]
    episodes = [cost | {"live": role} for cost, role in zip(costs, live, strict=True)]
    figure = figures.learning_curves(replace(oscillator, episodes=episodes))
    control, identification, strip = figure.axes
    assert list(line(control, "real system, live").get_ydata()) == [4.0, 3.0, 2.0, 1.0]
    # J_a spans less than a decade and J_p spans three.
    assert (control.get_yscale(), identification.get_yscale()) == ("linear", "log")
    spans = [
        [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in bars.get_paths()]
        for bars in strip.collections
        if bars.get_alpha() == 1.0
    ]
    assert [label.get_text() for label in strip.get_yticklabels()] == ["model-free", "model-based"]
    assert spans == [[(-0.5, 0.5), (0.5, 1.5)], [(1.5, 2.5), (2.5, 3.5)]]
    assert draw(figure) and not collisions(figure)


@pytest.mark.parametrize("arm", ["model_free", "model_based"])
def test_arms_leave_out_what_they_do_not_have(arm):
    snapshot = trained(LinearQuadratic(horizon=2.0), arm=arm, episodes=1)
    drawn = figures.figures_of(snapshot)
    assert set(drawn) == EVERYWHERE | ({"exogenous"} if arm == "model_based" else set())
    assert len(drawn["learning_curves"].axes) == (2 if arm == "model_free" else 3)
    for figure in drawn.values():
        draw(figure)
    draw(figures.exogenous(snapshot))
    bare = replace(snapshot, episodes=[])
    assert set(figures.figures_of(bare)) == set(drawn) - {"learning_curves"}


def test_power_and_speed_against_their_references(turbine):
    wind, speed, power, torque, pitch = axes = turbine_figures.power_and_speed(turbine).axes
    state, action = turbine.record.states[:-1], turbine.record.actions
    assert same(line(wind, "wind"), turbine.record.exogenous[:, 0])
    assert same(line(speed, "real"), 97.0 * state[:, 0])
    assert same(line(speed, "filtered"), state[:, 1])
    # The generator is far above its cut-in speed, so its power is torque times speed.
    np.testing.assert_allclose(line(power, "real").get_ydata(), 97e-6 * state[:, 0] * action[:, 0], rtol=1e-12)
    assert line(power, r"reference $\tilde P$").get_ydata().max() <= 5.0
    assert line(speed, r"reference $\tilde\omega_g$").get_ydata().max() <= 122.9096
    assert same(line(torque, "applied"), 1e-3 * action[:, 0]) and same(line(pitch, "applied"), action[:, 1])
    units = [ax.get_title(loc="left").split("[")[1] for ax in axes]
    assert units == ["m/s]", "rad/s]", "MW]", "kN m]", "deg]"]


def flown(plant, count=1, n=40):
    generator = torch.Generator().manual_seed(3)
    policy = plant.make_policy(generator)
    start = plant.draw_initial_state(count, generator)
    with torch.no_grad():
        return Rollout(plant, plant.closure, policy)(start, plant.draw_exogenous(count, generator)[:, :n])


def held(plant, one):
    return plant.setpoints(one.states[:, :-1], one.actions, one.exogenous)


def test_setpoints_are_what_the_costs_follow():
    turbine = WindTurbine(horizon=20.0)
    one = flown(turbine, 3)
    speed, wanted = held(turbine, one)["generator speed [rad/s]"]
    torch.testing.assert_close(speed, 97.0 * one.states[:, :-1, 0])
    assert wanted.max() <= 122.92 and held(turbine, one)["power [MW]"][1].max() <= 5.3  # the rated speed, 1173.7 rpm
    real = unknown(turbine, ("pitch",))  # an extended plant has the setpoints of its base
    assert list(held(real, flown(real))) == list(held(turbine, one))
    tank = CryogenicTank(horizon=3000.0)
    pressure, wanted = held(tank, flown(tank))["pressure [kPa]"]
    torch.testing.assert_close(pressure, 1e-3 * flown(tank).states[:, :-1, 2])
    assert (wanted == 500.0).all()
    drone = FlappingWing(horizon=0.05, target=(2.0, 3.0))
    assert [held(drone, flown(drone))[name][1].unique().item() for name in ("x [m]", "z [m]")] == [2.0, 3.0]
    assert held(Pendulum(), flown(Pendulum())) == {}


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


COUNT = 12


def judged(*names):
    generator = torch.Generator().manual_seed(0)
    values = {name: torch.rand(2, COUNT, generator=generator, dtype=torch.float64) + 0.1 for name in names}
    return {name: Judged(costs, {"final distance [m]": 100.0 * merit}) for name, (costs, merit) in values.items()}


def test_every_episode_is_a_point_and_every_mean_a_bar():
    found = judged("model_based", "model_free", "PD")
    figure = figures.unseen(found)
    draw(figure)
    assert len(figure.axes) == 2
    for ax, pick in zip(figure.axes, ("costs", "merit"), strict=True):
        shown = [line for line in ax.lines if line.get_marker() == "o"]
        bars = [line for line in ax.lines if line.get_marker() == "None"]
        for column, (who, values) in enumerate(found.items()):
            expected = values.control_costs if pick == "costs" else values.merit["final distance [m]"]
            assert np.array_equal(shown[column].get_ydata(), expected)
            assert np.allclose(bars[column].get_ydata(), expected.mean().item()), who
            assert (np.abs(shown[column].get_xdata() - column) < 0.3).all()
