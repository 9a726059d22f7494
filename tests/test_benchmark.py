"""The benchmark times every contender, compares their results, and says what it leaves out."""

import importlib.util
import json
import math
import runpy
import shutil
from pathlib import Path

import fresh_process
import numpy as np
import pytest
import torch
from benchmarking.case import Case, scenario_of, system_of
from benchmarking.contenders import QUANTITIES, Contenders
from benchmarking.figures import save_figures
from benchmarking.sizes import Grid, Size
from benchmarking.summary import DRONE, Summary
from benchmarking.timing import Cell, Stopwatch
from benchmarking.updates import milliseconds_of_update
from matplotlib.image import imread

from rt_torchrl import Rollout, control_cost

RECIPE = Path(__file__).parent.parent / "recipes" / "benchmark.py"
SMALL = ["--quick", "--no-compiled", "--no-starts", "--threads", "1", "--casadi", "--plants", "wind_turbine", "--jax"]
NOTHING = Contenders((), (), (), compiled=False, eager=())


def compared(folder, *options):
    """Cells of a benchmark that runs in a process of its own, by contender and quantity, at the largest size."""
    done = fresh_process.run(RECIPE, "--log-dir", str(folder), *options)
    assert done.returncode == 0, done.stderr[-3000:]
    cells = json.loads((folder / "benchmark.json").read_text())["cells"]
    largest = max(cell["steps"] * cell["realisations"] for cell in cells)
    return {(c["contender"], c["quantity"]): c for c in cells if c["steps"] * c["realisations"] == largest}


def cell(size, contender, quantity="gradient", wall=float("nan"), **more):
    return Cell(size, contender, quantity, wall, wall, 2.0 * wall, 1, wall, 0.0, **more)


@pytest.mark.slow
def test_every_engine_is_timed_and_compared(tmp_path):
    jax = ("jax_scan", "jax_sweep") if importlib.util.find_spec("jax") else ()
    found = compared(tmp_path, *SMALL, *jax, "--engines", "parallel", "autograd", "odeint_adjoint")
    names = ("parallel", "autograd", "odeint_adjoint", *jax)
    expected = {(name, quantity) for name in names for quantity in ("forward", "gradient")}
    assert set(found) == expected - {("jax_sweep", "forward")}  # it goes forward by the same scan
    assert all(found[name, "gradient"]["gap"] < 1e-9 for name in jax)
    assert all(cell["wall"] > 0 and cell["cpu"] > 0 for cell in found.values())
    # Both exact gradients agree to rounding; the continuous adjoint differs from them by the order of its step.
    assert found["autograd", "gradient"]["gap"] < 1e-11
    assert 1e-11 < found["odeint_adjoint", "gradient"]["gap"] < 1e-4
    assert (tmp_path / "wind_turbine-law-affine-1.png").stat().st_size > 10_000
    assert "parallel" in (tmp_path / "benchmark.txt").read_text()


def test_a_size_that_does_not_vary_has_no_panels(tmp_path):
    sizes = [Size(Case("wind_turbine"), 1, steps, batch) for steps, batch in ((10, 5), (20, 5), (20, 1))]
    heights = []
    for count in (3, 2):
        cells = [cell(size, "native", quantity, wall=0.1) for size in sizes[:count] for quantity in QUANTITIES]
        (path,) = save_figures(cells, tmp_path)
        heights.append(len(imread(path)))
    assert heights[0] == 2 * heights[1] > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "method"),
    [
        ("affine", "scalar"),
        pytest.param("mlp", "scalar", marks=pytest.mark.nightly),  # half a minute of g++
        pytest.param("affine", "lanes", marks=pytest.mark.nightly),
    ],
)
def test_casadi_and_torch_agree(policy, method):
    """The equations by hand in CasADi, and its derivative, with a number of realisations that fills no vector."""
    pytest.importorskip("casadi", reason="the drone in CasADi needs the extra bench")
    if shutil.which("g++") is None:
        pytest.skip("CasADi's code needs g++")
    from benchmarking.casadi_code import CasadiCode

    system = system_of(Case("flapping_wing", policy=policy))
    scenario = scenario_of(system.case, 60, 3)
    cost = Rollout(system.plant, system.closure, system.policy, engine="autograd").costs(*scenario).mean()
    expected = torch.cat([part.flatten() for part in torch.autograd.grad(cost, system.weights())])
    code = CasadiCode(system, method)
    also, gradient = code.gradient(code.inputs(scenario))
    assert also == pytest.approx(cost.item(), rel=1e-12)
    assert np.linalg.norm(gradient - expected.numpy()) < 1e-10 * expected.norm().item()


