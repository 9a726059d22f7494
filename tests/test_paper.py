"""``recipes/paper.py``, the paper's algorithm on one screen, and the preset of the same name."""

from pathlib import Path

import pytest

from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.runs.metrics import read_metrics
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.settings import module_of

pytestmark = pytest.mark.training

RECIPES = Path(__file__).parents[1] / "recipes"
SHORT = {"wind_turbine": 20.0, "flapping_wing": 0.05, "cryogenic_tank": 3000.0}
PLANTS = ["wind_turbine", *(pytest.param(name, marks=pytest.mark.slow) for name in SHORT if name != "wind_turbine")]
ITERATIONS = ("--twinning.learner.critic-iterations", "70", "--twinning.learner.actor-iterations", "60")
WORDS = ("--preset", "paper", "--seed", "3", "--unseen", "2", "--no-figures", *ITERATIONS)
REFEREE = ("--twinning.referee.patience", "0", "--twinning.referee.clone-patience", "0")


@pytest.mark.parametrize("plant", PLANTS)
def test_the_recipe_and_the_preset_are_one_algorithm(plant, tmp_path):
    """Over episodes with and without exploration, a change of roles and a clone, for which there is no patience."""
    recipe = load_recipe(RECIPES / f"{plant}.py")
    options = (*WORDS, *REFEREE, "--episodes", "4", "--horizon", str(SHORT[plant]), "--log-dir", str(tmp_path))
    config = from_command_line(recipe.Config, options)
    trained = Run(config, config.plant()).train()["episodes"]
    written = list(module_of(RECIPES / "paper.py").twinning(config))
    assert len(written) == len(trained) == 4
    for ours, its in zip(written, trained, strict=True):
        assert ours.pop("event") == its["event"]
        assert ours == pytest.approx({name: its[name] for name in ours}, rel=1e-6)
    assert {episode["event"] for episode in trained} & {"swap", "clone"}


def test_it_is_one_screen_with_three_options():
    text = (RECIPES / "paper.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 250
    assert list(module_of(RECIPES / "paper.py").Config.__dataclass_fields__) == ["plant", "seed", "episodes"]


@pytest.mark.parametrize("plant", PLANTS)
def test_the_figures_of_the_paper_are_drawn_beside_its_numbers(plant, tmp_path, monkeypatch, capsys):
    recipe = module_of(RECIPES / "paper_figures.py")
    short = ("--horizon", str(SHORT[plant]), "--episodes", "2", "--unseen", "3", *ITERATIONS)
    monkeypatch.setattr(recipe, "OPTIONS", (*recipe.OPTIONS, *short))
    recipe.main(recipe.Config(plant=plant, seeds=(0, 1), jobs=1, log_dir=tmp_path))
    said = capsys.readouterr().out
    assert f"{plant}, 2 seeds" in said and f"(paper {recipe.SWITCHES[plant]})" in said
    drawn = {path.stem for path in (tmp_path / plant / "figures").iterdir()}
    assert {"learning", "robustness", "prediction", *recipe.OF_A_RUN[plant], *recipe.OF_A_PLANT.get(plant, ())} <= drawn
    # A twin that diverges leaves null in metrics.json, and the other numbers are drawn.
    metrics = [read_metrics(tmp_path / plant / f"seed-{seed}") | {"seed": seed} for seed in (0, 1)]
    metrics[0]["episodes"][0] |= {"J_p": None, "J_p_before": None}
    metrics[0]["summary"]["J_p_ratio"] = None
    assert "J_p: nan" in recipe.table(plant, metrics) and recipe.learning(plant, metrics)
