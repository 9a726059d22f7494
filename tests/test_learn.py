"""Step 2: losses of TorchRL traced and by hand, TD errors, sums of rewards, the memory D_L, and a known optimum."""

import copy

import numpy as np
import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic, discounted_cost, optimal_gain
from scipy.stats import chisquare
from seeds_and_numbers import seeded
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import DDPGLoss

from rt_torchrl import LearnerConfig, Rollout, SaturatedAffine, SaturatedMLP
from rt_torchrl.steps.belief import equal
from rt_torchrl.steps.learn import ActorCritic
from rt_torchrl.steps.losses import BATCH, METHODS, LearningMethod, iteration, traced
from rt_torchrl.steps.memory import LongTermMemory

GAMMA = 0.9
PLANT = LinearQuadratic()
HALF_RANGE = 2.0  # of the force; its middle is zero


class Odd(nn.Module):
    """A policy of somebody else: an unused weight, a frozen one, and a number that looks at the whole batch."""

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor([[0.2, 0.1]], dtype=torch.float64))
        self.unused = nn.Parameter(torch.ones(3, dtype=torch.float64))
        self.frozen = nn.Parameter(torch.ones(1, dtype=torch.float64), requires_grad=False)

    def forward(self, observation):
        return -(observation - 0.1 * observation.mean(0)) @ self.gain.T * self.frozen


POLICIES = {
    "gain": lambda: LinearGain([[0.2, 0.1]]),
    "affine": lambda: SaturatedAffine(2, PLANT.actions, generator=seeded(5)),
    "perceptron": lambda: SaturatedMLP(2, PLANT.actions, hidden=(5, 4), generator=seeded(5)),
    "odd": Odd,
}


class Narrow(ActorCritic):
    critic_hidden = (16,)


class Tapering(ActorCritic):
    critic_hidden = (16, 8)


class Quick(ActorCritic):
    critic_rate = 3e-3


class Wild(Narrow):
    critic_rate = 1e308


def learner(algorithm="ddpg", seed=0, policy="gain", method=None, kind=Narrow, **options):
    options = {"algorithm": algorithm, "discount": GAMMA, "batch_size": 32, **options}
    return kind(PLANT, POLICIES[policy](), LearnerConfig(**options), generator=seeded(seed), method=method)


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


def transitions(observation, action, reward, following):
    done, terminated = (torch.zeros(reward.shape, dtype=torch.bool) for _ in range(2))
    next_ = {"observation": following, "reward": reward, "done": done, "terminated": terminated}
    return TensorDict({"observation": observation, "action": action, "next": next_}, batch_size=reward.shape[:-1])


def scaled(data):
    """What the memory keeps of transitions."""
    return data.clone().update({"action": data["action"] / HALF_RANGE, "steps_to_next_obs": torch.ones(len(data), 1)})


def filled(data, found, seed=1, **options):
    """The learner's memory with these transitions alone."""
    found.memory = LongTermMemory(len(data), generator=seeded(seed), **options)
    found.memory.store(scaled(data), found.td_errors(scaled(data)))
    return found.memory


def values(found, observation, action, *, target=False):
    """The values of all critics of a learner, or of their targets, for scaled actions."""
    pairs = TensorDict({"observation": observation, "action": action}, batch_size=len(observation))
    name = "qvalue_network" if hasattr(found.loss, "qvalue_network_params") else "value_network"
    network, weights = getattr(found.loss, name), getattr(found.loss, f"{'target_' * target}{name}_params")
    of_each = list[torch.Tensor]()
    for of_one in weights.unbind(0) if weights.batch_size else [weights]:
        with of_one.to_module(network):
            of_each.append(network(pairs.copy())["state_action_value"])
    return torch.stack(of_each)


def batches_of(found, count):
    drawn = found.memory.sample(count * found.batch_size)
    return list(zip(*(drawn[key].split(found.batch_size) for key in BATCH), strict=True))


