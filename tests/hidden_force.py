r"""A linear-quadratic control problem under partial observation, whose optimum is known without a training.

The oscillator of :mod:`linear_quadratic`, with two things that its policy does not see: the force follows the command
with a lag, :math:`\dot f = (a - f)/\tau`, and the disturbance is coloured, :math:`d_{k+1} = \rho d_k + w_k`. The policy
is a = −K (x, v). One command matters little: within its interval it changes the velocity by a ninth of what the
disturbance does.

With :math:`\xi = (x, v, f, d)` the closed loop is :math:`\xi_{k+1} = F_K \xi_k + (0, 0, 0, w_k)`. The expected cost of
an episode follows from two discrete Lyapunov equations, its minimum over K from a search over two numbers. scipy solves
both, and shares nothing with the library.
"""

import functools

import numpy as np
import torch
from linear_quadratic import LinearQuadratic
from scipy.linalg import expm, solve_discrete_lyapunov
from scipy.optimize import minimize

from rt_torchrl.plants.signal import Signal

LAG = 0.5  # s


class HiddenForce(LinearQuadratic):
    """See the module's docstring.

    Args:
        dt: control interval [s], a fifth of the lag and a sixtieth of the oscillator's period.
        horizon: length of an episode [s], ten periods.
        deviation: standard deviation of the disturbance [m/s^2].
        correlation_time: correlation time of the disturbance [s].
    """

    name = "hidden_force"
    states = (*LinearQuadratic.states, Signal(symbol="f", name="force", unit="N"))
    # Four standard deviations of the command under the optimal gain.
    actions = (Signal(symbol="a", name="command", unit="N", low=-5.0, high=5.0),)

    A = ((0.0, 1.0, 0.0), (-1.0, -0.3, 1.0), (0.0, 0.0, -1.0 / LAG))
    B = ((0.0,), (0.0,), (1.0 / LAG,))
    D = ((0.0,), (1.0,), (0.0,))
    Q = ((1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.0))
    true_closure = ((0.0, 0.0, 0.0), (-0.2, 0.1, 0.0), (0.0, 0.0, 0.0))

    def __init__(self, *, dt=0.1, horizon=60.0, deviation=1.0, correlation_time=2.0):
        super().__init__(dt=dt, horizon=horizon, noise=deviation)
        self.memory = float(np.exp(-dt / correlation_time))

    def observe(self, t, state, exogenous):
        return state[..., :2]

    def draw_initial_state(self, batch, generator):
        return 0.3 * super().draw_initial_state(batch, generator)

    def draw_exogenous(self, batch, generator):
        fresh = super().draw_exogenous(batch, generator)
        samples = [fresh[:, 0]]
        for k in range(1, self.n_steps):
            samples.append(self.memory * samples[-1] + (1.0 - self.memory**2) ** 0.5 * fresh[:, k])
        return torch.stack(samples, 1)


class Answer:
    r"""Expected costs of an episode of a :class:`HiddenForce` in closed form.

    With Σ_k the covariance of ξ_k and W that of (0, 0, 0, w_k), the mean S of Σ_0 … Σ_{n−1} fulfils

    .. math:: S = F_K S F_K^\top + W + (\Sigma_0 - \Sigma_n)/n, \qquad J(K) = \mathrm{tr}\,S\,(Q + K^\top R K)

    Args:
        plant: the plant; its matrices are read as numbers.
    """

    def __init__(self, plant):
        A, B, D, Q, self.R = (np.array(getattr(plant, name)) for name in "ABDQR")
        block = np.zeros((5, 5))
        block[:3] = np.hstack([A + np.array(plant.true_closure), B, D])
        held = expm(plant.dt * block)[:3]
        self.F, self.G = np.zeros((4, 4)), np.zeros((4, 1))
        self.F[:3, :3], self.F[:3, 3:], self.F[3, 3], self.G[:3] = held[:, :3], held[:, 4:], plant.memory, held[:, 3:4]
        self.W, self.Q, self.start = np.zeros((4, 4)), np.zeros((4, 4)), np.diag([0.09, 0.09, 0.09, plant.noise**2])
        self.W[3, 3], self.Q[:3, :3], self.n = plant.noise**2 * (1.0 - plant.memory**2), Q, plant.n_steps

    def closed(self, gain):
        """The gain on ξ and F_K, for a gain on (x, v) or on ξ."""
        K = np.zeros((1, 4))
        K[0, : np.size(gain)] = np.ravel(gain)
        return K, self.F - self.G @ K

    def cost(self, gain):
        """J(K) of an episode; infinite for a gain that is unstable.

        Args:
            gain: of (x, v), or of ξ.
        """
        K, F = self.closed(gain)
        if np.abs(np.linalg.eigvals(F)).max() >= 1.0:
            return np.inf
        settled, decay = solve_discrete_lyapunov(F, self.W), np.linalg.matrix_power(F, self.n)
        end = settled + decay @ (self.start - settled) @ decay.T
        mean = solve_discrete_lyapunov(F, self.W + (self.start - end) / self.n)
        return float(np.trace(mean @ (self.Q + K.T @ self.R @ K)))

    @functools.cached_property
    def gain(self):
        """The optimal gain of (x, v), shape (1, 2)."""
        # To the last digits, so that the gradient there is zero to what central differences can tell.
        found = minimize(self.cost, [1.0, 1.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-15})
        return found.x[None]

    def policy_gradient(self, gain, discount):
        r"""Half the mean of :math:`(dq/da)(da/dK)` over settled episodes, with the true q of discounted costs.

        A learner whose only error is its discount stays where this gradient is zero.
        """
        K, F = self.closed(gain)
        seen = solve_discrete_lyapunov(F, self.W)
        value = solve_discrete_lyapunov(discount**0.5 * F.T, self.Q + K.T @ self.R @ K)
        return ((self.R @ K - discount * self.G.T @ value @ F) @ seen)[0, :2]

    def excess(self, gain):
        """J(K)/J(K*) − 1."""
        return self.cost(gain) / self.cost(self.gain) - 1.0
