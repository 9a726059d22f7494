"""The six steps together, on the linear-quadratic plant, where the right closure and the right gain are known."""

import dataclasses

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic, optimal_gain
from printed_commands import documented
from seeds_and_numbers import seeded
from small_runs import IDLE
from tensordict import TensorDict
from test_classical import PD

import rt_torchrl as rt
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.steps.belief import Judged
from rt_torchrl.steps.report import metrics, same_architecture
from rt_torchrl.steps.switch import other_than

STEPS = ["interact", "learn", "inputs", "assimilate", "plan", "switch"]


LEARNING = rt.LearnerConfig(critic_iterations=3, actor_iterations=2, batch_size=16)


def twinning(
    plant=None, *, seed=0, env_seed=0, env=None, closure=None, model_free=None, model_based=None, first=None, **options
):
    """The algorithm on a real system, by default in simulation; ``options`` are those of its configuration."""
    plant = plant or LinearQuadratic(horizon=2.0)
    generator = torch.Generator().manual_seed(seed)
    usual = {
        "realisations": 2,
        "virtual_episodes": 3,
        "learner": IDLE,
        "assimilation": rt.AssimilationConfig(iterations=2),
        "planner": rt.PlannerConfig(iterations=2, starts=0, descent=rt.DescentConfig(rate=0.01)),
    }
    return rt.ReinforcementTwinning(
        env or rt.PlantEnv(plant, seed=env_seed),
        rt.DigitalTwin(plant, closure or plant.make_closure(generator)),
        model_free=model_free or plant.make_policy(generator),
        model_based=model_based or plant.make_policy(generator),
        config=rt.TwinningConfig(**usual | options),
        generator=generator,
        first=first,
    )


def flown(found, *steps, episode=None):
    """The episode after these steps, by default the first one."""
    if episode is None:
        episode = TensorDict({"number": found.episodes_done}).set_non_tensor("live", found.referee.live)
    for name in steps or ("interact",):
        episode = found.module[name](episode)
    return episode


def weights(module):
    return torch.cat([w.detach().flatten() for w in module.parameters()]).clone()


def scripted(found, live, idle):
    """Make step 6 compare these costs."""
    acts = found.referee.live
    costs = {found.policies[acts]: live, found.policies[other_than(acts)]: idle}
    found.belief.judge = lambda policy, episodes: Judged(*3 * (costs[policy],))


@pytest.mark.parametrize(
    "arm, expected", [("twinning", STEPS), ("model_free", STEPS[:2]), ("model_based", [STEPS[0], *STEPS[2:5]])]
)
def test_steps_come_in_order(arm, expected):
    found, calls = twinning(arm=arm, learner=LEARNING), []
    report = found.episode(calls.append)
    assert calls == expected and list(report["seconds"].keys()) == expected
    assert found.episodes_done == 1
    assert ("J_p" in report) == (arm != "model_free") and ("critic_loss" in report) == (arm != "model_based")


def test_what_is_stored_is_what_was_applied():
    """The turbine's rate limits change most commands of a policy with noise."""
    found, rollouts = twinning(WindTurbine(horizon=30.0), exploration=rt.ExplorationConfig(spread=1.0, episodes=5)), []
    fly = found.collector.rollout
    found.collector.rollout = lambda: rollouts.append(fly()) or rollouts[-1]
    found.steps["learn"].store(flown(found)["transitions"].values())
    (record,) = found.short_term
    (commands,) = rollouts[-1]["action"]
    stored = found.learner.memory.buffer[:60]
    # The plant latches the applied action into the state at the end of the interval.
    # The flight computes it in machine code, and the record from the states of the flight: rounding.
    torch.testing.assert_close(record.actions, record.states[1:, 4:], rtol=1e-14, atol=0.0)
    assert torch.equal(stored["action"], found.learner.actor.scaled(record.actions))
    assert (commands != record.actions).any(0).all()
    assert record.states.shape == (61, 6) and record.exogenous.shape == (60, 1)


@pytest.mark.parametrize("inputs", ["record", "realisations"])
def test_the_true_twin_replays_the_record_exactly_under_the_measured_input_only(inputs):
    closure = LinearClosure(LinearQuadratic.true_closure)
    found = twinning(closure=closure, assimilation=rt.AssimilationConfig(iterations=1, inputs=inputs))
    J_p = flown(found, "interact", "inputs", "assimilate")["J_p_before"].item()
    assert (J_p < 1e-20) == (inputs == "record")


