"""Rollouts, costs, steps and the digital twin: the matrix exponential, closed forms, backpropagation."""

import copy
import math
import re
from unittest import mock

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from scipy.linalg import expm
from scipy.optimize import brentq
from seeds_and_numbers import double, seeded
from seeds_and_numbers import drawn as episodes_of
from torch import nn
from torchdiffeq import odeint

from rt_torchrl import AssimilationConfig, DigitalTwin, DivergenceError, Rollout, identification_cost, shipped_plants
from rt_torchrl.contract.methods import random_commands
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from rt_torchrl.plants.sampling import RK4_REAL_STABILITY, require_stable_step, rk4_step
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.trajectories import twin as twin_module
from rt_torchrl.trajectories.engines import parallel
from rt_torchrl.trajectories.trajectory import Trajectory, pieces_of_equal_length

ENGINES = ("parallel", "odeint_adjoint", "autograd")
A, B = np.array(LinearQuadratic.A) + np.array(LinearQuadratic.true_closure), np.array(LinearQuadratic.B)


def held_solution(state, inputs, dt):
    """Exact states at every dt for u = a + d held: exp of the augmented matrix (Van Loan)."""
    block = np.zeros((3, 3))
    block[:2, :2], block[:2, 2:] = A, B
    transition = expm(block * dt)
    states = [state]
    for u in inputs:
        states.append(transition[:2, :2] @ states[-1] + transition[:2, 2] * u)
    return np.array(states)


def drawn(plant, batch):
    return *episodes_of(plant, batch), torch.randn(batch, plant.n_steps, 1, generator=seeded(9), dtype=torch.float64)


@pytest.mark.parametrize("engine", ENGINES)
def test_converges_to_the_matrix_exponential(engine):
    """Commands and disturbances held over 0.4 s, integrated in 1, 2, 4 steps: order 4 to the exact solution."""
    coarse = LinearQuadratic(dt=0.4, horizon=8.0, noise=0.5)
    state, exogenous, command = drawn(coarse, 3)
    exact = np.stack(
        [held_solution(s, u, 0.4) for s, u in zip(state.numpy(), (exogenous + command)[..., 0].numpy(), strict=True)]
    )
    errors = []
    for factor in (1, 2, 4):
        plant = LinearQuadratic(dt=0.4 / factor, horizon=8.0)
        inputs = [x.repeat_interleave(factor, 1) for x in (exogenous, command)]
        states = Rollout(plant, plant.closure, engine=engine)(state, *inputs).states.detach()
        errors.append(np.abs(states[:, ::factor].numpy() - exact).max())
    # Order 4 + O(dt), seen within 0.15 at the finest pair.
    assert math.log2(errors[1] / errors[2]) == pytest.approx(4.0, abs=0.15), errors
    # dt⁴/120 over 8 s for states and inputs of about 2: 1.3e-5.
    assert errors[2] < 3e-5


def test_segments_are_parts_on_the_clock_of_the_plant():
    plant = LinearQuadratic(horizon=1.0)
    state, exogenous, command = drawn(plant, 2)
    flown = Rollout(plant, plant.closure)(state, exogenous, command, start=3.0)._replace(seen=torch.rand(2, 11) > 0.5)
    segments = flown.segments(4, plant.dt).each()  # the last two intervals are left out
    parts = [flown.rows(k).part(first, first + 4, plant.dt) for k in (0, 1) for first in (0, 4)]
    assert [part.start for part in parts] == [3.0, 3.4, 3.0, 3.4] == [segment.start for segment in segments]
    for part, segment in zip(parts, segments, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(part, segment, strict=True) if isinstance(a, torch.Tensor))
        assert part.states.shape == (5, 2) and part.seen.shape == (5,) and part.actions.shape == (4, 1)


@pytest.mark.parametrize(
    ("lengths", "pieces"), [((50, 1, 50), [50, 50]), ((40, 50), [40, 40]), ((3, 9), [3] * 4), ((120, 50), [50] * 3)]
)
def test_an_episode_that_ended_at_once_cuts_no_other_record_to_pieces(lengths, pieces):
    records = [Trajectory(*(torch.zeros(n + k, 1) for k in (1, 0, 0))) for n in lengths]
    assert [len(piece.actions) for piece in pieces_of_equal_length(records, 50, 0.1)] == pieces


