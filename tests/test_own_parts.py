"""What a newcomer writes for a plant of their own, and what exploration adds to its policy."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from test_classical import PD

from rt_torchrl import (
    Measurement,
    Phase,
    RunConfig,
    Signal,
    check_plant,
)
from rt_torchrl.contract.check import require_controller
from rt_torchrl.runs.run import Run
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy

PLANT = LinearQuadratic(horizon=2.0)


class Turning(LinearQuadratic):
    name = "turning"
    states = (
        Signal(symbol="x", name="position", unit="m"),
        Signal(symbol="a", name="angle", unit="rad", low=-math.pi, high=math.pi, periodic=True),
    )
    state_sizes = (2.0, 0.5)


def test_a_discrepancy_counts_states_in_their_sizes_and_an_angle_the_short_way():
    one, other = torch.tensor([[1.0, 3.0]]).double(), torch.tensor([[5.0, -3.0]]).double()
    turned = 2.0 * math.pi - 6.0
    expected = 0.5 * ((4.0 / 2.0) ** 2 + (turned / 0.5) ** 2)
    assert Turning().discrepancy(one, other).tolist() == pytest.approx([expected], rel=1e-12)
    Turning.states = Turning.states[:1]
    with pytest.raises(ValueError, match=r"state_sizes=\(2.0, 0.5\) of plant 'turning'.*position \[m\]"):
        Turning().discrepancy(one[:, :1], other[:, :1])
    Turning.discrepancy_scales = (0.0,)
    with pytest.raises(ValueError, match=r"discrepancy_scales=\(0.0,\) of plant 'turning'"):
        Turning().discrepancy(one[:, :1], other[:, :1])


class Clocked(LinearQuadratic):
    measurements = (
        Measurement.of(LinearQuadratic.states[1], offset=1.0, scale=2.0),
        Measurement.of(LinearQuadratic.inputs[0]),
        Measurement(symbol="c", name="day", unit="-", read=Phase("cosine", 4.0)),
        Measurement(symbol="s", name="night", unit="-", read=Phase("sine", 4.0)),
    )

    def observe(self, t, state, exogenous):
        return super(LinearQuadratic, self).observe(t, state, exogenous)


def test_measurements_read_the_signal_of_their_name_and_the_phase_of_the_day(unchecked):
    plant = Clocked(horizon=2.0)
    state, exogenous = torch.tensor([[7.0, 5.0]]).double(), torch.tensor([[0.25]]).double()
    seen = plant.observe(torch.tensor([1.0]).double(), state, exogenous)
    torch.testing.assert_close(seen, torch.tensor([[2.0, 0.25, 0.0, 1.0]]).double(), rtol=0, atol=1e-15)
    alien = dataclasses.replace(Clocked.states[0], name="pressure")
    with pytest.raises(ValueError, match="'pressure' of plant .* is none of its states and inputs"):
        Measurement.of(alien).observed(plant, torch.zeros(()), state, exogenous)
    for of, period, wrong in (("tangent", 4.0, "cosine or sine"), ("sine", 0.0, "must be positive")):
        with pytest.raises(ValueError, match=wrong):
            Phase(of, period)


def law(**own):
    """A PD law with other methods."""
    return type("Mine", (PD,), own)


WRONG_LAWS: list[tuple[Any, str]] = [
    (PD(PLANT), "must be a class derived from ClassicalController; give its class, PD"),
    (LinearGain, "must be a class derived from ClassicalController; give a subclass of it"),
    (law(law=lambda self, state, memory, z: state[:, :1]), "first: Mine.law returns Tensor; give both"),
    (law(law=lambda self, state, memory: (state[:, :1], memory)), r"It is law\(state, memory, exogenous\)"),
    (
        law(law=lambda self, state, memory, z: (state[:, 0], memory)),
        r"returns a command, shape \(3,\).*A column is state",
    ),
    (
        law(law=lambda self, state, memory, z: (state[:, :1].float(), memory)),
        r"command, torch.float32 for 3 states",
    ),
    (
        law(law=lambda self, state, memory, z: (state[:, :1] / 0.0, memory)),
        "command, 3 values that are not finite",
    ),
    (
        law(law=lambda self, state, memory, z: (state[:, :1], state)),
        r"returns a memory, shape \(3, 2\).*memory_size=1",
    ),
    (
        law(memory_size=0, law=lambda self, state, memory, z: (state[:, :1], memory[:, [0]])),
        "as memory_size=0 says",
    ),
    (law(first_memory=lambda self, state: state), r"first_memory returns shape \(3, 2\).*memory_size=1"),
    (law(default_gains=()), r"default_gains=\(\) of Mine must be .*K_1 .*, one for each entry of gain_units"),
]


@pytest.mark.parametrize(("wrong", "message"), WRONG_LAWS)
def test_a_controller_that_does_not_fit_is_refused_in_words(wrong, message):
    require_controller("first", PD, PLANT)
    with pytest.raises(ValueError, match=message):
        require_controller("first", wrong, PLANT)


def test_a_run_refuses_them_before_any_work(tmp_path, unchecked):
    config = RunConfig(log_dir=tmp_path / "run")
    with pytest.raises(ValueError, match="first, an instance of LinearGain, must be a class"):
        Run(config, PLANT, first=LinearGain([[1.0, 1.0]]))
    with pytest.raises(ValueError, match=r"baselines\['PD'\], an instance of PD, must be .*give its class, PD"):
        Run(config, PLANT, baselines={"PD": PD(PLANT)})
    with pytest.raises(ValueError, match="plant=<class .* must be a plant; if this is a class, give an instance"):
        Run(config, LinearQuadratic)
    with pytest.raises(ValueError, match=r"plant=LinearQuadratic is a class; give a plant, such as"):
        check_plant(LinearQuadratic)
    assert not (tmp_path / "run").exists()


def test_a_text_stands_for_a_path(unchecked):
    assert RunConfig(log_dir="runs/mine").log_dir == Path("runs/mine")
    with pytest.raises(ValueError, match="log_dir=7 must be a path"):
        RunConfig(log_dir=7)
    with pytest.raises(ValueError, match="log_dir='' is the current folder"):
        RunConfig(log_dir="")


# Exploration noise: deviation and correlation of what reaches the actuators, and a fresh start at each episode.


class Held(torch.nn.Module):
    """A policy that always asks for the same action."""

    def __init__(self, action):
        super().__init__()
        self.action = action

    def forward(self, observation):
        return self.action


def noise(plant, n=400, rows=100, *, strength=1.0, **options):
    """Actions that noise makes of a policy that asks for mid-range, as shares of half the range."""
    middle = torch.tensor([0.5 * (a.low + a.high) for a in plant.actions], dtype=torch.float64)
    config = ExplorationConfig(spread=0.1, **options)
    actor = LivePolicy(plant, Held(middle.expand(rows, -1)), config, generator=torch.Generator().manual_seed(0))
    actor.begin(actor.policy, strength=strength)
    observation = torch.zeros(rows, len(plant.observations), dtype=torch.float64)
    acted = torch.stack([actor(observation) for _ in range(n)])
    half = torch.tensor([0.5 * (a.high - a.low) for a in plant.actions], dtype=torch.float64)
    return (acted - middle) / half


@pytest.mark.parametrize("intervals", [0.0, 3.0])
def test_deviation_and_correlation_are_those_asked_for(intervals):
    plant = LinearQuadratic()
    found = noise(plant, correlation_time=intervals * plant.dt, strength=0.5)
    rho = math.exp(-1.0 / intervals) if intervals else 0.0
    # Standard error of a deviation over 40 000 samples of which some 1 + 2ρ/(1 − ρ) count as one: 2 % at most.
    assert found.std((0, 1)).tolist() == pytest.approx([0.05] * len(plant.actions), rel=0.05)
    for lag in (1, 2, 5):
        correlation = (found[lag:] * found[:-lag]).mean((0, 1)) / found.square().mean((0, 1))
        assert correlation.tolist() == pytest.approx([rho**lag] * len(plant.actions), abs=0.04)


def test_the_strength_falls_to_zero():
    assert [ExplorationConfig(episodes=4).strength(episode) for episode in range(6)] == [1.0, 0.75, 0.5, 0.25, 0.0, 0.0]
    assert ExplorationConfig(episodes=0).strength(9) == 0.0