def test_live_starts_model_free_and_explores_less_and_less():
    found = twinning(arm="model_free", exploration=rt.ExplorationConfig(spread=0.2, episodes=4))
    assert found.referee.live == "model_free" and found.actor.policy is found.policies["model_free"]
    strengths = [found.episode()["exploration"] for _ in range(6)]
    assert strengths == pytest.approx([1.0, 0.75, 0.5, 0.25, 0.0, 0.0])


@pytest.mark.parametrize("live", ["model_free", "model_based"])
def test_clone_copies_the_live_weights_and_restarts_the_idle_optimiser(live):
    found = twinning(learner=LEARNING, referee=rt.RefereeConfig(clone_patience=0))
    found.referee.live = live
    episode = flown(found, *STEPS[:-1])
    optimisers = {
        "model_free": lambda: found.learner.actor_adam.parts[0].item(),
        "model_based": lambda: found.planner._optimiser.state,
    }
    idle, before = other_than(live), weights(found.policies[live])
    assert all(state() for state in optimisers.values())
    assert not torch.equal(weights(found.policies[idle]), before)
    scripted(found, live=1.0, idle=2.0)
    assert flown(found, "switch", episode=episode)["event"] == "clone"
    assert torch.equal(weights(found.policies[idle]), before) and torch.equal(weights(found.policies[live]), before)
    assert found.policies[idle] is not found.policies[live] and found.referee.live == live
    assert not optimisers[idle]() and optimisers[live]()


def test_planning_finds_the_optimal_gain():
    """The best constant gain on the true twin is Riccati's over 10 s, which are ten time constants of the loop."""
    plant, closure = LinearQuadratic(horizon=10.0, noise=0.0), LinearClosure(LinearQuadratic.true_closure)
    planner = rt.PlannerConfig(iterations=40, descent=rt.DescentConfig(optimiser="lbfgs", rate=1.0))
    found = twinning(plant, closure=closure, arm="model_based", realisations=8, planner=planner)
    episode = flown(found, "interact", "inputs")
    report = flown(found, "plan", episode=episode)
    assert report["J_a_plan"] < report["J_a_plan_before"]
    gain, best = found.policies["model_based"].gain.detach().numpy(), optimal_gain(1.0)
    # L-BFGS stops at cost changes of 1e-9; the cost curves with about 0.1 per unit of gain²: 1e-4, and the tail.
    assert np.linalg.norm(gain - best) < 1e-3 * np.linalg.norm(best), (gain, best)


def test_a_step_of_ones_own_flows_with_the_others():
    """The twin is the real system, so that the residual of the page is rounding."""
    closure = LinearClosure(LinearQuadratic.true_closure)
    found = twinning(closure=closure, assimilation=rt.AssimilationConfig(iterations=0))
    found.insert("residual", documented("method.md", "Residual")(found.twin), before="plan")
    report = found.episode()
    assert report["residual"] < 1e-9 and list(report["seconds"].keys()) == [*STEPS[:4], "residual", *STEPS[4:]]
    with pytest.raises(ValueError, match="before='planning' is no step of this arm; choose one of interact, learn"):
        found.insert("other", found.module["plan"], before="planning")


@pytest.mark.parametrize("step", ["learn", "assimilate"])
def test_what_a_step_has_that_is_left_out_is_left_alone(step):
    """Not even the start takes it; and the belief of a checkpoint does not depend on it."""
    first = rt.FirstController(PD(LinearQuadratic(horizon=2.0), (0.4, 0.3)))
    found, other = twinning(first=first), twinning(first=first)
    before = found.twin.closure.matrix.detach().clone()
    for each in (found, other):
        del each.module[step]
    found.episode()
    assert torch.equal(found.twin.closure.matrix, before) == (step == "assimilate")
    assert len(found.learner.memory) == (0 if step == "learn" else 40)
    other.load_state_dict(found.state_dict())
    assert len(other.belief.flown) == len(found.belief.flown) == 1 == len(other.belief.first)


