"""The gradient engines as the benchmark compares them; over whole episodes in the slow tests."""

import json
import runpy
from pathlib import Path

import fresh_process
import pytest

RECIPE = Path(__file__).parent.parent / "recipes" / "benchmark.py"


def compared(tmp_path, *options):
    """Output of the benchmark, which runs in a process of its own."""
    output = tmp_path / "result.json"
    done = fresh_process.run(RECIPE, "--repeats", "1", "--output", str(output), *options)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(output.read_text())


def test_every_engine_is_timed_and_compared(tmp_path):
    options = ["--plant", "wind_turbine", "--steps", "20", "--realisations", "2", "--no-compiled"]
    found = compared(tmp_path, *options, "--engines", "parallel", "autograd", "odeint_adjoint")
    assert all(seconds > 0 for seconds in found["medians"].values())
    assert found["gaps"]["odeint_adjoint"] == 0.0
    # Both others are exact; the continuous adjoint differs from them by the order of its step.
    assert 0.0 < found["gaps"]["parallel"] < 1e-4
    assert found["gaps"]["parallel"] == pytest.approx(found["gaps"]["autograd"], rel=1e-6)


def test_an_engine_that_cannot_is_left_out_and_the_others_are_timed(tmp_path, capsys):
    """The pendulum steps by a scheme of its own, which the continuous adjoint does not know."""
    recipe, output = runpy.run_path(str(RECIPE)), tmp_path / "result.json"
    small = {"plant": "pendulum", "realisations": 2, "steps": 5, "repeats": 1, "compiled": False, "output": output}
    recipe["main"](recipe["Config"](**small))
    shown, found = capsys.readouterr().out, json.loads(output.read_text())
    assert "left out: engine='odeint_adjoint' integrates the vector field, but plant 'pendulum'" in shown
    assert list(found["medians"]) == ["parallel"] and list(found["left_out"]) == ["odeint_adjoint"]
    recipe["main"](recipe["Config"](**small, engines=("odeint_adjoint", "parallel", "autograd")))
    # Two exact gradients: rounding.
    assert json.loads(output.read_text())["gaps"]["parallel"] < 1e-11
    with pytest.raises(ValueError, match="none of them can be timed.*scheme of its own; use parallel or autograd"):
        recipe["main"](recipe["Config"](**small, engines=("odeint_adjoint",)))


@pytest.mark.slow
@pytest.mark.parametrize("plant", ["wind_turbine", "flapping_wing", "cryogenic_tank"])
def test_engines_agree_over_a_whole_episode(tmp_path, plant):
    found = compared(tmp_path, "--plant", plant, "--realisations", "2")
    assert found["gaps"]["parallel"] < 1e-4


@pytest.mark.parametrize(
    ("options", "message"),
    [({"plant": "moon"}, "choose one of"), ({"eager": ("autograd",)}, "eager=.* must be some of engines=")],
)
def test_options_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        runpy.run_path(str(RECIPE))["Config"](**options)
