"""Records replayed in segments: their times and starts, and what is reported."""

import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic

from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.sensitivity import Sensitivities
from rt_torchrl.trajectories.trajectory import Trajectory, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import Assimilation, AssimilationConfig
from rt_torchrl.twinning.exogenous import ExogenousProcess


class Seasonal(LinearQuadratic):
    """A plant whose force comes and goes with the time."""

    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action * torch.cos(3.0 * t).unsqueeze(-1), exogenous, closure)


def flight(plant, seed=0):
    """A record of the true plant under random commands."""
    generator = torch.Generator().manual_seed(seed)
    state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    command = 2.0 * torch.rand(1, plant.n_steps, 1, generator=generator, dtype=torch.float64) - 1.0
    flown = Rollout(plant, plant.closure)(state, exogenous, command)
    return Trajectory(flown.states[0].detach(), command[0], exogenous[0])


def assimilation(plant, closure, **options):
    options = {"inputs": "record", "iterations": 30, **options}
    return Assimilation(DigitalTwin(plant, closure), AssimilationConfig(**options))


def replayed(*records):
    return Trajectory(*(torch.stack(x) for x in zip(*(r[:3] for r in records), strict=True)))


def test_segments_start_at_their_own_time_and_state():
    """Two records of 50 intervals are cut into segments of 12; J_p is the mean of what a loop over them finds."""
    plant, closure = Seasonal(), LinearClosure(torch.zeros(2, 2))
    records, expected = [flight(plant, seed) for seed in (0, 1)], []
    for record in records:
        for first in range(0, 48, 12):
            part = slice(first, first + 12)
            rollout = Rollout(plant, closure)
            piece = record.states[None, first : first + 13]
            flown = rollout(
                piece[:, 0], record.exogenous[None, part], record.actions[None, part], start=first * plant.dt
            )
            expected.append(identification_cost(plant, flown, piece).item())
    segments = replayed(*records).segments(12, plant.dt)
    found = assimilation(plant, closure).normal_equations(segments).cost.item()
    assert len(segments.states) == 8 and found == pytest.approx(sum(expected) / 8, rel=1e-12)  # sums in another order


def test_the_truth_has_no_cost_in_segments():
    plant = Seasonal()
    segments = replayed(flight(plant)).segments(7, plant.dt)
    assert assimilation(plant, plant.closure).normal_equations(segments).cost < 1e-28


@pytest.mark.parametrize("method", ["gradient", "levenberg_marquardt"])
def test_what_is_reported_is_the_cost_of_whole_records(method):
    plant, closure = Seasonal(), LinearClosure(torch.zeros(2, 2))
    record = flight(plant)
    before = assimilation(plant, closure).normal_equations(replayed(record)).cost.item()
    found = assimilation(plant, closure, segment=12, method=method, iterations=3)
    found = found.update([record], [], 1, torch.Generator())
    assert found.start == pytest.approx(before, rel=1e-12)  # two ways to sum
    assert found.best == pytest.approx(assimilation(plant, closure).normal_equations(replayed(record)).cost.item())


def test_sensitivities_start_at_their_own_time():
    """Two pieces together have the sensitivities of each alone."""
    plant, record = Seasonal(), flight(Seasonal())
    pieces = torch.tensor([0.0, 2.5], dtype=torch.float64)
    rows = [(record.states[k], record.exogenous[k : k + 25], record.actions[k : k + 25]) for k in (0, 25)]
    sensitivities = Sensitivities(plant, LinearClosure(torch.zeros(2, 2)))
    together = sensitivities(*(torch.stack(x) for x in zip(*rows, strict=True)), start=pieces)
    for b, row in enumerate(rows):
        alone = sensitivities(*(x[None] for x in row), start=pieces[b].item())
        for one, other in zip(together, alone, strict=True):
            torch.testing.assert_close(one[b], other[0], rtol=1e-12, atol=1e-14)


def test_a_start_for_each_is_refused_by_the_engine_that_has_one_span():
    plant = LinearQuadratic(horizon=1.0)
    rollout = Rollout(plant, plant.closure, engine="odeint_adjoint")
    state, inputs = torch.zeros(2, 2).double(), torch.zeros(2, 10, 1).double()
    with pytest.raises(ValueError, match="takes no start for each"):
        rollout(state, inputs, inputs, start=torch.tensor([0.0, 1.0], dtype=torch.float64))


@pytest.mark.parametrize(
    ("segment", "message"), [(-1, "segment=-1"), (51, "segment=51 of the assimilation exceeds the 50")]
)
def test_a_bad_segment_is_refused(segment, message):
    with pytest.raises(ValueError, match=message):
        assimilation(LinearQuadratic(), LinearClosure(torch.zeros(2, 2)), segment=segment)


def test_a_plant_without_inputs_has_an_empty_process():
    process = ExogenousProcess(torch.zeros(20, 0).double(), dt=0.1, signals=())
    assert process.sample(3, torch.Generator()).shape == (3, 20, 0)
