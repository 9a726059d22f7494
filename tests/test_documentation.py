"""README and documentation: their code and plants run, names have entries, the site builds without warnings."""

import importlib
import importlib.util
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import fresh_process
import pytest
import torch
from printed_commands import ROOT, TEXTS, blocks
from seeds_and_numbers import seeded
from tensordict import TensorDict
from test_export_recipe import leave_run

import rt_torchrl
from rt_torchrl import AssimilationConfig, HypothesesConfig, Rollout, check_plant
from rt_torchrl.atomic_file import write_json
from rt_torchrl.steps.hypotheses.assimilation import EnsembleAssimilation
from rt_torchrl.steps.hypotheses.ensemble import ALONE, make_twin

RUN_HERE = "README finished_run gallery habits hypotheses own_plant unknown_systems".split()


def test_every_page_with_code_is_run():
    """A page with a block needs a test that runs it, here or in another file that names the page."""
    others = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").glob("test_*.py") if path != Path(__file__)]
    for page in TEXTS:
        if blocks(page, "python") and page.removesuffix(".md") not in RUN_HERE:
            assert any(re.search(rf"\b{page}\b", text) for text in others), page


def scope_of(page, which=slice(None), **words):
    """What the code of a page defines, or that of some of its blocks, with other words in the place of some."""
    code, scope = "\n".join(blocks(page, "python")[which]), {"__name__": "page"}
    for word, other in {"runs/wind_turbine/TIME-seed-0": "run", **words}.items():
        code = code.replace(word, other)
    exec(compile(code, page, "exec"), scope)
    return scope


def leave_finished_run(folder):
    """A run of the turbine with random weights and two episodes, as a training leaves it."""
    leave_run(folder, "wind_turbine", policy="bias", horizon=60.0)
    episodes = [
        {"episode": k, "live": "model_based", "event": "keep", "real_cost": 0.1 - 0.01 * k, "J_p": 2.0, "seconds": {}}
        for k in range(2)
    ]
    unseen = {"judged_on": "simulation", "baselines": {}, "merit": {"model_based": {}}} | {
        "J_a_model_based": {"mean": 0.09}
    }
    summary = {"live": "model_based", "unseen": unseen, "twin": {"segment": 0}}
    write_json(folder / "metrics.json", {"episodes": episodes, "summary": summary})
    return folder