@pytest.mark.parametrize("engine", ENGINES)
def test_divergence_says_where_and_with_which_weights(engine):
    """A cubic feedback explodes in realisation 1, which starts far out; realisation 0 rests."""

    class Explosive(LinearClosure):
        def forward(self, features):
            return features**3

    plant = LinearQuadratic()
    state = torch.tensor([[0.0, 0.0], [100.0, 0.0]], dtype=torch.float64)
    zeros = torch.zeros(2, 50, 1, dtype=torch.float64)
    message = (
        r"plant 'linear_quadratic' diverged in realisation 1 at t = 10\.\d s: \w+ is not finite; the state "
        r"before was \[.*\], the weights those of Explosive\. Use a smaller dt"
    )
    with pytest.raises(DivergenceError, match=message):
        Rollout(plant, Explosive(plant.true_closure), engine=engine)(state, zeros, zeros, start=10.0)


# The Runge-Kutta step against torchdiffeq, a closed solution and the stability function


def test_stability_limit_is_the_root_of_the_stability_function():
    root = brentq(lambda x: -x + x**2 / 2 - x**3 / 6 + x**4 / 24, 2.0, 3.5)
    # Cut to three decimals, downwards, so that the limit itself is stable.
    assert 0.0 < root - RK4_REAL_STABILITY < 1e-3

    def amplification(rate):
        return abs(rk4_step(lambda t, s: -rate * s, double(0.0).squeeze(), double(1.0), 1.0).item())

    assert amplification(RK4_REAL_STABILITY) < 1.0 < amplification(RK4_REAL_STABILITY + 1e-3)


@pytest.mark.parametrize("rate", [10.0, 7.0, 0.0606])
def test_unstable_steps_are_refused_with_advice_that_works(rate):
    arguments = {"mode": "the valve", "remedy": "a slower valve"}
    with pytest.raises(ValueError, match="makes plant 'tank' unstable: the valve decays .* or a slower valve") as error:
        require_stable_step("tank", 3.0 / rate, rate, **arguments)
    advised = float(re.search(r"Use dt <= (\S+) s", str(error.value))[1])
    require_stable_step("tank", advised, rate, **arguments)
    # Three digits, and not over-cautious.
    assert advised * rate > 0.985 * RK4_REAL_STABILITY


# The digital twin: the weights that vary when it replays and when a policy is planned on it.


def twin_and_policy():
    plant = LinearQuadratic(horizon=1.0)
    twin = DigitalTwin(plant, LinearClosure(0.1 * torch.randn(2, 2, generator=seeded())))
    return twin, plant.make_policy(seeded(1)), episodes_of(plant, 3, seed=2)


def test_planning_holds_the_closure_constant_and_changes_no_gradient_of_the_policy():
    twin, policy, episodes = twin_and_policy()
    twin.cost(policy, *episodes).backward()
    planned = [w.grad.clone() for w in policy.parameters()]
    assert all(w.grad is None and w.requires_grad for w in twin.closure.parameters())
    # Independent of the engines: the plant's step in a loop, with a closure of its own that is differentiated too.
    law, (state, exogenous), total = copy.deepcopy(twin.closure), episodes, 0.0
    weights = [*policy.parameters(), *law.parameters()]
    for k in range(twin.plant.n_steps):
        t, z = torch.tensor(k * twin.plant.dt), exogenous[:, k]
        action = policy(state)
        total = total + twin.plant.running_cost(t, state, action, z).mean() / twin.plant.n_steps
        state = twin.plant.step(t, state, action, z, law).state
    expected = torch.autograd.grad(total, weights)
    for found, exact in zip(planned, expected, strict=False):
        torch.testing.assert_close(found, exact)
    assert expected[-1].abs().max() > 0.0


class Scaled(LinearClosure):
    """A closure with a number that is no weight."""

    scale = 1.0

    def forward(self, features):
        return self.scale * super().forward(features)


