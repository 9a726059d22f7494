"""Cold and warm start and peak memory of a contender, each measured in a process of its own."""

import ctypes
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarking.case import Case, scenario_of, system_of
from benchmarking.contenders import Contenders

START_STEPS = 100
"""Horizon of the first gradient, at which computing takes a small share of the time."""
STATUS = Path("/proc/self/status")


def started(contenders: Contenders, name: str, case: Case, size: tuple[int, int] | None) -> dict[str, float]:
    """Seconds that compilation takes without and with the caches of an earlier process, and peak memory.

    The caches are those of torch.compile and those in the user's cache folder; both lie in a temporary folder. The
    compiler's time is that of the first gradient less that of the second one.

    Args:
        contenders: the contenders.
        name: name of the contender.
        case: case that it computes.
        size: steps and realisations at which the memory is measured; None leaves it out.

    Raises:
        RuntimeError: if a process fails; the message is that of its error.
    """
    with tempfile.TemporaryDirectory() as caches:
        cold = _run(contenders, name, case, None, caches)
        warm = _run(contenders, name, case, size, caches)
    found = {"cold": cold["compile"], "warm": warm["compile"]}
    return found | {key: warm[key] for key in ("steps", "realisations", "peak_mib") if key in warm}


def _run(contenders: Contenders, name: str, case: Case, size: tuple[int, int] | None, caches: str) -> dict[str, float]:
    task = {"contenders": asdict(contenders), "name": name, "case": asdict(case), "size": size}
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "TORCHINDUCTOR_CACHE_DIR": str(Path(caches, "inductor")),
        "XDG_CACHE_HOME": str(Path(caches, "user")),
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "-m", "benchmarking.fresh_process", json.dumps(task)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{name} on {case.name} failed in a process of its own: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main(task: dict[str, Any]) -> dict[str, float]:
    """What one process measures of a task."""
    system = system_of(Case(**task["case"]))
    contender = Contenders(**task["contenders"]).made(task["name"], system)
    seconds = []
    calls = contender.calls(scenario_of(system.case, START_STEPS, 5))
    for _ in range(2):
        start = time.perf_counter()
        calls.gradient()
        seconds.append(time.perf_counter() - start)
    found = {"compile": max(0.0, seconds[0] - seconds[1])}
    if task["size"] is None or not hasattr(ctypes.CDLL(None), "malloc_trim"):
        return found
    steps, realisations = task["size"]
    calls = contender.calls(scenario_of(system.case, steps, realisations))
    calls.gradient()  # whatever another size compiles is no memory of the computation
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # or freed memory of the first call would hide what the second one takes
    before = _status("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak starts anew
    calls.gradient()
    return found | {"steps": steps, "realisations": realisations, "peak_mib": (_status("VmHWM") - before) / 1024.0}


def _status(name: str) -> float:
    """A number of this process's status [KiB]."""
    lines = STATUS.read_text(encoding="ascii").splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith(f"{name}:")))


if __name__ == "__main__":
    print(json.dumps(main(json.loads(sys.argv[1]))))
