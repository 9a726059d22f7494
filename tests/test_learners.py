"""Step 2 by DDPG and TD3: gradients, TD errors, bootstrapping, targets, and the optimal gain of a Riccati equation."""

import contextlib
import copy
import re

import numpy as np
import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic, discounted_cost, optimal_gain
from seeds_and_numbers import seeded
from tensordict import TensorDict
from torch.utils._pytree import tree_flatten

from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.twinning.learners import DDPG, TD3, LearnerConfig
from rt_torchrl.twinning.learners.config import LongTermMemoryConfig, TD3Config
from rt_torchrl.twinning.learners.long_term_memory import LongTermMemory

GAMMA = 0.9
GAMMA_IN_TORCHRL = torch.tensor(GAMMA, dtype=torch.float32).item()  # DDPGLoss keeps it in single precision


def learner(seed=0, kind=DDPG, **options):
    plant = LinearQuadratic()
    options = {"discount": GAMMA, "critic_hidden": (16,), "batch_size": 32, **options}
    return kind(plant, LinearGain([[0.2, 0.1]]), LearnerConfig(**options), generator=seeded(seed))


def explored(count, seed=0, spread=1.5):
    """Real transitions of the noise-free plant from broad initial states under random forces."""
    plant, generator, steps = LinearQuadratic(noise=0.0), seeded(seed), 5
    state = spread * torch.randn(count, 2, generator=generator, dtype=torch.float64)
    action = torch.empty(count, steps, 1, dtype=torch.float64).uniform_(-2.0, 2.0, generator=generator)
    zero = torch.zeros(count, steps, 1, dtype=torch.float64)
    with torch.no_grad():
        states = Rollout(plant, plant.closure)(state, zero, action).states
    reward = -plant.running_cost(torch.zeros(steps).double(), states[:, :-1], action, zero).unsqueeze(-1)
    return transitions(states[:, :-1], action, reward, states[:, 1:]).reshape(-1)


def transitions(observation, action, reward, following, done=False):
    flag = torch.full(reward.shape, done)
    next_ = {"observation": following, "reward": reward, "done": flag, "terminated": torch.zeros_like(flag)}
    return TensorDict({"observation": observation, "action": action, "next": next_}, batch_size=reward.shape[:-1])


def filled(data, found, seed=1, **options):
    """The learner's memory with these transitions alone."""
    found.memory = LongTermMemory(LongTermMemoryConfig(capacity=len(data), **options), generator=seeded(seed))
    found.memory.store(data, found.td_errors(data))
    return found.memory


def gradients(module):
    return [w.grad for w in module.parameters()]


def test_critic_loss_reaches_the_critic_alone():
    found, data = learner(), explored(10)
    found.loss.loss_value(data)[0].backward()
    assert all(g is not None and g.norm() > 0 for g in gradients(found.critic))
    assert all(g is None for g in gradients(found.policy))
    assert not any(w.requires_grad for w in found.loss.target_value_network_params.values(True, True))


