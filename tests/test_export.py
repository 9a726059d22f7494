"""Programs of torch.export and ONNX models: against the policy, without this library, and read back."""

import io
import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from seeds_and_numbers import seeded
from test_run_folder import Full
from torch import nn

from rt_torchrl import export_c, shipped_plants
from rt_torchrl.export import c_file, program
from rt_torchrl.export.exported_policy import load_policy
from rt_torchrl.export.program import export_onnx, export_program
from rt_torchrl.plants.policies import SaturatedMLP
from rt_torchrl.plants.signal import Signal

# The same operations in double precision, at most in another order.
ROUNDING = 1e-12


PLANT = LinearQuadratic()
WRITERS = {"pt2": export_program, "onnx": export_onnx, "c": export_c}


class Wider(LinearQuadratic):
    """A plant with one observation more."""

    observations = (*LinearQuadratic.observations, Signal(symbol="e_3", name="third", unit="-"))


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
    actions, interface = done.stdout.split("\n", 1)
    torch.testing.assert_close(
        torch.tensor(json.loads(actions), dtype=torch.float64), policy(rows).detach(), rtol=ROUNDING, atol=0
    )
    described = json.loads(interface)
    assert described["control_interval_s"] == 0.5
    assert described["action"][0] == {"name": "generator_torque", "unit": "N m", "low": 0.0, "high": 43_093.55}


@pytest.mark.parametrize("kind", ["pt2", "onnx"])
@pytest.mark.parametrize("name", ["wind_turbine", "cryogenic_tank"])
def test_programs_and_models_take_any_batch(name, kind, tmp_path):
    for package in ("onnx", "onnxruntime", "onnxscript") if kind == "onnx" else ():
        pytest.importorskip(package)
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


def test_onnx_without_its_packages_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(program, "ONNX_PACKAGES", ("onnx_of_no_one",))
    with pytest.raises(ValueError, match=r"package onnx_of_no_one.*pip install 'rt_torchrl\[export\]'"):
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


@pytest.mark.parametrize("name", ["the batch as a whole", "a fixed batch"])
def test_a_c_function_of_one_observation_is_compared_with_the_policy_of_many(name, tmp_path):
    if not any(map(shutil.which, c_file.COMPILERS)):
        pytest.skip("no C compiler here")
    with pytest.raises(ValueError, match="the C function of policy Law differs from the original by .*'force'"):
        export_c(Law(REFUSED[name][0]), tmp_path / "policy.c", LinearQuadratic())
    assert not list(tmp_path.iterdir())


# Exported policies read back: they act as the policy that they were made of.


def written(folder, kind):
    generator = torch.Generator().manual_seed(0)
    policy = SaturatedMLP(2, PLANT.actions, hidden=(5,), generator=generator)
    named = {"function": "law"} if kind == "c" else {}
    WRITERS[kind](policy, folder / f"law.{kind}", PLANT, **named)
    return policy, folder / f"law.{kind}"


