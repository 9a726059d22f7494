"""Incremental TD3: increments, decisions, the loss and its formulas, slopes of a twin, recovery."""

import copy
import inspect
import re

import pytest
import torch
from linear_quadratic import LinearGain, LinearQuadratic
from tensordict import TensorDict
from test_ddpg import seeded
from test_explicit_update import assert_same, whole
from torch import nn

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.actuators import LaggedActuator
from rt_torchrl.plants.increments import Increments, greatest_increments
from rt_torchrl.plants.policies import SaturatedAffine, SaturatedMLP
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.config import TwinningConfig
from rt_torchrl.twinning.hypotheses.ensemble import TwinEnsemble
from rt_torchrl.twinning.learners import LearnerConfig
from rt_torchrl.twinning.learners.config import IncrementalTD3Config, LongTermMemoryConfig
from rt_torchrl.twinning.learners.episode_memory import decision_intervals
from rt_torchrl.twinning.learners.explicit import row_function
from rt_torchrl.twinning.learners.explicit.critic_formulas import symexp, symlog
from rt_torchrl.twinning.learners.incremental_td3 import IncrementalTD3, settled
from rt_torchrl.twinning.learners.innovations import Innovations, count_innovations, inputs_within
from rt_torchrl.twinning.learners.lesson import Lesson
from rt_torchrl.twinning.learners.weights import change_of_actions, weights_of

PLANT = LinearQuadratic()
GAMMA = 0.9


def episodes(plant, count, seed=0):
    """Real episodes under random commands, as the algorithm stores them."""
    env, generator, found = PlantEnv(plant, seed=seed), seeded(seed), []
    low, high = plant.actions[0].low, plant.actions[0].high

    def act(td):
        shape = (1, len(plant.actions))
        noise = torch.rand(shape, generator=generator, dtype=torch.float64)
        return td.set("action", low + (high - low) * noise)

    for _ in range(count):
        episode = env.rollout(plant.n_steps, act)[0]
        episode["action"] = episode["next", "applied"]
        found.append(episode)
    return found


POLICIES = {
    "affine": lambda: SaturatedAffine(2, PLANT.actions, generator=seeded(5)),
    "perceptron": lambda: SaturatedMLP(2, PLANT.actions, hidden=(5, 4), generator=seeded(5)),
    "gain": lambda: LinearGain([[0.2, 0.1]]),
}


def learner(policy="perceptron", *, twin=True, episodes_of=PLANT, **options):
    own = {"decisions": 5, "settled": 0.1, "virtual": 40, **options.pop("own", {})}
    options = {"critic_iterations": 220, "batch_size": 32, "critic_hidden": (9, 7), "gradient_limit": 0.05, **options}
    options = {"discount": GAMMA, "return_steps": 6, "incremental": IncrementalTD3Config(**own), **options}
    found = IncrementalTD3(PLANT, POLICIES[policy](), LearnerConfig(**options), generator=seeded(3))
    if twin:
        found.take_twin(DigitalTwin(PLANT, copy.deepcopy(PLANT.closure)))
    for episode in episodes(episodes_of, 3):
        found.store(episode)
    return found


# What the critics see


def test_increments_are_asked_of_the_plants_actuators():
    turbine = WindTurbine()
    torch.testing.assert_close(greatest_increments(turbine), turbine.greatest_increment)
    slow = FlappingWing(stroke_plane_rate=3000.0)
    assert greatest_increments(slow).tolist() == [float("inf"), pytest.approx(1.5)]
    for plant in (FlappingWing(), CryogenicTank(), PLANT):
        assert greatest_increments(plant).isinf().all()


def test_an_increment_is_the_change_over_the_applied_action_or_a_share_of_the_range():
    turbine, generator = WindTurbine(), seeded(1)
    scales, state = Increments(turbine), turbine.draw_initial_state(50, generator)
    state[:, 4:6] = torch.rand(50, 2, generator=generator, dtype=torch.float64) * turbine.greatest_increment.new_tensor(
        [43e3, 30.0]
    )
    command = torch.rand(50, 2, generator=generator, dtype=torch.float64) * state.new_tensor([43e3, 30.0])
    u = scales.scaled(scales.centre(state), command).clamp(-1.0, 1.0)
    torch.testing.assert_close(state[:, 4:6] + u * turbine.greatest_increment, turbine.actuate(state, command))
    free = Increments(FlappingWing())
    centre = free.centre(torch.zeros(3, 4, dtype=torch.float64))
    assert free.scaled(centre, free.high.expand(3, 2)).tolist() == [[1.0, 1.0]] * 3


