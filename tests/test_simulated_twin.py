"""The ensemble smoother of twins without gradients: its sensitivities, and what it finds beside Levenberg-Marquardt."""

import pytest
import torch
from hidden_wall import Envelope, room_records
from linear_quadratic import LinearQuadratic
from straight_line import flown

from rt_torchrl.identification.estimation import Estimation
from rt_torchrl.plants.integrators import rk4_step
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.simulated_twin import SimulatedTwin
from rt_torchrl.trajectories.twin import DigitalTwin


def legacy(plant):
    """A code that nobody can differentiate: the plant's equations, step by step, in numbers."""

    def simulate(closure, state, exogenous, actions, start):
        ends = []
        for z, a in zip(exogenous, actions, strict=True):
            state = rk4_step(
                lambda t, s, a=a, z=z: plant.vector_field(t, s, a, z, closure),
                torch.tensor(start).double(),
                state,
                plant.dt,
            )
            ends.append(torch.tensor(state.tolist(), dtype=torch.float64))
            state = ends[-1]
        return torch.stack(ends)

    return simulate


def legacy_room(plant):
    """The room in Python's own numbers."""

    def simulate(closure, state, exogenous, actions, start):
        to_wall, outdoors, capacity = closure.coefficients.tolist()
        drive, dt, ends = zip(exogenous[:, 0].tolist(), actions[:, 0].tolist(), strict=True), plant.dt, []
        air, wall = state.tolist()

        def rates(air, wall, outside, heat):
            into = to_wall * (air - wall)
            return (outdoors * (outside - air) - into + heat) / 0.5e6, into / (1e6 * capacity)

        for given in drive:
            k1 = rates(air, wall, *given)
            k2 = rates(air + 0.5 * dt * k1[0], wall + 0.5 * dt * k1[1], *given)
            k3 = rates(air + 0.5 * dt * k2[0], wall + 0.5 * dt * k2[1], *given)
            k4 = rates(air + dt * k3[0], wall + dt * k3[1], *given)
            air += dt / 6.0 * (k1[0] + 2.0 * k2[0] + 2.0 * k3[0] + k4[0])
            wall += dt / 6.0 * (k1[1] + 2.0 * k2[1] + 2.0 * k3[1] + k4[1])
            ends.append((air, wall))
        return torch.tensor(ends, dtype=torch.float64)

    return simulate


def test_sensitivities_by_initial_states_of_a_linear_twin_are_exact():
    """Those by weights, of which the states are no linear function, are exact to the square of the spread."""
    plant, generator = LinearQuadratic(), torch.Generator().manual_seed(0)
    (segment,) = flown(plant, generator, (15,))
    closure = plant.make_closure(generator)
    before = closure.matrix.detach().clone()
    given = (segment.states[:1], segment.exogenous[None], segment.actions[None])
    states, S = SimulatedTwin(plant, closure, legacy(plant)).sensitivities(*given, initial=True)
    expected, exact = DigitalTwin(plant, closure).sensitivities(*given, initial=True)
    torch.testing.assert_close(states, expected)
    torch.testing.assert_close(S, exact, rtol=0, atol=1e-3 * exact.abs().max().item())
    assert torch.equal(closure.matrix, before) and S.shape == (1, 15, 2, 6)


def test_the_smoother_finds_what_levenberg_marquardt_finds():
    plant, sensors, records = room_records(lengths=(120,))
    found = {}
    for name in ("gradients", "ensemble"):
        closure = Envelope(torch.tensor([45.0, 110.0, 5.0]))
        twin = DigitalTwin(plant, closure)
        if name == "ensemble":
            twin = SimulatedTwin(plant, closure, legacy_room(plant))
        found[name] = Estimation(twin, sensors).run(records)
    errors = [found[name].uncertainty.standard_errors() for name in found]
    for weight, true in zip(Envelope.names, Envelope.true_coefficients, strict=True):
        exact, ensemble = (abs(found[name].after[weight] - true) for name in found)
        assert ensemble < 3.0 * max(exact, errors[0][weight])  # as near as by gradients, or as the data allow
        # The same minimum, to a small part of its uncertainty, and the same uncertainty.
        assert abs(found["ensemble"].after[weight] - found["gradients"].after[weight]) < 0.1 * errors[0][weight]
        assert errors[1][weight] == pytest.approx(errors[0][weight], rel=0.05)


def test_what_makes_no_ensemble_is_refused():
    plant, closure = LinearQuadratic(), LinearQuadratic().make_closure(torch.Generator().manual_seed(0))
    for options, message in (
        ({"spread": 0.0}, "spread=0.0"),
        ({"state_spread": torch.zeros(2).double()}, "must be positive"),
        ({"pairs": 5}, "pairs=5 of the ensemble must be at least 6"),
    ):
        with pytest.raises(ValueError, match=message):
            SimulatedTwin(plant, closure, legacy(plant), **options)
    twin = SimulatedTwin(plant, closure, lambda closure, state, z, a, start: a.new_full((len(a), 2), torch.nan))
    with pytest.raises(DivergenceError):
        twin.replay(torch.zeros(1, 2).double(), torch.zeros(1, 3, 1).double(), torch.zeros(1, 3, 1).double())