def test_weights_of_two_modules_are_not_shared():
    """One step would move them under another."""
    shared, plant = LinearGain([[0.1, 0.2]]), LinearQuadratic(horizon=2.0)
    with pytest.raises(ValueError, match="share trainable weights, which one step would move under another"):
        twinning(plant, model_free=shared, model_based=shared)


def test_keys_flow_as_the_steps_declare():
    """Each step finds what it reads, and writes what it says."""
    found = twinning()
    episode = TensorDict({"number": 0}).set_non_tensor("live", found.referee.live)
    for name, step in found.module.items():
        assert all(key in episode.keys(include_nested=True) for key in step.in_keys), name
        episode = step(episode)
        assert all(key in episode.keys(include_nested=True) for key in step.out_keys), name
    record, n = episode["record"], found.twin.plant.n_steps
    assert record["states"].shape == (n + 1, 2) and record["actions"].shape == record["exogenous"].shape == (n, 1)
    assert len(episode["transitions", "0"]) == n and episode["large_scale"].shape == (n, 1)
    assert set(found.in_keys) == {"number", "live"}


# A clone between two architectures.


PLANT = LinearQuadratic(horizon=2.0)


def affine(*rows):
    policy = rt.SaturatedAffine(2, PLANT.actions, generator=seeded(0))
    with torch.no_grad():
        policy.linear.weight.copy_(torch.tensor(rows))
    return policy


def perceptron(seed=1):
    return rt.SaturatedMLP(2, PLANT.actions, hidden=(16, 16), generator=seeded(seed))


def two_architectures(**options):
    options = {"learner": LEARNING, "referee": rt.RefereeConfig(clone_patience=0), **options}
    policies = {"model_free": perceptron(), "model_based": affine([-0.8, -1.1])}
    return twinning(PLANT, seed=9, closure=LinearClosure(PLANT.true_closure), **policies, **options)


@pytest.mark.parametrize("live", ["model_free", "model_based"])
def test_a_clone_event_distils(live):
    found = two_architectures()
    found.referee.live = live
    episode = flown(found, *STEPS[:-1])
    idle = other_than(live)
    before, replaced = weights(found.policies[live]), weights(found.policies[idle])
    judge, poor = found.belief.judge, found.policies[idle]

    def judged(policy, episodes):
        return (
            Judged(1e9, 1e9, 1e9)
            if policy is poor and torch.equal(weights(poor), replaced)
            else judge(policy, episodes)
        )

    found.belief.judge = judged
    report = flown(found, "switch", episode=episode)
    assert report["event"] == "clone" and torch.equal(weights(found.policies[live]), before)
    assert 0.0 < report["distillation_error"] < 0.05
    # The clone costs what the live policy does, within what an action of 5 % of the range can change.
    assert report["distillation_cost_ratio"] == pytest.approx(1.0, rel=0.1)
    assert report[f"expected/{idle}"] == pytest.approx(report[f"expected/{live}"].item(), rel=0.1)  # not 1e9
    steps = found.learner.actor_adam.parts[0] if idle == "model_free" else found.planner._optimiser.state
    assert not steps


def test_a_refused_clone_is_no_event_and_says_why():
    found = two_architectures()
    found.referee.live = "model_based"
    episode = flown(found, *STEPS[:-1])
    before = {role: weights(policy) for role, policy in found.policies.items()}
    costs = iter([1e-9, 2e-9, 2e-9, 1.0])  # of both policies, of that which is replaced, of its clone
    found.belief.judge = lambda policy, episodes: Judged(*3 * (next(costs),))
    report = flown(found, "switch", episode=episode)
    assert report["event"] == "keep" and "clone refused" in report["reason"]
    assert all(torch.equal(before[role], weights(policy)) for role, policy in found.policies.items())
    assert found.referee.stall_count == 0