@pytest.mark.parametrize(
    ("algorithm", "policy", "return_steps"),
    [
        *(("ddpg", policy, steps) for policy, steps in zip(POLICIES, (1, 10, 1, 10), strict=True)),
        *((algorithm, "perceptron", 10) for algorithm in METHODS if algorithm != "ddpg"),
    ],
)
def test_a_traced_iteration_is_that_of_torchrl_to_the_bit(algorithm, policy, return_steps):
    """Also with other weights, other batches, after a restart, and after a state was loaded."""
    ours, eager = (learner(algorithm, policy=policy, return_steps=return_steps) for _ in range(2))
    generator = seeded(4)
    for seed in range(4):
        episode = explored(20, seed=seed)
        episode["next", "terminated"] = torch.rand(len(episode), 1, generator=generator) < 0.05
        ours.store(episode), eager.store(episode)
    batches = batches_of(ours, 6)
    kinds = ("critic", "actor") if METHODS[algorithm].delay == 0 else ("critic", "both")
    flat = {kind: traced(ours, kind, batches[0]) for kind in kinds}
    start = copy.deepcopy(ours.state_dict())
    for k, batch in enumerate(batches):
        for kind in kinds:
            torch.manual_seed(k)
            found = flat[kind](*batch)
            torch.manual_seed(k)
            expected = iteration(eager, kind, *batch)
            assert equal(found, expected)
        if k == 2:
            ours.restart(), eager.restart()
        if k == 4:
            ours.load_state_dict(start), eager.load_state_dict(start)
        for name in ("loss", "critic_adam", "actor_adam"):
            assert equal(dict(getattr(ours, name).state_dict()), dict(getattr(eager, name).state_dict()))
    learned, before = (next(iter(policy.parameters())) for policy in (ours.policy, POLICIES[policy]()))
    assert not torch.equal(learned, before)


@pytest.mark.parametrize("algorithm", [name for name in METHODS if name != "relaxed_ddpg"])
def test_an_iteration_takes_the_steps_of_torchs_adam(algorithm):
    """Also with several critics, whose gradients lie in memory in another order than their weights."""
    ours, others = (learner(algorithm, policy="perceptron", kind=Tapering) for _ in range(2))
    ours.store(explored(20)), others.store(explored(20))
    (batch,) = batches_of(ours, 1)
    torch.manual_seed(0)
    traced(ours, "both", batch)(*batch)
    torch.manual_seed(0)
    losses = others.loss(TensorDict(dict(zip(BATCH, batch, strict=True)), batch_size=[len(batch[0])]))
    critic = losses["loss_qvalue"] if "loss_qvalue" in losses else losses["loss_value"]
    actor = losses["loss_actor"] + losses.get("loss_alpha", 0.0)
    weights = {"critic_adam": others.critic_adam.weights, "actor_adam": others.actor_adam.weights}
    for name, loss in (("critic_adam", critic), ("actor_adam", actor)):
        loss.backward(inputs=weights[name], retain_graph=True)
    nn.utils.clip_grad_norm_(weights["actor_adam"], torch.inf if METHODS[algorithm].relaxed else 1.0)
    for name, trained in weights.items():
        torch.optim.Adam(trained, lr=getattr(others, name).defaults["lr"]).step()
        torch.testing.assert_close(getattr(ours, name).weights, trained, rtol=0, atol=1e-9)


class Branching(LinearGain):
    def forward(self, observation):
        return super().forward(observation) * (2.0 if observation.sum() > 0 else 1.0)


def test_a_policy_that_cannot_be_traced_learns_by_torchrl_itself_and_a_notice_says_so():
    config = LearnerConfig(critic_iterations=2, actor_iterations=2)
    found = ActorCritic(PLANT, Branching([[0.2, 0.1]]), config, generator=seeded())
    found.store(explored(20))
    before = found.policy.gain.detach().clone()
    with pytest.warns(UserWarning, match="Step 2 is slower, because Branching cannot be traced"):
        report = found.update()
    assert report["value"].isfinite() and not torch.equal(found.policy.gain, before)


class Scheduled(LinearGain):
    """A law with a factor beside its weights."""

    def __init__(self, gain):
        super().__init__(gain)
        self.factor = 1.0

    def forward(self, observation):
        return self.factor * super().forward(observation)


def test_a_setting_of_the_policy_that_changes_is_read_anew():
    """With the factor zero no action depends on the gain, which then rests."""
    config = LearnerConfig(critic_iterations=2, actor_iterations=2)
    found = ActorCritic(PLANT, Scheduled([[0.2, 0.1]]), config, generator=seeded())
    found.store(explored(20))
    gains = [found.policy.gain.detach().clone()]
    for factor in (1.0, 0.0):
        found.policy.factor = factor
        found.restart()
        found.update()
        gains.append(found.policy.gain.detach().clone())
    assert not torch.equal(gains[0], gains[1]) and torch.equal(gains[1], gains[2])


def test_a_loss_of_ones_own():
    class Doubled(DDPGLoss):
        def loss_value(self, tensordict):
            value, metadata = super().loss_value(tensordict)
            return 2.0 * value, metadata

    own = LearningMethod(lambda actor, critics: Doubled(actor, critics[0], loss_function="l2"), delay=0)
    reports = []
    for method in (own, METHODS["ddpg"]):
        found = learner(method=method, critic_iterations=1, actor_iterations=0)
        filled(explored(20), found)
        reports.append(found.update()["critic_loss"].item())
    assert reports[0] == pytest.approx(2.0 * reports[1], rel=1e-12)