def test_a_rate_limit_that_reaches_the_whole_range_within_a_decision_is_none():
    scales = Increments(FlappingWing(stroke_plane_rate=3000.0), intervals=20)
    assert not scales.limited.any() and scales.scale.tolist() == [19.0, 30.0]


@pytest.mark.parametrize("discount, expected", [(0.98, 1), (0.9995, 40), (0.9998, 100), (0.5, 1)])
def test_decisions_divide_the_horizon_of_the_discount(discount, expected):
    assert decision_intervals(discount, 50) == expected


def test_transitions_sum_rewards_of_whole_decisions():
    found = learner(own={"return_episodes": 1})
    m, parts = found.memory.intervals, found.memory.transitions(3, recent=1, reward_scale=2.0)
    assert m == 2 and found.decisions == 3
    for part, episode, n in zip(parts, found.memory.episodes, (2, 2, 6), strict=True):
        assert len(part) == PLANT.n_steps - n and torch.equal(part["place"], torch.arange(len(part)))
        k = 7
        reward = sum(GAMMA**j * episode["reward"][k + j] for j in range(n))
        torch.testing.assert_close(part["next", "reward"][k], 2.0 * reward)
        assert part["next", "discount"][k].item() == pytest.approx(GAMMA**n)
        torch.testing.assert_close(part["action"][k], episode["action"][k : k + m].mean(0) / 2.0)
        assert torch.equal(part["next", "observation"][k], episode["observation"][k + n])


@pytest.mark.parametrize("intervals", [1, 4])
def test_an_innovation_is_what_the_beginning_does_not_foretell(intervals):
    """Of z' = 0.8 z + w it is w/σ for one interval, and for more it is uncorrelated with what is known."""
    generator, n = seeded(0), 4000
    noise = torch.randn(n, generator=generator, dtype=torch.float64)
    inputs = [noise[0]]
    for fresh in noise[1:]:
        inputs.append(0.8 * inputs[-1] + fresh)
    constant = torch.full((n,), 7.0, dtype=torch.float64)
    episode = TensorDict({"exogenous": torch.stack([torch.stack(inputs), constant], -1)}, batch_size=n)
    at = torch.arange(n - intervals)
    starts = (episode["exogenous"][at, :1] - episode["exogenous"][at, :1].mean()) / episode["exogenous"][at, :1].std()
    ahead = inputs_within(episode, at, intervals)
    found = Innovations(starts, ahead)(starts, ahead)
    assert found.shape[-1] == count_innovations(2, intervals) == 2 * min(intervals, 2)
    assert not found[:, 1::2].any()  # what is constant is foretold
    assert found[:, 0].std().item() == pytest.approx(1.0)
    assert abs((found[:, 0] * starts[:, 0]).mean().item()) < 1e-4
    if intervals == 1:
        torch.testing.assert_close(found[:, 0], (noise[1:] - noise[1:].mean()) / noise[1:].std(), rtol=0.0, atol=0.05)
    else:
        torch.testing.assert_close(ahead[5, 2], episode["exogenous"][6:10, 0].mean())
        assert torch.equal(inputs_within(episode, torch.tensor([n - 1]), intervals)[0, :2], episode["exogenous"][-1])


def test_targets_take_the_mean_of_critics_at_the_innovation_of_another_transition():
    found = learner()
    loss, batch = found.loss, Lesson(found, 1.0).data[torch.arange(5, 25)]
    assert batch["innovation"].shape == (20, count_innovations(len(PLANT.inputs), found.memory.intervals))
    following, others = batch["next"].clone(), torch.arange(20).roll(1)
    following["innovation"] = batch["innovation"][others]
    following["action"] = found.actor_module()(following)["action"].detach()
    value = loss._values(following, loss.target_qvalue_network_params).mean(0)
    goal = symlog(batch["next", "reward"] + batch["next", "discount"] * symexp(value.unsqueeze(-1))).squeeze(-1)
    expected = (loss._values(batch, loss.qvalue_network_params) - goal).abs().amax(0)
    torch.testing.assert_close(loss.value_loss(batch)[1]["td_error"], expected.detach())


