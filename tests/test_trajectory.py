"""Rollouts and costs against the matrix exponential and closed forms; what is refused."""

import math
import re

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from scipy.linalg import expm
from scipy.optimize import brentq
from seeds_and_numbers import double
from torchdiffeq import odeint

from rt_torchrl.plants.sampling import RK4_REAL_STABILITY, require_stable_step, rk4_step
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.trajectory import Trajectory, control_cost, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin

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


def drawn(plant, batch, seed=0):
    generator = torch.Generator().manual_seed(seed)
    state, exogenous = plant.draw_initial_state(batch, generator), plant.draw_exogenous(batch, generator)
    return state, exogenous, torch.randn(batch, plant.n_steps, 1, generator=generator, dtype=torch.float64)


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


def test_policy_in_the_loop_samples_and_holds():
    """With a = −K s_k held, s_{k+1} = (A_d − B_d K) s_k + B_d d_k."""
    plant, gain = LinearQuadratic(dt=0.02, horizon=3.0, noise=0.5), np.array([[0.8, 0.3]])
    state, exogenous, _ = drawn(plant, 2)
    flown = Rollout(plant, plant.closure, LinearGain(gain))(state, exogenous)
    # The Runge-Kutta error over time T: T dt⁴‖A‖⁵/120 with ‖A‖⁵ = 4, of a state of about 2: 3e-8.
    for row, (start, disturbance) in enumerate(zip(state.numpy(), exogenous[..., 0].numpy(), strict=True)):
        current = start
        for k, d in enumerate(disturbance):
            command = (-gain @ current).item()
            assert flown.actions[row, k, 0].item() == pytest.approx(command, abs=3e-8)
            current = held_solution(current, [command + d], 0.02)[-1]
        np.testing.assert_allclose(flown.states[row, -1].detach().numpy(), current, rtol=0, atol=3e-8)


@pytest.mark.parametrize("batch", [1, 4])
def test_engines_fly_the_same_trajectory(batch):
    plant = LinearQuadratic(horizon=2.0)
    state, exogenous, _ = drawn(plant, batch)
    policy = plant.make_policy(torch.Generator().manual_seed(1))
    flown = [Rollout(plant, plant.closure, policy, engine=engine)(state, exogenous) for engine in ENGINES]
    for other in flown[1:]:
        # One tableau, written by torchdiffeq in another order of operations.
        torch.testing.assert_close(other.states, flown[0].states, rtol=1e-13, atol=1e-14)
        torch.testing.assert_close(other.actions, flown[0].actions, rtol=1e-13, atol=1e-14)
    assert flown[0].states.shape == (batch, 21, 2) and flown[0].actions.shape == (batch, 20, 1)
    assert torch.equal(flown[0].states[:, 0], state)


class Clock(LinearQuadratic):
    """A plant that shows the policy the time, and whose cost depends on it."""

    def observe(self, t, state, exogenous):
        time = t.unsqueeze(-1).expand_as(state[..., :1])
        return torch.cat([time, exogenous.expand_as(time)], -1)

    def running_cost(self, t, state, applied, exogenous):
        return t.expand_as(state[..., 0])


@pytest.mark.parametrize("engine", ENGINES)
def test_time_and_inputs_reach_the_policy_and_the_cost(engine):
    plant = Clock(dt=0.25, horizon=2.0, noise=1.0)
    state, exogenous, _ = drawn(plant, 2)
    flown = Rollout(plant, plant.closure, LinearGain([[-1.0, -1.0]]), engine=engine)(state, exogenous, start=3.0)
    t = 3.0 + 0.25 * torch.arange(8, dtype=torch.float64)
    torch.testing.assert_close(flown.actions[..., 0], t + exogenous[..., 0], rtol=1e-15, atol=1e-15)
    # Mean of 3, 3.25, ..., 4.75.
    torch.testing.assert_close(control_cost(plant, flown), t.new_full((2,), 3.875))


