"""Seeds side by side, and a search over options."""

import json
from pathlib import Path

import pytest
from test_export_recipe import recipe

from rt_torchrl.study import sweep
from rt_torchrl.study.sweep import Searched, SeededRun, seeded_runs

SMALL = Path(__file__).with_name("small_recipe.py")


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
        seeded_runs(SMALL, [0], tmp_path, ["--seed", "3", "--log_dir=x"])
    config = recipe("sweep").Config
    with pytest.raises(ValueError, match="go together"):
        config(plant="wind_turbine", trials=3)
    with pytest.raises(ValueError, match="seeds"):
        config(plant="wind_turbine", seeds=())


def test_seeds_are_trained_and_compared(tmp_path, monkeypatch, capsys):
    """In this process, because another one would load PyTorch for each seed."""
    monkeypatch.setattr(sweep, "side_by_side", lambda batches, **_: [run.run() for batch in batches for run in batch])
    made = recipe("sweep")
    config = made.Config(plant=str(SMALL), seeds=(3, 4), given="--horizon 1.0", log_dir=tmp_path)
    made.main(config)
    folders = [tmp_path / "small_recipe" / f"seed-{seed}" for seed in (3, 4)]
    settings = [json.loads((folder / "config.json").read_text()) for folder in folders]
    assert [(one["seed"], one["horizon"], one["threads"]) for one in settings] == [(3, 1.0, 1), (4, 1.0, 1)]
    row = capsys.readouterr().out.splitlines()[1].split()
    costs = [SeededRun(recipe=SMALL, seed=0, folder=folder).cost() for folder in folders]
    assert row[2] == "2" and float(row[3]) == pytest.approx(sum(costs) / 2, rel=1e-4)
    assert (tmp_path / "small_recipe" / "seeds.png").exists()


def test_a_sweep_goes_on_where_it_was_cut_short_and_refuses_runs_of_other_options(tmp_path):
    (run,) = seeded_runs(SMALL, [3], tmp_path, ["--horizon", "1.0"])
    run.run()
    assert run.done() and run.arguments()[6] == "--resume"
    longer, patient, other = (
        SeededRun(recipe=SMALL, seed=3, folder=run.folder, options=("--horizon", horizon, "--episodes", "3", *more))
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
    stopped = SeededRun(recipe=SMALL, seed=3, folder=tmp_path, options=(*options, "--patience", "1"))
    longer = SeededRun(recipe=SMALL, seed=3, folder=tmp_path, options=options)
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
        study = sweep.search(SMALL, over, [0, 1], tmp_path, trials=12, jobs=1)
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
    recipe("sweep").main(recipe("sweep").Config(plant=str(SMALL), **options))
    rows = capsys.readouterr().out.splitlines()
    assert rows[-6].split()[2:] == ["--twinning.planner.iterations", "4"]
    best = json.loads((tmp_path / SMALL.stem / f"trial-{rows[-6].split()[0]}" / "seed-0" / "metrics.json").read_text())
    assert float(rows[-6].split()[1]) == pytest.approx(best["summary"]["unseen"]["J_a_model_based"]["mean"], rel=1e-4)
