"""Finished runs beside each other, and the study that makes them: numbers by hand, and small trainings."""

import dataclasses
import itertools
import json
import math
import os
import signal
from pathlib import Path

import pytest
import study
from linear_quadratic import LinearGain, LinearQuadratic, optimal_gain
from scipy.optimize import minimize

from rt_torchrl import Comparison, compare_runs
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs.compare import FinishedRun, Row, comparison_figure, paired_ratio
from rt_torchrl.steps.interact import Interact

pytestmark = pytest.mark.training

TINY = Path(__file__).with_name("small_recipe.py")
NAN = None  # in the place of what is not finite


def leave(folder, *, seed, costs, curve=(4.0, 2.0), arm="twinning", plant="tanks", valve=2.0, **settings):
    """The files of a finished run that a comparison reads."""
    folder.mkdir(parents=True)
    options = {"plant": plant, "recipe": {}, "seed": seed, "twinning": {"arm": arm}, "ran": [seed], **settings}
    (folder / "config.json").write_text(json.dumps(options))
    unseen = {
        "judged_on": "simulation",
        "episodes": len(costs),
        "costs": {"model_based": costs, "model_free": [9.0] * len(costs), "PI": [valve] * len(costs)},
        "merit": {"model_based": {"power [W]": {"mean": seed}}, "model_free": {"power [W]": {"mean": 0.0}}},
        "baselines": {"PI": {"merit": {"power [W]": {"mean": 5.0}}}},
        **{f"J_a_{role}": {} for role in ("model_based", "model_free")},
    }
    episodes = [
        {"real_cost": 2.0 * cost if cost else cost, "J_a_unseen": cost, "seconds": {"plan": 1.5, "learn": 0.5}}
        for cost in curve
    ]
    episodes[0]["alarm"] = 1.0
    summary = {"live": "model_based", "unseen": unseen}
    (folder / "metrics.json").write_text(json.dumps({"plant": plant, "episodes": episodes, "summary": summary}))
    return folder


def rows(tmp_path):
    """Two arms of three seeds: the second costs e^0.1, e^0.2 and e^0.3 times as much as the first."""
    first, second = [], []
    for seed, cost in enumerate((1.0, 3.0, 2.0)):
        first.append(leave(tmp_path / f"a{seed}", seed=seed, costs=[cost - 0.5, cost + 0.5]))
        dear = cost * math.exp(0.1 * (seed + 1))
        curve = (4.0, 1.05) if seed else (4.0, 3.0)
        second.append(leave(tmp_path / f"b{seed}", seed=seed, costs=[dear, dear], curve=curve, arm="model_based"))
    return first, second


def test_every_number_of_a_table_is_that_by_hand(tmp_path):
    first, second = ([FinishedRun.read(folder) for folder in group] for group in rows(tmp_path))
    a, b = Row(name="a", runs=first, optimum=1.0), Row(name="b", runs=second, optimum=1.0)
    numbers = Comparison("tanks", [a, b]).numbers()
    assert numbers["controllers"] == {"PI": 2.0}
    of_a, of_b = numbers["rows"]["a"], numbers["rows"]["b"]
    assert of_a["seeds"] == [0, 1, 2] and of_a["J_a"] == {"median": 2.0, "least": 1.0, "greatest": 3.0}
    assert of_a["paid"] == {"median": 12.0, "least": 12.0, "greatest": 12.0}  # 2 · (4 + 2)
    assert of_a["J_a_ratio"] == {"ratio": 1.0, "low": 1.0, "high": 1.0}
    assert of_a["episodes_to_optimum"] == {"median": math.inf, "least": math.inf, "greatest": math.inf}
    assert of_b["episodes_to_optimum"] == {"median": 2.0, "least": 2.0, "greatest": math.inf}
    assert of_a["alarms"]["median"] == 1.0 and of_a["seconds"]["median"] == 4.0
    assert of_a["merit"] == {"power [W]": 1.0}
    # Logarithms of the ratios are 0.1, 0.2, 0.3: mean 0.2, deviation 0.1, and t(0.975, 2) = 4.30265.
    half = 4.302652729749464 * 0.1 / math.sqrt(3.0)
    assert of_b["J_a_ratio"]["ratio"] == pytest.approx(math.exp(0.2))
    assert of_b["J_a_ratio"]["low"] == pytest.approx(math.exp(0.2 - half))
    assert of_b["J_a_ratio"]["high"] == pytest.approx(math.exp(0.2 + half))
    paid = [2.0 * 7.0, 2.0 * 5.05, 2.0 * 5.05]
    assert of_b["paid_ratio"]["ratio"] == pytest.approx(math.prod(cost / 12.0 for cost in paid) ** (1.0 / 3.0))