def test_a_copy_of_weights_is_no_clone_of_another_activation():
    """Weights have the same names and shapes but make other functions, so a copy of them is another policy."""

    def network(activation, generator_seed=0):
        torch.manual_seed(generator_seed)
        return torch.nn.Sequential(torch.nn.Linear(2, 4), activation, torch.nn.Linear(4, 1)).double()

    assert same_architecture(network(torch.nn.Tanh()), network(torch.nn.Tanh(), 1))
    assert not same_architecture(network(torch.nn.Tanh()), network(torch.nn.SiLU()))
    assert not same_architecture(network(torch.nn.LeakyReLU(0.1)), network(torch.nn.LeakyReLU(0.2)))

    class Scaled(torch.nn.Module):
        def __init__(self, factor):
            super().__init__()
            self.factor, self.layer = factor, torch.nn.Linear(2, 1)

    assert same_architecture(Scaled(1.0), Scaled(1.0)) and not same_architecture(Scaled(1.0), Scaled(2.0))
    ones, twos = np.ones(2), np.full(2, 2.0)
    assert same_architecture(Scaled(ones), Scaled(ones.copy())) and not same_architecture(Scaled(ones), Scaled(twos))
    assert not same_architecture(affine([-0.8, -1.1]), perceptron())


# What diverges on the twin: a closure, a plan, an idle policy, and a live one that its update has ruined.


def fill(module, number):
    """Give every weight of a module this number."""
    with torch.no_grad():
        for weight in module.parameters():
            weight.fill_(number)


def unsound(found, monkeypatch, episodes, weight=1e300):
    """Let step 4 find, in these episodes, a closure under which no flight stays finite, or near what was flown."""
    update = found.assimilation.update

    def updated(*arguments):
        descended = update(*arguments)
        if found.episodes_done in episodes:
            fill(found.twin.closure, weight)
        return descended

    monkeypatch.setattr(found.assimilation, "update", updated)


@pytest.mark.parametrize("step, weight", [("plan", 1e300), ("switch", 1e300), ("plan", 20.0)])
def test_a_closure_that_cannot_be_flown_with_is_taken_back(monkeypatch, step, weight):
    """Costs are infinite, or finite and more than e⁵ times what the real episode cost."""
    found, sound = twinning(), twinning()
    for algorithm in (found, sound):
        algorithm.episode()
    earlier = weights(found.twin.closure)
    unsound(found, monkeypatch, {1}, weight)
    # Compared with an algorithm whose step 4 finds nothing new, and whose planning begins afresh.
    sound.planner.restart()
    sound.assimilation.config = dataclasses.replace(sound.assimilation.config, iterations=0)
    if step == "switch":
        for algorithm in (found, sound):
            monkeypatch.setattr(algorithm.steps["plan"], "plan", lambda *arguments: metrics())
    report, expected = found.episode(), sound.episode()
    assert report["closure_refused"] == 1.0 and expected["closure_refused"] == 0.0
    assert report["reason"].startswith("closure refused: plant") and "diverged" in report["reason"]
    assert torch.equal(weights(found.twin.closure), earlier)
    for role in found.policies:
        assert torch.equal(weights(found.policies[role]), weights(sound.policies[role]))
    assert report["J_a_model_based"] == expected["J_a_model_based"]


@pytest.mark.parametrize("live, idle", [("model_free", "model_based"), ("model_based", "model_free")])
def test_an_idle_policy_that_diverges_on_the_twin_loses_and_is_named(monkeypatch, live, idle):
    """The closure that was just found stays, the training goes on, and the live policy stays live."""
    found = twinning(referee=rt.RefereeConfig(patience=0))
    found.referee.live, cost = live, found.twin.cost

    def checked(policy, *episodes):
        if policy is found.policies[idle]:
            raise rt.DivergenceError("plant 'linear_quadratic' diverged")
        return cost(policy, *episodes)

    monkeypatch.setattr(found.twin, "cost", checked)
    report = found.episode()
    assert report["closure_refused"] == 0.0 and found.referee.live == live
    assert report[f"J_a_{idle}"].isinf() and report[f"J_a_{live}"].isfinite()
    assert f"{idle} diverges on the twin" in report["reason"]
    assert report["plan_accepted"] == 0.0 or idle == "model_free"


def ruined_by(half, method, policy, monkeypatch):
    """Let a method leave finite weights under which the states overflow."""
    right = getattr(half, method)

    def ruined(*arguments):
        report = right(*arguments)
        fill(policy, 1e9)
        return report

    monkeypatch.setattr(half, method, ruined)


