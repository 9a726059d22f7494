"""The twin in C: one interval of every plant against torch and against closed forms."""

import ctypes

import pytest
import torch
from c_build import library, needs_compiler
from linear_quadratic import LinearClosure, LinearQuadratic
from scipy.linalg import expm
from seeds_and_numbers import seeded
from torch import nn

from rt_torchrl import export_twin, shipped_plants
from rt_torchrl.export import c_compiler
from rt_torchrl.export.c_compiler import c_array
from rt_torchrl.programs.c_source import CSource

CLOSE = 1e-9


def build(path):
    """The function of the C file."""
    step = getattr(library(path), f"{path.stem}_step")

    def run(t, *arrays):
        """The next state, written where the state was read."""
        arrays = [c_array(x) for x in arrays]
        step(ctypes.c_double(t), *arrays, arrays[0])
        return torch.tensor(list(arrays[0]), dtype=torch.float64)

    return run


def closures():
    for name, kind in shipped_plants().items():
        plant = kind()
        yield pytest.param(plant, plant.make_closure(seeded()), id=f"{name}-own")
        yield pytest.param(plant, plant.closure, id=f"{name}-true")
        if name != "pendulum":
            yield pytest.param(plant, plant.make_neural_closure(seeded(), (16, 16)), id=f"{name}-mlp")


@needs_compiler
@pytest.mark.parametrize(("plant", "closure"), list(closures()))
def test_twins_of_the_plants(plant, closure, tmp_path):
    """A flight in C, whose states are fed back, ends where the plant's own flight ends."""
    assert export_twin(closure, tmp_path / "twin.c", plant) < CLOSE
    export_twin(closure, tmp_path / "twin.c", plant, name="twin")
    step = build(tmp_path / "twin.c")
    state, exogenous = plant.draw_initial_state(1, seeded()), plant.draw_exogenous(1, seeded())
    found, middle = state[0], torch.tensor([[0.5 * (a.low + a.high) for a in plant.actions]], dtype=torch.float64)
    with torch.no_grad():
        for k in range(50):
            t = torch.tensor([k * plant.dt], dtype=torch.float64)
            found = step(t.item(), found.tolist(), middle[0].tolist(), exogenous[0, k].tolist())
            state = plant.step(t, state, middle, exogenous[:, k], closure).state
    assert state.isfinite().all()
    torch.testing.assert_close(found, state[0], rtol=CLOSE, atol=CLOSE)


@needs_compiler
def test_linear_dynamics_against_the_matrix_exponential(tmp_path):
    matrix = [[0.05, 0.0], [-0.4, 0.2]]
    plant = LinearQuadratic(dt=0.01)
    export_twin(LinearClosure(matrix), tmp_path / "twin.c", plant, name="twin")
    A, B, C, D = (torch.tensor(x, dtype=torch.float64) for x in (plant.A, plant.B, matrix, plant.D))
    block = torch.zeros(4, 4, dtype=torch.float64)
    block[:2] = torch.cat([A + C, B, D], 1)
    start = [0.7, -0.4, 1.5, 0.3]
    exact = torch.from_numpy(expm(0.01 * block.numpy()))[:2] @ torch.tensor(start, dtype=torch.float64)
    found = build(tmp_path / "twin.c")(0.0, start[:2], start[2:3], start[3:])
    # One step of the fourth order.
    torch.testing.assert_close(found, exact, rtol=0.0, atol=0.01**5)


class Branching(nn.Module):
    def forward(self, features):
        return features if features.sum() > 0.0 else -features


def test_a_branch_is_refused_with_its_line(tmp_path):
    with pytest.raises(ValueError, match=r"twin of plant 'linear_quadratic' .* a branch of Python .*in forward"):
        export_twin(Branching(), tmp_path / "twin.c", LinearQuadratic())
    assert not list(tmp_path.iterdir())


@needs_compiler
def test_a_wrong_translation_is_not_written(tmp_path, monkeypatch):
    right = CSource.text
    monkeypatch.setattr(CSource, "text", lambda source: right(source).replace("0.125", "0.1250004"))
    with pytest.raises(ValueError, match="twin_step in C differs from the twin by"):
        export_twin(LinearClosure([[0.0, 0.0], [0.125, 0.0]]), tmp_path / "twin.c", LinearQuadratic(), name="twin")
    assert not list(tmp_path.iterdir())


def test_a_machine_without_compiler_says_that_nothing_was_checked(tmp_path, monkeypatch):
    monkeypatch.setattr(c_compiler, "COMPILERS", ("no_such_compiler",))
    with pytest.warns(UserWarning, match="twin was not checked: there is no C compiler"):
        assert export_twin(LinearClosure([[0.0, 0.0], [1.0, 0.0]]), tmp_path / "it.c", LinearQuadratic()) is None
    assert (tmp_path / "it.c").exists() and (tmp_path / "it.h").exists()