def test_a_critic_of_any_name_is_trained():
    class Second(DDPGLoss):
        def __init__(self, actor, critics):
            super().__init__(actor, critics[0], loss_function="l2")
            self.convert_to_functional(critics[1], "second_critic", create_target_params=False)

        def forward(self, tensordict):
            found = super().forward(tensordict)
            with self.second_critic_params.to_module(self.second_critic):
                value = self.second_critic(tensordict.select("observation", "action").clone())["state_action_value"]
            return found.set("loss_second", (value - tensordict["next", "reward"]).square().mean())

    found = learner(method=LearningMethod(Second, critics=2, delay=0), critic_iterations=2, actor_iterations=1)
    filled(explored(20), found)
    before = found.loss.second_critic_params.detach().clone()
    found.update()
    differ = (found.loss.second_critic_params != before).flatten_keys()
    assert all(moved.any() for moved in differ.values())
    assert sum(w.numel() for w in found.actor_adam.weights) == sum(w.numel() for w in found.policy.parameters())


@pytest.mark.parametrize("algorithm", METHODS)
def test_priorities_are_sizes_of_errors_whatever_the_loss_reports(algorithm):
    """Where rewards dominate the values, |δ| grows as they do, and δ² would as their squares."""
    found, data, sizes = learner(algorithm), scaled(explored(10)), []
    for factor in (1e4, 1e6):
        batch = data.clone()
        batch["next", "reward"] *= factor
        sizes.append(found.td_errors(batch).mean().item())
    assert sizes[1] / sizes[0] == pytest.approx(100.0, rel=0.01)


@pytest.mark.parametrize(("algorithm", "rates"), [("ddpg", {"kind": Wild}), ("sac", {"actor_rate": 1e308})])
def test_an_update_that_leaves_numbers_that_are_not_finite_is_taken_back_and_said(algorithm, rates):
    """A second step of 1e308 overflows."""
    found = learner(algorithm, critic_iterations=6, actor_iterations=3, **rates)
    found.store(explored(20))
    before = copy.deepcopy(found.state_dict()), copy.deepcopy(found.policy.state_dict())
    report = found.update()
    assert report["reason"].startswith("update of model_free taken back: ")
    for name in ("loss", "critic_adam", "actor_adam"):
        assert equal(dict(found.state_dict()[name]), dict(before[0][name]))
    assert equal(found.policy.state_dict(), before[1])
    # It can go on with other rates.
    other = learner(algorithm, critic_iterations=6, actor_iterations=3)
    other.load_state_dict(found.state_dict())
    assert "reason" not in other.update() and not torch.equal(other.policy.gain, before[1]["gain"])


@pytest.mark.parametrize(
    ("algorithm", "order"),
    [("ddpg", ["critic"] * 7 + ["actor"] * 4), ("td3", ["critic", "both"] * 3 + ["critic"]), ("sac", ["both"] * 7)],
)
def test_iterations_come_in_the_order_of_the_method(monkeypatch, algorithm, order):
    found, kinds = learner(algorithm, critic_iterations=7, actor_iterations=4), []
    filled(explored(20), found)

    def noted(learner, kind, batch):
        return lambda *batch: kinds.append(kind) or iteration(learner, kind, *batch)

    monkeypatch.setattr("rt_torchrl.steps.learn.traced", noted)
    found.update()
    assert kinds == order


@pytest.mark.parametrize(
    ("algorithm", "updates", "spread", "options"),
    [
        # Measured at the end: 0.07 to 0.09 of ‖K*‖.
        pytest.param("ddpg", 45, 1.0, {"actor_iterations": 20, "actor_rate": 0.02}, id="ddpg"),
        # The lower of two critics leans towards small actions.
        pytest.param("td3", 30, 1.0, {"actor_rate": 0.01}, id="td3", marks=pytest.mark.nightly),
        # From wider states a third of the actions of K* are at their bounds, where they have the least entropy: SAC
        # pays for that with 3 % of the cost.
        pytest.param("sac", 20, 0.3, {"actor_rate": 0.01}, id="sac", marks=pytest.mark.nightly),
    ],
)
def test_policy_finds_the_optimal_gain(algorithm, updates, spread, options, unchecked):
    """On 5000 transitions of a noise-free plant."""
    best = optimal_gain(GAMMA)
    found = learner(algorithm, kind=Quick, batch_size=256, critic_iterations=100, target_rate=0.05, **options)
    start, data = found.policy.gain.detach().numpy().copy(), explored(1000, spread=spread)
    filled(data, found, prioritisation=0.0)
    for _ in range(updates):
        found.update()
    gain = found.policy.gain.detach().numpy()
    # ‖K − K*‖/‖K*‖ from 0.87. The critics are perceptrons, no quadratic forms, and wander with Adam's steps. The cost
    # is flat at its minimum.
    assert np.linalg.norm(start - best) > 0.8 * np.linalg.norm(best)
    assert np.linalg.norm(gain - best) < 0.15 * np.linalg.norm(best)
    assert 1.0 <= discounted_cost(gain, GAMMA) / discounted_cost(best, GAMMA) < 1.01


