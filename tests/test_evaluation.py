"""The reference optimum, on the plant where the best gain is known, and what cannot be flown."""

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic, optimal_gain
from test_classical import PD
from test_real_system import connected

from rt_torchrl.evaluation.limits import exact_optimum
from rt_torchrl.evaluation.real_episodes import RealEpisodes
from rt_torchrl.evaluation.unseen import RealController, UnseenEpisodes


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


class OnlyReal(RealController):
    """A controller that nobody flies here."""

    def fly_real(self, count, *, seed):
        raise AssertionError


def test_a_controller_of_another_kind_of_episodes_is_refused():
    plant = LinearQuadratic()
    with pytest.raises(ValueError, match="law=OnlyReal can only be flown on a real system; give a ClassicalController"):
        UnseenEpisodes(plant, 2).fly_baseline(OnlyReal(plant))
    with pytest.raises(ValueError, match="law=PD is flown on the plant.*give a RealController"):
        RealEpisodes(connected(plant), 2).fly_baseline(PD(plant))


def test_without_a_true_closure_nothing_is_flown_in_simulation():
    unseen = UnseenEpisodes(LinearQuadratic(), 2)
    unseen.closure = None
    with pytest.raises(ValueError, match="the true closure of plant 'linear_quadratic' is not known"):
        unseen.fly(LinearGain(optimal_gain(1.0)))
