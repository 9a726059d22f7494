"""The benchmark times engines whose gradients agree, and the drone in JAX and CasADi beside them."""

import json
import math
import shutil
from pathlib import Path
from unittest.mock import ANY

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


def close(rel, **values):
    return {name: pytest.approx(value, rel=rel) for name, value in values.items()}


TRUE = {
    # The inlet temperature is reported an interval late, so that the twin cannot be exact.
    "reactor": close(0.01, rate=7.2e10 / 60.0 * math.exp(-8750.0 / 325.0), activation=8750.0, jacket=5e4 / 239e3 / 6.0),
    "drive": close(1e-4, excitation=1.7e-3, inertia=3e-3, friction=0.01, fan=1e-4),
    # The upright pendulum hardly turns in its joints, and the rail's 0.05 N s/m are lost beside 500 N.
    "double_pendulum": close(1e-3, drive=500.0) | close(0.02, joint_friction=0.05) | {"rail_friction": ANY},
}


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("recipe", "package", "episodes", "classical", "ratio"),
    [
        ("reactor", "pcgym", 3, "PI", 1.0),
        ("drive", "gym_electric_motor", 4, "cascade", 0.95),
        ("double_pendulum", "mujoco", 3, "LQR", 0.7),
    ],
)
def test_systems_of_others_cost_less_than_under_their_controllers(
    tmp_path, recipe, package, episodes, classical, ratio
):
    pytest.importorskip(package)
    options = ("--real-unseen", "10", "--no-figures", "--threads", "1", "--log-dir", tmp_path, "--episodes", episodes)
    done = fresh_process.run(ROOT / "recipes" / f"{recipe}.py", *options)
    assert done.returncode == 0, done.stderr[-3000:]
    summary = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))["summary"]
    flown = summary["real_unseen"]["controllers"]
    assert flown[summary["live"]]["J_a"]["mean"] < ratio * flown[classical]["J_a"]["mean"]
    assert summary["closure"]["found"] == TRUE[recipe]
