"""Model predictive control: its plans beside quadratic programs and Riccati, its forecasts, and in a policy's place."""

import copy
import math

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from printed_commands import blocks, run_code
from scipy.linalg import solve_discrete_are
from scipy.optimize import lsq_linear
from seeds_and_numbers import drawn, seeded
from test_exogenous import autoregressive

from rt_torchrl import Decaying, DivergenceError, PlantEnv, Rollout, StateFeedback, control_cost
from rt_torchrl.control.command_cost import PENALTY, CommandCost
from rt_torchrl.control.predictive_control import PredictiveConfig, PredictiveControl, RecedingHorizon
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.signal import bounds
from rt_torchrl.systems.collectors import collector_of
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.trajectories.twin import constant

PLANT = LinearQuadratic(horizon=2.0, noise=0.5)


def control(plant=PLANT, closure=None, **options):
    return PredictiveControl(plant, closure or plant.closure, PredictiveConfig(horizon=1.0, **options))


@pytest.mark.parametrize(
    ("dt", "horizon", "hold", "expected"),
    [
        (0.05, 10.0, None, 1.0),
        (0.1, 2.0, None, 0.5),
        (0.1, 5.0, 0.5, 1.0),
        (1.0, 2.0, None, 1.0),
    ],
)
def test_a_window_that_nobody_set_has_twenty_commands_or_a_quarter_of_the_episode(dt, horizon, hold, expected):
    assert PredictiveConfig(hold=hold).length(LinearQuadratic(dt=dt, horizon=horizon)) == pytest.approx(expected)


@pytest.mark.parametrize("forecast", ["held", "decaying"])
def test_it_acts_on_the_real_system_as_it_flies_in_simulation(forecast):
    controller = control(forecast=forecast)
    controller.learn(PLANT.draw_exogenous(30, seeded(5)))
    assert isinstance(controller, StateFeedback)
    actor = LivePolicy(PLANT, controller, ExplorationConfig(), generator=seeded())
    actor.begin(controller, strength=0.0)
    flown = collector_of(PlantEnv(PLANT, seed=4), actor, PLANT).rollout()[0]  # as step 1 flies it
    expected = controller.fly(flown["state"][:1], flown["exogenous"][None])
    torch.testing.assert_close(flown["next", "applied"], expected.actions[0], rtol=1e-9, atol=1e-9)
    cost = control_cost(PLANT, expected)[0]
    torch.testing.assert_close(-flown["next", "reward"].mean(), cost, rtol=1e-9, atol=1e-12)
    assert len(controller.solves) == PLANT.n_steps
    found = controller.report()
    assert found["diverged_solves"] == 0.0 == len(controller.solves)  # the next report is of the next solves
    assert 0.0 < found["solve_median"] <= found["solve_max"] and not controller.report()


def test_a_controller_that_takes_over_within_a_period_begins_with_its_plan():
    """Nothing of this plant depends on the time."""
    state, inputs = torch.tensor([[1.0, -0.5]]).double(), torch.zeros(1, 1).double()
    controller = RecedingHorizon(PLANT, PLANT.closure, PredictiveConfig(horizon=1.0, period=0.5))
    commands = controller.plan(0.0, state, inputs)
    controller.begin()
    late = [controller.act(k * PLANT.dt, state, inputs) for k in (3, 4)]
    assert torch.equal(torch.stack(late, 1), commands[:, :2]) and not torch.equal(late[0], late[1])
    assert len(controller.solves) == 2
    assert torch.equal(controller.act(5 * PLANT.dt, state, inputs), controller._commands[:, 0])


class Undisturbed(LinearQuadratic):
    """The plant of the oracle without inputs."""

    inputs = ()

    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action, state.new_zeros((*state.shape[:-1], 1)), closure)

    def draw_exogenous(self, batch, generator):
        return torch.zeros(batch, self.n_steps, 0, dtype=torch.float64)


@pytest.mark.parametrize("plant", [LinearQuadratic(dt=2.0, horizon=20.0), Undisturbed(horizon=2.0)])
def test_model_predictive_control_that_nobody_set_suits_any_plant(plant):
    """Its window is two commands of an episode of ten; where there are no inputs, none is forecast."""
    unseen = UnseenEpisodes(plant, 2)
    controller = PredictiveControl(plant, plant.closure, PredictiveConfig())
    controller.learn(plant.draw_exogenous(20, seeded()))
    idle = torch.zeros(2, plant.n_steps, 1, dtype=torch.float64)
    costs = Rollout(plant, plant.closure).costs(unseen.initial_state, unseen.exogenous, idle)
    assert unseen.control_costs(controller).mean() < costs.mean()


def test_it_plans_on_the_closure_as_it_is_trained():
    """With the true closure it costs less than with a wrong one, and a copy keeps the closure that it has."""
    closure = LinearClosure(torch.tensor([[0.0, 0.0], [6.0, 0.0]]))
    controller, (state, exogenous) = control(closure=closure), drawn(PLANT, 4, 1)
    wrong, kept = control_cost(PLANT, controller.fly(state, exogenous, PLANT.closure)).mean(), copy.deepcopy(controller)
    with torch.no_grad():
        closure.matrix.copy_(PLANT.closure.matrix)
    right = control_cost(PLANT, controller.fly(state, exogenous, PLANT.closure)).mean()
    assert right < 0.95 * wrong
    torch.testing.assert_close(control_cost(PLANT, kept.fly(state, exogenous, PLANT.closure)).mean(), wrong)
    assert {name for name, _ in controller.named_parameters()} == {"closure.matrix"}


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


