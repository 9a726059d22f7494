"""What a run and the recipe of the limit are compared with, on a plant whose optimal commands are known."""

import ast
import dataclasses
import json
import re

import pytest
import torch
from linear_quadratic import LinearQuadratic
from printed_commands import blocks
from small_runs import SMALL
from test_export_recipe import leave_run, recipe
from test_optimal_control import quadratic_program

from rt_torchrl import load_run
from rt_torchrl.control.predictive_control import PredictiveConfig
from rt_torchrl.envs.cryogenic_tank.controllers import OnOffValve
from rt_torchrl.evaluation.limits import (
    LimitConfig,
    exact_optimum,
    fitting,
    flown_starts,
    predictive,
    resting_at_the_end,
)
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.options import configuration
from rt_torchrl.runs.results import results_table
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.trajectories.rollout import Rollout

WINDOW = PredictiveConfig(horizon=1.0, forecast="held")


@configuration
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
        assert set(found) == {"J_a", "J_a_by_gradients", "J_a_of_each_start", "better_over_reference"}
        assert found["J_a"] <= found["J_a_by_gradients"]
        assert "no limit: the recipe's Config has no limit()" in results_table(metrics)
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


@pytest.mark.parametrize(
    ("config", "options", "message"),
    [
        (Known, {"limit_episodes": -1}, "limit_episodes=-1 must be at least 0"),
        (Known, {"limit_episodes": 1}, "limit_episodes=1 must be 0, or at least 2"),
        (Known, {"reference": True, "device": "cuda"}, "limit on the CPU alone, and device='cuda'"),
        *(
            (recipe("limit").Config, {name: value}, f"{name}={value}")
            for name, value in {"episodes": 1, "seed": -1, "hold": -1, "mpc_horizon": -1.0}.items()
        ),
    ],
)
def test_impossible_options_are_refused(config, options, message):
    with pytest.raises(ValueError, match=message):
        config(**options)


@pytest.mark.parametrize(("horizon", "expected"), [(20.0, 8.0), (5.3, 5.0), (1.0, 1.0)])
def test_a_window_is_no_longer_than_an_episode(horizon, expected):
    window = dataclasses.replace(WINDOW, horizon=8.0, hold=0.5, period=1.0)
    assert fitting(window, LinearQuadratic(horizon=horizon)).horizon == pytest.approx(expected)


class Undisturbed(LinearQuadratic):
    """The plant of the oracle without inputs."""

    inputs = ()

    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action, state.new_zeros((*state.shape[:-1], 1)), closure)

    def draw_exogenous(self, batch, generator):
        return torch.zeros(batch, self.n_steps, 0, dtype=torch.float64)


@pytest.mark.parametrize("plant", [LinearQuadratic(dt=2.0, horizon=20.0), Undisturbed(horizon=2.0)])
def test_model_predictive_control_that_nobody_set_suits_any_plant(plant):
    """Two commands of an episode of ten are fewer than the futures of a scattered forecast; none is not forecast."""
    unseen = UnseenEpisodes(plant, 2)
    idle = Rollout(plant, plant.closure).costs(
        unseen.initial_state, unseen.exogenous, torch.zeros(2, plant.n_steps, 1, dtype=torch.float64)
    )
    assert predictive(unseen, PredictiveConfig()).mean < idle.mean()


def test_the_tanks_limit_begins_from_valves_that_suit_its_command():
    config = recipe("cryogenic_tank").Config
    duty, drop = (config(command=command, horizon=6000.0).limit() for command in ("duty", "drop"))
    assert duty.window is not None and drop.window is None and duty.hold == 20 and drop.hold == 1
    episodes = UnseenEpisodes(config(command="drop", horizon=6000.0).plant(), 2)
    starts = flown_starts(episodes, drop)
    assert list(starts) == ["on-off", "PI", "narrow on-off, resting"]
    flown = episodes.fly(drop.starts["narrow on-off"](episodes.plant)).actions
    assert (starts["narrow on-off, resting"] == resting_at_the_end(episodes, flown)).all()


# The recipe of the limits, on short episodes, and the start that rests at the end.


