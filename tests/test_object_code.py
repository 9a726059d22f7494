"""Object code: kept on disk, made again where it is damaged, loaded by any number of processes."""

import ctypes
import gc
import hashlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from rt_torchrl.programs import machine_code
from rt_torchrl.programs.machine_code import DIGEST, ObjectCode


def text(number):
    """A function that stores a number where its argument points."""
    return f"define void @put(ptr %x) {{\n  store double {number:.6e}, ptr %x\n  ret void\n}}\n"


def stored(number, code=None):
    found = np.zeros(1)
    (code or ObjectCode(text(number), "put", (ctypes.c_void_p,)))(found)
    return found[0]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(machine_code, "cache_folder", lambda: tmp_path / "native")
    return tmp_path / "native"


@pytest.fixture
def compilations(monkeypatch):
    """The texts that were compiled."""
    seen, compile_ = [], machine_code._compile
    monkeypatch.setattr(machine_code, "_compile", lambda text: seen.append(text) or compile_(text))
    return seen


def test_code_can_be_freed_and_other_code_stays():
    first, second, third = (ObjectCode(text(x), "put", (ctypes.c_void_p,)) for x in (1.0, 2.0, 3.0))
    del second
    gc.collect()
    assert [stored(1.0, first), stored(3.0, third), stored(4.0)] == [1.0, 3.0, 4.0]


SECOND = """
import ctypes, sys
from pathlib import Path
import numpy as np
from rt_torchrl.programs import machine_code

machine_code.cache_folder = lambda: Path(sys.argv[1])
if sys.argv[2] == "reads":
    machine_code._compile = None
code, found = machine_code.ObjectCode(sys.argv[3], "put", (ctypes.c_void_p,)), np.zeros(1)
code(found)
print(found[0])
"""


def second(*arguments):
    return subprocess.run(
        [sys.executable, "-c", SECOND, *map(str, arguments)], capture_output=True, text=True, check=False
    )


def test_other_processes_write_at_once_and_load_what_is_kept(folder, compilations):
    with ThreadPoolExecutor(2) as pool:
        done = list(pool.map(lambda _: second(folder, "writes", text(8.0)), range(2)))
    assert [d.stdout.split() for d in done] == [["8.0"]] * 2, done[0].stderr[-2000:]
    (kept,) = folder.iterdir()  # no partial file is left
    content = kept.read_bytes()
    assert hashlib.sha256(content[DIGEST:]).digest() == content[:DIGEST]
    assert stored(8.0) == 8.0 and not compilations
    assert second(folder, "reads", text(8.0)).stdout.split() == ["8.0"]


@pytest.mark.parametrize("damage", ["empty", "half", "one byte", "longer"])
def test_damaged_code_is_made_again(damage, folder, compilations):
    stored(1.0)
    (kept,) = folder.iterdir()
    whole = kept.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    damages = {"empty": b"", "half": whole[: len(whole) // 2], "one byte": flipped, "longer": whole + b"1"}
    kept.write_bytes(damages[damage])
    assert stored(1.0) == 1.0
    assert len(compilations) == 2 and kept.read_bytes() == whole


def test_a_folder_that_cannot_be_written_is_done_without(tmp_path, monkeypatch, compilations):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(machine_code, "cache_folder", lambda: tmp_path / "file" / "native")
    assert stored(1.0) == stored(1.0) == 1.0
    assert len(compilations) == 2


@pytest.mark.parametrize("changed", ["processor", "features", "llvm", "llvmlite"])
def test_other_processors_and_versions_have_files_of_their_own(changed, folder, monkeypatch):
    stored(1.0)
    changes = {
        "processor": (machine_code.llvm, "get_host_cpu_name", lambda: "x86-64"),
        "features": (machine_code, "_features", lambda: "-avx512f"),
        "llvm": (machine_code.llvm, "llvm_version_info", (1, 0, 0)),
        "llvmlite": (machine_code, "version", lambda name: "0.1"),
    }
    monkeypatch.setattr(*changes[changed])
    monkeypatch.setattr(machine_code, "_compile", lambda text: b"other code")
    machine_code._compiled(text(1.0))
    assert len(list(folder.iterdir())) == 2
