"""The study from results by hand: its plan, tables, figures and numbers, and finished runs side by side."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from handwritten_study import EPISODES, finish, finished, recipe, results

from rt_torchrl.atomic_file import finite
from rt_torchrl.study import figures as charts
from rt_torchrl.study import page, tables
from rt_torchrl.study.bootstrap import mean_interval
from rt_torchrl.study.comparison import comparison_figure, comparison_table, entries_of
from rt_torchrl.study.results import Entry, arm_entry, difference, weight_error
from rt_torchrl.study.tables import difference_table, paper_table
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


# The study's tables, figures and numbers, from results that are written by hand.


def rows_of(text):
    """Cells of each row of the Markdown tables in a text."""
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:2] == "| "]


def test_the_page_has_tables_and_numbers(tmp_path):
    figures = [Path("figures/a.png")]
    source = page.write(tmp_path, results(tmp_path), figures=figures, quick=True, command="uv run x")
    text = source.read_text()
    assert "(4.18 ± 0.01)e-1" in text and "no result" in text and "uv run x" in text and "![a](figures/a.png)" in text
    harder = {tuple(row[:2]): row for row in rows_of(text)}
    assert harder["noise 1 %", "twinning"][4] == "1.500" and harder["model error", "PD"][4] == "1.000"
    numbers = json.loads((tmp_path / "study.json").read_text())["flapping_wing"]
    assert numbers["entries"]["PD"]["J_a"] == pytest.approx(1.5 * 1.0, rel=0.1)
    assert numbers["variants"]["noise 1 %"]["twinning"]["J_a"] == pytest.approx(1.5 * 1.0, rel=0.1)


def test_differences_say_who_is_better(tmp_path):
    found = results(tmp_path)
    rows = rows_of(difference_table({"nominal": found.entries["flapping_wing"]} | found.variants["flapping_wing"]))
    signs = {}
    for variant, arm, other, interval in rows[2:]:
        low, high = map(float, interval.split(" … "))
        signs[variant, arm, other] = -1 if high < 0.0 else 1 if low > 0.0 else 0
    assert signs["nominal", "twinning", "model free"] == -1 and signs["nominal", "twinning", "model based"] == 0
    assert signs["nominal", "twinning", "PD"] == -1 and signs["nominal", "twinning, other", "PD"] == 1
    assert signs["noise 1 %", "twinning", "model free"] == -1 and signs["noise 1 %", "twinning", "model based"] == 0
    assert not any("oracle" in key for key in signs)


def test_the_table_has_the_limit_and_predictive_control_on_the_first_episodes(tmp_path):
    found = results(tmp_path)
    text = page.write(tmp_path, found, figures=[], quick=False, command="x").read_text()
    rows = {row[0]: row for row in reversed(rows_of(text))}
    entries = {entry.name: entry for entry in found.entries["flapping_wing"]}
    best = 0.5 * entries["twinning"].costs[0, :8].mean()
    assert rows["limit"][4] == "1.000" and rows["mpc"][4] == "1.500"
    assert rows["twinning"][4] == f"{entries['twinning'].costs[:, :8].mean() / best:.3f}"
    assert rows["mpc"][3] == f"{1.5 * best / entries['oracle'].costs[:, :8].mean():.3f}"
    assert "on the first 8 unseen episodes" in text and "3.25 ms in the median" in text
    numbers = json.loads((tmp_path / "study.json").read_text())["flapping_wing"]
    assert numbers["limits"]["mpc"]["milliseconds"] == 3.25 and numbers["limits"]["limit"]["episodes"] == 8
    without = page.write(tmp_path, found._replace(limits={"flapping_wing": []}), figures=[], quick=False, command="x")
    assert "limit" not in without.read_text()


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


def test_a_figure_shows_how_far_from_the_limit_everything_is(tmp_path):
    found = results(tmp_path)
    (ax,) = charts.limits(found.entries, found.limits).axes
    drawn = dict(zip([label.get_text() for label in ax.get_yticklabels()], ax.patches, strict=True))
    twinning, best = found.entries["flapping_wing"][0], found.limits["flapping_wing"][0]
    assert drawn["mpc"].get_width() == pytest.approx(1.5) and "limit" not in drawn
    assert drawn["twinning"].get_width() == pytest.approx(twinning.costs[:, :8].mean() / best.costs.mean())
    assert set(drawn) == {"mpc", *(entry.name.replace("_", " ") for entry in found.entries["flapping_wing"])}


def test_tables_have_a_word_for_what_diverges(tmp_path):
    """``metrics.json`` holds null for it."""
    metrics = finished(tmp_path, 0, 0.0).metrics()
    metrics["summary"]["unseen"]["J_a_model_free"]["mean"] = None
    assert "| inf |" in paper_table({"flapping_wing": [metrics["summary"]]})


def test_a_study_without_variants_has_no_section_of_them(tmp_path):
    found = results(tmp_path)._replace(variants={"flapping_wing": {}}, limits={"flapping_wing": []})
    source = page.write(tmp_path, found, figures=[], quick=False, command="uv run x")
    assert "Sensor noise and model error" not in source.read_text()


# Rows of the study and their intervals, from trainings that are written by hand.


def test_an_arm_is_judged_by_the_policy_that_acts(tmp_path):
    entry = arm_entry("twinning", [finished(tmp_path, seed, 0.1 * seed) for seed in range(3)])
    assert entry.costs.shape == (3, EPISODES)
    assert entry.mean == pytest.approx(entry.costs.mean(1).mean())
    assert entry.weight_error == pytest.approx([0.1] * 3) and entry.J_p_ratio == [1e-3] * 3
    assert entry.episodes_to(1.0) == [2, 2, 2] and entry.episodes_to(0.5) == [None] * 3
    assert entry.twin_errors == [pytest.approx([0.05, 0.0105, 0.01])] * 3
    low, high = entry.interval()
    assert low < entry.mean < high


def test_an_unseen_episode_that_diverges_costs_infinitely(tmp_path):
    """``metrics.json`` holds null there; the study must not fail, and the mean must not pass it over."""
    found = [finished(tmp_path, seed, 0.1 * seed) for seed in range(2)]
    metrics = found[1].metrics()
    live = metrics["summary"]["live"]
    metrics["summary"]["unseen"]["costs"][live][3] = None
    for values in metrics["summary"]["unseen"]["merit"][live].values():
        values["mean"] = None
    (found[1].folder / "metrics.json").write_text(json.dumps(metrics))
    entry = arm_entry("twinning", found)
    assert np.isposinf(entry.mean) and np.isfinite(entry.costs[0]).all()
    assert all(np.isnan(value) for value in entry.merit.values())
    low, high = entry.interval()
    assert np.isposinf(high) and not np.isnan(low)
    assert tables.cost_cells(entry)[0] == "inf"


def test_intervals_cover_the_mean_as_often_as_they_say():
    rng, hits = np.random.default_rng(0), 0
    for _ in range(40):
        low, high = mean_interval(rng.standard_normal((1, 60)))
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


def test_weights_that_the_real_system_has_beside_those_of_the_closure_count_for_nothing():
    """Such as the offset of a sensor, of which the plant's own closure knows nothing."""
    assert weight_error({"found": {"a": 1.1}, "true": {"a": 1.0, "pressure_offset": 15e3}}) == pytest.approx(0.1)


