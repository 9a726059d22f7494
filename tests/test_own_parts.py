"""What a newcomer writes for a plant of their own, and what exploration adds to its policy."""

import math
from pathlib import Path

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from test_classical import PD

from rt_torchrl import (
    Measurement,
    Phase,
    RunConfig,
    Signal,
)
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


def test_a_run_refuses_them_before_any_work(tmp_path, unchecked):
    config = RunConfig(log_dir=tmp_path / "run")
    with pytest.raises(ValueError, match="first, an instance of LinearGain, must be a class"):
        Run(config, PLANT, first=LinearGain([[1.0, 1.0]]))
    with pytest.raises(ValueError, match=r"baselines\['PD'\], an instance of PD, must be .*give its class, PD"):
        Run(config, PLANT, baselines={"PD": PD(PLANT)})
    with pytest.raises(ValueError, match="plant=<class .* must be a plant; if this is a class, give an instance"):
        Run(config, LinearQuadratic)
    assert not (tmp_path / "run").exists()


def test_a_text_stands_for_a_path(unchecked):
    assert RunConfig(log_dir="runs/mine").log_dir == Path("runs/mine")


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
