"""Programs of torch.export and ONNX models: against the policy, and without this library."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from seeds_and_numbers import seeded
from test_saved_files import Full
from torch import nn

from rt_torchrl import shipped_plants
from rt_torchrl.export import c_compiler, export_c, export_onnx, export_program, onnx_model
from rt_torchrl.export.agreement import detached, sample_observations
from rt_torchrl.plants.policies import SaturatedMLP
from rt_torchrl.plants.signal import Signal

# The same operations in double precision, at most in another order.
ROUNDING = 1e-12


def policies_of_the_plants():
    for name, kind in shipped_plants().items():
        plant = kind()
        yield pytest.param(plant, plant.make_policy(seeded()), id=name)


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


def test_a_program_needs_torch_alone(tmp_path):
    plant = shipped_plants()["wind_turbine"]()
    policy = SaturatedMLP(2, plant.actions, generator=seeded())
    assert export_program(policy, tmp_path / "policy.pt2", plant) < ROUNDING
    rows = torch.randn(7, 2, generator=seeded(), dtype=torch.float64)
    command = [sys.executable, "-c", WITHOUT_THE_LIBRARY, tmp_path / "policy.pt2", str(rows.tolist())]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    actions, interface = done.stdout.split("\n", 1)
    torch.testing.assert_close(
        torch.tensor(json.loads(actions), dtype=torch.float64), policy(rows).detach(), rtol=ROUNDING, atol=0
    )
    described = json.loads(interface)
    assert described["control_interval_s"] == 0.5
    assert described["action"][0] == {"name": "generator_torque", "unit": "N m", "low": 0.0, "high": 43_093.55}


@pytest.mark.parametrize(("plant", "policy"), list(policies_of_the_plants()))
def test_programs_take_any_batch(plant, policy, tmp_path):
    assert export_program(policy, tmp_path / "policy.pt2", plant) < ROUNDING
    loaded = torch.export.load(tmp_path / "policy.pt2").module()
    for batch in (1, 2, 17):
        e = torch.randn(batch, len(plant.observations), generator=seeded(), dtype=torch.float64)
        torch.testing.assert_close(loaded(e), policy(e).detach(), rtol=ROUNDING, atol=ROUNDING)


@pytest.mark.parametrize(("plant", "policy"), list(policies_of_the_plants()))
def test_onnx_models_take_any_batch(plant, policy, tmp_path):
    onnx, onnxruntime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    assert export_onnx(policy, tmp_path / "policy.onnx", plant) < ROUNDING
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"]  # the weights are in it
    model = onnx.load(tmp_path / "policy.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert [d.dim_param or d.dim_value for d in model.graph.input[0].type.tensor_type.shape.dim] == [
        "batch",
        len(plant.observations),
    ]
    described = {entry.key: entry.value for entry in model.metadata_props}["interface.json"]
    assert [signal["name"] for signal in json.loads(described)["action"]] == [s.name for s in plant.actions]
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    for batch in (1, 2, 17):
        e = torch.randn(batch, len(plant.observations), generator=seeded(), dtype=torch.float64)
        (found,) = session.run(["action"], {"observation": e.numpy()})
        torch.testing.assert_close(torch.from_numpy(found), policy(e).detach(), rtol=ROUNDING, atol=1e-9)


def test_onnx_without_its_packages_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(onnx_model, "NEEDED", ("onnx_of_no_one",))
    with pytest.raises(ValueError, match=r"package onnx_of_no_one.*pip install 'rt_torchrl\[onnx\]'"):
        export_onnx(LinearGain([[0.1, 0.2]]), tmp_path / "policy.onnx", LinearQuadratic())


@pytest.mark.parametrize(("export", "name"), [(export_onnx, "policy.onnx"), (export_program, "policy.pt2")])
def test_an_export_onto_a_full_disk_leaves_the_old_file(export, name, tmp_path, monkeypatch):
    if export is export_onnx:
        pytest.importorskip("onnxruntime")
        pytest.importorskip("onnxscript")
    (tmp_path / name).write_text("old")
    opened = Path.open

    def full(self, mode="r", *others, **named):
        found = opened(self, mode, *others, **named)
        return Full(found) if self.parent == tmp_path else found

    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", full)
        with pytest.raises(OSError, match="No space left on device"):
            export(LinearGain([[0.1, 0.2]]), tmp_path / name, LinearQuadratic())
    assert (tmp_path / name).read_text() == "old" and [path.name for path in tmp_path.iterdir()] == [name]


def test_what_onnxruntime_cannot_run_is_refused(tmp_path, monkeypatch):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")

    def lacking(*args, **kwargs):  # as onnxruntime 1.31 of the double-precision Elu
        raise NotImplementedError("Could not find an implementation for Elu(6)")

    monkeypatch.setattr(onnxruntime, "InferenceSession", lacking)
    with pytest.raises(
        ValueError, match=r"onnxruntime cannot run policy LinearGain .*Elu\(6\)\. Use the \.pt2 program or C"
    ):
        export_onnx(LinearGain([[0.1, 0.2]]), tmp_path / "policy.onnx", LinearQuadratic())
    assert not list(tmp_path.iterdir())


def test_exporting_leaves_the_policy_as_it_was(tmp_path):
    policy = SaturatedMLP(2, LinearQuadratic.actions, generator=seeded()).train()
    export_program(policy, tmp_path / "policy.pt2", LinearQuadratic())
    assert policy.training and all(weight.requires_grad for weight in policy.parameters())


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
    "the batch as a whole": (lambda law, e: (e - e.mean(0)) @ law.gain, "differs from it by .*'force'.*nothing was"),
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


@pytest.mark.parametrize("name", ["the batch as a whole", "a fixed batch"])
def test_a_c_function_of_one_observation_is_compared_with_the_policy_of_many(name, tmp_path):
    if not any(map(shutil.which, c_compiler.COMPILERS)):
        pytest.skip("no C compiler here")
    with pytest.raises(ValueError, match="the C function of policy Law differs from it by .*'force'"):
        export_c(Law(REFUSED[name][0]), tmp_path / "policy.c", LinearQuadratic())
    assert not list(tmp_path.iterdir())


def test_observations_lie_within_their_ranges():
    bounds = [(-1.0, 2.0), (3.0, torch.inf), (-torch.inf, -5.0), (-torch.inf, torch.inf)]
    signals = [Signal(symbol="e", name=f"e{k}", unit="-", low=a, high=b) for k, (a, b) in enumerate(bounds)]
    drawn = sample_observations(signals, 1000)
    low, high = torch.tensor(bounds, dtype=torch.float64).T
    assert ((drawn >= low) & (drawn <= high)).all()
    assert drawn[0].tolist() == [0.0, 3.0, -5.0, 0.0]
    # Half of a thousand uniform numbers within half of the range, to five deviations.
    assert abs((drawn[:, 0] < 0.5).double().mean() - 0.5) < 0.08
    # Both the middle and the saturated ends of a policy.
    assert (drawn[:, 3].abs() < 1.0).double().mean() > 0.2 and (drawn[:, 3].abs() > 3.0).double().mean() > 0.2


def test_a_copy_is_exported():
    policy = LinearGain([[0.1, 0.2]])
    assert detached(policy, LinearQuadratic()) is not policy