@pytest.mark.slow
@pytest.mark.parametrize(("closure", "policy", "method"), [("law", "affine", "scan"), ("mlp", "mlp", "sweep")])
@pytest.mark.parametrize("plant", ["wind_turbine", "flapping_wing", "cryogenic_tank"])
def test_jax_and_torch_agree(plant, closure, policy, method):
    """The plants in JAX, with which the engines are compared, are those of the library."""
    pytest.importorskip("jax", reason="the plants in JAX need the extra bench")
    from benchmarking.jax_loops import JaxLoops

    system = system_of(Case(plant, closure, policy))
    scenario = scenario_of(system.case, 60, 3)
    trajectory = Rollout(system.plant, system.closure, system.policy, engine="autograd")(*scenario)
    cost = control_cost(system.plant, trajectory).mean()
    names = [name for name, _ in system.policy.named_parameters()]
    expected = dict(zip(names, torch.autograd.grad(cost, system.weights()), strict=True))
    whole = torch.cat([part.flatten() for part in expected.values()]).norm().item()
    assert whole > 0.0
    loops = JaxLoops(system, method)
    inputs = loops.inputs(scenario)
    if method == "scan":
        states = trajectory.states[:, 1:].detach().permute(1, 2, 0).numpy()
        size = np.abs(states).max((0, 2), keepdims=True)  # of each state
        found_cost, ends = loops.forward(inputs)
        assert (np.abs(np.asarray(ends) - states) / size).max() < 1e-9
        assert float(found_cost) == pytest.approx(cost.item(), rel=1e-9)
    also_cost, gradient = loops.gradient(inputs)
    assert float(also_cost) == pytest.approx(cost.item(), rel=1e-9)
    assert set(gradient) == set(expected)
    gap = [np.asarray(gradient[name]).ravel() - part.flatten().numpy() for name, part in expected.items()]
    assert np.linalg.norm(np.concatenate(gap)) < 1e-9 * whole


def test_casadi_knows_the_drone_with_its_law_alone():
    pytest.importorskip("casadi", reason="the drone in CasADi needs the extra bench")
    for case in (Case("wind_turbine"), Case("flapping_wing", closure="mlp")):
        assert "only the drone with its law" in NOTHING.refusal("casadi_scalar", system_of(case))


