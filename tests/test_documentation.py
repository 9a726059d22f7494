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
from printed_commands import ROOT, TEXTS, blocks, run_code
from tensordict import TensorDict
from test_export_recipe import RECIPES, leave_run

import rt_torchrl
from rt_torchrl import HypothesesConfig
from rt_torchrl.atomic_file import write_json
from rt_torchrl.steps.config import ROLES
from rt_torchrl.steps.hypotheses.ensemble import ALONE, make_twin

RUN_HERE = "README finished_run gallery habits hypotheses own_plant unknown_systems".split()


def test_every_page_with_code_is_run():
    """A page with a block needs a test that runs it, here or in another file that names the page."""
    others = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").glob("test_*.py") if path != Path(__file__)]
    for page in TEXTS:
        if blocks(page, "python") and page.removesuffix(".md") not in RUN_HERE:
            assert any(re.search(rf"\b{page}\b", text) for text in others), page


def leave_finished_run(folder):
    """A run of the turbine with random weights and two episodes, as a training leaves it."""
    leave_run(folder, "wind_turbine", policy="bias", horizon=60.0)
    episodes = [
        {"episode": k, "live": "model_based", "event": "keep", "real_cost": 0.1 - 0.01 * k, "J_p": 2.0, "seconds": {}}
        for k in range(2)
    ]
    unseen = {"judged_on": "simulation", "baselines": {}, "merit": dict.fromkeys(ROLES, {})} | {
        f"J_a_{role}": {"mean": 0.09} for role in ROLES
    }
    summary = {"live": "model_based", "unseen": unseen, "twin": {"segment": 0}}
    write_json(folder / "metrics.json", {"episodes": episodes, "summary": summary})
    return folder