def cells(text):
    """Rows of the Markdown tables in a text by their first cell; the first table counts."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return {line[0]: line for line in reversed(lines)}


def test_the_table_shows_these_numbers(tmp_path):
    first, second = ([FinishedRun.read(folder) for folder in group] for group in rows(tmp_path))
    comparison = Comparison("tanks", [Row(name="a", runs=first, optimum=1.0), Row(name="b", runs=second, optimum=1.0)])
    table = cells(comparison.table())
    assert table["a"] == "a|3|2 (1 … 3)|+100 %|1.000|12|1.000|never|1|4".split("|")
    assert table["b"][4] == "1.221 [0.953, 1.566]" and table["b"][7] == "2 (2 … never)"
    assert table["PI"][:3] == ["PI", "", "2"]
    assert "| PI | 5 |" in comparison.table() and "| a | 1 |" in comparison.table()  # the plant's own quantities
    wide = [comparison, Comparison("others", [Row(name="a", runs=first), Row(name="b", runs=first)])]
    both = cells(study.overview(wide, "J_a_ratio"))
    assert both["others"] == ["others", "1.000"]
    assert both["geometric mean (systems)"][1] == f"{math.exp(0.1):.3f} (2)"


def test_ratios_are_those_of_common_seeds_with_positive_costs():
    others = {0: 1.0, 1: 9.0}
    assert paired_ratio({0: 2.0, 5: 7.0}, others) == {"ratio": pytest.approx(2.0), "low": None, "high": None}
    for costs in ({5: 2.0}, {0: -2.0, 1: 1.0}, {0: math.inf, 1: 1.0}):
        assert paired_ratio(costs, others) is None


def test_what_diverges_costs_infinitely(tmp_path):
    run = FinishedRun.read(leave(tmp_path / "run", seed=0, costs=[1.0, NAN], curve=(NAN, 1.0)))
    assert run.cost == math.inf and run.unseen == [math.inf, 1.0] and sum(run.real) == math.inf
    for merits in itertools.permutations((1.0, math.nan, 3.0)):  # in whatever order the folders are given
        row = Row(name="a", runs=[dataclasses.replace(run, merit={"power [W]": merit}) for merit in merits])
        assert math.isnan(row.numbers(row)["merit"]["power [W]"])
    comparison = Comparison("tanks", [Row(name="a", runs=[run], optimum=1.0)])
    row = cells(comparison.table())["a"]
    assert row[2] == row[4] == "inf" and row[5] == "2"  # near the optimum after the second episode
    comparison_figure([comparison], "t").canvas.draw()


def test_runs_that_differ_in_the_seed_are_one_row(tmp_path):
    first, second = rows(tmp_path)
    found = compare_runs([*first, *second])
    assert [row.name for row in found.rows] == ["arm twinning", "arm model_based"]
    assert [sorted(row.costs) for row in found.rows] == [[0, 1, 2]] * 2 and found.title == "tanks"
    seeing = leave(tmp_path / "seeing", seed=0, costs=[1.0, 1.0], observe=["measured"])
    metrics = json.loads((seeing / "metrics.json").read_text())
    metrics["summary"]["unseen"]["merit"]["model_based"]["level outside [%]"] = {"mean": 3.0}  # with limits of states
    (seeing / "metrics.json").write_text(json.dumps(metrics))
    drawn = leave(tmp_path / "drawn", seed=9, costs=[1.0, 1.0], figures=False, threads=2)
    assert [len(row.runs) for row in compare_runs([first[0], drawn]).rows] == [2]  # nor do figures and compilation
    for folders in ([first[0], seeing], [seeing, first[0]]):  # what a policy sees changes no task
        *_, heading, _, one, two, _ = compare_runs(folders).table().splitlines()
        assert "level outside [%]" in heading and sorted(row.split("|")[3].strip() for row in (one, two)) == ["", "3"]


def test_costs_on_different_twins_are_not_compared(tmp_path):
    folders = [leave(tmp_path / f"{seed}", seed=seed, costs=[1.0, 2.0]) for seed in (0, 1)]
    found = {"episodes": 2, "J_a": {"mean": 5.0}, "merit": {"power [W]": {"mean": 8.0}}}
    real = {"controllers": {"model_based": found, "PI": found}, "costs": {"model_based": [4.0, 6.0], "PI": [7.0, 9.0]}}
    for flights in ({}, {"real_unseen": real}):
        for folder in folders:
            metrics = json.loads((folder / "metrics.json").read_text())
            metrics["summary"]["unseen"]["judged_on"] = "twin"
            metrics["summary"] |= flights
            (folder / "metrics.json").write_text(json.dumps(metrics))
        if not flights:
            with pytest.raises(ValueError, match="judged on its own twin alone.*--real-unseen"):
                compare_runs(folders)
    found = compare_runs(folders)
    assert found.rows[0].costs == {0: 5.0, 1: 5.0} and found.numbers()["controllers"] == {"PI": 8.0}
    with pytest.raises(ValueError, match="differ in their place of the unseen episodes"):
        compare_runs([*folders, leave(tmp_path / "2", seed=2, costs=[1.0, 2.0])])


def test_a_panel_shows_one_kind_of_cost(tmp_path):
    """Those on unseen episodes, if all runs have them."""
    folders = [leave(tmp_path / f"{seed}", seed=seed, costs=[1.0, 2.0]) for seed in (0, 1)]
    metrics = json.loads((folders[1] / "metrics.json").read_text())
    shown = {}
    for judged in (True, False):
        (axes,) = comparison_figure([compare_runs(folders)], "title").axes
        shown[judged] = axes.lines[0].get_ydata().tolist()
        for episode in metrics["episodes"]:
            episode.pop("J_a_unseen", None)
        (folders[1] / "metrics.json").write_text(json.dumps(metrics))
    assert shown == {True: [4.0, 2.0], False: [8.0, 4.0]}


# The study itself.


def config(tmp_path, **options):
    usual = {"systems": (f"tiny={TINY}",), "arms": ("twinning",), "seeds": 2, "jobs": 1, "log_dir": tmp_path}
    return study.Config(**usual | options)


def test_systems_and_arms_have_names(tmp_path):
    made = study.Config(
        systems=("wind_turbine --unknown pitch", "gusty=flapping_wing --horizon=2", f"{TINY} --horizon=1"),
        arms=("default=", "model_free", "sac=--twinning.learner.algorithm sac"),
        given="--unseen 4",
        log_dir=tmp_path,
    )
    assert list(made.systems_by_name()) == ["wind_turbine-unknown-pitch", "gusty", "small_recipe-horizon-1"]
    arms = made.arms_by_name()
    assert list(arms) == ["default", "model_free", "sac"] and arms["default"] == []
    (training, *others) = made.trainings()["gusty", "model_free"]
    assert training.words == ("--horizon=2", "--unseen", "4", "--twinning.arm", "model_free") and len(others) == 4
    assert training.folder == tmp_path / "gusty" / "model_free" / "seed-0"
    config = training.config()
    assert (config.horizon, config.unseen, config.twinning.arm, config.unseen_every) == (2.0, 4, "model_free", 1)


def test_two_arms_and_two_seeds(tmp_path, capsys):
    """The same command again trains nothing; more episodes go on, and other options are refused."""
    arms = {"arms": ("twinning", "model_based")}
    study.main(config(tmp_path, jobs=2, **arms))  # in two processes
    found = json.loads((tmp_path / "study.json").read_text())["systems"]["tiny"]["rows"]
    folders = {(arm, seed): tmp_path / "tiny" / arm / f"seed-{seed}" for arm in found for seed in (0, 1)}
    written = {key: (folder / "metrics.json").read_bytes() for key, folder in folders.items()}
    summaries = {key: json.loads(content)["summary"] for key, content in written.items()}
    finals = {key: summary["unseen"][f"J_a_{summary['live']}"]["mean"] for key, summary in summaries.items()}
    assert list(found) == ["twinning", "model_based"]
    assert found["twinning"]["J_a"]["median"] == pytest.approx((finals["twinning", 0] + finals["twinning", 1]) / 2.0)
    plant = LinearQuadratic(horizon=2.0)
    best = found["twinning"]["optimum"]
    costs = UnseenEpisodes(plant, 3).control_costs
    searched = minimize(
        lambda gain: costs(LinearGain(gain[None])).mean().item(), optimal_gain(1.0)[0], method="Nelder-Mead"
    ).fun
    assert best == pytest.approx(searched, rel=1e-5) and best <= min(finals.values())
    assert "| twinning | 2 |" in capsys.readouterr().out and (tmp_path / "study.png").stat().st_size > 5000
    (optimum,) = (tmp_path / "optima").iterdir()
    kept = optimum.stat().st_mtime_ns
    study.main(config(tmp_path, **arms))
    assert {key: (folder / "metrics.json").read_bytes() for key, folder in folders.items()} == written
    assert optimum.stat().st_mtime_ns == kept
    optimum.write_text("{")
    study.main(config(tmp_path, given="--episodes 2", **arms))
    assert json.loads(optimum.read_text())["J_a"] > 0.0  # a damaged one is sought again
    longer = json.loads((folders["twinning", 0] / "metrics.json").read_text())["episodes"]
    assert len(longer) == 2 and longer[0] == json.loads(written["twinning", 0])["episodes"][0]
    with pytest.raises(ValueError, match="seed-0 holds a run of other options: episodes is 1 here and was 2"):
        study.main(config(tmp_path))


def test_a_training_that_fails_stops_no_other(tmp_path, capsys):
    broken, failing = tmp_path / "broken.py", "    if config.seed:\n        1 / 0\n    Run(config"
    broken.write_text(TINY.read_text().replace("    Run(config", failing))
    with pytest.raises(ValueError, match=r"1 failed, the others are kept:\n.*seed-1: ZeroDivisionError: division"):
        study.main(config(tmp_path / "study", systems=(f"tiny={broken}",), optimum=False))
    assert "| twinning | 1 |" in capsys.readouterr().out
    log = (tmp_path / "study" / "tiny" / "twinning" / "seed-1" / "training.log").read_text()
    assert "Traceback" in log and "1 / 0" in log


def test_a_comparison_of_runs_does_not_take_the_place_of_a_study(tmp_path):
    study.main(config(tmp_path / "study", seeds=1, optimum=False))
    kept = (tmp_path / "study" / "study.md").read_bytes()
    run = tmp_path / "study" / "tiny" / "twinning" / "seed-0"
    with pytest.raises(ValueError, match="holds a study of trainings; give the comparison another folder"):
        study.main(config(tmp_path / "study", runs=(run,)))
    assert (tmp_path / "study" / "study.md").read_bytes() == kept
    for _ in range(2):  # a comparison takes the place of itself
        study.main(config(tmp_path / "compared", runs=(run,)))


@pytest.mark.slow
def test_a_cluster_of_ray(tmp_path):
    ray = pytest.importorskip("ray", reason="a cluster needs the extra cluster")
    try:
        (comparison,), failures = study.studied(config(tmp_path, backend="ray"))
    finally:
        ray.shutdown()
    assert not failures and list(comparison.rows[0].costs) == [0, 1]


def test_an_interrupted_training_ends_the_study_and_goes_on(tmp_path, monkeypatch):
    forward, calls = Interact.forward, []

    def pressed(step, episode):
        calls.append(step)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return forward(step, episode)

    made = config(tmp_path, given="--episodes 2", optimum=False)
    with monkeypatch.context() as patched:
        patched.setattr(Interact, "forward", pressed)
        with pytest.raises(KeyboardInterrupt):
            study.studied(made)
    first, second = (tmp_path / "tiny" / "twinning" / f"seed-{seed}" for seed in (0, 1))
    assert len(json.loads((first / "metrics.json").read_text())["episodes"]) == 1 and not second.exists()
    (comparison,), failures = study.studied(made)
    assert not failures and [len(run.unseen) for run in comparison.rows[0].runs] == [2, 2]
