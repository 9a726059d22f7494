r"""The oracle plant: linear dynamics and quadratic costs, so that rollouts, costs and optimal gains have closed forms.

.. math:: \dot s = A s + B a + D z + p, \qquad L_a = s^\top Q s + a^\top R a, \qquad p = C s

with the closure C the unknown part of the dynamics. With A and B in real-Jordan form nothing here is shared with the
library's solvers: the tests compute matrix exponentials and Riccati solutions with scipy.
"""

import numpy as np
import torch
from scipy.linalg import expm, solve_discrete_are, solve_discrete_lyapunov
from torch import nn

from rt_torchrl import Plant, Signal


class LinearClosure(nn.Module):
    """p = C s."""

    def __init__(self, matrix):
        super().__init__()
        self.matrix = nn.Parameter(torch.as_tensor(matrix, dtype=torch.float64))

    def forward(self, features):
        return (features.unsqueeze(-2) * self.matrix).sum(-1)


class LinearGain(nn.Module):
    """a = −K e."""

    def __init__(self, gain):
        super().__init__()
        self.gain = nn.Parameter(torch.as_tensor(gain, dtype=torch.float64))

    def forward(self, observation):
        return -(observation.unsqueeze(-2) * self.gain).sum(-1)


class Constant(nn.Module):
    """A policy that always commands the same."""

    def __init__(self, *values):
        super().__init__()
        self.values = nn.Parameter(torch.tensor(values, dtype=torch.float64))

    def forward(self, observation):
        return self.values.expand(*observation.shape[:-1], -1)


class LinearQuadratic(Plant):
    """A damped oscillator with one force; see the module's docstring."""

    name = "linear_quadratic"
    states = (
        Signal(symbol="x", name="position", unit="m"),
        Signal(symbol="v", name="velocity", unit="m/s"),
    )
    actions = (Signal(symbol="a", name="force", unit="N", low=-2.0, high=2.0),)
    inputs = (Signal(symbol="d", name="disturbance", unit="m/s^2"),)
    observations = (
        Signal(symbol="e_1", name="position_error", unit="-"),
        Signal(symbol="e_2", name="velocity_error", unit="-"),
    )

    A = ((0.0, 1.0), (-1.0, -0.3))
    B = ((0.0,), (1.0,))
    D = ((0.0,), (1.0,))
    Q = ((1.0, 0.0), (0.0, 0.5))
    R = ((0.1,),)
    true_closure = ((0.0, 0.0), (-0.2, 0.1))

    def __init__(self, *, dt=0.1, horizon=5.0, noise=0.05):
        super().__init__(dt=dt, horizon=horizon, closure=LinearClosure(self.true_closure))
        self.noise = noise
        for name in "ABDQR":
            self.register_buffer(f"_{name}", torch.tensor(getattr(self, name), dtype=torch.float64))

    def vector_field(self, t, state, action, exogenous, closure):
        force = (exogenous.unsqueeze(-2) * self._D).sum(-1)
        return (
            (state.unsqueeze(-2) * self._A).sum(-1) + (action.unsqueeze(-2) * self._B).sum(-1) + force + closure(state)
        )

    def observe(self, t, state, exogenous):
        return state

    def running_cost(self, t, state, applied, exogenous):
        quadratic = (state.unsqueeze(-2) * self._Q).sum(-1) * state
        return quadratic.sum(-1) + ((applied.unsqueeze(-2) * self._R).sum(-1) * applied).sum(-1)

    def draw_initial_state(self, batch, generator):
        return torch.randn(batch, len(self.states), generator=generator, dtype=torch.float64)

    def draw_exogenous(self, batch, generator):
        return self.noise * torch.randn(batch, self.n_steps, 1, generator=generator, dtype=torch.float64)

    def make_closure(self, generator):
        start = torch.tensor(self.true_closure, dtype=torch.float64)
        return LinearClosure(start + 0.3 * torch.randn(start.shape, generator=generator, dtype=torch.float64))

    def make_policy(self, generator):
        shape = len(self.actions), len(self.observations)
        return LinearGain(0.1 * torch.randn(shape, generator=generator, dtype=torch.float64))


class Slewing(LinearQuadratic):
    """The same with a motor that changes its force by at most 0.1 N in an interval, from the last one, a state."""

    states = (*LinearQuadratic.states, Signal(symbol="a", name="force", unit="N"))
    controller_states = ("force",)

    def actuate(self, state, command):
        return torch.maximum(torch.minimum(command, state[..., 2:3] + 0.1), state[..., 2:3] - 0.1)

    def latch(self, state, applied):
        return torch.cat([state[..., :2], applied, state[..., 3:]], -1)

    def vector_field(self, t, state, action, exogenous, closure):
        rates = super().vector_field(t, state[..., :2], action, exogenous, closure)
        return torch.cat([rates, torch.zeros_like(action)], -1)

    def observe(self, t, state, exogenous):
        return state[..., :2]

    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state[..., :2], applied, exogenous)


def discretised():
    """Exact A_d, B_d over one interval, and the weights."""
    A, B, Q, R = (np.array(getattr(LinearQuadratic, name)) for name in "ABQR")
    block = np.zeros((3, 3))
    block[:2, :2], block[:2, 2:] = A + np.array(LinearQuadratic.true_closure), B
    transition = expm(0.1 * block)
    return transition[:2, :2], transition[:2, 2:], Q, R


def optimal_gain(gamma):
    """Infinite-horizon gain of Σ γ^k (sᵀQs + aᵀRa): the Riccati equation of √γA_d, √γB_d."""
    A, B, Q, R = discretised()
    A, B = np.sqrt(gamma) * A, np.sqrt(gamma) * B
    P = solve_discrete_are(A, B, Q, R)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def discounted_cost(gain, gamma):
    """Mean of Σ γ^k L_a over starts of unit covariance, by a Lyapunov equation."""
    A, B, Q, R = discretised()
    closed = np.sqrt(gamma) * (A - B @ gain)
    return np.trace(solve_discrete_lyapunov(closed.T, Q + gain.T @ R @ gain))