def test_jax_that_is_not_installed_is_left_out(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    system = system_of(Case("wind_turbine"))
    assert "install the extra bench" in NOTHING.refusal("jax_scan", system)
    assert "install the extra bench" in NOTHING.refusal("casadi_lanes", system)
    assert NOTHING.refusal("parallel", system) is None


@pytest.mark.slow
def test_compilation_and_memory_are_measured_in_fresh_processes(tmp_path):
    done = fresh_process.run(RECIPE, "--log-dir", str(tmp_path), "--quick", "--no-compiled", *SMALL[3:-1], "--jax",
                             "--engines", "autograd")  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    (found,) = json.loads((tmp_path / "benchmark.json").read_text())["starts"].values()
    assert found["autograd"]["cold"] >= 0.0 and found["autograd"]["warm"] >= 0.0
    # The tape of 60 intervals holds thousands of small tensors.
    assert found["autograd"].get("peak_mib", 1.0) > 0.1


def test_an_iteration_of_step_2_is_timed_traced_and_as_torchrl_makes_it():
    found = milliseconds_of_update("wind_turbine", iterations=20, repeats=1)
    assert 0.0 < found["traced"] < found["torchrl"] < 1e3


@pytest.mark.nightly  # minutes of backpropagation
@pytest.mark.parametrize("plant", ["wind_turbine", "flapping_wing", "cryogenic_tank"])
def test_engines_agree_over_a_whole_episode(tmp_path, plant):
    steps = {"wind_turbine": "1200", "flapping_wing": "10000", "cryogenic_tank": "14400"}[plant]
    sizes = ["--horizons", steps, "--at-horizon", steps, "--realisations", "2", "--at-realisations", "2"]
    common = ["--plants", plant, "--engines", "parallel", "odeint_adjoint", "--jax", "--threads", "1", "--repeats", "1"]
    found = compared(tmp_path, *common, *sizes, "--eager", "--no-starts", "--episodes", "0", "--updates", "0",
                     "--minutes", "0")  # fmt: skip
    assert found["odeint_adjoint", "gradient"]["gap"] < 1e-4


def test_lines_go_through_the_chosen_sizes_and_the_smaller_work_comes_first():
    drone, turbine = Case("flapping_wing"), Case("wind_turbine")
    grid = Grid([drone, turbine], [1, 2], [10, 100], [1, 5], at_horizon=100, at_realisations=5)
    assert grid.pairs() == [(10, 5), (100, 1), (100, 5)]
    assert [[(size.case, size.threads) for size in sizes] for sizes in grid][::3] == [
        [(drone, 1), (drone, 2)],
        [(turbine, 1), (turbine, 2)],
    ]
    assert len(Grid([drone], [1], [10, 100], [1, 5], at_horizon=100, at_realisations=5, all_pairs=True).pairs()) == 4


def test_a_size_that_would_take_too_long_is_left_out():
    case = Case("wind_turbine")
    watch = Stopwatch(Contenders(("autograd",), (), (), compiled=False, eager=()), 1, 1.0, lambda doing: None)
    watch.cells += [
        cell(Size(case, 1, 100, 5), "autograd", wall=0.5),
        cell(Size(case, 1, 200, 1), "autograd", wall=0.4),
    ]
    # Ten times the first size, and 25 times the second one.
    assert watch.predicted(Size(case, 1, 1000, 5), "autograd", "gradient") == pytest.approx(5.0)
    # Ten times the first size, whose realisations may take no longer than one, and five times the second one.
    assert watch.predicted(Size(case, 1, 1000, 1), "autograd", "gradient") == pytest.approx(2.0)
    assert math.isnan(watch.predicted(Size(case, 2, 1000, 5), "autograd", "gradient"))
    left = {found.quantity: found.left_out for found in watch.time([Size(case, 1, 1000, 5)], ["autograd"])}
    assert left == {"forward": "", "gradient": "about 5 s predicted, limit 1 s"}


def test_the_summary_gives_the_ratios():
    at = [Size(DRONE, 1, 10_000, batch) for batch in (5, 25)]
    short, two = Size(DRONE, 1, 100, 25), Size(DRONE, 2, 10_000, 5)
    cells = [cell(at[0], "native", wall=0.1), cell(at[0], "jax_scan", wall=1.0), cell(two, "native", wall=0.05)]
    cells += [cell(at[1], "native", wall=0.2), cell(short, "odeint_adjoint", wall=1.0)]
    cells += [cell(at[1], "odeint_adjoint", left_out="about 100 s predicted, limit 10 s")]
    cells += [cell(Size(DRONE, 1, 1_000, 5), "native", wall=0.02)]
    lines = Summary(cells, "native").lines()
    start = "drone, gradient, 10000 steps, {} realisations, 1 thread: native over {}"
    assert f"{start.format(5, 'jitted JAX scan')}: 10 times as fast by wall time, 10 by CPU time" in lines
    scaled = "500 times as fast by wall time, 500 by CPU time, odeint_adjoint scaled per step from 100 steps"
    assert f"{start.format(25, 'odeint_adjoint')}: {scaled}" in lines
    assert f"{start.format(125, 'jitted JAX scan')}: not measured (this size was not asked for)" in lines
    assert any("native on 2 threads is 2 times as fast as on 1, by minima 2" in line for line in lines)
    # 40 and 20 microseconds of CPU time for a step.
    assert any(line.endswith("40 us at 1000, 20 us at 10000; greatest over least 2") for line in lines)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizons": ()}, "horizons=.* must be one value or several different ones"),
        ({"realisations": (0, 5)}, "realisations=.* must all be at least 1"),
        ({"repeats": 0}, "repeats=0 must be at least 1"),
        ({"threads": (1, 10_000)}, "threads=.* must be at most"),
        ({"limit": 0.0}, "limit=0.0 s must be positive"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        runpy.run_path(str(RECIPE))["Config"](**options)