@pytest.mark.parametrize("kind", ["c", *(pytest.param(kind, marks=pytest.mark.nightly) for kind in ("pt2", "onnx"))])
def test_a_policy_read_back_acts_as_before(kind, tmp_path):
    if kind == "c" and c_file.compiler() is None:
        pytest.skip("there is no C compiler here")
    policy, path = written(tmp_path, kind)
    seen = torch.randn(7, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = load_policy(path, PLANT, trusted=True)
    torch.testing.assert_close(found(seen), policy(seen).detach(), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found(seen[0]), policy(seen[0]).detach(), rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match="does not (take|go with)"):
        load_policy(path, Wider(), trusted=True)


class Bomb:
    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def with_code(path, mark):
    """Put an object into the weights of a program that runs code when it is read."""
    held = io.BytesIO()
    torch.save(Bomb(mark), held)
    with zipfile.ZipFile(path) as whole:
        parts = {name: whole.read(name) for name in whole.namelist()}
    for name, content in parts.items():
        if name.endswith("weights_config.json"):
            found = json.loads(content)
            for one in found["config"].values():
                one["use_pickle"] = True
            parts[name] = json.dumps(found).encode()
        elif "/weights/weight_" in name:
            parts[name] = held.getvalue()
    with zipfile.ZipFile(path, "w") as whole:
        for name, content in parts.items():
            whole.writestr(name, content)


@pytest.mark.nightly
def test_code_in_a_program_does_not_run_unless_it_is_trusted(tmp_path):
    """PyTorch itself runs it, and has no way to load a program without."""
    _, path = written(tmp_path, "pt2")
    with_code(path, tmp_path / "mark")
    with pytest.raises(ValueError, match="law.pt2' is code"):
        load_policy(path, PLANT)
    assert not (tmp_path / "mark").exists()
    with pytest.raises(ValueError, match="is no PyTorch program"):
        load_policy(path, PLANT, trusted=True)
    assert (tmp_path / "mark").exists()


@pytest.mark.parametrize("name", ["law.pt2", "law.c"])
def test_a_file_with_code_is_not_opened_unless_it_is_trusted(name, tmp_path):
    (tmp_path / name).write_text("not read")
    with pytest.raises(ValueError, match=f"{name}' is code .*trusted=True"):
        load_policy(tmp_path / name, PLANT)


class First(torch.nn.Module):
    """A policy that looks at its first observation alone."""

    def forward(self, observation):
        return torch.tanh(0.5 * observation[..., :1])


@pytest.mark.skipif(c_file.compiler() is None, reason="there is no C compiler here")
def test_c_is_read_back_by_what_its_header_says(tmp_path):
    """Whatever the file and the function are called, and whichever observations the policy looks at."""
    export_c(First(), tmp_path / "policy.c", PLANT)
    seen = torch.tensor([[0.3, 5.0]], dtype=torch.float64)
    found = load_policy(tmp_path / "policy.c", PLANT, trusted=True)
    torch.testing.assert_close(found(seen), torch.tanh(0.5 * seen[:, :1]), rtol=1e-12, atol=1e-12)


class Stronger(LinearQuadratic):
    """A plant with one action more."""

    actions = (*LinearQuadratic.actions, Signal(symbol="a_2", name="second", unit="-"))


@pytest.mark.skipif(c_file.compiler() is None, reason="there is no C compiler here")
def test_c_that_is_no_policy_of_the_plant_is_not_called(tmp_path):
    """It would write beyond the actions that it is given, or be a function of something else."""
    _, path = written(tmp_path, "c")
    with pytest.raises(ValueError, match="has 1 actions, and here are 2"):
        load_policy(path, Stronger(), trusted=True)
    path.with_suffix(".h").unlink()
    with pytest.raises(ValueError, match=r"law.h is not beside it"):
        load_policy(path, PLANT, trusted=True)


def test_onnx_needs_its_runtime_alone_and_no_trust(tmp_path, monkeypatch):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    double, helper = onnx.TensorProto.DOUBLE, onnx.helper
    gain = helper.make_tensor("gain", double, [2, 1], [0.5, -2.0])
    signals = [
        helper.make_tensor_value_info(name, double, ["batch", n]) for name, n in (("observation", 2), ("action", 1))
    ]
    product = helper.make_node("MatMul", ["observation", "gain"], ["action"])
    graph = helper.make_graph([product], "law", signals[:1], signals[1:], [gain])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    (tmp_path / "law.onnx").write_bytes(model.SerializeToString())
    for name in ("onnx", "onnxscript"):
        monkeypatch.setitem(sys.modules, name, None)  # as if it were not installed
    found = load_policy(tmp_path / "law.onnx", PLANT)
    assert found(torch.tensor([3.0, 1.0], dtype=torch.float64)).tolist() == [-0.5]


@pytest.mark.parametrize("name", ["gone.pt2", "law.txt", "law"])
def test_a_file_that_is_no_exported_policy_is_refused(name, tmp_path):
    if name != "gone.pt2":
        (tmp_path / name).write_text("")
    with pytest.raises(ValueError, match="policy=.* must be a file that ends in .pt2, .onnx, .c"):
        load_policy(tmp_path / name, PLANT)


@pytest.mark.slow
def test_a_damaged_program_is_refused(tmp_path):
    _, path = written(tmp_path, "pt2")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match="is no PyTorch program"):
        load_policy(path, PLANT, trusted=True)