def run(tmp_path, **options):
    module = recipe("limit")
    descent = module.BoundedDescentConfig(iterations=300)
    module.main(module.Config(episodes=2, folder=tmp_path, descent=descent, **options))
    (path,) = tmp_path.glob("*.json")
    return json.loads(path.read_text())["contenders"]


def mean(contender):
    return sum(contender["costs"]) / len(contender["costs"])


@pytest.mark.slow
def test_the_turbines_limit_is_below_all_controllers(tmp_path, capsys):
    config, _ = leave_run(tmp_path / "run", "wind_turbine", policy="paper", horizon=15.0)
    found = run(tmp_path, mpc=("held", "scattered", "preview"), run=tmp_path / "run")
    episodes = UnseenEpisodes(config.plant(), 2)
    for role, policy in load_run(tmp_path / "run").policies.items():
        assert found[role.replace("_", "-")]["costs"] == pytest.approx(episodes.control_costs(policy).tolist())
    planned = [
        f"MPC, {model}, {forecast}" for model in ("exact", "fitted") for forecast in ("held", "scattered", "preview")
    ]
    assert list(found) == ["clairvoyant", "Jonkman", "model-based", "model-free", *planned]
    best, details = mean(found["clairvoyant"]), found["clairvoyant"]["details"]
    assert all(best < mean(contender) for name, contender in found.items() if name != "clairvoyant")
    assert mean(found["MPC, exact, preview"]) < mean(found["MPC, exact, held"])
    assert mean(found["MPC, exact, preview"]) < mean(found["MPC, fitted, preview"])
    assert set(details["above_the_best"]) == {
        *("Jonkman", "model-based", "model-free"),
        *("constant 0.25", "constant 0.5", "constant 0.75", "random 0"),
    }
    assert found["MPC, exact, held"]["details"]["milliseconds"]["median"] > 0.0
    printed = capsys.readouterr().out
    assert f"{mean(found['Jonkman']) / best:.4f}" in printed and "mean power [MW]" in printed


def test_a_run_has_its_own_cost_and_command(tmp_path):
    """The system is what wear has made of it in the controller's flight and three episodes."""
    options = {"command": "duty", "end_weight": 7200.0, "horizon": 7200.0, "model_error": True, "start": "controller"}
    config, _ = leave_run(tmp_path / "run", "cryogenic_tank", **options)
    (tmp_path / "run" / "metrics.json").write_text(json.dumps({"episodes": [{}] * 3, "summary": {}}))
    found, plant = run(tmp_path, run=tmp_path / "run", mpc=("held",), mpc_horizon=3600.0), config.plant()
    planned = ["MPC, exact, held", "MPC, fitted, held"]
    assert list(found) == ["clairvoyant", "on-off", "PI", "model-based", "model-free", *planned]
    episodes = UnseenEpisodes(plant, 2)
    episodes.closure = config.wear(plant)(3)
    judged = episodes.judge(episodes.fly(OnOffValve(plant)))
    assert found["on-off"]["costs"] == judged.control_costs.tolist()
    assert min(map(mean, found.values())) == mean(found["clairvoyant"])


def test_the_least_commands_last_as_long_as_costs_least():
    plant = LinearQuadratic(horizon=2.0, noise=0.0)
    plant.actions = (plant.actions[0].__class__(symbol="a", name="force", unit="N", low=0.0, high=2.0),)
    episodes = UnseenEpisodes(plant, 3)
    commands = torch.full((3, plant.n_steps, 1), 1.0, dtype=torch.float64)
    rested = resting_at_the_end(episodes, commands)
    rollout = Rollout(plant, plant.closure)
    costs = []
    for k in range(round(0.8 * plant.n_steps), plant.n_steps + 1):
        tried = commands.clone()
        tried[:, k:] = 0.0
        costs.append(rollout.costs(episodes.initial_state, episodes.exogenous, tried))
    wanted = torch.stack(costs).amin(0)
    torch.testing.assert_close(rollout.costs(episodes.initial_state, episodes.exogenous, rested), wanted)


def test_the_printed_example_runs(capsys):
    (code,) = blocks("optimal_control.md", "python")
    exec(compile(code, "docs/optimal_control.md", "exec"), {})
    first, second = ast.literal_eval(re.search(r"tensor\((\[.*?\])", capsys.readouterr().out).group(1))
    assert 0.0 < first < 0.1 and 0.0 < second < 0.1
