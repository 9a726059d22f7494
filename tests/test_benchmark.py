"""The benchmark times engines whose gradients agree, and the drone in JAX and CasADi beside them."""

import json
import math
import shutil
from pathlib import Path

import fresh_process
import pytest

ROOT = Path(__file__).parent.parent
RECIPE, PEERS = ROOT / "recipes" / "benchmark.py", ROOT / "tests" / "fast_gradients.py"


def rows(folder, script, *options):
    """Rows of a benchmark in a process of its own by engine and number of intervals, and the printed table."""
    done = fresh_process.run(script, "--output", str(folder), "--repeats", "1", *options)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads((folder / "benchmark.json").read_text())["rows"]
    assert all(row["forward"] > 0.0 and row["gradient"] > 0.0 for row in found)
    return {(row["contender"], row["steps"]): row for row in found}, done.stdout


@pytest.mark.slow
def test_every_engine_is_timed_and_agrees(tmp_path):
    sizes = ["--plants", "wind_turbine", "--horizons", "20", "60", "--realisations", "2"]
    found, printed = rows(tmp_path, RECIPE, *sizes)
    engines = {"native", "parallel", "odeint_adjoint", "autograd"}
    assert found.keys() == {(engine, steps) for engine in engines for steps in (20, 60)}
    assert all(printed.count(engine) == 2 for engine in engines)
    for (engine, steps), row in found.items():
        assert row["ratio"] == row["gradient"] / found["native", steps]["gradient"]
        # The exact gradients agree to rounding; the continuous adjoint differs by the order of its step.
        assert 1e-11 < row["gap"] < 1e-4 if engine == "odeint_adjoint" else row["gap"] < 1e-11
    assert (tmp_path / "wind_turbine.png").stat().st_size > 10_000


@pytest.mark.nightly  # minutes of backpropagation
@pytest.mark.parametrize(
    ("plant", "steps"), [("wind_turbine", 1_200), ("flapping_wing", 2_500), ("cryogenic_tank", 3_600)]
)
def test_engines_agree_over_thousands_of_intervals(tmp_path, plant, steps):
    sizes = ["--plants", plant, "--horizons", str(steps), "--realisations", "2"]
    found, _ = rows(tmp_path, RECIPE, *sizes, "--engines", "native", "parallel", "odeint_adjoint")
    assert found["parallel", steps]["gap"] < 1e-9 and found["odeint_adjoint", steps]["gap"] < 1e-4


@pytest.mark.nightly  # half a minute of g++
def test_jax_and_casadi_have_the_same_gradients(tmp_path):
    """Their equations are written by hand; three realisations fill no vector."""
    for package in ("jax", "casadi"):
        pytest.importorskip(package, reason="JAX and CasADi come with the group nightly")
    if shutil.which("g++") is None:
        pytest.skip("CasADi's code needs g++")
    sizes = ["--plants", "flapping_wing", "--horizons", "60", "--realisations", "3"]
    found, printed = rows(tmp_path, PEERS, *sizes, "--engines", "autograd", "native")
    assert {name for name, _ in found} == {"autograd", "native", "jax", "casadi", "casadi_lanes"}
    assert all(row["gap"] < 1e-10 for row in found.values()) and "casadi_lanes" in printed


# Recipes on systems of others: few episodes beat the classical controller, and the twin finds its coefficients.


RECIPES = fresh_process.ROOT / "recipes"


def trained(name, folder, *options):
    """The summary of a recipe's training, and the mean J_a of each controller's flights on the real system."""
    few = ("--real-unseen", "10", "--no-figures", "--threads", "1", "--log-dir", str(folder))
    done = fresh_process.run(RECIPES / f"{name}.py", *few, *options)
    assert done.returncode == 0, done.stderr[-3000:]
    summary = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["summary"]
    flown = summary["real_unseen"]["controllers"]
    return summary, {who: flights["J_a"]["mean"] for who, flights in flown.items()}


@pytest.mark.nightly
def test_the_reactor_is_held_better_than_by_its_controller(tmp_path):
    pytest.importorskip("pcgym", reason="the extra process is not installed")
    summary, costs = trained("reactor", tmp_path, "--episodes", "3")
    assert costs[summary["live"]] < costs["PI"]
    # The inlet temperature is reported an interval late, so that the twin cannot be exact.
    true = {"rate": 7.2e10 / 60.0 * math.exp(-8750.0 / 325.0), "activation": 8750.0, "jacket": 5e4 / 239e3 / 6.0}
    assert summary["closure"]["found"] == pytest.approx(true, rel=0.01)


@pytest.mark.nightly
def test_the_drive_follows_its_reference_better_than_its_cascade(tmp_path):
    pytest.importorskip("gym_electric_motor", reason="the extra drive is not installed")
    summary, costs = trained("drive", tmp_path, "--episodes", "4")
    assert costs[summary["live"]] < 0.95 * costs["cascade"]
    true = {"excitation": 1.7e-3, "inertia": 3e-3, "friction": 0.01, "fan": 1e-4}
    assert summary["closure"]["found"] == pytest.approx(true, rel=1e-4)


@pytest.mark.nightly
def test_the_double_pendulum_is_held_better_than_by_its_regulator(tmp_path):
    pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    summary, costs = trained("double_pendulum", tmp_path, "--episodes", "3")
    assert costs[summary["live"]] < 0.7 * costs["LQR"]
    found = summary["closure"]["found"]
    assert found["drive"] == pytest.approx(500.0, rel=1e-3)
    # The upright pendulum hardly turns in its joints, and the rail's 0.05 N s/m are lost beside 500 N.
    assert found["joint_friction"] == pytest.approx(0.05, rel=0.02)