def test_a_twin_that_diverges_has_an_infinite_error(tmp_path):
    """Its J_p is null in the metrics, and in the numbers of the study."""
    found = finished(tmp_path, 0, 0.0)
    metrics = found.metrics()
    metrics["episodes"][-1]["J_p"] = None
    (found.folder / "metrics.json").write_text(json.dumps(metrics))
    entry = arm_entry("twinning", [found])
    assert entry.twin_errors[0][-1] == float("inf") and entry.twin_errors[0][0] == pytest.approx(0.05)
    assert finite(page.numbers_of(entry))["J_p"][0][-1] is None


# Finished runs side by side.


KINDS = {"model_based": 1.0, "model_free": 3.0}


def leave(folder, *, arm, seed, costs, plant="tanks", hidden=(16,)):
    """The files of a finished run that a comparison reads."""
    folder.mkdir()
    settings = {"plant": plant, "recipe": {}, "seed": seed, "hidden": hidden, "twinning": {"arm": arm}, "ran": [seed]}
    (folder / "config.json").write_text(json.dumps(settings))
    unseen = {
        "episodes": len(costs),
        "costs": {"model_based": costs, "model_free": [9.0] * len(costs), "PI": [2.0] * len(costs)},
        "merit": {"model_based": {"power [W]": {"mean": seed}}, "model_free": {"power [W]": {"mean": 0.0}}},
        "baselines": {"PI": {"merit": {"power [W]": {"mean": 5.0}}}},
    }
    episodes = [{"real_cost": cost, "J_a_unseen": cost / 2.0} for cost in (4.0, 2.0)]
    metrics = {"plant": plant, "episodes": episodes, "summary": {"live": "model_based", "unseen": unseen}}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def four(tmp_path):
    return [
        leave(tmp_path / f"{arm}-{seed}", arm=arm, seed=seed, costs=[mean - 0.5, mean + 0.5 + seed])
        for arm, mean in KINDS.items()
        for seed in (0, 1)
    ]


