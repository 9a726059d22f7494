"""Memory of a gradient over a long horizon, in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the standard library reads no peak memory there")
def test_a_neural_ode_of_64_states_over_100_000_steps_fits_in_4_gib():
    paths = os.pathsep.join([str(TESTS.parent), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(TESTS / "neural_ode.py"), "100000"]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["peak"] < 4.0
    assert found["slope"] == pytest.approx(found["difference"], rel=1e-5)
