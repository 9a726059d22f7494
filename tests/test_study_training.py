"""Trainings of the study: their commands, what counts as finished, and the recipes' options for their variants."""

import pytest
import tyro
from handwritten_study import recipe, training, written

from rt_torchrl.study.training import VARIANTS


def test_the_command_of_a_training_can_be_repeated_by_hand(tmp_path):
    found = training(tmp_path, 3, variant="noise 1 %", options=("--quick",))
    command = found.command()
    assert "some_plant.py --seed 3 --twinning.arm twinning" in command and "--noise 0.01 --quick" in command
    assert "--overwrite" in command and "--resume" not in command
    found.folder.mkdir()
    (found.folder / "checkpoint.pt").touch()
    assert "--resume" in found.command() and "--overwrite" not in found.command()
    with pytest.raises(ValueError, match="variant='rain' does not exist; choose one of nominal"):
        training(tmp_path, variant="rain")


def test_a_failed_training_says_why_and_a_finished_one_is_kept(tmp_path):
    failing = training(tmp_path, recipe=written(tmp_path / "fails.py", "raise ValueError('no rotor')"))
    with pytest.raises(RuntimeError, match="fails.py --seed 0 .* failed; see .*training.log: no rotor"):
        failing.run()
    assert "fails.py --seed 0" in (failing.folder / "training.log").read_text()
    (failing.folder / "metrics.json").write_text("{}")
    failing.run()


def test_a_training_needs_a_recipe(tmp_path):
    with pytest.raises(RuntimeError, match="some_plant.py does not exist"):
        training(tmp_path).run()
    (tmp_path / "bare.py").write_text("x = 1")
    with pytest.raises(RuntimeError, match="has no class Config"):
        training(tmp_path, recipe=tmp_path / "bare.py").run()


@pytest.mark.parametrize("plant", ["wind_turbine", "flapping_wing", "cryogenic_tank"])
def test_every_variant_is_an_option_of_every_recipe(plant):
    config = recipe(plant).Config
    nominal = tyro.cli(config, args=[])
    for name, options in VARIANTS.items():
        harder = tyro.cli(config, args=list(options))
        assert (harder == nominal) == (name == "nominal")
        assert harder.model_error == (name == "model error")
