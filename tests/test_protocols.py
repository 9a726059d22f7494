"""The same checks of every learner, planner and referee, also of those in the documentation."""

import io
from functools import partial

import pytest
import torch
from linear_quadratic import LinearQuadratic
from printed_commands import documented
from seeds_and_numbers import seeded
from test_algorithm import flown, twinning, weights

import rt_torchrl as rt
from rt_torchrl.steps.losses import METHODS

pytestmark = pytest.mark.training

PLANT = LinearQuadratic(horizon=2.0)
SMALL = {"critic_iterations": 4, "actor_iterations": 3, "batch_size": 16}


def actor_critic(algorithm, policy):
    return rt.ActorCritic(PLANT, policy, rt.LearnerConfig(algorithm=algorithm, **SMALL), generator=seeded(1))


LEARNERS = {
    **{name: partial(actor_critic, name) for name in METHODS},
    "documented": lambda policy: documented("learner.md", "RandomSearch")(policy, generator=seeded(1)),
}
PLANNERS = {
    "whole episodes": lambda twin, policy: rt.WholeEpisodes(twin, policy, rt.PlannerConfig(iterations=2)),
    "documented": lambda twin, policy: documented("planner.md", "Steps")(twin, policy),
}
REFEREES = {
    "decision tree": lambda: rt.DecisionTree(rt.RefereeConfig(rule="decision_tree", patience=0)),
    "expected cost": lambda: rt.DecisionTree(rt.RefereeConfig()),
    "documented": lambda: documented("referee.md", "ModelFirst")(),
}


def algorithm(**parts):
    """The algorithm with learner, planner or referee given as an argument: a function of twin and policies."""
    generator = seeded(2)
    twin = rt.DigitalTwin(PLANT, PLANT.make_closure(generator))
    policies = {"model_free": PLANT.make_policy(generator), "model_based": PLANT.make_policy(generator)}
    given = {"learner": (policies["model_free"],), "planner": (twin, policies["model_based"]), "referee": ()}
    parts = {name: make(*given[name]) for name, make in parts.items()}
    config = twinning().config
    return rt.ReinforcementTwinning(rt.PlantEnv(PLANT), twin, **policies, config=config, generator=generator, **parts)


def saved(state):
    """The state after it was saved to and loaded from a file that may hold only tensors and plain containers."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


UNLIKE = {name: LEARNERS[name] for name in ("ddpg", "sac", "crossq", "documented")}
"""Learners with states of different kinds."""


@pytest.mark.parametrize(
    "part, protocol, makers",
    [("learner", rt.Learner, UNLIKE), ("planner", rt.Planner, PLANNERS), ("referee", rt.Referee, REFEREES)],
)
def test_a_training_with_each_goes_on_from_its_state_as_if_never_interrupted(part, protocol, makers):
    """The result is the same to the bit; the other two parts are the default ones."""
    for name, make in makers.items():
        one, other = algorithm(**{part: make}), algorithm(**{part: make})
        assert isinstance(getattr(one, part), protocol), name
        one.episode(), one.episode()
        other.load_state_dict(saved(one.state_dict()))
        costs = [found.episode()["real_cost"] for found in (one, other)]
        assert costs[0] == costs[1], name
        for role in ("model_free", "model_based"):
            assert torch.equal(*(weights(found.policies[role]) for found in (one, other))), (name, role)
        assert one.referee.live == other.referee.live and one.episodes_done == other.episodes_done == 3


@pytest.mark.parametrize("name", LEARNERS)
def test_learners_train_their_policy_in_place_and_no_other(name):
    found = algorithm(learner=LEARNERS[name])
    before = {role: weights(policy) for role, policy in found.policies.items()}
    episode = flown(found)
    report = found.learner.update() if found.learner.store(episode["transitions", "0"]) is None else None
    assert all(value.isfinite() for value in report.values())
    assert not torch.equal(weights(found.policies["model_free"]), before["model_free"])
    assert torch.equal(weights(found.policies["model_based"]), before["model_based"])
    assert found.learner.observations().shape[1] == len(PLANT.observations)


@pytest.mark.parametrize("name", PLANNERS)
def test_planners_improve_their_policy_on_what_they_are_given(name):
    found = algorithm(planner=PLANNERS[name])
    flown(found, "interact", "inputs")
    episodes, policy = found.virtual.draw(8), found.policies["model_based"]

    def cost():
        return found.twin.expected_costs(policy, *episodes).mean().item()

    before, plan, after = cost(), found.planner.plan(episodes), cost()
    assert plan.start == pytest.approx(before, rel=1e-12) and plan.best == pytest.approx(after, rel=1e-12)
    assert after < before and plan.gradient > 0 and plan.iterations >= 1