NOW = torch.tensor([[3.0, -1.0], [5.0, 2.0]], dtype=torch.float64)


def first_order(time, dt):
    """Records of an Ornstein-Uhlenbeck process of unit variance around 2."""
    return 2.0 + torch.from_numpy(np.stack([autoregressive(4000, math.exp(-dt / time), seed) for seed in range(40)]))


def test_a_decaying_forecast_goes_to_the_mean():
    mean, time = torch.tensor([1.0, 1.0], dtype=torch.float64), torch.tensor([2.0, 0.5], dtype=torch.float64)
    found = Decaying(mean, time, dt=0.5)(0.0, NOW, 40)
    torch.testing.assert_close(found[:, 0], NOW, rtol=0.0, atol=0.0)
    torch.testing.assert_close(found[0, 4], torch.tensor([1.0 + 2.0 / math.e, 1.0 - 2.0 * math.exp(-4.0)]).double())
    torch.testing.assert_close(found[:, -1], mean.expand(2, 2), rtol=1e-3, atol=1e-3)


def test_the_decay_of_a_first_order_process_is_found():
    records = torch.stack([first_order(6.0, 0.5), first_order(30.0, 0.5)], -1)
    found = Decaying.fitted(records, dt=0.5, horizon=20.0)
    torch.testing.assert_close(found.mean, torch.full((2,), 2.0).double(), rtol=0.05, atol=0.05)
    torch.testing.assert_close(found.time, torch.tensor([6.0, 30.0]).double(), rtol=0.1, atol=0.0)