CHANGES = {
    "an attribute": lambda closure: setattr(closure, "scale", 2.0),
    "another weight": lambda closure: setattr(closure, "matrix", nn.Parameter(2.0 * closure.matrix.detach())),
    "a frozen weight": lambda closure: closure.requires_grad_(False),
    "a hook": lambda closure: closure.register_forward_hook(lambda module, features, found: 2.0 * found),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_twin_is_planned_on_with_the_closure_it_has_now(change):
    twin, policy, episodes = twin_and_policy()
    twin.closure = Scaled(twin.closure.matrix.detach())
    before = twin.cost(policy, *episodes)
    CHANGES[change](twin.closure)
    found = twin.cost(policy, *episodes)
    fresh = DigitalTwin(twin.plant, copy.deepcopy(twin.closure)).cost(policy, *episodes)
    assert torch.equal(found, fresh) and (change == "a frozen weight" or not torch.equal(found, before))


# Forward sensitivities and Levenberg-Marquardt against backpropagation and known minima


def recorded(plant, batch=3, seed=0):
    """A true trajectory under random commands, and a twin that starts from the wrong closure."""
    generator = torch.Generator().manual_seed(seed)
    command = random_commands(plant, (batch, plant.n_steps), generator)
    exogenous = plant.draw_exogenous(batch, generator)
    start = plant.draw_initial_state(batch, generator)
    with torch.no_grad():
        flown = Rollout(plant, plant.closure)(start, exogenous, command)
    return DigitalTwin(plant, plant.make_closure(generator)), flown, exogenous


@pytest.mark.parametrize("piece", [parallel.PIECE, 7], ids=["at once", "in pieces"])
@pytest.mark.parametrize("plant", [LinearQuadratic(), WindTurbine(horizon=30.0)], ids=lambda plant: plant.name)
def test_gradient_and_states_are_those_of_backpropagation(plant, piece, monkeypatch):
    monkeypatch.setattr(parallel, "PIECE", piece)  # no divisor of the intervals: the last piece overlaps
    twin, flown, exogenous = recorded(plant)
    found = Assimilation(twin, AssimilationConfig()).likelihood(flown).normal_equations()
    rollout = Rollout(plant, twin.closure, engine="autograd")
    cost = identification_cost(plant, rollout(flown.states[:, 0], exogenous, flown.actions), flown.states).mean()
    gradient = torch.cat([g.flatten() for g in torch.autograd.grad(cost, list(twin.closure.parameters()))])
    # The same derivatives, forward instead of backward: rounding over at most 60 steps.
    assert found.cost.item() == pytest.approx(cost.item(), rel=1e-12)
    assert ((found.gradient - gradient).norm() / gradient.norm()).item() < 1e-10


@pytest.mark.parametrize("kind", [LinearQuadratic, *shipped_plants().values()], ids=lambda kind: kind.name)
def test_they_are_machine_code_on_every_plant(kind, monkeypatch):
    """Without it an assimilation takes ten times as long. A frozen weight has no column, and may be freed again."""
    plant = kind(horizon=4 * kind().dt)
    twin, flown, exogenous = recorded(plant)
    monkeypatch.setattr(twin_module, "over_all", None)
    closure, given = twin.closure, (flown.states[:, 0], exogenous, flown.actions)
    _, whole = twin.sensitivities(*given)
    first = next(closure.parameters())
    first.requires_grad_(False)
    if any(w.requires_grad for w in closure.parameters()):
        torch.testing.assert_close(twin.sensitivities(*given)[1], whole[..., first.numel() :])
    first.requires_grad_(True)
    torch.testing.assert_close(twin.sensitivities(*given)[1], whole)


class Solved(LinearQuadratic):
    """The oracle plant, whose rates solve equations M(s) ds/dt = M(s) f, as those of bodies with joints do."""

    def vector_field(self, t, state, action, exogenous, closure):
        rates = super().vector_field(t, state, action, exogenous, closure)
        M = torch.diag_embed(2.0 + state.cos()) + 0.1 * state.unsqueeze(-1) * state.unsqueeze(-2)
        return torch.linalg.solve(M, (M @ rates.unsqueeze(-1)).squeeze(-1))


class Stiffness(nn.Module):
    """p = (0, c s_1) with one number c, of no dimension."""

    def __init__(self):
        super().__init__()
        self.c = nn.Parameter(torch.tensor(-0.2, dtype=torch.float64))

    def forward(self, features):
        return torch.stack([torch.zeros_like(features[..., 0]), self.c * features[..., 0]], -1)


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize(("kind", "number"), [(Solved, False), (LinearQuadratic, True)])
def test_rates_may_solve_linear_equations_and_a_weight_may_have_no_dimension(kind, number, native, monkeypatch):
    """With gradients off, PyTorch mixes the rows in batched Jacobians of a solution."""
    twin, flown, exogenous = recorded(LinearQuadratic(horizon=1.0))
    twin.closure.load_state_dict({"matrix": torch.tensor([[0.0, 0.0], [-0.2, 0.0]]).double()})
    own = DigitalTwin(kind(horizon=1.0), Stiffness() if number else twin.closure)
    if not native:
        monkeypatch.setattr(own.sensitivities._engine, "native_end_states", lambda *given: None)
    given = flown.states[:, 0], exogenous, flown.actions
    states, whole = twin.sensitivities(*given)  # by the four numbers of the matrix, of which the third is c
    for found, expected in zip(own.sensitivities(*given), (states, whole[..., 2:3] if number else whole), strict=True):
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("segment", [0, 1, 7])
def test_a_replay_begins_anew_in_each_segment_and_is_no_number_where_it_diverges(segment):
    """Errors grow from where a replay begins; the last interval of a record has an input that no twin survives."""
    twin, flown, exogenous = recorded(LinearQuadratic(horizon=1.0), batch=1)
    record = flown._replace(exogenous=exogenous).each()[0]
    found, n = twin.replayed(record, segment), len(record.actions)
    for k in range(1, n + 1):
        first = (k - 1) // segment * segment if segment else 0
        rows = slice(first, k)
        end = twin.replay(record.states[first, None], exogenous[:, rows], flown.actions[:, rows]).states[0, -1]
        torch.testing.assert_close(found[k], end)
    wild = record._replace(
        exogenous=torch.cat([record.exogenous[:-1], torch.full((1, 1), 1.7e308, dtype=torch.float64)])
    )
    lost = twin.replayed(wild, segment)
    first = (n - 1) // segment * segment if segment else 0
    assert lost[first + 1 :].isnan().all() and torch.equal(lost[: first + 1], found[: first + 1])


class Residuals(nn.Module):
    """Two weights, and residuals r(w) whose half square is the cost."""

    def __init__(self, residuals, start):
        super().__init__()
        self.residuals, self.w = residuals, nn.Parameter(double(*start))

    def equations(self):
        w = self.w.detach()
        r, J = self.residuals(w), torch.autograd.functional.jacobian(self.residuals, w)
        return NormalEquations(0.5 * r @ r, J.T @ r, J.T @ J)


def valley(*start):
    """Rosenbrock's valley, in which gradient steps hardly move."""
    return Residuals(lambda w: torch.stack([w[0] - 1.0, 10.0 * (w[1] - w[0] ** 2)]), start)


def test_a_step_never_raises_the_cost_and_the_valley_is_followed():
    module = valley(-1.2, 1.0)
    optimiser, last = LevenbergMarquardt(module), float("inf")
    for _ in range(60):
        found = optimiser.run(module.equations, 1)
        assert found.best <= min(found.start, last)
        last = found.best
    torch.testing.assert_close(module.w.detach(), torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-6)


def test_a_trial_that_diverges_is_taken_back():
    module = valley(-1.2, 1.0)
    equations = mock.Mock(side_effect=[module.equations(), *[FloatingPointError] * 3])
    optimiser = LevenbergMarquardt(module, damping=1.0)
    optimiser.run(equations, 3)
    assert module.w.tolist() == [-1.2, 1.0]
    assert optimiser.damping == pytest.approx(2.0 * 4.0 * 8.0)


def test_a_cost_that_the_weights_cannot_lower_ends_the_run():
    module = valley(1.0, 1.0)
    cost, gradient, matrix = module.equations()
    # What noise leaves of the cost at its minimum, and a gradient that is rounding beside it.
    equations = mock.Mock(return_value=NormalEquations(cost + 1.0, gradient + 1e-9, matrix))
    found = LevenbergMarquardt(module).run(equations, 15)
    assert (equations.call_count, found.iterations, found.best) == (1, 0, 1.0)


def test_a_weight_that_is_hardly_known_does_not_hold_up_the_others():
    """The sum of two weights is well known, the second one alone hardly, and at its best 100.

    The whole step to (−99.5, 100), cut to a length of 1, would leave 99 % of the first residual.
    """
    module = Residuals(lambda w: torch.stack([w.sum() - 0.5, 0.01 * w[1] - 1.0]), (0.0, 0.0))
    LevenbergMarquardt(module).run(module.equations, 1)
    assert (module.w.sum() - 0.5).abs() < 0.05
    assert 0.1 < module.w.abs().max() <= 1.0


def forced_pendulum(t, state):
    angle, rate = state.unbind(-1)
    return torch.stack([rate, -torch.sin(angle) - 0.2 * rate * rate.abs() + torch.cos(3.0 * t)], -1)


def test_equals_torchdiffeq():
    start = torch.randn(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    times = 0.7 + 0.1 * torch.arange(21, dtype=torch.float64)
    expected = odeint(forced_pendulum, start, times, method="rk4")
    state = start
    for t, reference in zip(times[:-1], expected[1:], strict=True):
        state = rk4_step(forced_pendulum, t, state, 0.1)
        # The same formula; only the rounding of t + h/3 and of the sums differs, over at most 20 steps.
        torch.testing.assert_close(state, reference, rtol=1e-13, atol=1e-14)