def test_rescaling_is_inverted_and_keeps_four_orders_of_magnitude_apart():
    x = torch.tensor([-850.0, -2.0, -1e-3, 0.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(symexp(symlog(x)), x)
    assert symlog(x)[0].item() == pytest.approx(-6.75, abs=0.01)


# The formulas


@pytest.mark.parametrize("policy, trust", [("affine", 0.0), ("perceptron", 0.7), ("gain", 0.7)])
def test_updates_by_formula_give_the_weights_and_moments_of_torchrls_loss(policy, trust):
    expected, found = (
        learner(policy, update=update, critic_iterations=14, own={"trust": trust}) for update in ("torchrl", "explicit")
    )
    start = weights_of(found.policy)
    for each in (expected, found):
        each._waiting = False
    for _ in range(2):
        reports = [each.update() for each in (expected, found)]
        assert_same(*(report.to_dict() for report in reports))
        assert_same(whole(expected), whole(found))
    assert not same(found, start)


def test_torch_takes_the_place_of_machine_code(monkeypatch):
    monkeypatch.setattr(row_function, "LEAST_LANES", 99)
    options = {"batch_size": 27, "critic_iterations": 20, "own": {"trust": 0.5, "critics": 3}}
    expected, found = (learner(update=update, **copy.deepcopy(options)) for update in ("torchrl", "explicit"))
    for each in (expected, found):
        each._waiting = False
        each.update()
    assert_same(whole(expected), whole(found))


def test_the_state_goes_on_to_the_bit():
    one = learner(own={"trust": 0.5}, critic_iterations=30)
    one.flown(1.0)
    one.update()
    other = learner(own={"trust": 0.5}, critic_iterations=30)
    other.policy.load_state_dict(one.policy.state_dict())
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    for each in (one, other):
        each.flown(1.2)
        each.update()
    for name, weight in one.policy.state_dict().items():
        assert torch.equal(weight, other.policy.state_dict()[name])


# What a twin teaches


def returns(first, k, episode, closure, policy, shift=None):
    """Discounted sum of L_a from interval k on: the recorded action, shifted, and then the policy."""
    state, exogenous = episode["state"][k : k + 1], episode["exogenous"][None, k:]
    action = episode["action"][k] + (0.0 if shift is None else shift)
    one = Rollout(PLANT, closure, engine="autograd")(state, exogenous[:, :1], action.view(1, 1, -1))
    rest = Rollout(PLANT, closure, policy, engine="autograd")(one.states[:, -1], exogenous[:, 1:])
    states, actions = torch.cat([one.states, rest.states[:, 1:]], 1), torch.cat([one.actions, rest.actions], 1)
    t = PLANT.dt * torch.arange(k, k + actions.shape[1], dtype=torch.float64)
    cost = PLANT.running_cost(t, states[:, :-1], actions, exogenous)
    return (cost * GAMMA ** torch.arange(actions.shape[1]).double()).sum()


def test_slopes_are_those_of_the_twins_return_where_the_policy_flew():
    """On a linear plant with a linear policy only L_a is no linear function: the flight must be the policy's own."""
    found = learner("gain")
    closure, policy = copy.deepcopy(PLANT.closure), found.policy
    state, exogenous = PLANT.draw_initial_state(1, seeded(8)), PLANT.draw_exogenous(1, seeded(9))
    with torch.no_grad():
        flight = Rollout(PLANT, closure, policy)(state, exogenous)
    episode = found.memory.episodes[0].clone()
    episode["state"], episode["exogenous"], episode["action"] = flight.states[0, :-1], exogenous[0], flight.actions[0]
    slopes = found.teacher().slopes(episode)
    for k in (0, 11, 30):
        shift = torch.zeros(1, dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(returns(None, k, episode, closure, policy, shift), shift)
        torch.testing.assert_close(slopes[k], slope)
    of_decisions = found.teacher().decision_slopes(episode, torch.arange(4), 3.0)
    sums = slopes[:4] + GAMMA * slopes[1:5]
    torch.testing.assert_close(of_decisions, -3.0 * found.increments.scale * sums)


def test_critics_take_over_the_slopes():
    """On top of values, slopes bring ∂q/∂u nearer to what the twin says."""

    def error(trust):
        found = learner(own={"trust": trust, "virtual": 0, "actor_rate": 1e-9}, critic_iterations=700)
        found.update()
        found.trust = 1.0
        batch = Lesson(found, (1.0 - GAMMA) / found.memory.cost()).latest()
        u, wanted = batch["action"].clone().requires_grad_(), batch["slope"]
        batch["action"] = u
        value = symexp(found.loss._values(batch, found.loss.qvalue_network_params)[0])
        (slope,) = torch.autograd.grad(value.sum(), u)
        return ((slope - wanted).norm() / wanted.norm()).item()

    with_twin, without = error(1.0), error(0.0)
    assert with_twin < 0.5 and with_twin < 0.5 * without


def test_virtual_transitions_of_a_perfect_twin_begin_with_the_real_decision():
    found = learner(own={"trust": 1.0})
    lesson = Lesson(found, 1.0)
    virtual = lesson.data[lesson.data["virtual"].squeeze(-1)]
    assert len(virtual) == 40 and (virtual["weight"] == 1.0).all()
    episode = found.memory.episodes[0]
    m, n = found.memory.intervals, found.decisions * found.memory.intervals
    k = virtual["place"][0].item()
    first = sum(GAMMA**j * episode["reward"][k + j] for j in range(m))
    with torch.no_grad():
        exogenous = episode["exogenous"][None, k + m : k + n]
        flight = Rollout(PLANT, PLANT.closure, found.policy)(episode["state"][k + m].unsqueeze(0), exogenous)
        cost = PLANT.running_cost(torch.zeros(1).double(), flight.states[:, :-1], flight.actions, exogenous)
    rest = -(GAMMA ** torch.arange(m, n).double() * cost[0]).sum()
    torch.testing.assert_close(virtual["next", "reward"][0], first + rest, rtol=1e-6, atol=1e-9)
    drawn = lesson.data["virtual"][lesson.draw()]
    assert drawn.sum() == 16
    assert not lesson.data["virtual"][lesson.draw_latest()].any()


def test_without_trust_nothing_is_learned_from_a_twin():
    one, other = learner(critic_iterations=30), learner(critic_iterations=30, twin=False)
    for each in (one, other):
        each.update()
    assert_same(whole(one), whole(other))
    assert "slope" not in Lesson(one, 1.0).data and not Lesson(one, 1.0).data["virtual"].any()


def test_trust_without_a_twin_is_refused():
    with pytest.raises(ValueError, match="trust=0.5 needs a twin"):
        learner(own={"trust": 0.5}, twin=False).update()
    with pytest.raises(ValueError, match=r"trust=1.5 in the twin must lie in \[0, 1\]"):
        learner().trust = 1.5


def test_what_other_learners_read_changes_nothing_and_the_help_says_so():
    others = {"reward_scale": 1e-3, "actor_rate": 0.5, "memory": LongTermMemoryConfig(capacity=7, prioritisation=0.1)}
    one, other = learner(critic_iterations=30), learner(critic_iterations=30, **others)
    for each in (one, other):
        each.update()
    assert_same(whole(one), whole(other))
    said = {name: text for name, _, text in (part.partition(": ") for part in described(LearnerConfig))}
    for name, sentence in (
        ("reward_scale", "Incremental TD3 does not read it"),
        ("memory", "Incremental TD3 reads none of them"),
    ):
        assert sentence in said[name]


def described(config):
    """The description of each argument, with its name."""
    text = inspect.getdoc(config).split("Args:\n")[1]
    return [" ".join(part.split()) for part in re.split(r"\n    (?=\w+: )", "\n" + text) if part.strip()]


def test_trust_in_an_arm_without_a_twin_is_refused_before_an_episode_is_flown():
    taught = LearnerConfig(algorithm="incremental_td3", incremental=IncrementalTD3Config(trust=0.5))
    with pytest.raises(ValueError, match=r"learner.incremental.trust=0.5 needs a twin, which arm='model_free' has not"):
        TwinningConfig(arm="model_free", learner=taught)
    for arm, learning in (("twinning", taught), ("model_free", LearnerConfig(algorithm="incremental_td3"))):
        assert TwinningConfig(arm=arm, learner=learning).learner is learning


def test_the_likeliest_hypothesis_teaches_with_its_hidden_states():
    """Slopes and virtual returns are those of the plant with a lag, along what the sensors of that plant read."""
    lagging = LaggedActuator(PLANT, "force", 0.3)
    found = learner("gain", twin=False, own={"trust": 1.0})
    twin = TwinEnsemble(PLANT, PLANT.closure, {"lags": lagging}, {"lags": lagging.closure})
    twin.weights = {"lags": 1.0}
    found.take_twin(twin)
    start, exogenous = lagging.at_rest(PLANT.draw_initial_state(1, seeded(8))), PLANT.draw_exogenous(1, seeded(9))
    with torch.no_grad():
        flight = Rollout(lagging, lagging.closure, found.policy)(start, exogenous)
    episode = found.memory.episodes[0].clone()
    episode["state"], episode["exogenous"] = flight.states[0, :-1, :2], exogenous[0]
    episode["action"] = flight.actions[0]
    slopes = found.teacher().slopes(episode)
    for k in (0, 30):
        action = flight.actions[0, k].clone().requires_grad_()
        one = Rollout(lagging, lagging.closure, engine="autograd")(
            flight.states[:, k], exogenous[:, k : k + 1], action.view(1, 1, -1)
        )
        rest = Rollout(lagging, lagging.closure, found.policy, engine="autograd")(
            one.states[:, -1], exogenous[:, k + 1 :]
        )
        states, actions = torch.cat([one.states, rest.states[:, 1:]], 1), torch.cat([one.actions, rest.actions], 1)
        t = PLANT.dt * torch.arange(k, PLANT.n_steps, dtype=torch.float64)
        cost = lagging.running_cost(t, states[:, :-1], actions, exogenous[:, k:])
        total = (cost * GAMMA ** torch.arange(cost.shape[1]).double()).sum()
        torch.testing.assert_close(slopes[k], torch.autograd.grad(total, action)[0])
    found.memory.episodes.clear()
    found.memory.episodes.append(episode)
    virtual = found.teacher().transitions(8, 1, reward_scale=1.0, generator=seeded(0))
    mean, spread = found.memory.statistics()
    met = (virtual["next", "features"] * spread + mean)[:, 2:4]
    # The recorded decision, of two intervals, leads where the real system went.
    torch.testing.assert_close(met, episode["state"][virtual["place"] + 2], rtol=1e-6, atol=1e-8)


def test_trust_is_measured_only_if_something_is_taught():
    assert learner().asks_for_trust
    assert not learner(own={"measured": False}).asks_for_trust
    assert not learner(own={"slopes": False, "virtual": 0}).asks_for_trust
    found = learner()
    found.trust_twin(0.8)
    assert found.trust == 0.8


# Patience, trust region and recovery


def test_the_policy_waits_until_the_errors_have_settled():
    found = learner(own={"settled": 1e9}, critic_iterations=50)
    start = weights_of(found.policy)
    found.update()
    found.adopt()
    assert same(found, start)
    found.update()
    found.adopt()
    assert not same(found, start)


def test_the_policys_learning_rate_cools():
    found = learner(own={"cooling": 2.0, "actor_rate": 1e-2}, critic_iterations=4)
    rates = []
    for _ in range(3):
        found.update()
        rates.append(found.actor_optimiser.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-2, 1e-2 / 1.5, 0.5e-2])
    found.restart()
    found.update()
    assert found.actor_optimiser.param_groups[0]["lr"] == 1e-2


@pytest.mark.parametrize("iterations, rate", [(1000, 0.01), (20, 5 / 3 * 2 / 40), (1, 0.5)])
def test_targets_carry_values_through_the_horizon_within_two_updates(iterations, rate):
    """Five decisions of the horizon are two targets of three decisions; the policy's delay is two."""
    assert 1.0 - learner(critic_iterations=iterations).target.eps == pytest.approx(rate)


def test_errors_have_settled_when_a_window_falls_no_longer():
    falling, level = torch.linspace(1.0, 0.1, 200), torch.ones(200)
    assert not settled(list(falling), 0.9) and settled(list(level), 0.9)
    assert not settled(list(level[:199]), 0.9) and not settled(list(level[:100]), 0.9)


def test_the_actions_keep_to_the_trust_region():
    found = learner(own={"trust_region": 1e-3, "actor_rate": 0.1}, critic_iterations=30)
    earlier = weights_of(found.policy)
    found._waiting = False
    found.update()
    found.adopt()
    seen, half = Lesson(found, 1.0).latest()["observation"], torch.tensor([2.0], dtype=torch.float64)
    assert 0.0 < change_of_actions(found.policy, earlier, seen, half) <= 1e-3


def test_an_update_is_a_candidate_until_it_has_flown():
    found = learner(critic_iterations=30)
    found._waiting = False
    start = weights_of(found.policy)
    found.update()
    assert same(found, start)
    found.adopt()
    flown = weights_of(found.policy)
    assert not same(found, start)
    found.flown(1.0)
    assert same(found, flown) and not found._waiting


def candidate_on_board():
    """A learner whose policy has flown for 1, and then taken the weights of an update; and the weights that flew."""
    found = learner(critic_iterations=30)
    found._waiting = False
    found.adopt()
    found.flown(1.0)
    start = weights_of(found.policy)
    found.update()
    found.adopt()
    return found, start


def test_a_candidate_that_may_not_fly_does_not_count_as_proved():
    found, start = candidate_on_board()
    proposed = weights_of(found.policy)
    found.grounded()
    assert same(found, start) and not same(found, proposed)
    found.grounded()  # nothing is on board
    found.adopt()
    assert same(found, proposed)
    found.flown(9.0)
    assert same(found, start)


@pytest.mark.parametrize("cost, kept", [(1.4, True), (1.6, False)])
def test_a_dear_episode_brings_back_the_weights_from_before(cost, kept):
    found, start = candidate_on_board()
    found.flown(cost)
    assert same(found, start) is not kept
    assert found._waiting is not kept


def test_costs_do_not_creep_up():
    found = learner(critic_iterations=4)
    for cost, kept in ((1.0, True), (1.4, True), (1.2, True), (1.7, True), (1.75, True), (1.85, False)):
        found.update()
        found.adopt()
        flown = weights_of(found.policy)
        found._waiting = False
        found.flown(cost)
        assert same(found, flown) is kept, cost


def test_a_candidate_of_an_idle_policy_is_improved_further():
    found = learner(critic_iterations=30)
    found._waiting = False
    start = weights_of(found.policy)
    found.update()
    found.update()
    assert not same(found, start)


def same(found, weights):
    return all(torch.equal(weight, weights[name]) for name, weight in weights_of(found.policy).items())


def test_a_transition_beyond_an_episode_is_refused():
    with pytest.raises(ValueError, match="return_steps=60 in decisions of 2 control intervals do not fit"):
        learner(return_steps=60)


@pytest.mark.parametrize(
    "change", [{"critics": 1}, {"virtual": -1}, {"trust": 1.1}, {"recovery": 1.0}, {"trust_region": 0.0}]
)
def test_wrong_parameters_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        IncrementalTD3Config(**change)


def test_the_policy_may_be_anybodys():
    class Own(nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = nn.Parameter(torch.tensor([0.3, 0.1], dtype=torch.float64))

        def forward(self, observation):
            return -(observation * torch.tanh(self.gain)).sum(-1, keepdim=True)

    POLICIES["own"] = Own
    try:
        found = learner("own", critic_iterations=20)
        found._waiting = False
        report = found.update()
    finally:
        del POLICIES["own"]
    assert report["value"].isfinite() and report["actor_gradient"] > 0.0