def test_inputs_that_stand_still_or_wander_in_the_records_are_held():
    """Set points of other episodes are not forecast to decay to those that have been met."""
    noise = torch.randn(20, 200, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    still = (0.1 + noise[:, :1]).expand(-1, 200)
    records = torch.stack([still, 100.0 * still + noise.cumsum(1), noise], -1)
    assert Decaying.fitted(records, dt=0.5, horizon=20.0).time.isinf().tolist() == [True, True, False]
    assert Decaying.fitted(records[:1, :, :1], dt=0.5, horizon=20.0).time.isinf().all()


def matrices(plant):
    """The interval as s⁺ = A s + B a + D z, by the four terms of Runge and Kutta's scheme, and the weights of L_a."""
    continuous = np.array(plant.A) + np.array(plant.true_closure)
    power, total = np.eye(2), np.zeros((2, 2))
    for order in range(1, 5):
        total = total + power * plant.dt / order
        power = power @ continuous * plant.dt / order
    # total is now dt·(I + A dt/2 + (A dt)²/6 + (A dt)³/24).
    A = np.eye(2) + continuous @ total
    return A, total @ np.array(plant.B), total @ np.array(plant.D), np.array(plant.Q), np.array(plant.R)


def quadratic_program(plant, s_0, z):
    """The optimal actions of a window as a bounded least-squares problem."""
    A, B, D, Q, R = matrices(plant)
    root, n = np.linalg.cholesky(Q).T, len(z)
    gain, free, rows, rest = np.zeros((2, n)), s_0.copy(), [], []
    for now, z_k in zip(np.eye(n), z, strict=True):
        rows += [root @ gain, np.sqrt(R[0, 0]) * now[None]]
        rest += [root @ free, np.zeros(1)]
        gain, free = A @ gain + B * now, A @ free + D[:, 0] * z_k
    return lsq_linear(np.concatenate(rows), -np.concatenate(rest), bounds=(-2.0, 2.0), tol=1e-14).x


class Scheduled:
    """A forecast of one's own: inputs that are known beforehand."""

    def __init__(self, inputs, dt):
        self.inputs, self.dt = inputs, dt

    def __call__(self, t, exogenous, n):
        first = round(t / self.dt)
        return self.inputs[:, first : first + n]


def test_plans_are_those_of_a_quadratic_program():
    state, inputs = 2.0 * drawn(PLANT, 3, 1)[0], PLANT.draw_exogenous(3, seeded(2))
    config = PredictiveConfig(horizon=1.0, tolerance=0.0, iterations=300)
    controller = RecedingHorizon(PLANT, PLANT.closure, config, forecast=Scheduled(inputs, PLANT.dt))
    found, bounded = controller.plan(0.4, state, inputs[:, 4]), 0
    for episode in range(3):
        wanted = quadratic_program(PLANT, state[episode].numpy(), inputs[episode, 4:14, 0].numpy())
        np.testing.assert_allclose(found[episode, :, 0].numpy(), wanted, atol=2e-4)
        bounded += (np.abs(wanted) > 2.0 - 1e-9).sum()
    assert bounded > 0


@pytest.mark.parametrize("name", ["held", "decaying"])
def test_its_forecast_is_that_of_the_inputs_met_and_is_kept(name):
    (state, exogenous), records = drawn(PLANT, 2, 2), PLANT.draw_exogenous(9, seeded(9)).cumsum(1)
    policy, again = control(forecast=name), control(forecast=name)
    held, before = (each.fly(state, exogenous).actions for each in (control(forecast="held"), policy))
    torch.testing.assert_close(before, held, rtol=0.0, atol=0.0)  # nothing is met yet
    policy.learn(records[:, :6])  # shorter than the window
    policy.learn(records)
    fitted = Decaying.fitted(records, dt=PLANT.dt, horizon=1.0)
    if name == "decaying":
        assert torch.equal(policy.forecast.mean, fitted.mean) and torch.equal(policy.forecast.time, fitted.time)
    again.load_state_dict(policy.state_dict())
    after = policy.fly(state, exogenous).actions
    assert torch.equal(again.fly(state, exogenous).actions, after)
    assert torch.equal(after, before) == torch.allclose(after, before, atol=1e-3) == (name == "held")


@pytest.mark.parametrize("horizon", [30.0, pytest.param(600.0, marks=pytest.mark.slow)])
def test_the_code_of_the_page_prints_what_its_table_says(horizon, capsys):
    """Of whole episodes; in shorter ones it is better than a wind that is held, as in the table."""
    (code,) = [block for block in blocks("planner.md", "python") if "RecedingHorizon" in block]
    costs = []
    for own in ("", ", forecast=forecast"):
        short = code.replace("WindTurbine()", f"WindTurbine(horizon={horizon})").replace(", forecast=forecast", own)
        run_code("planner.md", short)
        costs.append(float(capsys.readouterr().out))
    assert costs[1] < costs[0] and (horizon < 600.0 or costs[1] == pytest.approx(0.01182, abs=1e-5))


def test_a_long_horizon_is_the_linear_quadratic_regulator():
    plant = LinearQuadratic(horizon=3.0, noise=0.0)
    A, B, _, Q, R = matrices(plant)
    P = solve_discrete_are(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    config = PredictiveConfig(horizon=8.0, tolerance=0.0, iterations=500)
    controller = RecedingHorizon(plant, plant.closure, config)
    state = torch.tensor([[0.5, -0.3], [-0.2, 0.6]], dtype=torch.float64)
    flown = controller.fly(state, torch.zeros(2, plant.n_steps, 1, dtype=torch.float64))
    s = state.numpy().T
    for k in range(plant.n_steps):
        np.testing.assert_allclose(flown.actions[:, k].numpy().T, -K @ s, atol=1e-5)
        s = A @ s - B @ K @ s
    assert len(controller.solves) == 2 * plant.n_steps


# The cost of held commands, its gradient and its descent beside rollouts and a bounded least-squares problem.


class Untraceable(LinearQuadratic):
    """A plant whose running cost leaves torch."""

    def running_cost(self, t, state, applied, exogenous):
        assert state.isfinite().all().item()
        return super().running_cost(t, state, applied, exogenous)


class Ending(LinearQuadratic):
    def terminal_cost(self, state):
        return 3.0 * state[..., 0] ** 2


def by_rollout(plant, plan, state, exogenous, *, hold=1, start=0.0, penalty=PENALTY):
    """J and its gradient by autograd through every step."""
    n, (low, high) = len(exogenous), bounds(plant.actions)
    u = torch.from_numpy(plan).clone().requires_grad_()
    command = (low + (high - low) * u).repeat_interleave(hold, 0)[:n]
    rollout = Rollout(plant, constant(plant.closure), engine="autograd")
    flown = rollout(state[None], exogenous[None], command[None], start=start)
    t = start + plant.dt * torch.arange(n, dtype=torch.float64)
    cost = plant.running_cost(t, flown.states[0, :-1], flown.actions[0], exogenous).mean()
    ends = plant.terminal_cost(flown.states[0])
    cost = cost + (ends[-1] - ends[0]) / (n * plant.dt)
    cost = cost + penalty * ((command - flown.actions[0]) / (high - low)).square().sum(-1).mean()
    return cost.item(), torch.autograd.grad(cost, u)[0].numpy()


@pytest.mark.parametrize("hold, n", [(1, 12), (4, 9)])
@pytest.mark.parametrize("kind", [WindTurbine, LinearQuadratic, Untraceable, Ending])
def test_cost_and_gradient_are_those_of_a_rollout(kind, hold, n):
    plant = kind()
    states, inputs = drawn(plant, 3, 3)
    inputs = inputs[:, :n]
    cost = CommandCost(plant, constant(plant.closure), n, hold=hold)
    assert cost.shape == (-(-n // hold), len(plant.actions))
    plan = np.random.default_rng(0).random(cost.shape)
    for state, exogenous, start in zip(states, inputs, (0.0, 40.0, 0.0), strict=True):
        cost.begin(state, exogenous, start=start)
        found = cost(plan)
        wanted = by_rollout(plant, plan, state, exogenous, hold=hold, start=start)
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * np.abs(other).max())
