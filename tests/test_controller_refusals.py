"""What is no controller is refused; angles go the short way."""

import math

import pytest
import torch
from c_build import needs_compiler
from linear_quadratic import LinearGain, LinearQuadratic
from test_export_controller import GAINS, Lagged
from torch import nn

from rt_torchrl import check_plant, export_controller
from rt_torchrl.contract.check import PlantContractError
from rt_torchrl.export.controller import Controller
from rt_torchrl.plants.signal import Signal
from rt_torchrl.programs.c_source import CSource


class Guessed(Lagged):
    """A plant whose filter depends on the closure."""

    def vector_field(self, t, state, action, exogenous, closure):
        rates = super().vector_field(t, state, action, exogenous, closure)
        return torch.cat([rates[..., :1] + closure(state[..., 1:3])[..., 1:], rates[..., 1:]], -1)


class Misnamed(LinearQuadratic):
    controller_states = ("speed_error",)


class Branching(LinearQuadratic):
    def observe(self, t, state, exogenous):
        return state if state.sum() > 0.0 else -state


class Misstarted(Lagged):
    def controller_start(self, measured, exogenous):
        return measured[..., :1]


class Turning(Lagged):
    """The position is an angle, and the filter follows it."""

    states = (
        Lagged.states[0],
        Signal(symbol="x", name="position", unit="m", low=-math.pi, high=math.pi, periodic=True),
        *Lagged.states[2:],
    )


def test_an_angle_goes_the_short_way():
    """From 3.1 over π to −3.1 is an advance of 2π − 6.2, which the filter df/dt = x − f follows."""
    controller = Controller(Turning(dt=0.1), LinearGain(GAINS))
    zero, one = torch.zeros(1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    before, after = (torch.tensor([[x, 0.0]], dtype=torch.float64) for x in (3.1, -3.1))
    memory = torch.tensor([[0.0, 3.0]], dtype=torch.float64)
    _, found = controller.advance(zero, memory, before, one, one, after)[0].tolist()
    rate = (2.0 * math.pi - 6.2) / 0.1
    exact = 3.1 + 0.1 * rate - rate + (3.0 - 3.1 + rate) * math.exp(-0.1)
    assert found == pytest.approx(exact, abs=1e-6)


REFUSED = {
    "a state that depends on the closure": (Guessed, GAINS, r"integral, filtered_position\) depend on the closure"),
    "a name that is no state": (Misnamed, [[1.0, 1.0]], "names speed_error; its states are position, velocity"),
    "another number of first states": (Misstarted, GAINS, r"returns shape \(1, 1\); its last dimension must be 2"),
    "a branch": (Branching, [[1.0, 1.0]], "controller of plant 'linear_quadratic' .* a branch of Python .*in observe"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_controller_is_refused(name, tmp_path):
    kind, gains, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        export_controller(LinearGain(gains), tmp_path / "it.c", kind(dt=0.1))
    assert not list(tmp_path.iterdir())


def test_the_check_of_a_plant_finds_a_misnamed_state():
    with pytest.raises(PlantContractError, match="controller_states: 'speed_error' is no state"):
        check_plant(Misnamed(dt=0.1), traced=False)


@needs_compiler
def test_a_wrong_translation_is_not_written(tmp_path, monkeypatch):
    right = CSource.text
    monkeypatch.setattr(CSource, "text", lambda source: right(source).replace("0.25", "0.2500004"))
    with pytest.raises(ValueError, match="the controller it in C differs from that in torch"):
        export_controller(LinearGain([[0.25, 1.0]]), tmp_path / "it.c", LinearQuadratic(), name="it")
    assert not list(tmp_path.iterdir())


class Frozen(nn.Module):
    """A policy that numpy computes, which no program can follow."""

    def forward(self, e):
        return torch.from_numpy(-0.1 * e.detach().numpy()[..., :1])


def test_numbers_that_leave_torch_are_refused_with_their_line(tmp_path):
    with pytest.raises(
        ValueError, match=r"\.numpy\(\) takes a number from a tensor that varies \(in forward, .*_refusals"
    ):
        export_controller(Frozen(), tmp_path / "it.c", LinearQuadratic())
    assert not list(tmp_path.iterdir())
