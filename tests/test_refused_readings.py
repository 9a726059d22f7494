"""Readings that the watchdog refuses: their names, the episodes that are not learned from, and the next episode."""

import re

import pytest
import torch
from linear_quadratic import LinearQuadratic
from test_real_episodes import HORIZON, algorithm
from test_real_system import connected
from test_safety import Clock, Failing, failing, fly, layer

from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.reading import Actuation, Reading
from rt_torchrl.systems.real_system import RealSystem

NAN = float("nan")
RANGES = {"ranges": {"observation": (-50.0, 50.0)}}


class Spiky(Failing):
    """A system with a value that is off in its fourth observation, in the first episodes only."""

    def __init__(self, plant, value, episodes):
        super().__init__(plant, Clock(), broken=[3], value=value)
        self.left = episodes

    def _step(self, tensordict):
        broken, self.broken = self.broken, self.broken if self.left else set()
        found, self.broken = super()._step(tensordict), broken
        self.left -= int(self._step_count) == self.plant.n_steps and self.left > 0
        return found


def stored(found):
    """Everything that both memories hold, in one vector."""
    record, replay = found.short_term[-1], found.learner.memory.buffer[:]
    entries = [replay[key] for key in ("observation", "action", ("next", "observation"), ("next", "reward"))]
    return torch.cat([tensor.flatten() for tensor in (*entries, record.states, record.actions, record.exogenous)])


@pytest.mark.parametrize(
    ("value", "options", "reason"),
    [
        (1e5, RANGES, "refused 1 of its readings, the first at the end of interval 3"),
        (NAN, {}, "refused 1 of its readings, the first at the end of interval 3"),
        (1e300, {}, r"observation holds 1e\+300 in interval 4"),
    ],
)
def test_an_episode_with_a_refused_reading_is_flown_again(value, options, reason):
    plant = LinearQuadratic(horizon=HORIZON)
    found = algorithm(layer(Spiky(plant, value, episodes=2), **options))
    report = found.episode()
    assert report["episodes_refused"] == 2 and len(found.env.reports) == 3
    assert re.search(reason, report["refusal"])
    assert len(found.learner.memory) == 20 and len(found.short_term) == 1
    # Of this plant under these policies nothing comes near to fifty.
    assert stored(found).abs().max() < 50.0 and report["real_cost"] < 50.0
    assert "episodes_refused" not in found.episode()


def test_a_machine_whose_readings_stay_refused_ends_the_training():
    plant = LinearQuadratic(horizon=HORIZON)
    found = algorithm(layer(Spiky(plant, 1e5, episodes=3), **RANGES))
    with pytest.raises(ValueError, match=r"3 real episodes in a row .* refused 1 of its readings"):
        found.episode()
    assert not len(found.learner.memory) and not found.short_term and found.episodes_done == 0
    # The machine has been mended.
    assert found.episode()["real_cost"].isfinite() and len(found.learner.memory) == 20


def test_without_a_layer_numbers_that_overflow_are_refused_too():
    plant = LinearQuadratic(horizon=HORIZON)
    found = algorithm(Spiky(plant, 1e300, episodes=1))
    report = found.episode()
    assert report["episodes_refused"] == 1 and stored(found).isfinite().all()


def test_a_late_reading_is_no_wrong_one():
    env = failing(late=[6], deadline=0.2)
    assert not fly(env, [0.5] * 20)["next", "refused"].any() and env.report.counts["late"] == 1


def test_a_real_system_passes_the_refusals_of_its_layer_on():
    plant = LinearQuadratic(horizon=HORIZON)
    guarded = failing(broken=[3, 4], value=1e5, **RANGES)
    readings = {"state": Reading(keys=("state",)), "exogenous": Reading(keys=("exogenous",))}
    system = RealSystem(guarded, plant, applied=Reading(keys=("applied",)), actuation=Actuation(), **readings)
    episode = system.rollout(20)
    assert episode["next", "refused"].flatten().nonzero().flatten().tolist() == [3, 4]
    assert "refused" not in connected(plant).observation_spec


class Worthless(PlantEnv):
    """A system whose own reward is NaN."""

    def _step(self, tensordict):
        found = super()._step(tensordict)
        return found.set("reward", found["reward"] * NAN)


def test_a_reward_is_no_reading():
    """A bad reward trips nothing: a real system does not use it, and where it is used the episode is refused."""
    plant = LinearQuadratic(horizon=HORIZON)
    env = layer(Worthless(plant))
    assert fly(env, [0.5] * 20)["next", "applied"].eq(0.5).all() and not env.report.events
    with pytest.raises(ValueError, match=r"3 real episodes in a row .*\('next', 'reward'\) holds nan"):
        algorithm(env).episode()


class Silent(PlantEnv):
    """A system that leaves out its observation from its third step on."""

    def _step(self, tensordict):
        found = super()._step(tensordict)
        return found.exclude("observation") if self._step_count >= 3 else found


def test_an_observation_that_is_left_out_is_a_fault_and_the_last_one_is_held():
    env = layer(Silent(LinearQuadratic(horizon=HORIZON)))
    episode = fly(env, [0.5] * 20)
    assert episode["next", "refused"].flatten().nonzero().flatten().tolist() == list(range(2, 20))
    assert (episode["next", "observation"][0, 2:] == episode["next", "observation"][0, 1]).all()
    assert env.report.counts["missing"] == 18 and "observation" in env.report.events[0].reasons["missing"]


def test_a_critic_that_has_diverged_is_told_before_a_memory_takes_its_errors():
    found = algorithm(PlantEnv(LinearQuadratic(horizon=HORIZON)))
    for weight in found.learner.critic.parameters():
        weight.data.fill_(NAN)
    with pytest.raises(ValueError, match="TD errors .* not finite .* critic has diverged"):
        found.episode()
    assert not len(found.learner.memory) and not found.short_term
