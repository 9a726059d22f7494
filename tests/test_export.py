"""Programs of torch.export and ONNX models: against the policy, and without this library."""

import json
import subprocess
import sys

import pytest
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import seeded
from torch import nn

from rt_torchrl import SaturatedMLP, shipped_plants
from rt_torchrl.export.program import export_onnx, export_program

# The same operations in double precision, at most in another order.
ROUNDING = 1e-12


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
    plant, path = shipped_plants()[name](), tmp_path / f"policy.{kind}"
    policy = plant.make_policy(seeded())
    if kind == "onnx":
        onnx, onnxruntime, _ = map(pytest.importorskip, ("onnx", "onnxruntime", "onnxscript"))
        assert export_onnx(policy, path, plant) < ROUNDING
        model = onnx.load(path)
        onnx.checker.check_model(model, full_check=True)
        (described,) = (json.loads(e.value) for e in model.metadata_props if e.key == "interface.json")
        assert [signal["name"] for signal in described["action"]] == [s.name for s in plant.actions]
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    else:
        assert export_program(policy, path, plant) < ROUNDING
        act = torch.export.load(path).module()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]  # the weights are in it
    for batch in (1, 2, 17):
        e = torch.randn(batch, len(plant.observations), generator=seeded(), dtype=torch.float64)
        found = torch.from_numpy(session.run(["action"], {"observation": e.numpy()})[0]) if kind == "onnx" else act(e)
        torch.testing.assert_close(found, policy(e).detach(), rtol=ROUNDING, atol=1e-9)


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
    return law.calls * (e @ law.gain)


REFUSED = {
    "a branch on values": (lambda law, e: e @ law.gain if e.sum() > 0 else e[:, :1], "cannot be traced.*torch.where"),
    "random numbers": (lambda law, e: e @ law.gain + torch.randn_like(e[:, :1]), "gives two actions"),
    "a memory": (counting, "gives two actions for one observation"),
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
