"""The study's numbers and report, from results that are written by hand, and the command of a training."""

import base64
import importlib.util
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro

from rt_torchrl import shipped_plants
from rt_torchrl.evaluation.unseen import UNSEEN_SEED, UnseenEpisodes
from rt_torchrl.study import captions, page, report, yardsticks
from rt_torchrl.study import figures as charts
from rt_torchrl.study.findings import Entry, Results, arm_entry, difference, spread, weight_error, yardstick_entry
from rt_torchrl.study.scheduling import side_by_side
from rt_torchrl.study.training import CHANGED, VARIANTS, Training
from rt_torchrl.study.yardsticks import Yardstick, changed_closure, configured, cost_over_episodes

EPISODES = 30
RECIPES = Path(__file__).parent.parent / "recipes"


def recipe(name):
    """A recipe as a module; tyro reads its source for the help."""
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def training(tmp_path, seed=0, **options):
    arguments = {"recipe": tmp_path / "some_plant.py", "arm": "twinning", "variant": "nominal", "seed": seed}
    return Training(**arguments | {"folder": tmp_path / f"seed-{seed}"} | options)


def summary(costs, live="model_based"):
    mean = {"mean": float(np.mean(costs))}
    return {
        "live": live,
        "J_p_ratio": 1e-3,
        "closure_error": {"found": [0.1, 0.02], "start": [1.0, 0.2]},
        "closure": {"found": {"a": 1.1, "b": 2.0}, "true": {"a": 1.0, "b": 2.0}},
        "unseen": {
            "costs": {"model_based": costs, "model_free": [2.0 * c for c in costs]},
            "merit": {role: {"m [m]": mean} for role in ("model_based", "model_free")},
            "J_a_before": {"mean": 10.0},
            "J_a_model_based": mean,
            "J_a_model_free": {"mean": 2.0 * mean["mean"]},
            "J_p_before": {"mean": 1.0},
            "J_p": {"mean": 1e-3},
        },
    }


def finished(tmp_path, seed, shift, **options):
    """A training whose results are there: costs about 1 + shift."""
    costs = (1.0 + shift + 0.1 * np.random.default_rng(7).standard_normal(EPISODES)).tolist()
    found = training(tmp_path, seed, **options)
    found.folder.mkdir()
    episodes = [
        {"episode": k, "J_a_unseen": cost, "J_p": cost / 100, "event": event}
        for k, (cost, event) in enumerate(((5.0, "keep"), (1.05, "swap"), (1.0, "keep")))
    ]
    (found.folder / "metrics.json").write_text(json.dumps({"summary": summary(costs), "episodes": episodes}))
    return found


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


def written(path, main):
    """A recipe of the options every recipe has, with this as its main."""
    path.write_text(
        "import json, os\n"
        "from dataclasses import dataclass\n"
        "from rt_torchrl.runs.run_config import RunConfig\n\n"
        "@dataclass(frozen=True, kw_only=True)\n"
        "class Config(RunConfig):\n    pass\n\n"
        f"def main(config):\n    {main}\n"
    )
    return path


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


def test_an_arm_is_judged_by_the_policy_that_acts(tmp_path):
    entry = arm_entry("twinning", [finished(tmp_path, seed, 0.1 * seed) for seed in range(3)])
    assert entry.costs.shape == (3, EPISODES)
    assert entry.mean == pytest.approx(entry.costs.mean(1).mean())
    assert entry.weight_error == pytest.approx([0.1] * 3) and entry.J_p_ratio == [1e-3] * 3
    assert entry.episodes_to(1.0) == [2, 2, 2] and entry.episodes_to(0.5) == [None] * 3
    assert entry.twin_errors == [pytest.approx([0.05, 0.0105, 0.01])] * 3
    low, high = entry.interval()
    assert low < entry.mean < high


def test_intervals_cover_the_mean_as_often_as_they_say():
    rng, hits = np.random.default_rng(0), 0
    for _ in range(40):
        low, high = spread(rng.standard_normal((1, 60)))
        hits += low < 0.0 < high
    # 95 % of 40 is 38; fewer than 33 has a probability of 1e-3.
    assert hits >= 33


def test_differences_are_paired_by_episode():
    rng = np.random.default_rng(0)
    hard = 10.0 * rng.random((1, 50))
    first, second = (Entry(name=name, costs=hard + shift, merit={}) for name, shift in (("a", 0.1), ("b", 0.0)))
    # Episodes differ by ten, the controllers by a tenth in each.
    assert difference(first, second) == pytest.approx((0.1, 0.1))
    with pytest.raises(ValueError, match="a was judged on 50 unseen episodes, c on 3"):
        difference(first, Entry(name="c", costs=np.ones((1, 3)), merit={}))


