"""Files that a run writes: whole or not at all, without code, and with their damage noticed."""

import errno
import json
import os
import pickle
import stat
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from rt_torchrl.atomic_file import finite, write_atomically, write_json
from rt_torchrl.runs.tensor_file import load_tensors, save_tensors

CONTENT = {
    "policy": {"gain": torch.linspace(0.0, 1.0, 300, dtype=torch.float64)},
    "pair": (1, 0.5),
    "names": ["model_free", None, True],
}


def same(one, other):
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return type(one) is type(other) and all(map(same, one, other)) and len(one) == len(other)
    return one == other


def test_what_is_saved_is_read_back(tmp_path):
    file = tmp_path / "weights.pt"
    save_tensors(file, CONTENT)
    assert same(load_tensors(file), CONTENT)
    # As anybody reads it.
    assert same(torch.load(file, weights_only=True), CONTENT)
    assert [path.name for path in tmp_path.iterdir()] == ["weights.pt"]


def test_weights_and_numbers_of_other_kinds_are_saved_as_plain_ones(tmp_path):
    module, file = nn.Linear(2, 3), tmp_path / "weights.pt"
    save_tensors(file, {"module": module.state_dict(), "number": np.float64(0.1), "size": torch.Size([2])})
    found = load_tensors(file)
    assert type(found["module"]) is dict and type(found["number"]) is float and found["size"] == (2,)
    torch.testing.assert_close(found["module"], dict(module.state_dict()), rtol=0, atol=0)


def test_what_could_not_be_read_back_is_not_saved(tmp_path):
    file = tmp_path / "checkpoint.pt"
    save_tensors(file, CONTENT)
    with pytest.raises(ValueError, match=r"\['real_system'\]\['rng'\]\[1\] of what is to be saved is a ndarray"):
        save_tensors(file, {"real_system": {"rng": [0, np.zeros(2)]}})
    assert same(load_tensors(file), CONTENT)


class Bomb:
    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "bare pickle"])
def test_a_file_runs_no_code(tmp_path, legacy):
    file, trace = tmp_path / "checkpoint.pt", tmp_path / "trace"
    if legacy:
        file.write_bytes(pickle.dumps({"format": Bomb(trace)}))
    else:
        torch.save({"format": 4, "state": Bomb(trace)}, file)
    with pytest.raises(ValueError, match="checkpoint.pt is (not loaded|damaged, or no file of a run)"):
        load_tensors(file)
    assert not trace.exists()


def test_every_truncation_is_noticed(tmp_path):
    file = tmp_path / "weights.pt"
    save_tensors(file, CONTENT)
    whole = file.read_bytes()
    for length in [*range(0, len(whole), 37), len(whole) - 1]:
        file.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"weights\.pt is (damaged|not loaded)"):
            load_tensors(file)


def test_a_changed_bit_is_noticed_or_without_effect(tmp_path):
    file = tmp_path / "weights.pt"
    save_tensors(file, CONTENT)
    whole, generator, noticed = file.read_bytes(), np.random.default_rng(0), 0
    for position in generator.integers(0, len(whole), 1000):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << generator.integers(8)
        file.write_bytes(bytes(damaged))
        try:
            # Bytes between the parts, such as padding and dates, say nothing of the content.
            assert same(load_tensors(file), CONTENT)
        except ValueError as error:
            assert str(file) in str(error)  # noqa: PT017  (most damages raise, a few are without effect)
            noticed += 1
    # Half of the file is the one large tensor, whose bits all count.
    assert noticed > 500


