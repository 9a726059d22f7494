"""Step 4 from first weights that a single descent does not lead away from."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from test_assimilation import flight, of_segments

from rt_torchrl.envs.flapping_wing.closures import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.controllers import TrimmedPD
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.steps.config import AssimilationConfig
from rt_torchrl.trajectories.twin import DigitalTwin


class Folded(torch.nn.Module):
    """A spring p = (0, k x) of stiffness k = 0.1 (w³ − 3w), of at least −0.2 for positive w."""

    def __init__(self, w):
        super().__init__()
        self.w = torch.nn.Parameter(torch.tensor([w], dtype=torch.float64))

    def forward(self, features):
        w = self.w[0]
        spring = 0.1 * (w**3 - 3.0 * w) * features[..., 0]
        return torch.stack([torch.zeros_like(spring), spring], -1)


class Stiff(LinearQuadratic):
    true_closure = ((0.0, 0.0), (-0.5, 0.0))


def test_a_local_minimum_is_left_by_other_first_weights():
    """From w = 1.5 the stiffness −0.5 is behind a hill; w³ − 3w = −5 has one root, w = −2.27902."""
    plant = Stiff(noise=0.0)
    record, twin = flight(plant), DigitalTwin(plant, Folded(1.5))
    found = {}
    for starts in (1, 4):
        twin.closure.load_state_dict(Folded(1.5).state_dict())
        config = AssimilationConfig(inputs="record", iterations=30, method="levenberg_marquardt", starts=starts)
        fit = Assimilation(twin, config).update([record], [], 1, torch.Generator())
        found[starts] = fit, twin.closure.w.item()
    assert found[1][1] == pytest.approx(1.0, abs=0.1) and found[1][0].best > 1e-3
    assert found[4][1] == pytest.approx(-2.27902, abs=1e-4) and found[4][0].best < 1e-10
    assert found[4][0].start == found[1][0].start


@pytest.mark.slow
def test_drag_at_zero_angle_is_not_lost_on_the_way():
    """b is 3 % of the drag, so that a step may give it up while a and c are still far from theirs."""
    plant = FlappingWing(horizon=1.0)
    generator = torch.Generator().manual_seed(0)
    state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    (record,) = TrimmedPD(plant).fly(state, exogenous).each()
    for first in ((1.159, 0.0530, 2.100), (1.461, 0.0232, 1.610), (2.188, 0.0296, 0.816)):
        closure = QuasiSteadyPolar(torch.tensor(first, dtype=torch.float64))
        of_segments(plant, closure, method="levenberg_marquardt", iterations=40).update([record], [], 1, generator)
        torch.testing.assert_close(closure.coefficients, plant.closure.coefficients, rtol=0.01, atol=0.0)
