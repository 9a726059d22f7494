"""Classical controllers: their laws, and their flights against the plant's own step."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import drawn, stepped

from rt_torchrl import ClassicalController, SaturatedAffine
from rt_torchrl.envs.cryogenic_tank.controllers import OnOffValve, PIValve
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.controllers import TrimmedPD
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs.results import flights_of
from rt_torchrl.steps.config import ROLES


class PD(ClassicalController):
    """a = −K_1 x − K_2 v, with a memory that counts the intervals."""

    gain_units = {"K_1": "N/m", "K_2": "N s/m"}
    default_gains = (0.3, 0.3)
    memory_size = 1

    def law(self, state, memory, exogenous):
        return -(self.log_gains.exp() * state).sum(-1, keepdim=True), memory + 1.0


LOAD = torch.tensor([[130.0]], dtype=torch.float64)


def episodes(plant, count=6, size=0.3):
    state, exogenous = drawn(plant, count)
    return size * state, exogenous


def test_a_flight_is_the_plants_steps_under_the_saturated_command():
    plant = LinearQuadratic(horizon=3.0)
    state, exogenous = episodes(plant, size=3.0)
    flown = PD(plant, (2.0, 1.0)).fly(state, exogenous)
    assert flown.states.shape == (6, 31, 2) and flown.actions.shape == (6, 30, 1)
    law = lambda k, t, s, z: (-2.0 * s[:, :1] - 1.0 * s[:, 1:]).clamp(-2.0, 2.0)  # noqa: E731
    states, applied, _ = stepped(plant, plant.closure, state, exogenous, law)
    torch.testing.assert_close(flown.states, states, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(flown.actions, applied, rtol=1e-13, atol=1e-13)
    assert (flown.actions.abs() == 2.0).any()


class FeedForward(PD):
    """A PD law that cancels the measured disturbance, and keeps its sum."""

    def law(self, state, memory, exogenous):
        command, _ = super().law(state, memory, exogenous)
        return command - exogenous, memory + exogenous


def test_a_law_sees_the_measured_inputs_of_its_interval_in_flights_and_interval_by_interval():
    """The velocity follows v' = ... + a + z: with the disturbance cancelled, the flight is the one without it."""
    plant = LinearQuadratic(horizon=3.0)
    state, exogenous = episodes(plant)
    cancelled = FeedForward(plant).fly(state, exogenous)
    still = PD(plant).fly(state, torch.zeros_like(exogenous))
    torch.testing.assert_close(cancelled.states, still.states, rtol=0, atol=1e-12)
    controller = FeedForward(plant)
    controller.begin()
    commands = [controller.act(0.0, cancelled.states[:, k], exogenous[:, k]) for k in range(plant.n_steps)]
    torch.testing.assert_close(torch.stack(commands, 1), cancelled.actions, rtol=0, atol=1e-12)
    torch.testing.assert_close(controller._memory, exogenous.sum(1), rtol=0, atol=1e-12)


class Wild(PD):
    """A law that asks for what is no number."""

    def law(self, state, memory, exogenous):
        return torch.nan * state[:, :1], memory


def test_a_baseline_that_diverges_does_not_take_the_results():
    plant = LinearQuadratic(horizon=3.0)
    unseen = UnseenEpisodes(plant, 4)
    affine = SaturatedAffine(2, plant.actions, generator=torch.Generator().manual_seed(0))
    with pytest.warns(UserWarning, match="baseline 'wild' is left out of the results: .* diverged"):
        found = flights_of(unseen, dict.fromkeys(ROLES, affine), {"wild": Wild(plant), "PD": PD(plant)})
    assert list(found) == [*ROLES, "PD"]


def test_the_pd_law_holds_the_drone_at_its_target_in_the_mean_wind():
    plant = FlappingWing(horizon=0.5)
    hover = torch.tensor([[5.0, 5.0, 0.0, 0.0]], dtype=torch.float64)
    flown = TrimmedPD(plant, (16.0, 16.0, 23.0, 23.0)).fly(hover, torch.ones(1, plant.n_steps, 1, dtype=torch.float64))
    # The trim is known to 0.3 deg, which 23 deg/m make 1.3 cm; the beat itself moves the body by some millimetres.
    assert (flown.states[..., :2] - 5.0).abs().max() < 0.02


def test_the_valve_opens_above_its_band_and_shuts_below_it():
    valve, is_open, found = OnOffValve(CryogenicTank(), (150e3,)), torch.zeros(1, 1).double(), []
    for error in (-2e3, 0.5e3, 1.5e3, 0.5e3, -0.5e3, -1.5e3, 0.5e3):
        state = torch.tensor([[27.0, 42.0, 500e3 + error]], dtype=torch.float64)
        command, is_open = valve.law(state, is_open, LOAD)
        found.append(round(command.item()))
    assert found == [0, 0, 150_000, 150_000, 150_000, 0, 0]


def test_the_integral_of_the_valve_stops_where_the_valve_does():
    plant = CryogenicTank()
    valve, memory = PIValve(plant, (1.0, 1e-3)), torch.zeros(1, 1).double()
    high = torch.tensor([[27.0, 42.0, 540e3]], dtype=torch.float64)
    for _ in range(1000):
        command, memory = valve.law(high, memory, LOAD)
    assert memory.item() == 200e3 and command.item() == pytest.approx(240e3)
    command, memory = valve.law(high - torch.tensor([0.0, 0.0, 80e3]), memory, LOAD)
    assert memory.item() == pytest.approx(200e3 - 1e-3 * 40e3 * 30.0)