def test_torch_reads_no_field_that_python_does_not_check(tmp_path):
    """The flag that makes a part a folder: torch gives memory of its size that nobody has written."""
    file = tmp_path / "weights.pt"
    save_tensors(file, CONTENT)
    whole = file.read_bytes()
    flag = whole.index(b"PK\x01\x02") + 38  # external attributes of the first part
    changed = whole[:flag] + b"\x10" + whole[flag + 1 :]
    file.write_bytes(changed)
    with pytest.raises(ValueError, match=r"weights\.pt is damaged.*does not have the checksum"):
        load_tensors(file)
    # A file of an earlier version has no checksum of the whole.
    length = whole.rindex(b"sha256:") - 2
    file.write_bytes(changed[:length] + b"\0\0")
    assert same(load_tensors(file), CONTENT)


@pytest.mark.parametrize("content", [b"", b"\x00" * 100, b"PK\x03\x04", b"{}", os.urandom(5000)])
def test_a_foreign_file_is_refused_by_name(tmp_path, content):
    file = tmp_path / "checkpoint.pt"
    file.write_bytes(content)
    with pytest.raises(ValueError, match="checkpoint.pt is damaged, or no file of a run"):
        load_tensors(file)
    torch.save([1, 2], file)
    with pytest.raises(ValueError, match="checkpoint.pt is no file of a run: it holds a list"):
        load_tensors(file)


class Full:
    """A file on a full disk, which takes only a part of the content."""

    def __init__(self, file):
        self.file = file

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.file.close()

    def write(self, content):
        self.file.write(content[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    file = tmp_path / "checkpoint.pt"
    save_tensors(file, CONTENT)
    opened = Path.open
    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", lambda self, mode="r": Full(opened(self, mode)))
        with pytest.raises(OSError, match="No space left on device.*intact; make room.*checkpoint.pt"):
            save_tensors(file, {"other": 1})
    assert same(load_tensors(file), CONTENT)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_a_write_into_a_missing_folder_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing is written; make its folder.*gone/metrics\.json") as error:
        write_json(tmp_path / "gone" / "metrics.json", {})
    assert "intact" not in str(error.value) and "room" not in str(error.value)


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS])
def test_a_write_without_permission_says_so(number, tmp_path, monkeypatch):
    def refused(*_, **__):
        raise OSError(number, os.strerror(number))

    (tmp_path / "metrics.json").write_text("old")
    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", refused)
        with pytest.raises(
            OSError, match=r"what was there before is intact; write where you may.*metrics\.json"
        ) as error:
            write_json(tmp_path / "metrics.json", {})
    assert "room" not in str(error.value) and (tmp_path / "metrics.json").read_text() == "old"


def test_an_error_after_the_new_content_does_not_speak_of_the_old_one(tmp_path, monkeypatch):
    """The folder cannot be flushed, so that only a power cut would bring the old content back."""
    flush = os.fsync

    def failing(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        flush(descriptor)

    file = tmp_path / "metrics.json"
    file.write_text("old")
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", failing)
        with pytest.raises(OSError, match=r"is written, but a power cut may undo it.*metrics\.json") as error:
            write_json(file, {"new": 1})
    assert "intact" not in str(error.value) and json.loads(file.read_text()) == {"new": 1}


def test_a_file_is_never_seen_half_written(tmp_path, monkeypatch):
    """The process is killed at the end of the writing, when only the new name is not on the disk yet."""
    file = tmp_path / "metrics.json"
    write_json(file, {"old": 1})

    def killed(self, target):
        assert json.loads(file.read_text()) == {"old": 1}
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(file, b"{")
    assert json.loads(file.read_text()) == {"old": 1} and len(list(tmp_path.iterdir())) == 1


def test_numbers_that_json_does_not_have_are_null(tmp_path):
    file, found = tmp_path / "metrics.json", {"a": [float("inf"), 1.0], "b": {"c": float("nan"), "d": "NaN"}}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(file, found)
    assert not list(tmp_path.iterdir())
    write_json(file, finite(found))

    def refused(name):
        raise AssertionError(f"{name} is not JSON")

    assert json.loads(file.read_text(), parse_constant=refused) == {"a": [None, 1.0], "b": {"c": None, "d": "NaN"}}
