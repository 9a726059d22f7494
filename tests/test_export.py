"""ONNX models against the policy."""

import json

import pytest
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import seeded
from test_classical import PD
from torch import nn

from rt_torchrl import shipped_plants
from rt_torchrl.export.program import export_onnx

onnx, onnxruntime, _ = map(pytest.importorskip, ("onnx", "onnxruntime", "onnxscript"))

# The same operations in double precision, at most in another order.
ROUNDING = 1e-12


@pytest.mark.parametrize("name", ["wind_turbine", "cryogenic_tank"])
def test_models_take_any_batch(name, tmp_path):
    plant, path = shipped_plants()[name](), tmp_path / "policy.onnx"
    policy = plant.make_policy(seeded())
    assert export_onnx(policy, path, plant) < ROUNDING
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    (described,) = (json.loads(e.value) for e in model.metadata_props if e.key == "interface.json")
    assert described["control_interval_s"] == plant.dt
    action, signal = described["action"][0], plant.actions[0]
    assert action == {"name": signal.name, "unit": signal.unit, "low": signal.low, "high": signal.high}
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert [file.name for file in tmp_path.iterdir()] == [path.name]  # the weights are in it
    for batch in (1, 2, 17):
        e = torch.randn(batch, len(plant.observations), generator=seeded(), dtype=torch.float64)
        found = torch.from_numpy(session.run(["action"], {"observation": e.numpy()})[0])
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
    "a branch on values": (lambda law, e: e @ law.gain if e.sum() > 0 else e[:, :1], "has no ONNX form.*torch.where"),
    "random numbers": (lambda law, e: e @ law.gain + torch.randn_like(e[:, :1]), "gives two actions"),
    "a memory": (counting, "gives two actions for one observation"),
    "the batch as a whole": (
        lambda law, e: (e - e.mean(0)) @ law.gain,
        "differs from the original by .*'force'.*nothing was",
    ),
    "a fixed batch": (lambda law, e: e @ law.gain * (1.0 if len(e) < 5 else 2.0), "has no ONNX form.*any batch"),
    "another number of actions": (lambda law, e: e @ law.gain.T.expand(2, 2), r"returns torch.float64 \(3, 2\)"),
    "single precision": (lambda law, e: (e @ law.gain).float(), r"returns torch.float32 \(3, 1\).*\.double\(\)"),
    "another number of observations": (lambda law, e: e @ law.gain.repeat(2, 1), r"cannot take float64 .*\(3, 2\)"),
    "no number": (lambda law, e: (e @ law.gain - 1e300).exp().log(), "actions that are not finite"),
}


def test_a_classical_controller_is_refused_in_words(tmp_path):
    with pytest.raises(ValueError, match="PD has no forward.observation., as classical and predictive controllers"):
        export_onnx(PD(LinearQuadratic()), tmp_path / "policy.onnx", LinearQuadratic())


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_function_of_the_observation_is_refused(name, tmp_path):
    formula, message = REFUSED[name]
    with pytest.raises(ValueError, match=f"(?s){message}"):
        export_onnx(Law(formula), tmp_path / "policy.onnx", LinearQuadratic())
    assert not list(tmp_path.iterdir())
