"""What a run with the option ``reference`` is compared with, on the plant whose optimal commands are known."""

import dataclasses
import json
from dataclasses import dataclass

import pytest
from handwritten_study import recipe
from linear_quadratic import LinearQuadratic
from small_runs import SMALL
from test_optimal_control import quadratic_program

from rt_torchrl.control.predictive_control import PredictiveConfig
from rt_torchrl.evaluation.limits import LimitConfig, exact_optimum, fitting, flown_starts, resting_at_the_end
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs.results_table import results_table
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig

WINDOW = PredictiveConfig(horizon=1.0, forecast="held")


@dataclass(frozen=True, kw_only=True)
class Known(RunConfig):
    """A configuration that says how its limit is computed."""

    def limit(self):
        return LimitConfig(starts={}, window=WINDOW)


@pytest.mark.parametrize("config", [RunConfig, Known])
def test_a_run_states_the_limit_beside_the_optimum_of_its_class(tmp_path, config):
    options = {"episodes": 1, "unseen": 4, "limit_episodes": 2, "untrained": 0, "figures": False, "reference": True}
    plant = LinearQuadratic(horizon=2.0)
    metrics = Run(config(log_dir=tmp_path / "run", compiled=False, twinning=SMALL, **options), plant).train()
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())["summary"]["reference"]
    assert found["better_over_reference"] >= 1.0 - 1e-9
    if config is RunConfig:
        assert set(found) == {"J_a", "J_a_of_each_start", "better_over_reference"}
        assert "limit on" not in results_table(metrics)
        return
    best, unseen = found["limit"], UnseenEpisodes(plant, 4)
    exact = [
        quadratic_program(plant, unseen.initial_state[k].numpy(), unseen.exogenous[k, :, 0].numpy())[1] for k in (0, 1)
    ]
    assert best["episodes"] == 2 and best["J_a"] == pytest.approx(sum(exact) / 2, rel=1e-6)
    assert max(best["above_the_best"].values()) < 1e-4 and best["projected_gradient"] < 1e-4
    assert best["mpc"]["over_limit"] > 1.0 and best["mpc"]["milliseconds"]["median"] > 0.0
    # The gain has no range, so that it may cost less than commands that have one.
    gain = exact_optimum(unseen, plant.make_policy).policy
    assert best["optimum_over_limit"] == pytest.approx(unseen.control_costs(gain)[:2].mean().item() / best["J_a"])
    costs = metrics["summary"]["unseen"]["costs"][metrics["summary"]["better"]][:2]
    assert best["better_over_limit"] == pytest.approx(sum(costs) / 2 / best["J_a"])
    line = f"limit on the first 2 episodes: J_a {best['J_a']:.5g}; over it: better policy"
    assert line in results_table(metrics) and "model predictive control" in results_table(metrics)


def test_without_episodes_the_limit_is_left_out(tmp_path):
    options = {"episodes": 1, "unseen": 2, "untrained": 0, "figures": False, "reference": True, "limit_episodes": 0}
    plant = LinearQuadratic(horizon=1.0)
    Run(Known(log_dir=tmp_path / "run", compiled=False, twinning=SMALL, **options), plant).train()
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())["summary"]["reference"]
    assert "limit" not in found


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"limit_episodes": -1}, "limit_episodes=-1 must be at least 0"),
        ({"limit_episodes": 1}, "limit_episodes=1 must be 0, or at least 2"),
        ({"reference": True, "device": "cuda"}, "limit on the CPU alone, and device='cuda'"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Known(**options)


def test_the_first_episodes_are_those_of_all():
    episodes = UnseenEpisodes(LinearQuadratic(horizon=1.0), 5)
    few = episodes.first(3)
    assert (few.initial_state == episodes.initial_state[:3]).all() and len(episodes.initial_state) == 5
    assert (few.exogenous == episodes.exogenous[:3]).all() and few.closure is episodes.closure


@pytest.mark.parametrize(("horizon", "expected"), [(20.0, 8.0), (5.3, 5.0), (1.0, 1.0)])
def test_a_window_is_no_longer_than_an_episode(horizon, expected):
    window = dataclasses.replace(WINDOW, horizon=8.0, hold=0.5, period=1.0)
    assert fitting(window, LinearQuadratic(horizon=horizon)).horizon == pytest.approx(expected)


def test_an_episode_shorter_than_the_time_between_two_plans_is_refused():
    with pytest.raises(ValueError, match="horizon=2 s of plant 'linear_quadratic' is shorter than the 3 s between"):
        fitting(dataclasses.replace(WINDOW, horizon=6.0, period=3.0), LinearQuadratic(horizon=2.0))


def test_the_tanks_limit_begins_from_valves_that_suit_its_command():
    config = recipe("cryogenic_tank").Config
    duty, drop = (config(command=command, horizon=6000.0).limit() for command in ("duty", "drop"))
    assert duty.window is not None and drop.window is None and duty.hold == 20 and drop.hold == 1
    episodes = UnseenEpisodes(config(command="drop", horizon=6000.0).plant(), 2)
    starts = flown_starts(episodes, drop)
    assert list(starts) == ["on-off", "PI", "narrow on-off, resting"]
    flown = episodes.fly_baseline(drop.starts["narrow on-off"](episodes.plant)).actions
    assert (starts["narrow on-off, resting"] == resting_at_the_end(episodes, flown)).all()
