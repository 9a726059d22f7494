"""The recipe of the limits, on short episodes, and the start that rests at the end."""

import ast
import dataclasses
import json
import math
import re

import pytest
import torch
from linear_quadratic import LinearQuadratic
from printed_commands import blocks
from test_export_recipe import leave_run, recipe

from rt_torchrl import load_run
from rt_torchrl.control.command_cost import BoundedDescentConfig
from rt_torchrl.control.predictive_control import PredictiveConfig
from rt_torchrl.envs.cryogenic_tank.controllers import OnOffValve
from rt_torchrl.evaluation.limits import resting_at_the_end
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs.results_file import write_results
from rt_torchrl.trajectories.rollout import Rollout


def run(tmp_path, **options):
    module = recipe("limit")
    descent = module.BoundedDescentConfig(iterations=300)
    module.main(module.Config(episodes=2, folder=tmp_path, descent=descent, **options))
    (path,) = tmp_path.glob("*.json")
    return json.loads(path.read_text())["contenders"]


def mean(contender):
    return sum(contender["costs"]) / len(contender["costs"])


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
    assert found["Jonkman"]["milliseconds"]["median"] > 0.0 and found["clairvoyant"]["milliseconds"] is None
    printed = capsys.readouterr().out
    assert f"{mean(found['Jonkman']) / best:.4f}" in printed and "mean power [MW]" in printed


def test_a_run_has_its_own_cost_and_command(tmp_path):
    config, _ = leave_run(tmp_path / "run", "cryogenic_tank", command="duty", end_weight=7200.0, horizon=7200.0)
    found, plant = run(tmp_path, run=tmp_path / "run", mpc=("held",), mpc_iterations=1), config.plant()
    assert found["MPC, exact, held"]["details"]["gradients"] <= 3
    planned = ["MPC, exact, held", "MPC, fitted, held"]
    assert list(found) == ["clairvoyant", "on-off", "on-off, resting", "PI", "model-based", "model-free", *planned]
    episodes = UnseenEpisodes(plant, 2)
    judged = episodes.judge(episodes.fly_baseline(OnOffValve(plant)))
    assert found["on-off"]["costs"] == judged.control_costs.tolist()
    assert min(map(mean, found.values())) == mean(found["clairvoyant"])


def test_solves_have_the_recipes_window_with_what_is_asked_for():
    module, window = recipe("limit"), PredictiveConfig(horizon=2.0, iterations=7)
    assert module.chosen_window(module.Config(), window) == window
    found = module.chosen_window(module.Config(mpc_horizon=8.0, mpc_iterations=60, mpc_tolerance=1e-6), window)
    assert found == dataclasses.replace(window, horizon=8.0, iterations=60, tolerance=1e-6)


@pytest.mark.parametrize("option", [{"plant": "wind_turbine"}, {"horizon": 15.0}])
def test_a_run_is_not_mixed_with_a_plant(option, tmp_path):
    with pytest.raises(ValueError, match="run has a plant and a horizon of its own"):
        recipe("limit").Config(run=tmp_path, **option)


def test_results_are_standard_json(tmp_path):
    """Numbers that are not finite are null, and paths are text."""
    content = {"config": BoundedDescentConfig(), "costs": (1.5, math.inf, math.nan), "folder": tmp_path, "none": None}
    found = json.loads(write_results(tmp_path / "found.json", content).read_text(), parse_constant=pytest.fail)
    assert found["costs"] == [1.5, None, None] and found["folder"] == str(tmp_path) and found["none"] is None
    assert found["config"]["memory"] == BoundedDescentConfig().memory


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


@pytest.mark.parametrize("option", [{"episodes": 1}, {"seed": -1}, {"hold": -1}, {"mpc_horizon": -1.0}])
def test_impossible_options_are_refused(option):
    ((name, value),) = option.items()
    with pytest.raises(ValueError, match=f"{name}={value}"):
        recipe("limit").Config(**option)


def test_a_folder_that_cannot_be_made_is_refused_before_any_work(tmp_path):
    (tmp_path / "file").write_text("")
    module = recipe("limit")
    with pytest.raises(ValueError, match="folder=.*file/below cannot be made"):
        module.main(module.Config(folder=tmp_path / "file" / "below"))
