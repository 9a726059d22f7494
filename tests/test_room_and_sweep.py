"""Recipes of comparisons: unknown systems, fronts of weights, searches of options."""

import dataclasses
import json
import os
from pathlib import Path

import pytest
from handwritten_study import recipe
from test_export_recipe import RECIPES

from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.study import sweep
from rt_torchrl.study.pareto import Effort, pareto_front
from rt_torchrl.study.room import Room, require_page, room_table, write_into
from rt_torchrl.study.sweep import Searched, SeededRun, seeded_runs
from rt_torchrl.study.training import Training
from rt_torchrl.study.yardstick import Yardstick

# The room between policies planned on a twin that does not know the real system, and the optimum on that system.


ROOMY = Room(system="pitch", oracle=0.05, planned=[0.2, 0.1, 0.3], said=[0.04, 0.05, 0.06], classical={"PD": 0.07})

HELPED = dataclasses.replace(ROOMY, helped=[0.06, 0.055, 0.3], paid=[1.0, 2.0, 3.0], helped_paid=[0.5, 0.4, 0.6])


def test_the_gap_is_that_of_the_median_over_the_least_cost_that_was_found():
    assert ROOMY.gap == pytest.approx(3.0)
    beyond = Room(system="", oracle=0.5, planned=[0.4, 0.41], said=[0.4, 0.4], classical={})
    assert beyond.best == 0.4 and beyond.gap == pytest.approx(0.0125)
    shown = room_table([ROOMY, beyond]).splitlines()
    assert shown[2] == "| pitch | 0.05 | 0.2 (0.1 … 0.3) | 300.0 % | 0.05 | PD 0.07 | yes |"
    assert shown[3].startswith("| as the twin | 0.4 |") and shown[3].endswith("| 1.2 % | 0.4 | – | no room |")


