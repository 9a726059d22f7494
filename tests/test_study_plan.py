"""The plan of the study: which trainings and yardsticks its recipe asks for, and in which batches."""

import json

import pytest
from handwritten_study import EPISODES, finish, recipe

from rt_torchrl.study.training import VARIANTS, Training


def test_a_plant_that_does_not_exist_is_refused():
    config = recipe("study").Config
    with pytest.raises(ValueError, match="must be all, or some of wind_turbine, flapping_wing, cryogenic_tank"):
        config(plants=("moon",))
    assert config(plants=("all",)).chosen() == ["wind_turbine", "flapping_wing", "cryogenic_tank"]


def test_short_trainings_of_a_plant_share_a_worker(tmp_path):
    study = recipe("study")
    batches = study.short_batches(study.Config(quick=True, folder=tmp_path))
    plants_of = [{task.plant for task in batch if isinstance(task, Training)} for batch in batches]
    # The turbine's oracle shares no graph with its trainings, the gain-scheduled policy none with the other ones.
    assert plants_of == [{"cryogenic_tank"}, {"flapping_wing"}, {"wind_turbine"}, {"wind_turbine"}, set()]
    (alone,) = batches[3]
    assert alone.options[-2:] == ("--policy", "scheduled")
    assert [task.path.stem for task in batches[4]] == ["oracle", "Jonkman", "limit-2", "mpc-2"]
    planned = [task for batch in batches for task in batch]
    assert len(planned) == len(study.ordered_tasks(study.Config(quick=True, folder=tmp_path)))


def test_the_limit_and_predictive_control_can_be_left_out(tmp_path):
    config = recipe("study").Config
    plants = ("wind_turbine", "flapping_wing", "cryogenic_tank")
    asked = {plant: list(config(folder=tmp_path).limits(plant)) for plant in plants}
    # Gradients find no plans of the tank's half-open valve.
    assert asked == {"wind_turbine": ["limit", "mpc"], "flapping_wing": ["limit", "mpc"], "cryogenic_tank": ["limit"]}
    assert all(config(folder=tmp_path, limit_episodes=0).limits(plant) == {} for plant in plants)
    few = config(folder=tmp_path, limit_episodes=3)
    assert few.limits("wind_turbine")["mpc"].path.name == "mpc-3.json"  # other results than those on 8 episodes
    assert "--limit-episodes 3" in recipe("study").command(few)
    for impossible in (1, 101, -1):
        with pytest.raises(ValueError, match=f"limit_episodes={impossible} must be 0, or from 2 to unseen=100"):
            config(limit_episodes=impossible)


def test_the_plan_of_the_study_counts_seeds_and_variants(tmp_path):
    config = recipe("study").Config(seeds=3, variant_seeds=2, folder=tmp_path)
    groups = config.trainings("flapping_wing")
    assert {key: len(group) for key, group in groups.items() if key[0] == "nominal"} == {
        ("nominal", arm): 3 for arm in ("twinning", "model_free", "model_based", "twinning, perceptron")
    }
    arms = ("twinning", "model_free", "model_based")
    assert [key for key in groups if key[0] != "nominal"] == [(v, a) for v in VARIANTS if v != "nominal" for a in arms]
    assert all(len(group) == 2 for key, group in groups.items() if key[0] != "nominal")
    folders = {t.folder for group in groups.values() for t in group}
    assert len(folders) == 3 * 4 + 4 * 3 * 2
    policies = [name for v, name in config.trainings("wind_turbine") if v == "nominal"][3:]
    assert policies == ["twinning, gain-scheduled", "twinning, with bias", "twinning, perceptron"]
    (first, *_) = config.trainings("wind_turbine")["nominal", policies[0]]
    assert first.arm == "twinning" and first.command().endswith("--policy scheduled")
    short = recipe("study").Config(quick=True, folder=tmp_path).trainings("flapping_wing")
    assert list(dict.fromkeys(variant for variant, _ in short)) == ["nominal", "noise 5 %", "model error"]
    # What is kept of a quick study is never taken for a result of the whole one.
    assert folders.isdisjoint(t.folder for group in short.values() for t in group)


ALL = ("wind_turbine", "flapping_wing", "cryogenic_tank")


def test_names_of_unknown_systems_belong_to_the_plants_that_have_them():
    config = recipe("study").Config
    assert config().beside() == dict.fromkeys(ALL, ())
    found = config(unknown=("valve_lag", "gust", "inflow", "pitch", "bias_5")).beside()
    assert found == dict(zip(ALL, (("inflow", "pitch"), ("gust",), ("bias_5", "valve_lag")), strict=True))