def test_the_code_of_a_finished_run_runs(tmp_path, monkeypatch, capsys):
    leave_finished_run(tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    code = "\n".join(blocks("finished_run.md", "python")).replace("runs/wind_turbine/TIME-seed-0", "run")
    run_code("finished_run.md", code.replace("diagnose(run)", "diagnose(run, episodes=2)"))
    shown = capsys.readouterr().out
    assert "torch.Size([601, 6]) torch.Size([600, 2])" in shown and "JonkmanController 0.0" in shown
    assert shown.count(" | ") == 7 * 3  # seven reasons
    assert (tmp_path / "states.png").exists() and (tmp_path / "learning.png").exists()


def tutorial_with_suspects():
    """What the plant of the tutorial and the page of hypotheses define."""
    tutorial = run_code("own_plant.md", blocks("own_plant.md", "python")[0], __name__="tutorial")
    return run_code("hypotheses.md", **tutorial)


def test_the_suspects_of_the_tutorial_plant_are_plants():
    scope = tutorial_with_suspects()
    found = scope["Tank"]().suspects()
    assert list(found) == ["pump lags", "pump late"] and all(len(plant.states) > 2 for plant in found.values())
    assert list(scope["LeakyTank"]().suspects()) == [*found, "leaks"]
    tank = scope["SuspiciousTank"]()
    twin = make_twin(tank, tank.closure, HypothesesConfig(which=("unknown flow", "pump lags")))
    assert set(twin.twins) == {ALONE, "unknown flow", "pump lags"}


def test_the_real_turbine_has_what_its_twin_does_not_know():
    scope = run_code("unknown_systems.md")
    assert len(scope["real"].states) > len(scope["twin"].states)


def test_every_block_of_code_is_marked_as_python():
    """A block in another spelling of the language would not be run."""
    assert not any(blocks(page, "py") for page in TEXTS)


def test_the_code_of_the_gallery_draws_what_it_says(tmp_path, monkeypatch):
    leave_finished_run(tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    run_code("gallery.md", "\n".join(blocks("gallery.md", "python")).replace("runs/wind_turbine/TIME-seed-0", "run"))
    assert (tmp_path / "power_and_speed.png").exists() and (tmp_path / "flights.png").exists()


def test_the_callback_of_the_documentation_ends_a_training():
    said = run_code("habits.md", blocks("habits.md", "python")[0])["cheap_enough"]
    assert said([{"real_cost": 0.01}, {"real_cost": 0.5}]) is None
    assert said([{"real_cost": 0.5}, {"real_cost": 0.01}]) == "the real system costs 0.01"


def test_the_callback_of_the_documentation_tells_a_logger(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scope = run_code("habits.md", blocks("habits.md", "python")[1])
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
        scope = run_code("habits.md", blocks("habits.md", "python")[2].replace("n_trials=10", "n_trials=1"))
        assert len(scope["search"].trials) == done
    costs = [
        json.loads(Path(f"runs/search/0-{seed}/metrics.json").read_text())["summary"]["unseen"]["J_a_model_based"]
        for seed in (0, 1)
    ]
    assert scope["search"].trials[0].value == pytest.approx(sum(cost["mean"] for cost in costs) / 2.0)


@pytest.mark.slow
def test_the_notebook_runs(tmp_path):
    nbformat = pytest.importorskip("nbformat", reason="the notebook comes with the group test")
    nbclient = pytest.importorskip("nbclient", reason="the notebook comes with the group test")
    pytest.importorskip("ipykernel", reason="the notebook comes with the group test")
    notebook = nbformat.read(ROOT / "docs" / "first_steps.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("model_" in output.get("data", {}).get("text/plain", "") for output in shown)
    assert sum("image/png" in output.get("data", {}) for output in shown) == 2
    assert list((tmp_path / "runs" / "wind_turbine").glob("*/weights.pt"))


def test_the_front_page_is_short():
    assert len(TEXTS["README.md"].splitlines()) <= 130


@pytest.mark.nightly  # .ci/run builds the site in every run; this is for those who run no .ci/run
@pytest.mark.skipif(importlib.util.find_spec("sphinx") is None, reason="the site needs the group docs")
def test_the_site_builds_without_warnings(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "docs", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    entries = (tmp_path / "api.html").read_text(encoding="utf-8")
    assert all(f'id="rt_torchrl.{name}"' in entries for name in rt_torchrl.__all__)
    assert not (tmp_path / "_build").exists()


# The code and the commands of the README are right.


def test_its_code_runs(monkeypatch):
    from rt_torchrl import ReinforcementTwinning

    # The steps are tested elsewhere and take minutes here; what is tested is that the snippet builds them.
    monkeypatch.setattr(
        ReinforcementTwinning,
        "episode",
        lambda self: self.module["interact"](TensorDict({"number": 0}).set_non_tensor("live", self.referee.live)),
    )
    assert run_code("README.md")["report"]["real_cost"] > 0


def headings(page):
    """The anchors of a page, as its renderers make them of its headings."""
    found = re.findall(r"^#+ (.+)$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in found}


def test_its_files_exist():
    readme = TEXTS["README.md"]
    for link in re.findall(r"\]\(((?!http|#)[^)]+)\)", readme) + re.findall(r"uv run (recipes/\S+\.py)", readme):
        path, _, heading = link.partition("#")
        assert (ROOT / path).exists(), link
        assert not heading or heading in headings(path), link


@pytest.mark.slow
def test_the_tutorial_runs_as_it_is_printed(tmp_path):
    """In a process of its own, as a user runs it: the check of the plant traces, which this process could not."""
    code = "\n".join(blocks("own_plant.md", "python"))
    lines = [line for line in code.splitlines() if line.strip() and not line.strip().startswith("#")]
    assert len(lines) < 65
    done = fresh_process.run(code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    upper, lower = map(float, re.findall(r"outlet': ([\d.e-]+)", done.stdout)[:2])
    # The inflow is measured without noise: to rounding.
    assert upper == pytest.approx(5e-5, rel=1e-9) and lower == pytest.approx(4e-5, rel=1e-9)


def test_the_pictures_of_the_gallery_are_those_that_its_script_draws():
    drawn = runpy.run_path(str(RECIPES.parent / "docs" / "gallery.py"))["PICTURES"]
    pictures = {f"{plant}_{name}" for plant, names in drawn.items() for name in names}
    assert pictures == set(re.findall(r"\(gallery/([\w.]+)\)", TEXTS["gallery.md"]))
    assert all((RECIPES.parent / "docs" / "gallery" / name).is_file() for name in pictures)