def test_a_live_policy_that_its_update_has_ruined_puts_no_closure_in_doubt(monkeypatch):
    """The weights that flew are sound; those that step 2 made of them diverge, cost infinitely much and lose."""
    found = twinning(referee=rt.RefereeConfig(rule="decision_tree", patience=0))
    ruined_by(found.learner, "update", found.policies["model_free"], monkeypatch)
    report = found.episode()
    assert report["closure_refused"] == 0.0 and report["J_a_model_free"].isinf()
    assert report["event"] == "swap" and found.referee.live == "model_based"
    assert "model_free diverges on the twin" in report["reason"]


def test_a_plan_that_diverges_is_refused_and_the_policy_before_stays(monkeypatch):
    found = twinning()
    before = weights(found.policies["model_based"])
    ruined_by(found.planner, "plan", found.policies["model_based"], monkeypatch)
    report = found.episode()
    assert report["plan_accepted"] == 0.0 and report["closure_refused"] == 0.0
    assert torch.equal(weights(found.policies["model_based"]), before)
    assert report["J_a_model_based"].isfinite()


@pytest.mark.parametrize("closures", [0, 1])
def test_an_interrupt_leaves_no_plan_that_nobody_has_judged(monkeypatch, closures):
    """Neither in the first plan, nor in that which repeats it with an earlier closure."""
    found, planned = twinning(), []
    before = weights(found.policies["model_based"])

    def interrupted(episodes):
        fill(found.policies["model_based"], 0.0)
        planned.append("unsound")
        raise KeyboardInterrupt if len(planned) > closures else rt.DivergenceError("the twin diverged")

    def unsound_twin(*arguments):
        if planned and planned[-1] == "unsound":
            planned[-1] = "told"
            raise rt.DivergenceError("the twin diverged under what has flown")

    monkeypatch.setattr(found.planner, "plan", interrupted)
    monkeypatch.setattr(found.belief, "require_sound_twin", unsound_twin)
    with pytest.raises(KeyboardInterrupt):
        found.episode()
    assert len(planned) == closures + 1 and torch.equal(weights(found.policies["model_based"]), before)


@pytest.mark.parametrize("method", ["adam", "levenberg_marquardt"])
def test_a_fit_begins_anew_where_the_present_closure_diverges_and_the_first_one_does_not(method):
    found = twinning(assimilation=rt.AssimilationConfig(iterations=2, segment=0, method=method))
    found.episode()
    fill(found.twin.closure, 1e3)
    report = found.episode()
    assert report["J_p_before"].isinf() and report["J_p"].isfinite()
    assert all(weight.abs().max() < 10.0 for weight in found.twin.closure.parameters())
    assert all(weight.isfinite().all() for weight in found.assimilation.first.values())
    fill(found.twin.closure, 1e3)
    found.assimilation.first = {name: torch.full_like(w, 1e4) for name, w in found.assimilation.first.items()}
    report = flown(found, "assimilate", episode=TensorDict({"record": {"whole": torch.tensor(True)}, "live": "first"}))
    assert report["J_p_before"].isinf() and report["J_p"].isinf()
    assert all((weight == 1e3).all() for weight in found.twin.closure.parameters())


@pytest.mark.parametrize("right", [True, False])
def test_a_plan_that_no_flight_has_tried_does_not_stay_if_real_episodes_contradict_the_twin(right):
    plant = LinearQuadratic(horizon=2.0)
    closure = LinearClosure(plant.closure.matrix.detach() + (0.0 if right else 0.5))
    referee = rt.RefereeConfig(rule="expected_cost")
    options = {"arm": "model_based", "referee": referee, "assimilation": rt.AssimilationConfig(iterations=0)}
    found = twinning(plant, closure=closure, **options)
    for _ in range(3):
        found.episode()
    flown_weights = [flight.weights["gain"] for flight in found.belief.flown]
    with torch.no_grad():
        found.model_based.gain.add_(1.0)
    untried = weights(found.model_based)
    assert found.belief.contradicted == found.conclude() == (not right)
    concluded = found.model_based.gain.detach().clone()
    assert any(torch.equal(concluded, gain) for gain in flown_weights) == (not right)
    assert torch.equal(weights(found.model_based), untried) == right
    assert not found.conclude() and torch.equal(found.model_based.gain, concluded)
