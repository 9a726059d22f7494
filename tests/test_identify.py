"""The two recipes around logs, from a recorded file to the results."""

import importlib.util
import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from rt_torchrl.envs.wind_turbine.closures import SaintDrenan
from rt_torchrl.fit.least_squares import EstimationConfig

pd = pytest.importorskip("pandas")
RECIPES = Path(__file__).parent.parent / "recipes"


def recipe(name):
    """The module of a recipe."""
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Half a minute of the turbine under Jonkman's controller, with a gap; the speed in rpm, the time in ms."""
    path, record = tmp_path_factory.mktemp("log") / "log.csv", recipe("record_log")
    states = {"states": ("rotor_speed",), "horizon": 30.0, "gap": 0.1}
    record.main(record.Config(log=path, plant="wind_turbine", **states))
    table = pd.read_csv(path)
    table["rpm"], table["ms"] = table.pop("rotor_speed") * 30.0 / np.pi, 1e3 * table.pop("time")
    table.to_csv(path, index=False)
    return path


COLUMNS = ("rpm=rotor_speed[rpm]", "ms=time*1e-3")


def test_a_log_is_identified_and_the_results_are_written(log, tmp_path, capsys):
    identify = recipe("identify")
    config = EstimationConfig(iterations=2, rounds=1)
    identify.main(identify.Config(log=log, plant="wind_turbine", columns=COLUMNS, log_dir=tmp_path, estimation=config))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    # Dai's coefficients are wrong by some rad/s within half a minute; two steps take most of that away.
    (training,), (held_out,) = (metrics[side]["rms"].values() for side in ("training", "held_out"))
    assert training["after"] < 0.5 * training["before"] and held_out["after"] < held_out["before"]
    assert list(metrics["training"]["rms"]) == ["rotor_speed"]
    assert [steps for _, steps in metrics["log"]["segments"]] == [29, 23]
    # 15 s and 12 s at 0.5 s, less what the jitter takes at the ends.
    seconds = metrics["training"]["seconds"], metrics["held_out"]["seconds"]
    assert seconds[1] / sum(seconds) == pytest.approx(0.25, abs=0.03)
    closure = SaintDrenan.from_set("Dai2016")
    closure.load_state_dict(torch.load(tmp_path / "weights.pt", weights_only=True)["closure"])
    after = [entry["after"] for entry in metrics["weights"].values()]
    assert closure.coefficients.tolist() == pytest.approx(after)
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        f"{name}.png" for name in ("twin_and_log", "weights", "correlations")
    }
    shown = capsys.readouterr().out
    assert "gap from" in shown and "c8" in shown and "RMS errors, held out" in shown


@pytest.mark.parametrize("name", ["config.json", "checkpoint.pt", "weights.pt", "metrics.json"])
def test_results_of_a_training_or_an_identification_are_not_overwritten(name, tmp_path):
    (tmp_path / name).write_text("kept")
    config = recipe("identify").Config(log=tmp_path / "log.csv", plant="wind_turbine", log_dir=tmp_path)
    with pytest.raises(ValueError, match=rf"log_dir={tmp_path} holds results already.*{name}.*choose another folder"):
        config.make_folder("wind_turbine")
    assert (tmp_path / name).read_text() == "kept" and [path.name for path in tmp_path.iterdir()] == [name]


def test_identifications_within_a_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda *_: "20260101-000000")
    config = recipe("identify").Config(log=tmp_path / "log.csv", plant="wind_turbine")
    folders = [config.make_folder("wind_turbine") for _ in range(3)]
    assert len(set(folders)) == 3 and all((folder / "figures").is_dir() for folder in folders)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"plant": "windmill"}, "plant='windmill' does not exist"),
        ({"columns": ()}, "no column 'time'"),
        ({"columns": ("rpm=rotor_speed*1000", COLUMNS[1]), "held_out": 2.0}, "held_out=2.0"),
        ({"columns": (COLUMNS[0], "ms=time*1e-6")}, "no part of 10"),
        ({"dt": 60.0}, "unstable"),
        ({"dt": 0.0}, "dt=0.0 s must be positive"),
        ({"seed": -1}, "seed=-1 must not be negative"),
        ({"plant": None}, "give one of --plant and --recipe"),
        ({"recipe": RECIPES / "wind_turbine.py"}, "give one of --plant and --recipe"),
        ({"plant": "gone.py:Room"}, "gone.py does not exist"),
        ({"plant": "rt_torchrl:Signal"}, "plant='rt_torchrl:Signal' is no class derived from Plant"),
        ({"plant": None, "recipe": RECIPES / "identify.py"}, "has no class Config derived from RunConfig"),
        ({"log_dir": Path("")}, "log_dir='' is the current folder"),
    ],
)
def test_what_cannot_be_identified_is_refused(log, tmp_path, options, message):
    identify = recipe("identify")
    given = {"log": log, "plant": "wind_turbine", "columns": COLUMNS, "log_dir": tmp_path} | options
    with pytest.raises(ValueError, match=message):
        identify.main(identify.Config(**given))
    assert not list(tmp_path.iterdir())


OWN = """
from dataclasses import dataclass
from rt_torchrl.runs.run_config import RunConfig
from own_turbine import Own
@dataclass(frozen=True, kw_only=True)
class Config(RunConfig):
    dt: float = 0.5
    horizon: float = 30.0
    def plant(self):
        return Own(dt=self.dt, horizon=self.horizon)
def main(config):
    pass
"""
OWN_PLANT = """
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
class Own(WindTurbine):
    name = "own"
class Demanding(WindTurbine):
    def __init__(self, blades):
        super().__init__()
"""


def test_an_own_plant_is_made_by_its_file_or_its_recipe(tmp_path):
    (tmp_path / "own_turbine.py").write_text(OWN_PLANT), (tmp_path / "own_recipe.py").write_text(OWN)
    identify, file = recipe("identify"), tmp_path / "own_turbine.py"
    for options in ({"plant": f"{file}:Own"}, {"recipe": tmp_path / "own_recipe.py"}):
        own = identify.Config(log=file, **options).make_plant()
        faster = identify.Config(log=file, dt=0.25, **options).make_plant()
        assert own.name == faster.name == "own" and (own.dt, faster.dt) == (0.5, 0.25)
        assert own.horizon == faster.horizon
    with pytest.raises(ValueError, match="cannot be made .*blades.*its options must have defaults"):
        identify.Config(log=file, plant=f"{file}:Demanding").make_plant()


def test_what_cannot_be_recorded_is_refused(tmp_path):
    record = recipe("record_log")
    for options, message in (
        ({"plant": "windmill"}, "windmill"),
        ({"plant": "wind_turbine", "gap": 0.5}, "gap=0.5"),
        ({"plant": "wind_turbine", "states": ("rotor_speed", "foo")}, r"states=\['foo'\].*choose of rotor_speed"),
        ({"plant": "wind_turbine", "law": "random"}, "law='random' does not exist; choose classical or policy"),
    ):
        with pytest.raises(ValueError, match=message):
            record.Config(log=tmp_path / "log.csv", **options)
