"""What policies of some sensors see, and twins that trainings identify without noise."""

import json

import pytest
import torch
from test_export_recipe import RECIPES

from rt_torchrl.runs.command_line import from_command_line, load_recipe

SENSORS = {
    "wind_turbine": ("rotor_speed",),
    "flapping_wing": ("forward_position", "height"),
    "cryogenic_tank": ("pressure",),
}
"""The sensors that are there, beside those of the inputs."""
SEEN = {"wind_turbine": (), "flapping_wing": ("--observe", "position+wind"), "cryogenic_tank": ()}
"""Options with which the policies observe nothing but these sensors and what a controller computes from them."""


@pytest.mark.parametrize("name", SENSORS)
def test_policies_of_some_sensors_see_nothing_else(name):
    """No change of another state, which no controller holds, changes the observation."""
    config = from_command_line(load_recipe(RECIPES / f"{name}.py").Config, SEEN[name])
    plant, generator = config.plant(), torch.Generator().manual_seed(0)
    state, time = plant.draw_initial_state(1, generator), torch.zeros(1).double()
    exogenous = plant.draw_exogenous(1, generator)[:, 0]
    seen = plant.observe(time, state, exogenous)
    for k, signal in enumerate(plant.states):
        if signal.name not in (*SENSORS[name], *plant.controller_states):
            moved = state.clone()
            moved[:, k] += 0.01
            assert torch.equal(plant.observe(time, moved, exogenous), seen), signal.name


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "episodes", "words", "most"),
    [
        # Without noise the fit goes on until steps end in rounding.
        ("flapping_wing", 1, ("--twinning.assimilation.iterations", "60"), 1e-3),
        ("cryogenic_tank", 2, (), 1e-2),
    ],
)
def test_the_weights_are_those_of_the_real_system_after_two_and_three_episodes(tmp_path, name, episodes, words, most):
    """The classical controller flies the first of them; the twin has the true form, and sensors have no noise."""
    fitted = ["--twinning.assimilation.inputs", "record", "--twinning.assimilation.method", "levenberg_marquardt"]
    fitted += ["--twinning.arm", "model_based", "--twinning.hypotheses.which", "none", *words]
    short = ["--episodes", str(episodes), "--unseen", "2", "--no-figures", "--threads", "1"]
    recipe = load_recipe(RECIPES / f"{name}.py")
    recipe.main(from_command_line(recipe.Config, [*short, *fitted, "--log-dir", str(tmp_path)]))
    laws = json.loads((tmp_path / "metrics.json").read_text())["summary"]["closure"]
    assert max(abs(laws["found"][weight] / true - 1.0) for weight, true in laws["true"].items()) < most