def test_a_page_takes_each_table_once(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Page\n\ntext\n")
    for text in ("first", "second"):
        write_into(page, "turbine", text)
        write_into(page, "drone", text)
    assert page.read_text().count("second") == 2 and "first" not in page.read_text()
    assert page.read_text().startswith("# Page\n\ntext\n\n<!-- turbine -->")
    with pytest.raises(ValueError, match=r"gone\.md cannot be read"):
        write_into(tmp_path / "gone.md", "drone", "text")


def test_a_page_that_cannot_be_written_is_refused_before_any_work(tmp_path, monkeypatch):
    made, page = recipe("unknown"), tmp_path / "pages" / "page.md"
    config = made.Config(plant="wind_turbine", folder=tmp_path / "kept", page=page)
    worked = []
    monkeypatch.setattr(made, "on_this_machine", lambda tasks, jobs: worked.append(tasks))
    with pytest.raises(ValueError, match=r"page.md cannot be read .*; give a text that exists"):
        made.main(config)
    page.parent.mkdir()
    page.write_bytes(b"\xff")
    with pytest.raises(ValueError, match=r"page.md cannot be read .*; give a text that exists"):
        made.main(config)
    page.write_text("# Page\n")
    with monkeypatch.context() as patched:  # to the superuser, who may run this, no folder is closed
        patched.setattr(os, "access", lambda path, mode: path != page.parent)
        with pytest.raises(ValueError, match=r"page.md cannot be written, because the folder .*pages cannot"):
            require_page(page)
    require_page(page)
    require_page(None)
    assert not worked and page.read_text() == "# Page\n"


@pytest.mark.parametrize(
    ("options", "system", "unknown"),
    [
        (("wind_turbine",), "inflow+pitch", ("inflow", "pitch")),
        (("flapping_wing", "--task", "hop"), "plane_6.3", ("plane_6.3",)),
        (("cryogenic_tank", "--unseen", "4"), "nothing", ()),
    ],
)
def test_trainings_and_optimum_are_of_the_recipe_with_the_unknown_system(options, system, unknown, tmp_path):
    made = recipe("unknown")
    config = from_command_line(made.Config, [*options, "--seeds", "2", "--folder", str(tmp_path)])
    assert config.rows()[0] == "nothing" and len(config.rows()) == 1 + len(made.SYSTEMS[config.plant])
    trainings = config.trainings(system)
    assert [training.seed for training in trainings] == [0, 1]
    found = from_command_line(load_recipe(config.recipe).Config, trainings[1].arguments())
    assert found.unknown == unknown and found.twinning.arm == "model_based" and found.episodes == 3
    optimum = config.optimum(system)
    assert found.unseen == optimum.compute.keywords["unseen"]
    # Optima of different numbers of episodes are kept apart.
    assert optimum.path.name == ("oracle-4.json" if "--unseen" in options else "oracle.json")


def test_a_row_is_made_of_what_is_kept(tmp_path, monkeypatch):
    made = recipe("unknown")
    config = made.Config(plant="wind_turbine", systems=("pitch",), seeds=3, folder=tmp_path, page=tmp_path / "page.md")
    (tmp_path / "page.md").write_text("# Page\n")

    def metrics(training):
        helped = training.folder.name.endswith("hypotheses")
        assert training.options[training.options.index("--twinning.hypotheses.which") + 1] == (
            "automatic" if helped else "none"
        )
        costs, paid = (HELPED.helped, HELPED.helped_paid) if helped else (HELPED.planned, HELPED.paid)
        unseen = {"J_a_model_based": {"mean": costs[training.seed]}, "baselines": {"PD": {"J_a": {"mean": 0.07}}}}
        summary = {"unseen": unseen, "cost_of_learning": {"sum": paid[training.seed]}}
        said = ROOMY.said[training.seed]
        return {"summary": summary, "episodes": [{"J_a_plan": 1.0}, {"J_a_plan": said}]}

    monkeypatch.setattr(Training, "metrics", metrics)
    monkeypatch.setattr(Yardstick, "run", lambda yardstick: {"J_a": {"mean": 0.05}})
    monkeypatch.setattr(made, "on_this_machine", lambda tasks, jobs: None)
    made.main(config)
    kept = json.loads((config.kept / "room.json").read_text())["rows"]
    assert kept == [vars(HELPED) | {"gap": pytest.approx(3.0)}]
    assert room_table([HELPED]) in (tmp_path / "page.md").read_text()


def test_a_row_with_hypotheses_says_what_they_are_worth():
    cells = HELPED.cells()
    assert cells[:7] == ROOMY.cells() and cells[7:] == ["0.06 (0.055 … 0.3)", "20.0 %", "2, 0.5"]
    assert "with hypotheses" in room_table([HELPED]) and "with hypotheses" not in room_table([ROOMY])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"systems": ("gust",)}, "gust does not exist"),
        ({"systems": ("anemometer_low+anemometer_high",)}, "both change the anemometer"),
        ({"task": "hop"}, "task='hop' is a task of the drone"),
        ({"seeds": 0}, "seeds=0 must be at least 1"),
        ({"unseen": 1}, "unseen=1 must be at least 2"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        recipe("unknown").Config(plant="wind_turbine", **options)


# The front of a plant's quantities over a weight of its cost.


SMALL = Effort(planned_on=3, unseen=3, starts=1, approach=40, iterations=40)
SHORT = ("--horizon", "30", "--policy", "bias", "--observe", "measured", "--task", "engineering")


def turbine(*values):
    return pareto_front(RECIPES / "wind_turbine.py", SHORT, "engineering.pitch-rate", values, SMALL)


def test_dearer_pitch_travels_less_and_lets_the_rotor_run_faster():
    points = list(turbine(0.01, 10.0))
    travel, speed, power = (
        [point.merit[name] for point in points]
        for name in ("pitch travel [deg/s]", "speed above rated [rad/s]", "mean power [MW]")
    )
    assert [point.weight for point in points] == [0.01, 10.0]
    assert travel[1] < 0.7 * travel[0] and speed[1] > speed[0] and min(power) > 1.0
    assert points[0].cost < points[1].cost


@pytest.mark.parametrize("values", [(0.1,), (0.1, 0.1), (0.1, -1.0), (0.1, float("nan"))])
def test_impossible_values_are_refused_before_any_work(values):
    with pytest.raises(ValueError, match=r"values=.*engineering\.pitch-rate must be"):
        turbine(*values)


@pytest.mark.parametrize("name", ["planned_on", "unseen", "starts", "approach", "iterations"])
def test_impossible_efforts_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}=-1 must be at least"):
        dataclasses.replace(SMALL, **{name: -1})