def test_names_that_a_plant_of_the_study_does_not_have_are_refused():
    config = recipe("study").Config
    with pytest.raises(
        ValueError, match=r"none of them is on wind_turbine, flapping_wing\. Name the plants .*--plants"
    ):
        config(unknown=("bias_15",))
    with pytest.raises(ValueError, match="moon is on none of these plants; choose cryogenic_tank: bias_5, bias_15"):
        config(unknown=("bias_15", "moon"), plants=("cryogenic_tank",))
    with pytest.raises(ValueError, match="pitch is on none of these plants"):  # another plant has it
        config(unknown=("bias_15", "pitch"), plants=("cryogenic_tank",))
    with pytest.raises(ValueError, match="bias_5 and bias_15 both change the pressure sensor"):
        config(unknown=("bias_5", "bias_15"), plants=("cryogenic_tank",))


def test_everything_of_a_study_is_made_on_the_real_system_that_it_names(tmp_path):
    study = recipe("study")
    common = {"plants": ("cryogenic_tank",), "folder": tmp_path}
    nominal, config = study.Config(**common), study.Config(unknown=("valve_lag", "bias_15"), **common)
    trainings = [task for task in study.ordered_tasks(config) if isinstance(task, Training)]
    assert all("--unknown bias_15 valve_lag" in training.command() for training in trainings)
    yardsticks = [task for task in study.ordered_tasks(config) if not isinstance(task, Training)]
    assert len(yardsticks) == 5
    assert all("bias_15" in str(task.compute.args) and "valve_lag" in str(task.compute.args) for task in yardsticks)
    # Model error would be another real system.
    assert config.variants() == ["noise 0.5 %", "noise 1 %", "noise 5 %"]
    assert nominal.variants() == [*config.variants(), "model error"]
    assert study.command(config).startswith(
        "uv run recipes/study.py --plants cryogenic_tank --unknown valve_lag bias_15 "
    )
    # The same names in another order are the same system; nothing else shares a folder with it.
    again = study.Config(unknown=("bias_15", "valve_lag"), **common)
    others = [nominal, study.Config(unknown=("bias_15",), **common), study.Config(quick=True, **common)]
    assert places(again) == places(config)
    assert all(places(other).isdisjoint(places(config)) for other in others)


def places(config):
    """Where a study keeps its report and results."""
    tasks = recipe("study").ordered_tasks(config)
    return {config.report, *(task.folder if isinstance(task, Training) else task.path for task in tasks)}


def test_a_report_is_written_of_a_system_that_its_twin_does_not_know(tmp_path):
    """Of the turbine without the limit, because its report has no line of costs: nothing is computed."""
    study = recipe("study")
    config = study.Config(plants=("wind_turbine",), unknown=("pitch",), quick=True, limit_episodes=0, folder=tmp_path)
    groups = config.trainings("wind_turbine")
    for training in (training for group in groups.values() for training in group):
        finish(training)
    for task in study.yardstick_tasks(config, "wind_turbine"):
        task.path.parent.mkdir(parents=True, exist_ok=True)
        task.path.write_text(json.dumps({"costs": [1.1] * EPISODES, "merit": {"m [m]": {"mean": 1.0}}}))
    page = study.write(config)
    assert page.parent == tmp_path / "quick" / "unknown" / "pitch"
    text = (page.parent / "README.md").read_text()
    assert "## Wind turbine with pitch" in text and "| noise 5 % | twinning |" in text
    assert "| model error |" not in text and "following.png" not in text
    assert "beside the paper" not in text  # whose table is of the plants as their twins know them
    assert json.loads((page.parent / "study.json").read_text())["wind_turbine"]["unknown"] == ["pitch"]


def test_the_report_is_written_from_what_is_kept(tmp_path):
    """A whole quick study of the drone from results written by hand: nothing is computed."""
    study = recipe("study")
    config = study.Config(plants=("flapping_wing",), quick=True, folder=tmp_path)
    groups = config.trainings("flapping_wing")
    for training in (training for group in groups.values() for training in group):
        finish(training)
    judged = {"costs": [1.1] * EPISODES, "merit": {"m [m]": {"mean": 1.0}}}
    line = {"name": "episodes planned on", "unit": "-", "values": [2, 5], "costs": [1.2, 1.1]}
    for task in study.yardstick_tasks(config, "flapping_wing"):
        task.path.parent.mkdir(parents=True, exist_ok=True)
        task.path.write_text(json.dumps(line if task.path.stem == "episode-line" else judged | {"changed": judged}))
    assert all(task.done() for task in study.ordered_tasks(config))
    page = study.write(config)
    text = (page.parent / "README.md").read_text()
    study_figures = ["learning", "robustness", "limits", "variants", "following", "flapping_wing_episode-line"]
    shown = [part.split(")")[0] for part in text.split("](figures/")[1:]]
    assert shown == [f"{name}.png" for name in study_figures]
    assert all((page.parent / "figures" / name).exists() for name in shown)
    names = ("twinning", "twinning, perceptron", "PD", "oracle", "limit", "mpc")
    assert all(f"| {name} |" in text for name in names)
    assert "--quick" in text
    numbers = json.loads((page.parent / "study.json").read_text())["flapping_wing"]
    assert list(numbers["variants"]) == ["noise 5 %", "model error"]