def test_a_closure_of_another_kind_has_no_weight_error():
    assert weight_error({"found": {"a": 1.0}, "true": {"c1": 2.0}}) is None
    assert weight_error({"found": {"a": 1.0}, "true": None}) is None


def test_what_is_kept_is_not_computed_again(tmp_path):
    calls = []
    yardstick = Yardstick(tmp_path / "deep" / "x.json", lambda: calls.append(1) or {"costs": [1.0]})
    for _ in range(2):
        assert yardstick.done() == bool(calls)
        assert yardstick.run() == {"costs": [1.0]}
    assert len(calls) == 1


def results(tmp_path):
    trainings = [finished(tmp_path, seed, 0.0) for seed in range(2)]
    twinning = arm_entry("twinning", trainings)
    ruler = np.array(twinning.costs[0])
    yardsticks = [
        yardstick_entry(name, {"costs": (ruler * factor).tolist(), "merit": {"m [m]": {"mean": 1.0}}})
        for name, factor in (("PD", 1.5), ("oracle", 0.98))
    ]
    halves = [Entry(name="model_free", costs=twinning.costs * 3.0, merit=twinning.merit, curves=[[3.0]] * 2)]
    halves.append(Entry(name="model_based", costs=twinning.costs, merit=twinning.merit, curves=twinning.curves))
    halves.append(Entry(name="twinning, other", costs=twinning.costs * 2.0, merit=twinning.merit, curves=[[2.0]] * 2))
    noisy = [Entry(name=e.name, costs=1.5 * e.costs[:1], merit=e.merit) for e in (twinning, *halves[:2])]
    changed = [Entry(name=e.name, costs=e.costs, merit=e.merit, twin_errors=e.twin_errors) for e in (twinning, *halves)]
    variants = {"noise 1 %": noisy, CHANGED: [*changed[:3], yardsticks[0]]}
    summaries = [t.metrics()["summary"] for t in trainings]
    plant = "flapping_wing"
    return Results({plant: [twinning, *halves, *yardsticks]}, {plant: summaries}, {plant: variants})


def test_the_report_says_what_was_found(tmp_path):
    found = results(tmp_path)
    text = "\n\n".join(report.sections(found, figures=["FIGURE"], quick=True, command="uv run x"))
    assert "Within 5 % of the oracle: **yes** (1.020)" in text
    assert "Against model free alone: **better**" in text
    assert "Against model based alone: **neither better nor worse**" in text
    assert "Twinning against the classical PD: **better**" in text
    assert "Twinning, other against the classical PD: **worse**" in text
    assert "(4.18 ± 0.01)e-1" in text and "no result" in text and "FIGURE" in text
    (row,) = [line for line in text.splitlines() if line.startswith("| noise 1 % | twinning |")]
    assert "| 1.500 |" in row
    assert any(line.startswith("| model error | PD |") and "| 1.000 |" in line for line in text.splitlines())
    assert "Twinning, noise 1 %: against model based alone **neither better nor worse**" in text
    assert "against model free alone **better**" in text
    numbers = json.loads(json.dumps(report.numbers(found)["flapping_wing"]))
    assert numbers["entries"]["PD"]["J_a"] == pytest.approx(1.5 * 1.0, rel=0.1)
    assert numbers["variants"]["noise 1 %"]["twinning"]["J_a"] == pytest.approx(1.5 * 1.0, rel=0.1)


def computed(tmp_path, backend, jobs=2):
    """What the study computes side by side from two trainings of a recipe that only writes its process."""
    main = "(config.log_dir / 'metrics.json').write_text(json.dumps({'process': os.getpid()}))"
    script = written(tmp_path / "tiny.py", main)
    trainings = [training(tmp_path, seed, recipe=script) for seed in range(2)]
    side_by_side([[task] for task in trainings], backend=backend, jobs=jobs)
    return [t.metrics()["process"] for t in trainings]


def test_trainings_run_side_by_side(tmp_path):
    assert os.getpid() not in computed(tmp_path, "loky")


class Counted:
    """A task that writes a file when it is run."""

    def __init__(self, path):
        self.path = path

    def run(self):
        with self.path.open("a") as file:
            file.write(f"{os.getpid()}\n")

    def done(self):
        return self.path.exists()


