"""Model predictive control in the place of a policy: it acts as it flies, in time, and on the closure as it is."""

import copy
import math

import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from seeds_and_numbers import seeded

from rt_torchrl.control.forecasts import Decaying
from rt_torchrl.control.predictive_control import PredictiveConfig, PredictiveControl, RecedingHorizon
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.systems.collectors import collector_of
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.state_feedback import StateFeedback, commands_along
from rt_torchrl.trajectories.trajectory import control_cost
from rt_torchrl.trajectories.twin import DigitalTwin

PLANT = LinearQuadratic(horizon=2.0, noise=0.5)


def control(plant=PLANT, closure=None, **options):
    return PredictiveControl(plant, closure or plant.closure, PredictiveConfig(horizon=1.0, **options))


def episodes(plant=PLANT, batch=2, seed=1):
    generator = seeded(seed)
    return plant.draw_initial_state(batch, generator), plant.draw_exogenous(batch, generator)


def on_the_real_system(controller, env, *, strength=0.0):
    """An episode as step 1 flies it."""
    actor = LivePolicy(env.plant, controller, ExplorationConfig(), generator=seeded())
    actor.begin(controller, strength=strength)
    return collector_of(env, actor, env.plant).rollout()[0]


@pytest.mark.parametrize("forecast", ["held", "decaying"])
def test_it_acts_on_the_real_system_as_it_flies_in_simulation(forecast):
    controller = control(forecast=forecast)
    controller.learn(PLANT.draw_exogenous(30, seeded(5)))
    assert isinstance(controller, StateFeedback)
    flown = on_the_real_system(controller, PlantEnv(PLANT, seed=4))
    expected = controller.fly(flown["state"][:1], flown["exogenous"][None])
    torch.testing.assert_close(flown["next", "applied"], expected.actions[0], rtol=1e-9, atol=1e-9)
    cost = control_cost(PLANT, expected)[0]
    torch.testing.assert_close(-flown["next", "reward"].mean(), cost, rtol=1e-9, atol=1e-12)
    found = controller.report()
    assert found["late_solves"] == found["diverged_solves"] == 0.0 and len(controller.solves) == PLANT.n_steps
    assert 0.0 < found["solve_median"] <= found["solve_max"]


def test_exploration_moves_its_commands():
    controller = control()
    noisy, calm = (on_the_real_system(controller, PlantEnv(PLANT, seed=4), strength=s) for s in (1.0, 0.0))
    assert torch.equal(noisy["state"][0], calm["state"][0])
    assert (noisy["action"][0] - calm["action"][0]).abs() > 1e-3 and noisy["action"].abs().max() <= 2.0


def test_costs_on_twin_and_unseen_episodes_are_those_of_its_flights():
    closure = LinearClosure(torch.zeros(2, 2))
    controller, twin = control(closure=closure), DigitalTwin(PLANT, closure)
    state, exogenous = episodes()
    flown = controller.fly(state, exogenous, closure)
    torch.testing.assert_close(twin.cost(controller, state, exogenous), control_cost(PLANT, flown).mean())
    replayed = Rollout(PLANT, closure)(state, exogenous, flown.actions)
    torch.testing.assert_close(replayed.states, flown.states, rtol=1e-9, atol=1e-9)
    unseen = UnseenEpisodes(PLANT, 2)
    real = controller.fly(unseen.initial_state, unseen.exogenous, PLANT.closure)
    torch.testing.assert_close(unseen.control_costs(controller), control_cost(PLANT, real))
    with pytest.raises(ValueError, match="start=0.5 of a flight by PredictiveControl must be 0"):
        twin.control(controller, state, exogenous, start=0.5)


class Movable(LinearQuadratic):
    """A plant that is to be held at a place, which its user may move."""

    def __init__(self):
        super().__init__(horizon=2.0, noise=0.0)
        self.register_buffer("target", torch.zeros(1, dtype=torch.float64))

    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(
            t, torch.cat([state[..., :1] - self.target, state[..., 1:]], -1), applied, exogenous
        )


def test_it_flies_to_a_target_that_has_moved():
    plant = Movable()
    start, inputs = torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, plant.n_steps, 1, dtype=torch.float64)
    controller = control(plant)
    still = controller.fly(start, inputs).states[0, -1, 0].item()
    plant.target.fill_(0.7)
    moved, anew = (each.fly(start, inputs).states for each in (controller, control(plant)))
    torch.testing.assert_close(moved, anew, rtol=1e-9, atol=1e-12)
    assert abs(still) < 1e-6 and moved[0, -1, 0] > 0.2


