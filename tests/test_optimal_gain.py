"""Step 2 finds the optimal linear gain, which a Riccati equation knows, by every learner with a critic."""

import numpy as np
import pytest
import test_ddpg
import test_td3
from linear_quadratic import LinearQuadratic
from scipy.linalg import expm, solve_discrete_are, solve_discrete_lyapunov
from test_ddpg import GAMMA, explored, filled

from rt_torchrl.twinning.learners import TD3Config


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


@pytest.mark.parametrize(
    ("learner", "updates", "options"),
    [
        # Measured at the end: 0.07 to 0.09 of ‖K*‖.
        pytest.param(test_ddpg.learner, 45, {"actor_iterations": 20, "actor_rate": 0.02}, id="ddpg"),
        # The lower of two critics leans towards small actions.
        pytest.param(
            test_td3.learner,
            30,
            {"td3": TD3Config(smoothing=0.05, smoothing_limit=0.1), "actor_rate": 0.01},
            id="td3",
        ),
    ],
)
def test_policy_finds_the_optimal_gain(learner, updates, options, unchecked):
    """On 5000 transitions of a noise-free plant."""
    best = optimal_gain(GAMMA)
    critic = {"critic_hidden": (64, 64), "critic_iterations": 100, "critic_rate": 3e-3, "target_rate": 0.05}
    found = learner(batch_size=256, **critic, **options)
    start, data = found.policy.gain.detach().numpy().copy(), explored(1000, spread=1.0)
    filled(data, found, prioritisation=0.0)
    for _ in range(updates):
        found.update()
    gain = found.policy.gain.detach().numpy()
    # ‖K − K*‖/‖K*‖ from 0.87. The critics are perceptrons, no quadratic forms, and wander with Adam's steps. The cost
    # is flat at its minimum.
    assert np.linalg.norm(start - best) > 0.8 * np.linalg.norm(best)
    assert np.linalg.norm(gain - best) < 0.15 * np.linalg.norm(best)
    assert 1.0 <= discounted_cost(gain, GAMMA) / discounted_cost(best, GAMMA) < 1.01