def test_a_batch_runs_in_one_process_and_the_bar_counts_tasks(tmp_path, capsys):
    batches = [[Counted(tmp_path / f"{batch}-{task}") for task in range(3)] for batch in range(2)]
    batches[0][0].run()
    side_by_side(batches, backend="loky", jobs=2)
    workers = [[task.path.read_text().split()[-1] for task in batch] for batch in batches]
    assert all(len(set(found)) == 1 for found in workers)
    shown = capsys.readouterr().err
    assert "1/6" in shown and "6/6" in shown


def test_a_task_that_fails_stops_no_other(tmp_path):
    failing = training(tmp_path, 7, recipe=written(tmp_path / "fails.py", "raise ValueError('no rotor')"))
    others = [Counted(tmp_path / "first"), Counted(tmp_path / "second")]
    with pytest.raises(RuntimeError, match=r"1 failed, the others are kept:\nRuntimeError: .*fails.py .* no rotor"):
        side_by_side([[failing, others[0]], [others[1]]], backend="loky", jobs=1)
    assert all(task.done() for task in others)


def test_trainings_spread_over_ray(tmp_path):
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        assert os.getpid() not in computed(tmp_path, "ray")
    finally:
        ray.shutdown()


def test_the_figures_show_every_arm_and_yardstick(tmp_path):
    found = results(tmp_path)
    curves = charts.learning(found.entries)
    texts = {text.get_text() for text in curves.legends[0].get_texts()}
    assert texts == {"twinning", "model free", "model based", "twinning, other", "oracle", "classical"}
    (line,) = [line for line in curves.axes[0].lines if line.get_label() == "twinning"]
    assert np.allclose(line.get_ydata(), [5.0, 1.05, 1.0])
    other = {"a": [found.entries["flapping_wing"][3]], "b": found.entries["flapping_wing"][::-1]}
    drawn = [ax.lines for ax in charts.learning(other).axes]
    colours = [{line.get_color() for line in lines if line.get_label() == "twinning, other"} for lines in drawn]
    assert colours[0] == colours[1] and len(colours[0]) == 1
    violins = charts.robustness(found.entries)
    labels = [label.get_text() for label in violins.axes[0].get_xticklabels()]
    assert labels == ["twinning", "model free", "model based", "twinning,\nother", "PD", "oracle"]
    harder = charts.variants(found.entries, found.variants).axes[0]
    assert [label.get_text() for label in harder.get_xticklabels()] == ["nominal", "noise 1 %", "model error"]
    points = [line for line in harder.lines if np.allclose(line.get_xdata(), 0.8)]
    assert np.allclose([line.get_ydata() for line in points], 1.5, rtol=0.05) and len(points) == 1
    line = {"name": "K_P", "unit": "-", "values": [1.0, 10.0], "costs": [2.0, 1.0]}
    (axes,) = charts.cost_line(line, found.entries["flapping_wing"]).axes
    assert [drawn.get_label() for drawn in axes.lines[1:]] == ["twinning", "PD", "oracle"]
    assert np.allclose(axes.lines[1].get_ydata(), found.entries["flapping_wing"][0].mean)
    following = charts.following(found.entries, found.variants).axes[0]
    assert [line.get_label() for line in following.lines] == ["nominal", "model error"]
    assert np.allclose(following.lines[1].get_ydata(), [0.05, 0.0105, 0.01])


def test_captions_say_what_is_seen(tmp_path):
    found = results(tmp_path)
    curves = captions.learning(found)
    assert "twinning 3, 3; model based 3, 3; model free never, never." in curves
    worst = max(e.costs.max() for e in found.entries["flapping_wing"] if e.name == "PD")
    assert f"PD {worst:.3g}" in captions.robustness(found)
    assert "twinning suffers most from noise 1 %, 1.5 times its nominal cost" in captions.variants(found)
    assert "J_p ends at 0.01, with model error at 0.01" in captions.following(found)
    line = {"name": "K_P", "values": [1.0, 10.0, 1e3, 1e4], "costs": [2.5, 2.3, 2.4, 2.2]}
    said = captions.gain_line(line)
    assert "K_P = 10 with 2.3, 2.4 at K_P = 1e+03, and 2.2 at K_P = 1e+04" in said
    assert "2.5 on 1, 2.3 on 10" in captions.episode_line(line | {"values": [1, 10, 100, 1000]})
    assert "falls all the way" in captions.gain_line(line | {"costs": [4.0, 3.0, 2.0, 1.0]})


