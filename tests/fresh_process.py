"""Processes of their own, for what the run-time checks of annotations in this one do not stand, such as compilation.

They are forked from a server that has imported PyTorch, TorchRL and the library once, without these checks.
"""

import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
METHOD = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
CONTEXT = multiprocessing.get_context(METHOD)
if METHOD == "forkserver":
    CONTEXT.set_forkserver_preload(["rt_torchrl.runs.run", "rt_torchrl.figures.training"])


def run(source: str | Path, *arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess:
    """What a Python script does, or a piece of code, as ``subprocess.run`` would give it."""
    with tempfile.TemporaryDirectory() as folder:
        script = source if isinstance(source, Path) else Path(folder, "script.py")
        if script is not source:
            script.write_text(source, encoding="utf-8")
        command = [str(script), *map(str, arguments)]
        process = CONTEXT.Process(target=_main, args=(command, cwd, folder))
        process.start()
        process.join()
        out, err = (Path(folder, name).read_text(encoding="utf-8") for name in ("out", "err"))
    return subprocess.CompletedProcess(command, process.exitcode, out, err)


def _main(command: list[str], cwd: Path, folder: str) -> None:
    for stream, name in ((sys.stdout, "out"), (sys.stderr, "err")):
        with open(Path(folder, name), "wb") as file:
            os.dup2(file.fileno(), stream.fileno())
    os.chdir(cwd)
    sys.argv = command
    sys.path.insert(0, str(Path(command[0]).parent))
    runpy.run_path(command[0], run_name="__main__")
