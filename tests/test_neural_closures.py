"""Closures with a perceptron in them: their start, the bounds that keep their physics, their identification."""

import copy

import pytest
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import seeded
from test_twin import recorded
from torch import nn
from torch.nn.utils import parameters_to_vector

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.evaluation.checks import rms_error, visited_features
from rt_torchrl.plants.closures import BoundedPerceptron
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.steps.config import AssimilationConfig
from rt_torchrl.trajectories.engines.interval import Interval
from rt_torchrl.trajectories.engines.parallel import as_one_batch, linearise
from rt_torchrl.trajectories.rollout import drive_of
from rt_torchrl.trajectories.twin import DigitalTwin, jacobians_of

PLANTS = [WindTurbine(horizon=20.0), FlappingWing(horizon=0.01), CryogenicTank(horizon=1200.0)]
RANGES = {
    "wind_turbine": ((3.0, 12.0), (0.0, 20.0)),
    "flapping_wing": ((-1.0, 1.0), (-1.0, 1.0)),
    "cryogenic_tank": ((0.9, 1.1), (0.6, 0.7), (0.0, 2.0), (0.0, 1.0)),
}


def points(plant, count=200):
    low, high = torch.tensor(RANGES[plant.name], dtype=torch.float64).unbind(-1)
    return low + (high - low) * torch.rand(count, len(low), generator=seeded(1), dtype=torch.float64)


def disturbed(plant, scale=1.0):
    """A neural closure whose perceptron is not zero."""
    closure = plant.make_neural_closure(seeded(), (8, 8))
    with torch.no_grad():
        closure.correction.network[-1].weight.normal_(0.0, scale, generator=seeded(2))
    return closure


@pytest.fixture(params=PLANTS, ids=lambda plant: plant.name)
def plant(request):
    return request.param


def test_it_starts_where_the_papers_does(plant):
    features = points(plant)
    assert torch.equal(plant.make_neural_closure(seeded(3), (8,))(features), plant.make_closure(seeded(3))(features))
    assert not torch.allclose(disturbed(plant)(features), plant.make_closure(seeded())(features), rtol=1e-2)


def test_the_correction_is_bounded_wherever_the_features_are():
    correction = BoundedPerceptron([(0.0, 1.0), (-5.0, 5.0)], [0.5, 2.0], hidden=(4,), generator=seeded())
    with torch.no_grad():
        correction.network[-1].weight.fill_(50.0)
    far = 1e3 * torch.randn(100, 2, generator=seeded(1), dtype=torch.float64)
    assert (correction(far).abs() <= torch.tensor([0.5, 2.0])).all() and (correction(far).abs() > 0.4).any()