def test_captions_of_a_training_come_from_its_metrics(tmp_path):
    metrics = finished(tmp_path, 0, 0.0).metrics()
    found = captions.of_run("flapping_wing", metrics)
    assert found["learning_curves"].endswith("Swap after episode 2; no clone. J_a of the live policy went from 5 to 1.")
    # The model-free costs are twice the live ones.
    assert "The live policy (model based) costs less than model free on 30 of 30." in found["unseen"]
    assert "RMS error where the last episode went: 0.1, 0.02; of the initial twin 1, 0.2." in found["polars"]
    assert "RMS error" not in found["flight"]


def test_the_page_holds_its_figures(tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "a.png").write_bytes(b"\x89PNG")
    shown = page.figure(tmp_path / "figures" / "a.png", tmp_path, "what is seen")
    source, html = page.write(tmp_path, "Title", [page.table(["x", "y"], [["1", "2"]]), shown])
    assert "![what is seen](figures/a.png)" in source.read_text()
    text = html.read_text()
    held = base64.b64encode(b"\x89PNG").decode()
    assert "<table>" in text and f'src="data:image/png;base64,{held}"' in text
    assert "figures/a.png" not in text


@pytest.mark.parametrize("plant", ["wind_turbine", "flapping_wing", "cryogenic_tank"])
def test_every_variant_is_an_option_of_every_recipe(plant):
    config = recipe(plant).Config
    nominal = tyro.cli(config, args=[])
    for name, options in VARIANTS.items():
        harder = tyro.cli(config, args=list(options))
        assert (harder == nominal) == (name == "nominal")
        assert harder.model_error == (name == "model error")


def test_a_system_with_model_error_ends_as_its_recipe_says():
    turbine, drone, tank = (shipped_plants()[name]() for name in ("wind_turbine", "flapping_wing", "cryogenic_tank"))
    recipes = [RECIPES / f"{name}.py" for name in ("wind_turbine", "flapping_wing", "cryogenic_tank")]
    worn = changed_closure(turbine, recipes[0], ())
    speeds, pitch = torch.tensor([[7.6]], dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    features = torch.cat([speeds, pitch], -1)
    assert worn(features).item() < 0.95 * turbine.closure(features).item()
    # The drone's real body is the plant's own; it is the twin that believes in a lighter one.
    assert changed_closure(drone, recipes[1], ()) is None
    fouled = changed_closure(tank, recipes[2], ("--episodes", "11"))
    ratio = fouled.log_coefficients.exp() / tank.closure.log_coefficients.exp()
    assert ratio.tolist() == pytest.approx([1.0, 0.98**10, 1.0])


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
    assert [task.path.stem for task in batches[4]] == ["oracle", "Jonkman"]
    planned = [task for batch in batches for task in batch]
    assert len(planned) == len(study.ordered_tasks(study.Config(quick=True, folder=tmp_path)))


def test_a_plan_on_training_episodes_is_judged_on_unseen_ones(monkeypatch):
    monkeypatch.setattr(yardsticks, "missing_for_compilation", lambda: "a compiler")
    system = RECIPES / "wind_turbine.py", ("--horizon", "5")
    planned = {n: cost_over_episodes(*system, unseen=4, counts=(2, 3), iterations=n) for n in (0, 8)}
    plant = configured(*system).plant()
    start = plant.make_policy(torch.Generator().manual_seed(UNSEEN_SEED))
    assert planned[0]["costs"] == pytest.approx([UnseenEpisodes(plant, 4).control_costs(start).mean().item()] * 2)
    assert planned[8]["values"] == [2, 3] and max(planned[8]["costs"]) < planned[0]["costs"][0]


def test_yardsticks_are_measured_on_the_plant_of_the_trainings():
    short = configured(RECIPES / "flapping_wing.py", ("--quick", "--horizon", "1.25"))
    assert short.plant().horizon == pytest.approx(1.25) and short.episodes == 3
    for name, default in shipped_plants().items():
        if (RECIPES / f"{name}.py").exists():
            assert configured(RECIPES / f"{name}.py", ()).plant().extra_repr() == default().extra_repr()


def test_the_plan_of_the_study_counts_seeds_and_variants(tmp_path):
    config = recipe("study").Config(seeds=3, variant_seeds=2, folder=tmp_path)
    groups = config.trainings("flapping_wing")
    assert {key: len(group) for key, group in groups.items() if key[0] == "nominal"} == {
        ("nominal", arm): 3 for arm in ("twinning", "model_free", "model_based", "twinning, perceptron")
    }
    arms = ("twinning", "model_free", "model_based")
    drawn = [t for group in groups.values() for t in group if t.figures]
    assert drawn == groups["nominal", "twinning"][:1] and "--no-figures" not in drawn[0].command()
    assert "--no-figures" in groups["nominal", "twinning"][1].command()
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
