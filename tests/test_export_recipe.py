"""A run folder read back, and the recipe that exports from it."""

import importlib.util
import json
import shutil
from pathlib import Path

import pytest
import torch

from rt_torchrl import load_run
from rt_torchrl.export import c_file
from rt_torchrl.runs.loaded_run import config_class_of
from rt_torchrl.runs.run_config import physics_of
from rt_torchrl.runs.run_folder import save_tensors
from rt_torchrl.runs.settings import settings_of

RECIPES = Path(__file__).parent.parent / "recipes"


def recipe(name):
    spec = importlib.util.spec_from_file_location(f"recipe_{name}_of_the_test", RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def leave_run(folder, name, **options):
    """Write the files of a run as Run.train writes them, with random weights."""
    config = config_class_of(RECIPES / f"{name}.py")(seed=3, log_dir=folder, **options)
    return config, leave_run_of(folder, config, physics_of(config))


def leave_run_of(folder, config, plant):
    """The same of any configuration and plant; return the policies and the closure."""
    generator = torch.Generator().manual_seed(7)
    policies, closure = config.make_policies(plant, generator), config.make_closure(plant, generator)
    parts = {**config.acting_policies(policies, plant, closure), "closure": closure}
    with torch.no_grad():
        for weight in (weight for part in parts.values() for weight in part.parameters()):
            weight += torch.randn(weight.shape, generator=generator, dtype=weight.dtype)
    folder.mkdir(exist_ok=True)
    settings = settings_of(config, plant.name)
    (folder / "config.json").write_text(json.dumps(settings, indent=2, default=str) + "\n")
    save_tensors(folder / "weights.pt", {role: part.state_dict() for role, part in parts.items()})
    return parts


def test_the_recipe_writes_every_format(tmp_path, capsys):
    onnxruntime, _ = map(pytest.importorskip, ("onnxruntime", "onnxscript"))
    _, parts = leave_run(tmp_path, "wind_turbine", policy="bias")
    export = recipe("export")
    export.main(export.Config(run=tmp_path, role="model_free", formats=("c", "onnx")))
    written = {path.name for path in (tmp_path / "exported").iterdir()}
    assert written == {f"wind_turbine_model_free.{suffix}" for suffix in ("c", "h", "onnx")}
    session = onnxruntime.InferenceSession(tmp_path / "exported" / "wind_turbine_model_free.onnx")
    e = torch.tensor([[0.2, -0.4]], dtype=torch.float64)
    action = torch.from_numpy(session.run(["action"], {"observation": e.numpy()})[0])
    assert torch.allclose(action, parts["model_free"](e)) and not torch.allclose(action, parts["model_based"](e))
    assert "void wind_turbine_model_free(" in (tmp_path / "exported" / "wind_turbine_model_free.h").read_text()
    assert capsys.readouterr().out.count("of the actions' ranges") >= 2


def test_the_recipe_writes_policy_controller_and_twin(tmp_path, capsys, monkeypatch):
    """A run with perceptrons in all places, in C and nothing else."""
    if not any(map(shutil.which, c_file.COMPILERS)):
        pytest.skip("no C compiler here")
    monkeypatch.setattr("rt_torchrl.export.c_controller.INTERVALS", 20)
    leave_run(tmp_path, "wind_turbine", policy="mlp", closure="mlp", hidden=(5,))
    export = recipe("export")
    export.main(export.Config(run=tmp_path, what=("policy", "controller", "twin"), formats=("c",)))
    names = ("wind_turbine_model_based", "wind_turbine_model_based_controller", "wind_turbine_twin")
    written = {path.name for path in (tmp_path / "exported").iterdir()}
    assert written == {f"{name}.{suffix}" for name in names for suffix in ("c", "h")}
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 3 and "of the sizes of the states" in printed[2]
    summary = {"live": "model_based", "may_not_act": {"model_based": "model_based may not act: it is dear"}}
    (tmp_path / "metrics.json").write_text(json.dumps({"episodes": [], "summary": summary}))
    for what, warning in (("policy", "warning: model_based may not act: it is dear\n"), ("twin", "")):
        export.main(export.Config(run=tmp_path, what=(what,), name="blade", output=tmp_path / "other"))
        assert capsys.readouterr().err == warning
    assert "void blade_twin_step(double t," in (tmp_path / "other" / "blade_twin.h").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"role": "oracle"}, "role='oracle' does not exist in this run; choose model_based or model_free"),
        ({"formats": ()}, r"formats=\(\) must be some of c, onnx, discon"),
        ({"what": ("plant",)}, r"what=\('plant',\) must be some of policy, controller, twin"),
        ({"what": ("policy", "controller"), "formats": ("onnx",)}, r"no format of the controller; add c or discon\."),
        ({"what": ("controller",), "formats": ("c", "onnx")}, "no onnx of controller can be written; leave it out"),
        ({"recipe": Path("nowhere.py")}, "nowhere.py does not exist"),
        ({"recipe": RECIPES / "record_log.py"}, "Config of recipe=.* is no class derived from RunConfig"),
        ({"recipe": RECIPES / "flapping_wing.py"}, "cannot be carried out.*no option.*engineering"),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_bad_options_are_refused(options, message, tmp_path):
    leave_run(tmp_path, "wind_turbine")
    export = recipe("export")
    with pytest.raises(ValueError, match=message):
        export.main(export.Config(run=tmp_path, **options))
    assert not (tmp_path / "exported").exists()


def test_folders_that_hold_no_run_are_refused(tmp_path):
    folder = tmp_path / "run"
    config, _ = leave_run(folder, "wind_turbine", policy="paper")

    def refusal(folder, message):
        with pytest.raises(ValueError, match=message):
            load_run(folder, type(config))

    refusal(tmp_path, "is no run folder: it has no config.json")
    settings = json.loads((folder / "config.json").read_text())
    for change, message in (
        ({"plant": None}, "does not name a plant"),
        ({"plant": "balloon"}, "is a run of plant 'balloon', the recipe is of 'wind_turbine'"),
        ({"policy": "mlp"}, "weights of 'model_based' .* do not fit"),
        ({"twinning": {"referee": {"colour": "red"}}}, "has no option twinning.referee.colour; it is of another"),
        ({"episodes": "many"}, "episodes='many' must be a valid integer"),
        ({"wind_files": ["gone.hh"]}, "cannot be carried out: .*gone.hh"),
    ):
        (folder / "config.json").write_text(json.dumps(settings | change))
        refusal(folder, message)
    (folder / "config.json").write_text(json.dumps(settings))
    (folder / "weights.pt").write_bytes((folder / "weights.pt").read_bytes()[:500])
    refusal(folder, "weights.pt is damaged")
    (folder / "weights.pt").unlink()
    refusal(folder, "has no weights.pt: it is not finished.*--resume")
    (folder / "config.json").write_text("{")
    refusal(folder, "config.json is damaged")
