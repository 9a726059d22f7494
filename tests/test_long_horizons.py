"""Memory of gradients over long horizons, each in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent


pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the standard library reads no peak memory there")


def found_by(script, *arguments):
    """What a script of this folder prints as JSON at its end."""
    paths = os.pathsep.join([str(TESTS.parent), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(TESTS / script), *map(str, arguments)]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_a_neural_ode_of_64_states_over_100_000_steps_fits_in_4_gib():
    found = found_by("neural_ode.py", 100_000)
    assert found["peak"] < 4.0
    assert found["slope"] == pytest.approx(found["difference"], rel=1e-5)


@pytest.mark.nightly
def test_a_thousand_flights_of_100_000_steps_fit_in_8_gib():
    """The winds alone take 0.75 GiB, and the gradient by them as much."""
    found = found_by("long_drone.py", 1000, 100_000)
    assert found["peak"] < 8.0
    assert found["slope"] == pytest.approx(found["difference"], rel=1e-6)
