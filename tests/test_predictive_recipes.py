"""Model predictive control in the recipes, over short episodes, with the options that change what it meets."""

import dataclasses
import json

import pytest
from printed_commands import ROOT

from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.user_code import module_of

SHORT = {
    "wind_turbine": ["--horizon", "20", "--twinning.learner.return-steps", "1"],
    "flapping_wing": [
        *("--horizon", "0.2", "--twinning.learner.return-steps", "1"),
        *("--twinning.planner.receding-horizon.horizon", "1"),
    ],
    "cryogenic_tank": ["--horizon", "7200", "--twinning.learner.return-steps", "1", "--command", "duty"],
}
ALWAYS = (
    "--quick --untrained 0 --no-figures --threads 1 --twinning.planner.method receding_horizon "
    "--twinning.referee.patience 0 --twinning.planner.receding-horizon.virtual-episodes 1 "
    "--twinning.learner.critic-iterations 5 --twinning.learner.actor-iterations 5"
).split()


def recipe(name):
    return module_of(ROOT / "recipes" / f"{name}.py")


def records(tmp_path, name, *options):
    """The episodes of a short training by the recipe's own command line and main."""
    module = recipe(name)
    words = [*ALWAYS, *SHORT[name], "--log-dir", str(tmp_path / "run"), *options]
    module.main(from_command_line(module.Config, words))
    return json.loads((tmp_path / "run" / "metrics.json").read_text())["episodes"]


@pytest.mark.parametrize(
    "options",
    [
        pytest.param("--observe measured+wind --policy mlp --model-error", marks=pytest.mark.nightly),
        pytest.param("--observe preview --noise 0.01 --twinning.referee.rule decision_tree", marks=pytest.mark.nightly),
        pytest.param(
            "--policy scheduled --twinning.learner.algorithm td3 --twinning.arm model_based", marks=pytest.mark.slow
        ),
        # Torch computes the gradients of a window that the critic prices, so that a solve takes tenths of a second.
        pytest.param(
            "--closure mlp --twinning.assimilation.segment 5 --twinning.planner.receding-horizon.terminal critic "
            "--episodes 1 --horizon 5 --twinning.planner.receding-horizon.horizon 2",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_turbine_takes_it_with_other_options(tmp_path, options):
    acted = [record for record in records(tmp_path, "wind_turbine", *options.split()) if "solve_median" in record]
    assert acted and all(record["late_solves"] == 0.0 for record in acted)
    if "critic" not in options:  # one that has hardly learned prices the end of a window wrongly
        assert all(record["real_cost"] < 0.5 for record in acted), [record["real_cost"] for record in acted]


@pytest.mark.slow
def test_the_drone_takes_it_with_a_wrong_mass_and_sensors(tmp_path):
    options = "--twinning.arm model_based --model-error --observe phase --noise 0.001".split()
    found = records(tmp_path, "flapping_wing", *options)
    assert len(found) == 3 and all(record["late_solves"] == 0.0 < record["solve_median"] for record in found)


@pytest.mark.slow
def test_the_tank_takes_it_with_duty_cycles(tmp_path):
    found = records(tmp_path, "cryogenic_tank", "--twinning.arm", "model_based")
    assert len(found) == 3 and all(record["late_solves"] == 0.0 < record["solve_median"] for record in found)


def test_the_tank_refuses_it_with_a_half_open_valve():
    module = recipe("cryogenic_tank")
    planner = dataclasses.replace(module.CONVERGED.planner, method="receding_horizon")
    twinning = dataclasses.replace(module.CONVERGED, planner=planner)
    with pytest.raises(ValueError, match="command='drop' does not go with start='mpc' or method=.*Use command duty"):
        module.Config(command="drop", twinning=twinning)
