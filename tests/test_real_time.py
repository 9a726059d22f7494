"""Model predictive control in real time: a simulated plant that does not wait, and the recipe around it."""

import json

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic
from tensordict import TensorDict
from test_export_recipe import leave_run, recipe

from rt_torchrl.runs.loaded_run import load_run
from rt_torchrl.runs.rehearsal import Fallback, controller
from rt_torchrl.systems.real_system import episode_seed
from rt_torchrl.systems.wall_clock import WallClock
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import control_cost

PLANT = LinearQuadratic(horizon=1.0, noise=0.5)


class Time:
    """A clock that goes on only when somebody waits or works."""

    def __init__(self):
        self.now, self.waits = 0.0, []

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds
        self.waits.append(seconds)


def flown(works):
    """The states and applied actions of an episode whose controller works for some time at each call."""
    clock = Time()
    wall, seen, asked = WallClock(PLANT, clock=clock, sleep=clock.sleep), [], []

    def controller(reported):
        seen.append({name: values.copy() for name, values in reported.items()})
        clock.now += works[len(asked)] if len(asked) < len(works) else 0.0
        asked.append(np.array([0.1 * (1 + len(asked))]))
        return asked[-1]

    wall.simulate(3, controller)
    return wall, clock, seen, np.array(asked[:-1])


def test_an_episode_in_time_is_a_rollout_at_the_pace_of_the_clock():
    wall, clock, seen, asked = flown([0.02] * PLANT.n_steps)
    generator = torch.Generator().manual_seed(3)
    start, inputs = PLANT.draw_initial_state(1, generator), PLANT.draw_exogenous(1, generator)
    expected = Rollout(PLANT, PLANT.closure)(start, inputs, torch.from_numpy(asked)[None])
    np.testing.assert_allclose([each["state"] for each in seen], expected.states[0].detach().numpy(), rtol=1e-12)
    np.testing.assert_allclose([each["applied"] for each in seen[1:]], asked)
    assert wall.late == 0 and wall.answers == pytest.approx([0.02] * PLANT.n_steps)
    assert clock.now == pytest.approx(PLANT.horizon) and clock.waits == pytest.approx([0.08] * PLANT.n_steps)


def test_a_late_action_leaves_the_last_one():
    wall, clock, seen, asked = flown([0.02, 0.02, 0.25, 0.02])
    applied = np.array([each["applied"] for each in seen[1:]])
    expected = asked.copy()
    expected[2] = asked[1]
    np.testing.assert_array_equal(applied, expected)
    assert wall.late == 1 and clock.now == pytest.approx(PLANT.horizon + 0.15)


@pytest.mark.slow
def test_model_predictive_control_is_in_time(tmp_path, capsys):
    """Twelve intervals of the turbine at the pace of the wall clock."""
    leave_run(tmp_path / "run", "wind_turbine", dt=0.25, horizon=3.0)
    module = recipe("real_time")
    module.main(module.Config(run=tmp_path / "run", folder=tmp_path / "found"))
    found = json.loads((tmp_path / "found" / "real_time.json").read_text())
    assert found["intervals"] == found["solves"] == 12.0 and found["late_actions"] == found["late_solves"] == 0.0
    assert found["safety_events"] == 0.0
    run = load_run(tmp_path / "run")
    generator = torch.Generator().manual_seed(episode_seed(0, 0))
    start, inputs = (draw(1, generator) for draw in (run.plant.draw_initial_state, run.plant.draw_exogenous))
    flown = controller(run, run.plant, None).fly(start, inputs, run.plant.closure)
    assert found["J_a"] == pytest.approx(control_cost(run.plant, flown).item(), rel=1e-6)
    assert 0.0 < found["solve_median_ms"] <= found["solve_p99_ms"] <= found["solve_max_ms"] < 200.0
    assert "late actions" in capsys.readouterr().out


@pytest.mark.slow
def test_solves_that_are_late_leave_the_plan_and_the_plant_in_time(tmp_path):
    leave_run(tmp_path / "run", "wind_turbine", dt=0.25, horizon=2.0)
    module = recipe("real_time")
    module.main(module.Config(run=tmp_path / "run", folder=tmp_path / "found", deadline=1e-6))
    found = json.loads((tmp_path / "found" / "real_time.json").read_text())
    assert found["late_solves"] == found["solves"] == 8.0 and found["late_actions"] == 0.0


def test_the_fallback_is_the_model_free_policy(tmp_path):
    config, parts = leave_run(tmp_path / "run", "wind_turbine", horizon=3.0)
    run = load_run(tmp_path / "run")
    generator = torch.Generator().manual_seed(0)
    state, wind = run.plant.draw_initial_state(1, generator)[0], torch.tensor([11.0]).double()
    reported = TensorDict({"time": torch.zeros(1).double(), "state": state, "exogenous": wind})
    expected = parts["model_free"](run.plant.observe(torch.zeros(()).double(), state, wind))
    torch.testing.assert_close(Fallback(run.plant, run)(reported), expected)


@pytest.mark.parametrize("option", [{"seconds": 0.0}, {"deadline": -1.0}, {"seed": -1}])
def test_impossible_options_are_refused(option, tmp_path):
    ((name, value),) = option.items()
    with pytest.raises(ValueError, match=f"{name}={value}"):
        recipe("real_time").Config(run=tmp_path, **option)


@pytest.mark.parametrize("name", ["limit", "real_time"])
def test_a_folder_that_cannot_be_made_is_refused_before_any_work(name, tmp_path):
    (tmp_path / "file").write_text("")
    module = recipe(name)
    options = {} if name == "limit" else {"run": tmp_path / "none"}
    with pytest.raises(ValueError, match="folder=.*file/below cannot be made"):
        module.main(module.Config(folder=tmp_path / "file" / "below", **options))
