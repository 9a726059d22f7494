"""TD3: the lower of two target critics, smoothed targets, a delayed policy."""

import copy

import numpy as np
import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from test_ddpg import GAMMA, GAMMA_IN_TORCHRL, explored, filled, seeded

from rt_torchrl.twinning.learners import TD3, LearnerConfig
from rt_torchrl.twinning.learners.config import TD3Config


def learner(seed=0, td3=None, **options):
    options = {"discount": GAMMA, "critic_hidden": (16,), "batch_size": 32, **options}
    config = LearnerConfig(algorithm="td3", td3=td3 or TD3Config(smoothing=0.0), **options)
    return TD3(LinearQuadratic(), LinearGain([[0.2, 0.1]]), config, generator=seeded(seed))


def critics(found, *, target):
    """The two critics, or their targets, as plain modules."""
    weights = found.loss.target_qvalue_network_params if target else found.loss.qvalue_network_params
    modules = []
    for k in range(2):
        module = copy.deepcopy(found.critics[k])
        named = weights[k].flatten_keys(".")
        with torch.no_grad():
            for name, weight in module.named_parameters():
                weight.copy_(named["module." + name])
        modules.append(module)
    return modules


def test_the_critics_start_apart_and_from_the_generator():
    one, other = (critics(learner(), target=False) for _ in range(2))
    assert torch.equal(one[0].network[0].weight, other[0].network[0].weight)
    assert not torch.equal(one[0].network[0].weight, one[1].network[0].weight)


def test_the_target_is_the_lower_of_two_at_the_delayed_policys_action():
    """max_i |r + γ min_j q_j′(e′, π′(e′)) − q_i(e, a)| by hand, without noise."""
    found, data = learner(target_rate=0.3, critic_iterations=20), explored(10)
    filled(data, found)
    found.update()
    first = data[:6].clone()
    following, reward = first["next", "observation"], first["next", "reward"]
    delayed = LinearGain(found.loss.target_actor_network_params.flatten_keys(".")["module.gain"].detach())
    assert not torch.equal(delayed.gain, found.policy.gain)
    with torch.no_grad():
        values = [q(following, delayed(following)) for q in critics(found, target=True)]
        y = reward + GAMMA_IN_TORCHRL * torch.minimum(*values)
        deltas = [(y - q(first["observation"], first["action"])).abs() for q in critics(found, target=False)]
    expected = torch.maximum(*deltas)[:, 0]
    torch.testing.assert_close(found.td_errors(first), expected, rtol=1e-10, atol=1e-12)


def test_smoothing_moves_targets_by_no_more_than_its_limit():
    """Noise of at most 10 % of half the range moves |δ| less than noise of up to twice that half."""
    data = explored(40)
    quiet = learner().td_errors(data)
    limits = 0.1, 2.0
    gaps = [
        (learner(td3=TD3Config(smoothing=1.0, smoothing_limit=limit)).td_errors(data) - quiet).abs().max()
        for limit in limits
    ]
    # The perceptrons are nearly linear over so short a way: the ratio of the limits, within a factor of two.
    assert gaps[0] > 0.0 and 0.5 * limits[1] / limits[0] / 2.0 < gaps[1] / gaps[0] < 2.0 * limits[1] / limits[0]


def test_smoothing_is_drawn_from_the_learners_generator():
    errors = []
    for _ in range(2):
        torch.manual_seed(np.random.default_rng().integers(2**31))
        found = learner(td3=TD3Config())
        state = torch.get_rng_state()
        errors.append(found.td_errors(explored(10)))
        assert torch.equal(state, torch.get_rng_state())
    assert torch.equal(*errors)


@pytest.mark.parametrize("delay, policy_steps", [(1, 7), (2, 3), (3, 2)])
def test_the_policy_and_the_targets_follow_with_their_delay(monkeypatch, delay, policy_steps):
    options = {"critic_iterations": 7, "actor_iterations": 50}
    found, calls = learner(td3=TD3Config(delay=delay), **options), []
    filled(explored(10), found)
    for part, label in ((found.critic_optimiser, "q"), (found.actor_optimiser, "a"), (found.target, "t")):
        step = part.step
        monkeypatch.setattr(part, "step", lambda label=label, step=step: calls.append(label) or step())
    found.update()
    assert calls.count("q") == 7 and calls.count("a") == calls.count("t") == policy_steps
    assert calls[:delay] == ["q"] * delay and calls[delay : delay + 2] == ["a", "t"]


@pytest.mark.parametrize("change", [{"delay": 0}, {"smoothing": -0.1}, {"smoothing_limit": float("nan")}])
def test_wrong_parameters_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        TD3Config(**change)