def test_it_plans_on_the_closure_as_it_is_trained():
    """With the true closure it costs less than with a wrong one, and a copy keeps the closure that it has."""
    closure = LinearClosure(torch.tensor([[0.0, 0.0], [6.0, 0.0]]))
    controller, (state, exogenous) = control(closure=closure), episodes(batch=4)
    wrong, kept = control_cost(PLANT, controller.fly(state, exogenous, PLANT.closure)).mean(), copy.deepcopy(controller)
    with torch.no_grad():
        closure.matrix.copy_(PLANT.closure.matrix)
    right = control_cost(PLANT, controller.fly(state, exogenous, PLANT.closure)).mean()
    assert right < 0.95 * wrong
    torch.testing.assert_close(control_cost(PLANT, kept.fly(state, exogenous, PLANT.closure)).mean(), wrong)
    assert {name for name, _ in controller.named_parameters()} == {"closure.matrix"}


def test_its_forecast_is_that_of_the_inputs_met():
    controller, records = control(forecast="decaying"), PLANT.draw_exogenous(40, seeded(9))
    state, exogenous = episodes()
    before = controller.fly(state, exogenous).actions
    held = RecedingHorizon(PLANT, PLANT.closure, PredictiveConfig(horizon=1.0))
    held.prepare(PLANT.draw_initial_state(1, g := seeded()), PLANT.draw_exogenous(1, g)[:, 0])
    torch.testing.assert_close(before, held.fly(state, exogenous).actions, rtol=0.0, atol=0.0)
    controller.learn(records)
    fitted = Decaying.fitted(records, dt=PLANT.dt, horizon=1.0)
    assert torch.equal(controller.forecast.mean, fitted.mean) and torch.equal(controller.forecast.time, fitted.time)
    again = control(forecast="decaying")
    again.load_state_dict(controller.state_dict())
    after = controller.fly(state, exogenous).actions
    assert torch.equal(again.fly(state, exogenous).actions, after) and not torch.allclose(after, before, atol=1e-3)
    still = control(forecast="held")
    still.learn(records)
    assert torch.equal(still.fly(state, exogenous).actions, before)


def test_the_first_action_is_never_late():
    """The plan that is made before the episode begins goes on; without it the first solve has no deadline."""
    controller, (state, exogenous) = control(deadline=1e-9), episodes(batch=1)
    controller.begin()
    controller.act(0.0, state, exogenous[:, 0])
    assert [solve.late for solve in controller.solves] == [True] and controller.report()["late_solves"] == 1.0
    on_the_real_system(controller, PlantEnv(PLANT, seed=4))
    assert controller.report()["late_solves"] == PLANT.n_steps
    assert not any(solve.late for solve in control().solves)


def test_the_deadline_does_not_reach_simulated_episodes():
    state, exogenous = episodes()
    late, early = control(deadline=1e-9).fly(state, exogenous), control().fly(state, exogenous)
    assert torch.equal(late.actions, early.actions)


def test_commands_along_another_flight_are_its_own_in_these_states():
    controller, (state, exogenous) = control(), episodes()
    flown = controller.fly(state, exogenous)
    torch.testing.assert_close(commands_along(controller, flown, PLANT.dt), flown.actions, rtol=1e-9, atol=1e-9)


class Fragile(LinearQuadratic):
    """A plant that diverges where it is pushed to the right, from a position on."""

    def step(self, t, state, command, exogenous, closure):
        end = super().step(t, state, command, exogenous, closure)
        broken = torch.exp(2000.0 * (state[..., :1] - 5.0) * (command + 1.0))
        return end._replace(state=end.state + broken - torch.exp(torch.zeros_like(broken)))


def test_a_model_that_diverges_leaves_a_command_that_does_not():
    plant = Fragile(horizon=1.0, noise=0.0)
    controller = RecedingHorizon(plant, plant.closure, PredictiveConfig(horizon=0.5))
    controller.plan(0.0, torch.zeros(1, 2).double(), torch.zeros(1, 1).double())
    beyond = torch.tensor([[30.0, 0.0]]).double()
    planned = controller.plan(0.1, beyond, torch.zeros(1, 1).double())
    assert controller.solves[-1].diverged and planned.isfinite().all()
    with pytest.raises(DivergenceError, match="diverges in every first plan"):
        controller.begin()
        controller.plan(0.0, torch.full((1, 2), math.inf).double(), torch.zeros(1, 1).double())


def test_what_cannot_be_is_refused():
    controller = control()
    with pytest.raises(ValueError, match="no function of the observation.*--role model_free"):
        controller(torch.zeros(1, 2).double())
    with pytest.raises(ValueError, match="virtual_episodes=0"):
        PredictiveConfig(virtual_episodes=0)
    actor = LivePolicy(PLANT, controller, ExplorationConfig(), generator=seeded())
    with pytest.raises(ValueError, match="PredictiveControl acts from state and exogenous input; give both"):
        actor(torch.zeros(1, 2).double())
    elsewhere = LinearClosure(torch.zeros(2, 2)).to("meta")
    with pytest.raises(ValueError, match="closure is on meta"):
        control(closure=elsewhere)
