"""Exported policies read back: they act as the policy that they were made of."""

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
    found = load_policy(path, PLANT)
    torch.testing.assert_close(found(seen), policy(seen).detach(), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found(seen[0]), policy(seen[0]).detach(), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["c", *(pytest.param(kind, marks=pytest.mark.nightly) for kind in ("pt2", "onnx"))])
def test_a_policy_of_other_observations_is_refused(kind, tmp_path):
    if kind == "c" and c_compiler.compiler() is None:
        pytest.skip("there is no C compiler here")
    _, path = written(tmp_path, kind)
    with pytest.raises(ValueError, match="does not take the observations"):
        load_policy(path, Wider())


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
        load_policy(path, PLANT)