def test_the_recipe_keeps_table_and_figure(tmp_path, capsys, monkeypatch):
    made = recipe("pareto")
    front = made.FRONTS["cryogenic_tank"]
    short = dataclasses.replace(front, options=(*front.options, "--horizon", "39990"), effort=SMALL)
    monkeypatch.setitem(made.FRONTS, "cryogenic_tank", short)
    made.main(made.Config(plant="cryogenic_tank", values=(500.0, 50e3), log_dir=tmp_path / "new"))
    found = json.loads((tmp_path / "new" / "cryogenic_tank.json").read_text())
    mass = [point["merit"]["vented mass [kg]"] for point in found["front"]]
    assert mass[1] < mass[0] and set(found["classical"]) == {"on-off", "PI"}
    assert (tmp_path / "new" / "cryogenic_tank.png").stat().st_size > 5000
    assert "late pressure error [kPa]" in capsys.readouterr().out


def test_weights_of_another_task_are_refused():
    made = recipe("wind_turbine")
    weights = made.EngineeringCost(pitch_rate=0.1)
    assert made.Config(task="engineering", engineering=weights).plant().cost == weights
    with pytest.raises(ValueError, match="weights of the task engineering"):
        made.Config(engineering=weights)


# Seeds side by side, and a search over options.


TINY = Path(__file__).with_name("small_recipe.py")


class Trial:
    """Takes the middle of every range, and the last choice; keeps what it was asked."""

    def __init__(self):
        self.asked = []

    def suggest_int(self, name, low, high, *, log):
        self.asked.append((name, low, high, log))
        return (low + high) // 2

    def suggest_float(self, name, low, high, *, log):
        self.asked.append((name, low, high, log))
        return (low + high) / 2

    def suggest_categorical(self, name, choices):
        self.asked.append((name, choices))
        return choices[-1]


@pytest.mark.parametrize(
    ("text", "word", "asked"),
    [
        ("a.b=2..8", "5", ("a.b", 2, 8, False)),
        ("--a=1..100", "50", ("a", 1, 100, True)),
        ("rate=1e-4..1e-2", repr((1e-4 + 1e-2) / 2), ("rate", 1e-4, 1e-2, True)),
        ("shift=-1.0..3.0", "1.0", ("shift", -1.0, 3.0, False)),
        ("rule=one|other", "other", ("rule", ("one", "other"))),
    ],
)
def test_what_is_searched_is_read_from_a_word(text, word, asked):
    trial = Trial()
    assert Searched.read(text).drawn(trial) == word and trial.asked == [asked]


@pytest.mark.parametrize("text", ["a", "a=3", "a=3..1", "a=x..y", "=1..2", "a=0..inf"])
def test_what_is_neither_a_range_nor_choices_is_refused(text):
    with pytest.raises(ValueError, match="over='"):
        Searched.read(text)


def test_a_sweep_keeps_its_own_options(tmp_path):
    with pytest.raises(ValueError, match="given holds --log-dir, --seed"):
        seeded_runs(TINY, [0], tmp_path, ["--seed", "3", "--log_dir=x"])
    config = recipe("sweep").Config
    with pytest.raises(ValueError, match="go together"):
        config(plant="wind_turbine", trials=3)
    with pytest.raises(ValueError, match="seeds"):
        config(plant="wind_turbine", seeds=())


def test_seeds_are_trained_and_compared(tmp_path, monkeypatch, capsys):
    """In this process, because another one would load PyTorch for each seed."""
    monkeypatch.setattr(sweep, "side_by_side", lambda batches, **_: [run.run() for batch in batches for run in batch])
    made = recipe("sweep")
    config = made.Config(plant=str(TINY), seeds=(3, 4), given="--horizon 1.0", log_dir=tmp_path)
    made.main(config)
    folders = [tmp_path / "small_recipe" / f"seed-{seed}" for seed in (3, 4)]
    settings = [json.loads((folder / "config.json").read_text()) for folder in folders]
    assert [(one["seed"], one["horizon"], one["threads"]) for one in settings] == [(3, 1.0, 1), (4, 1.0, 1)]
    row = capsys.readouterr().out.splitlines()[1].split()
    costs = [SeededRun(recipe=TINY, seed=0, folder=folder).cost() for folder in folders]
    assert row[2] == "2" and float(row[3]) == pytest.approx(sum(costs) / 2, rel=1e-4)
    assert (tmp_path / "small_recipe" / "seeds.png").exists()