def test_both_sides_of_a_wing_are_alike_and_its_drag_is_positive():
    closure, angle = disturbed(PLANTS[1], 5.0), torch.linspace(0.1, 3.0, 50, dtype=torch.float64)
    one, other = (closure(torch.stack([a.sin(), a.cos()], -1)) for a in (angle, -angle))
    torch.testing.assert_close(one[:, 0], -other[:, 0], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(one[:, 1], other[:, 1], rtol=1e-12, atol=1e-14)
    assert (one[:, 1] > 0.0).all()
    along = closure(torch.tensor([[0.0, 1.0]], dtype=torch.float64))
    assert along[0, 0] == 0.0


def test_the_tanks_coefficients_stay_within_a_factor_of_two():
    tank = PLANTS[2]
    ratio = disturbed(tank, 20.0)(points(tank)) / tank.make_closure(seeded())(points(tank))
    assert ratio.min() >= 0.5 and ratio.max() <= 2.0 and ratio.max() > 1.5


def test_jacobians_by_rows_are_those_by_columns(plant):
    """Jacobians by reverse mode equal those by forward mode, by states on visited intervals."""
    _, flown, exogenous = recorded(plant, batch=2)
    closure = disturbed(plant, 0.3)
    names = tuple(name for name, _ in closure.named_parameters())
    interval, drive = Interval(plant, closure, None), drive_of(plant, exogenous, flown.actions)
    starts, drive = as_one_batch(flown.states[:, :-1].transpose(0, 1), drive)
    with torch.no_grad():
        columns, rows = linearise(interval, starts, drive), jacobians_of(interval, names, starts, drive)
    assert rows.shape[-1] == columns.shape[-1] + sum(w.numel() for w in closure.parameters())
    rows = rows[..., : columns.shape[-1]]
    # The same derivatives in another order: rounding, relative to the largest of each state.
    assert ((columns - rows).abs().amax((0, 2)) <= 1e-10 * columns.abs().amax((0, 2)).clamp(min=1e-300)).all()


class Corrected(nn.Module):
    """The law that a twin starts from and a perceptron of one layer."""

    def __init__(self, law):
        super().__init__()
        self.law = law
        ranges = [(-3.0, 3.0)] * 2
        self.correction = BoundedPerceptron(ranges, [1.0, 1.0], hidden=(), generator=seeded())

    def forward(self, features):
        return self.law(features) + self.correction(features)


def test_a_prior_pulls_the_perceptron_against_the_record():
    plant, moved = LinearQuadratic(horizon=4.0, noise=0.0), []
    for prior in (0.01, 0.1, 1.0):
        twin, flown, exogenous = recorded(plant, batch=1)
        twin = DigitalTwin(plant, Corrected(twin.closure.requires_grad_(False)))
        start = parameters_to_vector(twin.closure.correction.parameters()).detach()
        config = AssimilationConfig(prior=prior, inputs="record", method="levenberg_marquardt", iterations=40)
        assimilation = Assimilation(twin, config)
        assimilation.update([flown.each()[0]], [], 1, seeded())
        away = parameters_to_vector(twin.closure.correction.parameters()).detach() - start
        moved.append(away.norm().item())
        found = assimilation.likelihood(flown).normal_equations()
        # At the minimum of both the gradient of J_p is the pull of the prior; the steps end where 1e-4 of the cost is
        # left to gain, some hundredths of the gradient.
        assert (found.gradient + prior * away).norm() <= 0.1 * found.gradient.norm()
    assert moved[0] > moved[1] > moved[2] > 0.0


def test_a_prior_pulls_to_the_closure_that_a_training_begins_with_and_goes_on_doing_so():
    """A stiff prior leaves a perceptron where it is: at the weights of an earlier training, not at random ones."""
    plant = LinearQuadratic(horizon=4.0, noise=0.0)
    twin, flown, exogenous = recorded(plant, batch=1)
    record, config = flown.each()[0], AssimilationConfig(prior=1e9, inputs="record", method="levenberg_marquardt")
    first = Assimilation(DigitalTwin(plant, Corrected(twin.closure)), config)
    for weight in first.twin.closure.correction.parameters():
        torch.nn.init.constant_(weight, 0.3)
    first.begin()
    again = Assimilation(DigitalTwin(plant, Corrected(copy.deepcopy(twin.closure))), config)
    again.twin.closure.load_state_dict(first.twin.closure.state_dict())
    again.load_state_dict(copy.deepcopy(first.state_dict()))
    for assimilation in (first, again):
        assimilation.update([record], [], 1, seeded())
        for weight in assimilation.twin.closure.correction.parameters():
            torch.testing.assert_close(weight, torch.full_like(weight, 0.3), rtol=0, atol=1e-4)


def test_a_segment_longer_than_the_record_is_refused():
    twin, flown, exogenous = recorded(LinearQuadratic(horizon=2.0), batch=1)
    record = flown.each()[0]
    with pytest.raises(ValueError, match="segment=21 of the assimilation exceeds the 20 control"):
        Assimilation(twin, AssimilationConfig(segment=21, inputs="record")).update([record], [], 1, seeded())


def test_the_error_where_visited_is_that_of_the_coefficients():
    """On the turbine, where the features are known: λ = ωR/u and the pitch."""
    plant = PLANTS[0]
    _, flown, exogenous = recorded(plant, batch=1)
    record = flown.each()[0]
    features = visited_features(plant, record)
    lam = 63.0 * record.states[:-1, 0] / record.exogenous[:, 0]
    torch.testing.assert_close(features, torch.stack([lam, record.actions[:, 1]], -1), rtol=1e-14, atol=0)
    closure = plant.make_closure(seeded())
    error = (closure(features) - plant.closure(features)).square().mean().sqrt()
    assert rms_error(closure, plant.closure, features).tolist() == pytest.approx([error.item()], rel=1e-12)
    assert rms_error(plant.closure, plant.closure, features).tolist() == [0.0]