def test_actor_loss_reaches_the_policy_alone_and_is_the_policy_gradient():
    found, data = learner(), explored(10)
    found.loss.loss_actor(data)[0].backward()
    assert all(g is None or (g == 0).all() for g in gradients(found.critic))
    # −E[∂q/∂a ∂π/∂w] with π = −K e, so ∂π/∂K = −e; ∂q/∂a by central differences.
    observation, h = data["observation"], 1e-5
    with torch.no_grad():
        action = found.policy(observation)
        slope = (found.critic(observation, action + h) - found.critic(observation, action - h)) / (2 * h)
    expected = (slope * observation).mean(0, keepdim=True)
    # Step² times the third derivative, 1e-10, and rounding 1e-16/1e-5.
    torch.testing.assert_close(found.policy.gain.grad, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("kind", [DDPG, TD3])
@pytest.mark.parametrize("value", [float("nan"), -1e86])
@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation"), ("next", "reward")])
def test_a_transition_that_is_not_finite_is_refused_by_name(kind, key, value):
    found, data = learner(kind=kind), explored(2)
    before = copy.deepcopy(found.state_dict())
    data[key][3, -1] = value
    with pytest.raises(ValueError, match=re.escape(f"{key!r} of transition 3 is {value:g}")):
        found.store(data)
    assert not len(found.memory)
    assert_equal(found.state_dict()["loss"], before["loss"])


@pytest.mark.parametrize(("kind", "update"), [(DDPG, "explicit"), (DDPG, "torchrl"), (TD3, "torchrl")])
@pytest.mark.parametrize("rate", ["critic_rate", "actor_rate"])
def test_an_update_that_leaves_numbers_that_are_not_finite_is_taken_back_and_said(kind, rate, update):
    """A second step of 1e308 overflows."""
    options = {rate: 1e308, "update": update, "critic_iterations": 6, "actor_iterations": 3}
    found = learner(kind=kind, **options)
    found.store(explored(20))
    before = copy.deepcopy(found.state_dict()), copy.deepcopy(found.policy.state_dict())
    report = found.update()
    assert report["reason"].startswith("update of model_free taken back: ")
    for name in ("loss", "critic_optimiser", "actor_optimiser"):
        assert_equal(found.state_dict()[name], before[0][name])
    assert_equal(found.policy.state_dict(), before[1])
    # It can go on with other rates.
    for optimiser in (found.critic_optimiser, found.actor_optimiser):
        optimiser.param_groups[0]["lr"] = 1e-3
    assert "reason" not in found.update() and not torch.equal(found.policy.gain, before[1]["gain"])


def assert_equal(state, other):
    """Two states hold the same numbers."""
    (ours, structure), (its, its_structure) = tree_flatten(dict(state)), tree_flatten(dict(other))
    assert structure == its_structure
    assert all(torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b for a, b in zip(ours, its, strict=True))


@pytest.mark.parametrize("kind", [DDPG, TD3])
@pytest.mark.parametrize("error", [None, KeyboardInterrupt, FloatingPointError])
def test_small_operations_run_on_one_thread_of_torch(kind, error, monkeypatch):
    found, before, seen = learner(kind=kind, critic_iterations=2, actor_iterations=2), torch.get_num_threads(), []
    filled(explored(20), found)
    refresh = LongTermMemory.refresh

    def counted(memory, *arguments):
        seen.append(torch.get_num_threads())
        if error is not None:
            raise error("stop")
        return refresh(memory, *arguments)

    monkeypatch.setattr(LongTermMemory, "refresh", counted)
    torch.set_num_threads(2)
    try:
        with pytest.raises(KeyboardInterrupt) if error is KeyboardInterrupt else contextlib.nullcontext():
            found.update()
        assert seen and set(seen) == {1} and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("done", [False, True])
def test_td_error_is_that_of_the_target_critic_and_bootstraps_through_truncation(done):
    """|r + γ q′(e′, π(e′)) − q(e, a)| by hand; the end of an episode (done, not terminated) is no end of the return."""
    found, data = learner(target_rate=0.3), explored(10)
    earlier = copy.deepcopy(found.critic)
    filled(data, found)
    found.update()
    first = data[:6].clone()
    first["next", "done"].fill_(done)
    target = copy.deepcopy(found.critic)
    weights = found.loss.target_value_network_params.flatten_keys(".")
    with torch.no_grad():
        for name, weight in target.named_parameters():
            weight.copy_(weights["module." + name])
        following = first["next", "observation"]
        y = first["next", "reward"] + GAMMA_IN_TORCHRL * target(following, found.policy(following))
        expected = (y - found.critic(first["observation"], first["action"])).abs()[:, 0]
        # The target is neither the present critic nor the first one.
        assert not torch.equal(target.network[0].weight, found.critic.network[0].weight)
        assert not torch.equal(target.network[0].weight, earlier.network[0].weight)
    torch.testing.assert_close(found.td_errors(first), expected, rtol=1e-10, atol=1e-12)  # |δ| = √δ²


def test_target_follows_at_its_rate():
    """After one critic iteration: w′ = (1 − τ) w_0 + τ w_1."""
    found, data = learner(target_rate=0.3, critic_iterations=1, actor_iterations=0), explored(10)
    before = {name: w.detach().clone() for name, w in found.critic.named_parameters()}
    filled(data, found)
    found.update()
    weights = found.loss.target_value_network_params.flatten_keys(".")
    for name, after in found.critic.named_parameters():
        assert not torch.equal(after, before[name])
        torch.testing.assert_close(weights["module." + name], 0.7 * before[name] + 0.3 * after.detach())


def test_critic_iterations_come_first_and_are_counted(monkeypatch):
    found, calls, sizes = learner(critic_iterations=7, actor_iterations=4, batch_size=64, update="torchrl"), [], []
    memory = filled(explored(10), found)
    for optimiser, label in ((found.critic_optimiser, "q"), (found.actor_optimiser, "a")):
        step = optimiser.step
        monkeypatch.setattr(optimiser, "step", lambda label=label, step=step: calls.append(label) or step())
    sample = memory.sample
    monkeypatch.setattr(memory, "sample", lambda size: sizes.append(size) or sample(size))
    gain = found.policy.gain.detach().clone()
    found.update()
    assert calls == ["q"] * 7 + ["a"] * 4
    # n_b = 64, but at most n_t = 50; those of the four policy iterations are drawn in one call.
    assert sizes == [50] * 7 + [200]
    assert not torch.equal(gain, found.policy.gain)


def test_sampled_errors_are_refreshed():
    found, data = learner(critic_iterations=1, actor_iterations=0), explored(10)
    memory = filled(data, found)
    before = memory.sampler.priorities(len(data)).clone()
    memory.refresh(torch.arange(len(data)), torch.full((len(data),), 100.0))
    found.update()
    after = memory.sampler.priorities(len(data))
    changed = after < 10.0
    # δ is that of the critic before its step, which is the one they were stored with.
    assert 0 < changed.sum() <= 32
    torch.testing.assert_close(after[changed], before[changed], rtol=1e-5, atol=0)


def test_restart_forgets_the_moments_of_the_policys_optimiser():
    found, data = learner(critic_iterations=0, actor_iterations=3, actor_rate=0.01), explored(10)
    filled(data, found)
    found.update()
    assert len(found.actor_optimiser.state) == 1
    found.restart()
    assert len(found.actor_optimiser.state) == 0
    before = found.policy.gain.detach().clone()
    found.config = LearnerConfig(critic_iterations=0, actor_iterations=1, batch_size=32)
    found.update()
    # Adam's first step has the length of the rate in each direction, up to ε = 1e-8 over the gradient.
    torch.testing.assert_close((found.policy.gain - before).abs(), torch.full((1, 2), 0.01).double(), rtol=1e-4, atol=0)


def td3_learner(seed=0, td3=None, **options):
    return learner(seed, TD3, td3=td3 or TD3Config(smoothing=0.0), **options)


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
    one, other = (critics(td3_learner(), target=False) for _ in range(2))
    assert torch.equal(one[0].network[0].weight, other[0].network[0].weight)
    assert not torch.equal(one[0].network[0].weight, one[1].network[0].weight)


def test_the_target_is_the_lower_of_two_at_the_delayed_policys_action():
    """max_i |r + γ min_j q_j′(e′, π′(e′)) − q_i(e, a)| by hand, without noise."""
    found, data = td3_learner(target_rate=0.3, critic_iterations=20), explored(10)
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
    quiet = td3_learner().td_errors(data)
    limits = 0.1, 2.0
    gaps = [
        (td3_learner(td3=TD3Config(smoothing=1.0, smoothing_limit=limit)).td_errors(data) - quiet).abs().max()
        for limit in limits
    ]
    # The perceptrons are nearly linear over so short a way: the ratio of the limits, within a factor of two.
    assert gaps[0] > 0.0 and 0.5 * limits[1] / limits[0] / 2.0 < gaps[1] / gaps[0] < 2.0 * limits[1] / limits[0]


def test_smoothing_is_drawn_from_the_learners_generator():
    errors = []
    for _ in range(2):
        torch.manual_seed(np.random.default_rng().integers(2**31))
        found = td3_learner(td3=TD3Config())
        state = torch.get_rng_state()
        errors.append(found.td_errors(explored(10)))
        assert torch.equal(state, torch.get_rng_state())
    assert torch.equal(*errors)


@pytest.mark.parametrize("delay, policy_steps", [(1, 7), (2, 3), (3, 2)])
def test_the_policy_and_the_targets_follow_with_their_delay(monkeypatch, delay, policy_steps):
    options = {"critic_iterations": 7, "actor_iterations": 50}
    found, calls = td3_learner(td3=TD3Config(delay=delay), **options), []
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


@pytest.mark.parametrize(
    ("make", "updates", "options"),
    [
        # Measured at the end: 0.07 to 0.09 of ‖K*‖.
        pytest.param(learner, 45, {"actor_iterations": 20, "actor_rate": 0.02}, id="ddpg"),
        # The lower of two critics leans towards small actions.
        pytest.param(
            td3_learner,
            30,
            {"td3": TD3Config(smoothing=0.05, smoothing_limit=0.1), "actor_rate": 0.01},
            id="td3",
            marks=pytest.mark.nightly,  # TorchRL's loss takes a minute
        ),
    ],
)
def test_policy_finds_the_optimal_gain(make, updates, options, unchecked):
    """On 5000 transitions of a noise-free plant."""
    best = optimal_gain(GAMMA)
    critic = {"critic_hidden": (64, 64), "critic_iterations": 100, "critic_rate": 3e-3, "target_rate": 0.05}
    found = make(batch_size=256, **critic, **options)
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