def test_the_code_of_a_finished_run_runs(tmp_path, monkeypatch, capsys):
    leave_finished_run(tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    scope_of("finished_run.md", **{"diagnose(run)": "diagnose(run, episodes=2)"})
    shown = capsys.readouterr().out
    assert "torch.Size([601, 6]) torch.Size([600, 2])" in shown and "JonkmanController 0.0" in shown
    assert shown.count(" | ") == 7 * 3  # seven reasons
    scope_of("gallery.md")
    assert len(list(Path().glob("*.png"))) == 4


def test_the_extension_of_the_documentation_finds_a_leak():
    scope = scope_of("own_plant.md", slice(1))
    exec(compile("\n".join(blocks("hypotheses.md", "python")), "hypotheses.md", "exec"), scope)
    tank, suspicious = scope["LeakyTank"](), scope["SuspiciousTank"]()
    assert list(tank.suspects()) == ["pump lags", "pump late", "leaks"]
    config = HypothesesConfig(which=("unknown flow", "pump lags"))
    assert set(make_twin(suspicious, suspicious.closure, config).twins) == {ALONE, *config.which}
    check_plant(tank.suspects()["leaks"], steps=10, traced=False)
    real, generator = scope["Leak"](scope["TwoTanks"](), 4e-3), seeded()
    commands = 2e-4 * torch.rand(1, tank.n_steps, 1, generator=generator, dtype=torch.float64)
    start, inputs = real.draw_initial_state(1, generator), real.draw_exogenous(1, generator)
    (record,) = Rollout(real, real.closure)(start, inputs, commands).each()
    config = HypothesesConfig(call=0.0, which=("leaks", "pump lags"))
    twin = make_twin(tank, tank.make_closure(generator), config)
    fit = AssimilationConfig(method="levenberg_marquardt", inputs="record")
    EnsembleAssimilation(twin, fit, config).update([record], (), 1, generator)
    found = twin.twins["leaks"].closure.named_coefficients()
    assert twin.weights == {"leaks": 1.0} and found["leak"].item() == pytest.approx(4e-3, rel=1e-3)
    assert found["lower_outlet"].item() == pytest.approx(4e-5, rel=1e-2)


def test_the_real_turbine_has_what_its_twin_does_not_know():
    scope = scope_of("unknown_systems.md")
    assert len(scope["real"].states) > len(scope["twin"].states)


def test_the_callbacks_of_the_documentation_end_a_training_and_tell_a_logger(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scope = scope_of("habits.md", slice(2))
    assert scope["cheap_enough"]([{"real_cost": 0.01}, {"real_cost": 0.5}]) is None
    assert scope["cheap_enough"]([{"real_cost": 0.5}, {"real_cost": 0.01}]) == "the real system costs 0.01"
    record = {"episode": 0, "real_cost": 0.5, "rms/speed [rad/s]": 0.1, "live": "model_free"}
    assert scope["to_logger"]([record]) is None
    (curve,) = tmp_path.rglob("real_cost.csv")
    assert curve.read_text().split() == ["0,0.5"] and len(list(tmp_path.rglob("speed.csv"))) == 1


@pytest.mark.slow
def test_the_search_of_the_documentation_runs(tmp_path, monkeypatch):
    """As printed, with a single trial; the same code goes on with the search."""
    pytest.importorskip("optuna", reason="a search needs the extra sweep")
    monkeypatch.chdir(tmp_path)
    for done in (1, 2):
        trials = scope_of("habits.md", slice(2, 3), **{"n_trials=10": "n_trials=1"})["search"].trials
        assert len(trials) == done
    files = (Path(f"runs/search/0-{seed}/metrics.json") for seed in (0, 1))
    costs = [json.loads(file.read_text())["summary"]["unseen"]["J_a_model_based"]["mean"] for file in files]
    assert trials[0].value == pytest.approx(sum(costs) / 2.0)


@pytest.mark.slow
def test_the_notebook_runs(tmp_path):
    needed = ("nbformat", "nbclient", "ipykernel")
    nbformat, nbclient, _ = (pytest.importorskip(name, reason="the notebook needs the group test") for name in needed)
    notebook = nbformat.read(ROOT / "docs" / "first_steps.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("model_" in output.get("data", {}).get("text/plain", "") for output in shown)
    assert sum("image/png" in output.get("data", {}) for output in shown) == 2
    assert list((tmp_path / "runs" / "wind_turbine").glob("*/weights.pt"))


@pytest.mark.nightly  # .ci/run builds the site in every run; this is for those who run no .ci/run
@pytest.mark.skipif(importlib.util.find_spec("sphinx") is None, reason="the site needs the group docs")
def test_the_site_builds_without_warnings(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "docs", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    entries = (tmp_path / "api.html").read_text(encoding="utf-8")
    assert all(f'id="rt_torchrl.{name}"' in entries for name in rt_torchrl.__all__)
    assert not (tmp_path / "_build").exists()


def test_the_code_of_the_readme_runs(monkeypatch):
    # The steps are tested elsewhere and take minutes here; what is tested is that the snippet builds them.
    def first_step(training):
        return training.module["interact"](TensorDict({"number": 0}).set_non_tensor("live", training.referee.live))

    monkeypatch.setattr(rt_torchrl.ReinforcementTwinning, "episode", first_step)
    assert scope_of("README.md")["report"]["real_cost"] > 0


def test_files_that_the_readme_names_exist():
    for link in re.findall(r"\]\(((?!http|#)[^)#]+)", TEXTS["README.md"]):
        assert (ROOT / link).exists(), link


@pytest.mark.slow
def test_the_tutorial_runs_as_it_is_printed(tmp_path):
    """In a process of its own, as a user runs it: the check of the plant traces, which this process could not."""
    done = fresh_process.run("\n".join(blocks("own_plant.md", "python")), cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    upper, lower = map(float, re.findall(r"outlet': ([\d.e-]+)", done.stdout)[:2])
    # The inflow is measured without noise: to rounding.
    assert upper == pytest.approx(5e-5, rel=1e-9) and lower == pytest.approx(4e-5, rel=1e-9)


def test_the_pictures_of_the_gallery_are_those_that_its_script_draws():
    drawn = runpy.run_path(str(ROOT / "docs" / "gallery.py"))["PICTURES"]
    pictures = {f"{plant}_{name}" for plant, names in drawn.items() for name in names}
    assert pictures == set(re.findall(r"\(gallery/([\w.]+)\)", TEXTS["gallery.md"]))
    assert all((ROOT / "docs" / "gallery" / name).is_file() for name in pictures)
