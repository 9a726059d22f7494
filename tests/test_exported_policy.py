"""Exported policies read back: they act as the policy that they were made of."""

import io
import json
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from linear_quadratic import LinearQuadratic

from rt_torchrl import Signal, export_c, export_onnx, export_program
from rt_torchrl.export import c_compiler
from rt_torchrl.export.exported_policy import load_policy
from rt_torchrl.plants.policies import SaturatedMLP

PLANT = LinearQuadratic()
WRITERS = {"pt2": export_program, "onnx": export_onnx, "c": export_c}


class Wider(LinearQuadratic):
    """A plant with one observation more."""

    observations = (*LinearQuadratic.observations, Signal(symbol="e_3", name="third", unit="-"))


def written(folder, kind):
    generator = torch.Generator().manual_seed(0)
    policy = SaturatedMLP(2, PLANT.actions, hidden=(5,), generator=generator)
    named = {"function": "law"} if kind == "c" else {}
    WRITERS[kind](policy, folder / f"law.{kind}", PLANT, **named)
    return policy, folder / f"law.{kind}"


@pytest.mark.parametrize("kind", ["c", *(pytest.param(kind, marks=pytest.mark.nightly) for kind in ("pt2", "onnx"))])
def test_a_policy_read_back_acts_as_before(kind, tmp_path):
    if kind == "c" and c_compiler.compiler() is None:
        pytest.skip("there is no C compiler here")
    policy, path = written(tmp_path, kind)
    seen = torch.randn(7, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = load_policy(path, PLANT, trusted=True)
    torch.testing.assert_close(found(seen), policy(seen).detach(), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found(seen[0]), policy(seen[0]).detach(), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["c", *(pytest.param(kind, marks=pytest.mark.nightly) for kind in ("pt2", "onnx"))])
def test_a_policy_of_other_observations_is_refused(kind, tmp_path):
    if kind == "c" and c_compiler.compiler() is None:
        pytest.skip("there is no C compiler here")
    _, path = written(tmp_path, kind)
    with pytest.raises(ValueError, match="does not take the observations"):
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


@pytest.mark.skipif(c_compiler.compiler() is None, reason="there is no C compiler here")
def test_c_is_read_back_by_what_its_header_says(tmp_path):
    """Whatever the file and the function are called, and whichever observations the policy looks at."""
    export_c(First(), tmp_path / "policy.c", PLANT)
    seen = torch.tensor([[0.3, 5.0]], dtype=torch.float64)
    found = load_policy(tmp_path / "policy.c", PLANT, trusted=True)
    torch.testing.assert_close(found(seen), torch.tanh(0.5 * seen[:, :1]), rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match="takes 2 observations, and here are 3"):
        load_policy(tmp_path / "policy.c", Wider(), trusted=True)


class Stronger(LinearQuadratic):
    """A plant with one action more."""

    actions = (*LinearQuadratic.actions, Signal(symbol="a_2", name="second", unit="-"))


@pytest.mark.skipif(c_compiler.compiler() is None, reason="there is no C compiler here")
def test_c_that_is_no_policy_of_the_plant_is_not_called(tmp_path):
    """It would write beyond the actions that it is given, or be a function of something else."""
    _, path = written(tmp_path, "c")
    with pytest.raises(ValueError, match="returns 1 actions, and here are 2"):
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
