"""The benchmark times engines whose gradients agree, and the drone in JAX and CasADi beside them."""

import json
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
    assert all(row["forward"] > 0.0 and row["gradient"] > 0.0 and row["first"] > 0.0 for row in found)
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


@pytest.mark.slow
def test_a_size_that_would_take_too_long_is_left_out(tmp_path):
    sizes = ["--plants", "wind_turbine", "--horizons", "20", "600", "--realisations", "2", "--limit", "0.1"]
    found, _ = rows(tmp_path, RECIPE, *sizes, "--engines", "native", "autograd")
    assert found.keys() == {("native", 20), ("autograd", 20), ("native", 600)}


@pytest.mark.nightly  # minutes of backpropagation
@pytest.mark.parametrize(
    ("plant", "steps"), [("wind_turbine", 1_200), ("flapping_wing", 10_000), ("cryogenic_tank", 14_400)]
)
def test_engines_agree_over_a_whole_episode(tmp_path, plant, steps):
    sizes = ["--plants", plant, "--horizons", str(steps), "--realisations", "2"]
    found, _ = rows(tmp_path, RECIPE, *sizes, "--engines", "native", "parallel", "odeint_adjoint")
    assert found["parallel", steps]["gap"] < 1e-9 and found["odeint_adjoint", steps]["gap"] < 1e-4


@pytest.mark.nightly  # half a minute of g++
@pytest.mark.parametrize("policy", ["affine", "mlp"])
def test_jax_and_casadi_have_the_same_gradients(tmp_path, policy):
    """Their equations are written by hand; three realisations fill no vector."""
    for package in ("jax", "casadi"):
        pytest.importorskip(package, reason="JAX and CasADi come with the group nightly")
    if shutil.which("g++") is None:
        pytest.skip("CasADi's code needs g++")
    sizes = ["--plants", "flapping_wing", "--policy", policy, "--horizons", "60", "--realisations", "3"]
    found, printed = rows(tmp_path, PEERS, *sizes, "--engines", "autograd", "native")
    assert {name for name, _ in found} == {"autograd", "native", "jax", "casadi", "casadi_lanes"}
    assert all(row["gap"] < 1e-10 for row in found.values()) and "casadi_lanes" in printed