def test_runs_that_differ_in_the_seed_are_one_row(tmp_path):
    runs, controllers = entries_of(four(tmp_path))
    assert [entry.name for entry in runs] == ["arm model-based", "arm model-free"]
    np.testing.assert_allclose([entry.mean for entry in runs], [1.25, 3.25])
    assert [entry.merit["power [W]"] for entry in runs] == [0.5, 0.5]
    assert [(entry.name, entry.mean) for entry in controllers] == [("PI", 2.0)]
    assert runs[0].curves == [[2.0, 1.0]] * 2
    table = [line.split() for line in comparison_table(runs, controllers).splitlines()]
    assert table[1][:4] == ["arm", "model-based", "2", "1.25"] and table[3][:2] == ["PI", "2"]
    low, high = runs[0].interval()
    assert 0.5 <= low < 1.25 < high <= 2.5


def test_the_figure_has_a_line_for_each_row(tmp_path):
    runs, controllers = entries_of(four(tmp_path))
    (ax,) = comparison_figure(runs, controllers, "t").axes
    assert {line.get_label(): np.mean(line.get_ydata()) for line in ax.lines} == {
        "arm model-based": 1.5,
        "arm model-free": 1.5,
        "PI": 2.0,
    }


def test_a_policy_that_diverged_on_the_way_is_drawn(tmp_path):
    """``metrics.json`` holds null for it."""
    folders = four(tmp_path)
    for folder in folders:
        metrics = json.loads((folder / "metrics.json").read_text())
        metrics["episodes"][0]["J_a_unseen"] = None
        (folder / "metrics.json").write_text(json.dumps(metrics))
    runs, controllers = entries_of(folders)
    assert runs[0].curves == [[np.inf, 1.0]] * 2
    comparison_figure(runs, controllers, "t").canvas.draw()


def test_runs_that_cannot_be_compared_are_refused(tmp_path):
    first = leave(tmp_path / "a", arm="twinning", seed=0, costs=[1.0, 2.0])
    with pytest.raises(ValueError, match=r"differ in their plant \(tanks, drone\)"):
        entries_of([first, leave(tmp_path / "b", arm="twinning", seed=0, costs=[1.0, 2.0], plant="drone")])
    with pytest.raises(ValueError, match=r"differ in their number of unseen episodes \(2, 3\)"):
        entries_of([first, leave(tmp_path / "c", arm="twinning", seed=0, costs=[1.0, 2.0, 3.0])])
    (first / "metrics.json").unlink()
    with pytest.raises(ValueError, match="has no metrics.json: it is not finished"):
        entries_of([first])


def on_the_twin(folder, **real):
    """Make a finished run one that was judged on its own twin."""
    file = folder / "metrics.json"
    metrics = json.loads(file.read_text())
    metrics["summary"]["unseen"]["judged_on"] = "twin"
    metrics["summary"] |= real
    file.write_text(json.dumps(metrics))
    return folder


def test_costs_on_different_twins_are_not_compared(tmp_path):
    folders = [leave(tmp_path / f"{seed}", arm="model_based", seed=seed, costs=[1.0, 2.0]) for seed in (0, 1)]
    for folder in folders:
        on_the_twin(folder)
    with pytest.raises(ValueError, match="judged on its own twin alone.*--real-unseen"):
        entries_of(folders)
    found = {"episodes": 2, "J_a": {"mean": 5.0}, "merit": {"power [W]": {"mean": 8.0}}}
    real = {"controllers": {"model_based": found, "PI": found}, "costs": {"model_based": [4.0, 6.0], "PI": [7.0, 9.0]}}
    runs, controllers = entries_of([on_the_twin(folder, real_unseen=real) for folder in folders])
    assert [(entry.name, entry.mean) for entry in (*runs, *controllers)] == [(runs[0].name, 5.0), ("PI", 8.0)]
    simulated = leave(tmp_path / "2", arm="model_based", seed=2, costs=[1.0, 2.0])
    with pytest.raises(ValueError, match="differ in their place of the unseen episodes"):
        entries_of([*folders, simulated])


# The ruler's table, from ruled trainings.


RULER = Path(__file__).parent / "ruler.py"


def ruled(folder, model_based, model_free, paid):
    folder.mkdir(parents=True)
    unseen = {"J_a_model_based": {"mean": model_based}, "J_a_model_free": {"mean": model_free}}
    metrics = {"summary": {"live": "model_free", "unseen": unseen}, "episodes": [{"real_cost": cost} for cost in paid]}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "seconds.json").write_text("12.0")


def test_a_row_has_ranges_and_counts_trainings_whose_dearer_policy_is_live(tmp_path):
    ruled(tmp_path / "turbine-pitch" / "0", 1.0, 1.25, [2.0, 3.0])
    ruled(tmp_path / "turbine-pitch" / "1", 1.5, 1.5, [4.0, 4.0])
    command = [sys.executable, str(RULER), "--seeds", "2", "--folder", str(tmp_path), "--rows", "turbine, pitch"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "| turbine, pitch | 2 | 1.25 … 1.5 | 1 … 1.5 | 1 | 5 … 8 | 12 |"