def test_control_cost_of_a_decaying_state():
    """s = (e^{−t}, 0), a = 2e^{−t}: J_a = (Q₁₁ + 4R) mean e^{−2t_k}, a geometric sum over k = 0 ... n − 1."""
    plant, n, h = LinearQuadratic(dt=0.1, horizon=4.0), 40, 0.1
    t = h * torch.arange(n + 1, dtype=torch.float64)
    states = torch.stack([torch.exp(-t), torch.zeros(n + 1)], -1).double().unsqueeze(0)
    flown = Trajectory(states, 2.0 * states[:, :-1, :1], torch.zeros(1, n, 1, dtype=torch.float64))
    ratio = math.exp(-2 * h)
    expected = (1.0 + 4.0 * 0.1) * (1 - ratio**n) / (1 - ratio) / n
    cost = control_cost(plant, flown)
    assert cost.item() == pytest.approx(expected, rel=1e-13)  # 40 roundings


def test_identification_cost_of_a_growing_error():
    """Error (t, 0): J_p = dt Σ ½t_k² over k = 1 ... n = ½dt³ n(n + 1)(2n + 1)/6; the start does not count."""
    plant, n, h = LinearQuadratic(dt=0.1, horizon=4.0), 40, 0.1
    states = torch.randn(2, n + 1, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    error = torch.stack([h * torch.arange(n + 1), torch.zeros(n + 1)], -1).double()
    error[0] = 7.0
    cost = identification_cost(plant, Trajectory(states, states[:, :-1, :1], states[:, :-1, :1]), states + error)
    expected = 0.5 * h**3 * n * (n + 1) * (2 * n + 1) / 6
    # Differences of numbers of order four: 1e-15 of them; dt in single precision would give 1e-8.
    torch.testing.assert_close(cost, torch.full((2,), expected, dtype=torch.float64), rtol=1e-6, atol=0)


def test_twin_replays_and_controls_with_its_own_closure():
    plant = LinearQuadratic(horizon=2.0)
    closure = LinearClosure([[0.0, 0.0], [0.5, 0.0]])
    twin, policy = DigitalTwin(plant, closure), LinearGain([[0.3, 0.1]])
    state, exogenous, command = drawn(plant, 2)
    for found, expected in (
        (twin.replay(state, exogenous, command), Rollout(plant, closure)(state, exogenous, command)),
        (twin.control(policy, state, exogenous), Rollout(plant, closure, policy)(state, exogenous)),
    ):
        assert torch.equal(found.states, expected.states) and torch.equal(found.actions, expected.actions)
    with torch.no_grad():
        other = twin.replay(state, exogenous, command).states
        closure.matrix += 0.1
        assert not torch.equal(other, twin.replay(state, exogenous, command).states)


def test_tensors_that_come_again_are_read_anew(unchecked):
    """A rollout holds the drive of its last call, but no numbers of it."""
    plant = LinearQuadratic(horizon=1.0)
    (state, exogenous, command), closure = drawn(plant, 3), LinearClosure(torch.zeros(2, 2))
    native, exact = (Rollout(plant, closure, engine=engine) for engine in ("native", "autograd"))
    for change in (lambda: None, lambda: command.numpy().__imul__(2.0), lambda: exogenous.add_(1.0), state.neg_):
        change()
        for _ in range(2):
            costs = native.costs(state, exogenous, command)
            torch.testing.assert_close(costs, exact.costs(state, exogenous, command), rtol=1e-12, atol=1e-12)
    command.data = command.roll(1, 0)
    torch.testing.assert_close(native.costs(state, exogenous, command), exact.costs(state, exogenous, command))
    commands = command.requires_grad_()
    assert torch.autograd.grad(native.costs(state, exogenous, commands).sum(), commands)[0].abs().max() > 0.0
    exogenous[0, 0, 0] = math.nan
    with pytest.raises(ValueError, match="exogenous holds NaN"):
        native.costs(state, exogenous, command)
    with pytest.raises(ValueError, match="exogenous has shape"):
        native.costs(state, exogenous[:2], command)


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