def test_a_sweep_goes_on_where_it_was_cut_short_and_refuses_runs_of_other_options(tmp_path):
    (run,) = seeded_runs(TINY, [3], tmp_path, ["--horizon", "1.0"])
    run.run()
    assert run.done() and run.arguments()[6] == "--resume"
    longer, patient, other = (
        SeededRun(recipe=TINY, seed=3, folder=run.folder, options=("--horizon", horizon, "--episodes", "3", *more))
        for horizon, more in (("1.0", ()), ("1.0", ("--patience", "1")), ("2.0", ()))
    )
    with pytest.raises(
        ValueError, match=r"seed-3 holds the results of other options: horizon is 2\.0 here and was 1\.0"
    ):
        other.done()
    assert not longer.done() and not patient.done()
    longer.run()
    metrics = json.loads((run.folder / "metrics.json").read_text())
    assert longer.done() and len(metrics["episodes"]) == 3


def test_a_run_that_its_patience_or_a_callback_has_ended_is_done(tmp_path):
    options = ("--horizon", "1.0", "--episodes", "9")
    stopped = SeededRun(recipe=TINY, seed=3, folder=tmp_path, options=(*options, "--patience", "1"))
    longer = SeededRun(recipe=TINY, seed=3, folder=tmp_path, options=options)
    stopped.run()
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert len(metrics["episodes"]) < 9 and metrics["summary"]["ended"] == "no gain of 1 % in the last 1 episodes"
    assert stopped.done() and not longer.done()
    metrics["summary"]["ended"] = None  # as if it had been interrupted
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    assert not stopped.done()


def test_a_search_finds_the_least_cost_and_goes_on(tmp_path, monkeypatch):
    """The trainings are replaced by a cost of the option, whose least value is known: it lies at 3."""
    pytest.importorskip("optuna", reason="a search needs the extra sweep")

    def train(runs, jobs):
        for run in runs:
            value = float(run.options[run.options.index("--x") + 1])
            if value == 5:
                raise RuntimeError("it failed")
            run.folder.mkdir(parents=True)
            summary = {"live": "model_free", "unseen": {"J_a_model_free": {"mean": (value - 3) ** 2 + run.seed}}}
            (run.folder / "metrics.json").write_text(json.dumps({"summary": summary}))

    monkeypatch.setattr(sweep, "train_all", train)
    over = [Searched.read("x=0..5")]
    for done in (12, 24):
        study = sweep.search(TINY, over, [0, 1], tmp_path, trials=12, jobs=1)
        assert len(study.trials) == done
    assert study.best_params == {"x": 3} and study.best_value == 0.5
    table = sweep.trials_table(study).splitlines()
    assert table[1].split()[1:] == ["0.5", "--x", "3"]
    failed = sum(one.value is None for one in study.trials)
    assert failed == 0 or f"{failed} trials failed" in table[-1]


@pytest.mark.nightly
def test_a_search_with_real_trainings(tmp_path, capsys):
    """Four gradients a plan are better than none, and the search finds it, by the command as printed."""
    pytest.importorskip("optuna", reason="a search needs the extra sweep")
    over = ("twinning.planner.iterations=0|4",)
    given = "--twinning.arm model_based"
    options = {"given": given, "trials": 6, "over": over, "log_dir": tmp_path, "jobs": 1, "seeds": (0,)}
    recipe("sweep").main(recipe("sweep").Config(plant=str(TINY), **options))
    rows = capsys.readouterr().out.splitlines()
    assert rows[-6].split()[2:] == ["--twinning.planner.iterations", "4"]
    best = json.loads((tmp_path / TINY.stem / f"trial-{rows[-6].split()[0]}" / "seed-0" / "metrics.json").read_text())
    assert float(rows[-6].split()[1]) == pytest.approx(best["summary"]["unseen"]["J_a_model_based"]["mean"], rel=1e-4)
