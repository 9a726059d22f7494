"""Files and units of others: refused in words, or sound; never accepted in silence."""

import json
import math
import shutil
import warnings
import zipfile
from functools import cache, partial
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from linear_quadratic import LinearQuadratic
from test_disturbances import HH_HEADER, bts_bytes, hh_line, plane

from rt_torchrl import RunConfig
from rt_torchrl.envs.wind_turbine.rotor import DATA, PowerCoefficientTable
from rt_torchrl.envs.wind_turbine.turbsim import GREATEST_SPEED, read_wind
from rt_torchrl.fit.log import SensorLog, checked, read_log
from rt_torchrl.fit.resampling import INTERVALS_PER_ROW, resample
from rt_torchrl.options import read_options
from rt_torchrl.runs import run_folder
from rt_torchrl.runs.run_folder import load_tensors, save_tensors
from rt_torchrl.runs.settings import BESIDE, as_written, read_settings

PLANT = LinearQuadratic(horizon=2.0)

# Damaged and foreign files: a reader returns something sound, or raises a ValueError in words.


def write_log(path):
    t = 0.1 * np.arange(60)
    columns = {"position": np.sin(t), "velocity": np.cos(t), "force": 0.1 * np.sin(3 * t), "disturbance": 0.0 * t}
    SensorLog(times=t, columns=columns).write(path)


def read_sensor_log(path):
    found = checked(read_log(path, PLANT), PLANT)
    resampled = resample(found, PLANT)
    for segment in resampled.segments:
        assert all(part.isfinite().all() for part in segment[:3])
        # What the plant's signals may be, and no more intervals than the rows can tell of.
        assert segment.actions.abs().max() <= 2.0
    assert sum(len(s.actions) for s in resampled.segments) <= INTERVALS_PER_ROW * len(found.times)


WIND = HH_HEADER + "".join(hh_line(0.5 * k, 8.0 + 0.1 * k) for k in range(20))


def read_wind_file(path):
    found = read_wind(path)
    assert np.isfinite(found.speed).all() and (np.diff(found.time) > 0).all()
    assert found.speed.min() >= 0.0 and found.speed.max() <= GREATEST_SPEED


def read_table(path):
    table = PowerCoefficientTable.from_csv(path)
    probe = torch.tensor([[7.0, 0.0], [9.0, 10.0]]).double()
    assert table(probe).isfinite().all() and table.values.max() <= 16 / 27


@cache
def weights():
    gain = torch.randn(3, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return {"policy": {"gain": gain}, "names": ["a", None, True, 0.5]}


def read_weights(path):
    found = load_tensors(path)
    if "policy" in found:  # a byte between the parts says nothing of the content
        assert torch.equal(found["policy"]["gain"], weights()["policy"]["gain"])


def content():
    return {"format": run_folder.FORMAT, "episodes": [{"episode": 0}], "state": {"plant": "p", "algorithm": weights()}}


def read_checkpoint(path):
    algorithm = Mock()  # which takes a checkpoint's state
    algorithm.twin.plant.name = "p"
    assert run_folder.load_checkpoint(path.parent, algorithm) == [{"episode": 0}]
    (state,) = algorithm.load_state_dict.call_args.args
    assert torch.equal(state["policy"]["gain"], weights()["policy"]["gain"])


def read_config(path):
    settings = read_settings(path.parent)
    config = read_options(RunConfig, {key: value for key, value in settings.items() if key not in BESIDE})
    assert math.isfinite(config.noise) and config.episodes >= 1


READERS = {
    "log.csv": (write_log, read_sensor_log),
    "log.parquet": (write_log, read_sensor_log),
    "wind.hh": (lambda path: path.write_text(WIND), read_wind_file),
    "wind.bts": (lambda path: path.write_bytes(bts_bytes(plane()[1])[0]), read_wind_file),
    "table.csv": (partial(shutil.copy, DATA / "nrel5mw_Cp_table_rosco.csv"), read_table),
    "weights.pt": (lambda path: save_tensors(path, weights()), read_weights),
    "checkpoint-0001.pt": (lambda path: save_tensors(path, content()), read_checkpoint),
    "config.json": (lambda path: path.write_text(json.dumps(as_written(RunConfig()) | {"plant": "p"})), read_config),
}
"""Functions that write a good file of a name, and that read it and require a sound result."""
WORDS = "nan,inf,-inf,1e308,-1,0,,x,1e999,2026-01-01,\",;,-0.0,99999999999999999999,µ,[],{},true,null,NaN,#,'"
TOKENS = [*(word.encode() for word in WORDS.split(",")), b",", b"\n", b"\x00", b"\xff\xfe"]
EDITS = ("flip", "cut", "insert", "swap", "token")


def spoilt(whole, edit, at, span, token):
    """The file after one edit at a share of its length."""
    n = len(whole)
    k = min(int(at * n), max(0, n - 1))
    if edit == "flip" and n:
        return whole[:k] + bytes([whole[k] ^ (1 << span % 8)]) + whole[k + 1 :]
    if edit == "cut":
        return whole[:k]
    if edit == "insert":
        return whole[:k] + token * (1 + span % 3) + whole[k:]
    if edit == "swap":
        lines = whole.split(b"\n")
        one, other = int(at * len(lines)) % len(lines), span % len(lines)
        lines[one], lines[other] = lines[other], lines[one]
        return b"\n".join(lines)
    # In the place of an entry of a table or a value.
    start = max(whole.rfind(mark, 0, k) for mark in (b",", b"\n", b":", b" ")) + 1
    ends = [end for mark in (b",", b"\n", b" ") if (end := whole.find(mark, k)) >= 0]
    return whole[:start] + token + whole[min(ends, default=n) :]


EDIT = st.tuples(st.sampled_from(EDITS), st.floats(0.0, 1.0), st.integers(1, 200), st.sampled_from(TOKENS))


def damaged(good):
    """Files: a good one after one to four edits, and, seldom, any bytes."""

    def edited(edits):
        found = good
        for edit in edits:
            found = spoilt(found, *edit)
        return found

    return st.one_of(*[st.lists(EDIT, min_size=1, max_size=4).map(edited)] * 9, st.binary(max_size=400))


@pytest.mark.usefixtures("unchecked")  # what stands for an algorithm is none
@pytest.mark.parametrize("examples", [5, pytest.param(150, marks=pytest.mark.faults)])
@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_refused_or_sound(name, examples, tmp_path):
    path, (write, read) = tmp_path / name, READERS[name]
    write(path)
    good = path.read_bytes()
    read(path)

    @settings(
        max_examples=examples, derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(file=damaged(good))
    def tried(file):
        path.write_bytes(file)
        try:
            read(path)
        except ValueError as error:
            if not str(error):
                raise
        finally:
            for left in tmp_path.glob("*"):
                left.unlink()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        tried()


@pytest.mark.parametrize("compressed", [True, False], ids=["compressed", "overlapping"])
def test_a_file_of_tensors_that_would_grow_is_refused(tmp_path, compressed):
    path = tmp_path / "weights.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED) as archive:
        archive.writestr("archive/data.pkl", b"\0" * 100_000)
    if not compressed:
        whole = path.read_bytes()
        size = (100_000).to_bytes(4, "little")
        path.write_bytes(whole.replace(size, (2**31).to_bytes(4, "little")))
    with pytest.raises(ValueError, match=r"weights\.pt is damaged, or no file of a run"):
        read_weights(path)
