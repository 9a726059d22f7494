"""The reference optimum, on the plant where the best gain is known."""

import torch
from linear_quadratic import LinearGain, LinearQuadratic
from test_ddpg import optimal_gain

from rt_torchrl.evaluation.unseen import UnseenEpisodes, exact_optimum


def random_gain(generator):
    return LinearGain(torch.randn(1, 2, generator=generator, dtype=torch.float64))


def test_the_reference_reaches_the_riccati_gain_from_every_start():
    unseen = UnseenEpisodes(LinearQuadratic(noise=0.0), 8)
    best = unseen.control_costs(LinearGain(optimal_gain(1.0))).mean().item()
    found = exact_optimum(unseen, random_gain, starts=3, iterations=25, few=3, polish=10)
    # Over 5 s instead of for ever, and for these starts, a gain can be a little better than Riccati's.
    assert 0.98 * best < found.cost <= best
    assert found.cost == unseen.control_costs(found.policy).mean().item()
    assert max(found.costs) < 1.001 * min(found.costs)  # on the few, a quadratic-like cost of one minimum