def episode(n):
    """Observations k, rewards k + 1, truncated at the end."""
    k = torch.arange(n, dtype=torch.float64).unsqueeze(-1)
    found = transitions(k.expand(n, 2), k, k + 1, (k + 1).expand(n, 2)).set("state", k)
    found["next", "done"][-1] = True
    return found


def test_rewards_are_summed_over_whole_windows_only_and_the_target_discounts_by_their_number():
    model_free = learner(return_steps=3, discount=0.5)
    found = model_free.transitions(episode(4))
    # 1 + 2/2 + 3/4 and 2 + 3/2 + 4/4; after the third interval only two remain.
    assert found["next", "reward"].flatten().tolist() == pytest.approx([2.75, 4.5], rel=1e-6)
    assert found["next", "observation"][:, 0].tolist() == [3.0, 4.0]
    assert found["steps_to_next_obs"].flatten().tolist() == [3, 3]
    with torch.no_grad():
        action = model_free.policy(found["next", "observation"]) / HALF_RANGE
        bootstrap = values(model_free, found["next", "observation"], action)[0]  # the target critic starts as its copy
        delta = found["next", "reward"] + 0.5**3 * bootstrap
        delta -= values(model_free, found["observation"], found["action"])[0]
    # TorchRL keeps γ in single precision.
    torch.testing.assert_close(model_free.td_errors(found), delta.abs().squeeze(-1), rtol=1e-6, atol=1e-7)


def memory(capacity=10, seed=0, **options):
    return LongTermMemory(capacity, generator=seeded(seed), **options)


def labelled(labels):
    return TensorDict({"label": torch.tensor(labels, dtype=torch.float64)}, batch_size=[len(labels)])


def labels(found):
    return sorted(found.buffer[: len(found)]["label"].tolist())


ERRORS = torch.tensor([0.0, 0.1, 0.5, 1.0, 2.0, 5.0, 0.3, 0.3], dtype=torch.float64)


@pytest.mark.parametrize("alpha", [0.0, 0.6, 1.0])
def test_sampling_follows_the_priorities(alpha, monkeypatch):
    """P(i) ∝ (|δ_i| + tol)^α*, by a χ² test at 0.1 %; the draws are seeded, so the outcome is always the same."""
    tol = 0.05
    monkeypatch.setattr("rt_torchrl.steps.memory.TOL", tol)
    found = memory(prioritisation=alpha)
    found.store(labelled(list(range(8))), -ERRORS)
    counts = torch.zeros(8)
    for _ in range(40):
        counts += found.sample(500)["label"].long().bincount(minlength=8)
    weights = (ERRORS + tol) ** alpha
    expected = 20_000 * weights / weights.sum()
    assert chisquare(counts.numpy(), expected.numpy() * counts.sum().item() / expected.sum().item()).pvalue > 1e-3


def test_eviction_goes_by_the_present_priorities():
    """Errors rank one way at first and the other way after a refresh; the transitions that are now least go first."""
    found = memory(capacity=6)
    found.store(labelled([0.0, 1.0, 2.0, 3.0]), torch.tensor([9.0, 8.0, 0.1, 0.2]))
    found.store(labelled([4.0, 5.0]), torch.tensor([5.0, 5.0]))
    found.refresh(torch.tensor([0, 1, 2, 3]), torch.tensor([0.1, 0.2, 9.0, 8.0]))
    found.store(labelled([6.0, 7.0]), torch.tensor([1.0, 1.0]))
    assert labels(found) == [2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    # Now 6 and 7 are least; the newcomer takes the place of one of them, with its own priority.
    found.store(labelled([8.0]), torch.tensor([50.0]))
    assert labels(found)[:4] == [2.0, 3.0, 4.0, 5.0] and 8.0 in labels(found) and len(found) == 6
    drawn = found.sample(2000)["label"]
    assert {2.0, 3.0, 4.0, 5.0, 8.0} <= set(drawn.tolist()) and drawn.mode().values == 8.0


def test_a_critic_that_has_diverged_is_told():
    found, episode = learner(return_steps=1), explored(4)
    with torch.no_grad():
        for weight in found.critic_adam.weights:
            weight.fill_(torch.nan)
    with pytest.raises(FloatingPointError, match="TD error exceeds single precision"):
        found.store(episode)
