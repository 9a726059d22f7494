"""Programs of torch.export and ONNX models: against the policy, and without this library."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from seeds_and_numbers import seeded
from test_run_folder import Full
from torch import nn

from rt_torchrl import SaturatedMLP, shipped_plants
from rt_torchrl.export.program import export_onnx, export_program

# The same operations in double precision, at most in another order.
ROUNDING = 1e-12


WRITERS = {"pt2": export_program, "onnx": export_onnx}


def require_packages(kind):
    for package in ("onnx", "onnxruntime", "onnxscript") if kind == "onnx" else ():
        pytest.importorskip(package)


WITHOUT_THE_LIBRARY = """
import sys
sys.modules["rt_torchrl"] = None  # an import of it now fails
import torch
path, rows = sys.argv[1], eval(sys.argv[2])
extra = {"interface.json": ""}
policy = torch.export.load(path, extra_files=extra).module()
print(policy(torch.tensor(rows, dtype=torch.float64)).tolist())
print(extra["interface.json"])
"""


@pytest.mark.slow
def test_a_program_needs_torch_alone(tmp_path):
    plant = shipped_plants()["wind_turbine"]()
    policy = SaturatedMLP(2, plant.actions, generator=seeded())
    assert export_program(policy, tmp_path / "policy.pt2", plant) < ROUNDING
    rows = torch.randn(7, 2, generator=seeded(), dtype=torch.float64)
    command = [sys.executable, "-c", WITHOUT_THE_LIBRARY, tmp_path / "policy.pt2", str(rows.tolist())]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    actions, described = map(json.loads, done.stdout.split("\n", 1))
    torch.testing.assert_close(torch.tensor(actions, dtype=torch.float64), policy(rows).detach(), rtol=ROUNDING, atol=0)
    assert described["control_interval_s"] == 0.5
    assert described["action"][0] == {"name": "generator_torque", "unit": "N m", "low": 0.0, "high": 43_093.55}


@pytest.mark.parametrize("kind", ["pt2", "onnx"])
@pytest.mark.parametrize("name", ["wind_turbine", "cryogenic_tank"])
def test_programs_and_models_take_any_batch(name, kind, tmp_path):
    require_packages(kind)
    plant, path = shipped_plants()[name](), tmp_path / f"policy.{kind}"
    policy = plant.make_policy(seeded())
    assert WRITERS[kind](policy, path, plant) < ROUNDING
    assert [file.name for file in tmp_path.iterdir()] == [path.name]  # the weights are in it
    if kind == "onnx":
        act, described = by_onnxruntime(path)
        assert [signal["name"] for signal in described["action"]] == [s.name for s in plant.actions]
    else:
        act = torch.export.load(path).module()
    for batch in (1, 2, 17):
        e = torch.randn(batch, len(plant.observations), generator=seeded(), dtype=torch.float64)
        torch.testing.assert_close(act(e), policy(e).detach(), rtol=ROUNDING, atol=1e-9)


def by_onnxruntime(path):
    """A checked model as a function, and what its metadata say."""
    import onnx
    import onnxruntime

    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    described = {entry.key: entry.value for entry in model.metadata_props}["interface.json"]
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return lambda e: torch.from_numpy(session.run(["action"], {"observation": e.numpy()})[0]), json.loads(described)


@pytest.mark.parametrize("kind", ["pt2", "onnx"])
def test_an_export_onto_a_full_disk_leaves_the_old_file(kind, tmp_path, monkeypatch):
    require_packages(kind)
    name = f"policy.{kind}"
    (tmp_path / name).write_text("old")
    opened = Path.open

    def full(self, mode="r", *others, **named):
        found = opened(self, mode, *others, **named)
        return Full(found) if self.parent == tmp_path else found

    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", full)
        with pytest.raises(OSError, match="No space left on device"):
            WRITERS[kind](LinearGain([[0.1, 0.2]]), tmp_path / name, LinearQuadratic())
    assert (tmp_path / name).read_text() == "old" and [path.name for path in tmp_path.iterdir()] == [name]


class Law(nn.Module):
    """A policy with a weight and a buffer, of any formula."""

    def __init__(self, formula):
        super().__init__()
        self.formula = formula
        self.gain = nn.Parameter(torch.ones(2, 1, dtype=torch.float64))
        self.register_buffer("calls", torch.zeros((), dtype=torch.float64))

    def forward(self, e):
        return self.formula(self, e)


def counting(law, e):
    law.calls += 1.0
    return e @ law.gain


REFUSED = {
    "a branch on values": (lambda law, e: e @ law.gain if e.sum() > 0 else e[:, :1], "cannot be traced.*torch.where"),
    "random numbers": (lambda law, e: e @ law.gain + torch.randn_like(e[:, :1]), "draws random numbers"),
    "a memory": (counting, "changes its buffers calls"),
    "the batch as a whole": (
        lambda law, e: (e - e.mean(0)) @ law.gain,
        "differs from the original by .*'force'.*nothing was",
    ),
    "a fixed batch": (lambda law, e: e @ law.gain * (1.0 if len(e) < 5 else 2.0), "cannot be traced.*any batch"),
    "another number of actions": (lambda law, e: e @ law.gain.T.expand(2, 2), r"returns torch.float64 \(3, 2\)"),
    "single precision": (lambda law, e: (e @ law.gain).float(), r"returns torch.float32 \(3, 1\).*\.double\(\)"),
    "another number of observations": (lambda law, e: e @ law.gain.repeat(2, 1), r"cannot take float64 .*\(3, 2\)"),
    "no number": (lambda law, e: e @ law.gain / 0.0, "actions that are not finite"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_function_of_the_observation_is_refused(name, tmp_path):
    formula, message = REFUSED[name]
    with pytest.raises(ValueError, match=f"(?s){message}"):
        export_program(Law(formula), tmp_path / "policy.pt2", LinearQuadratic())
    assert not list(tmp_path.iterdir())
