"""Real episodes of the algorithm: one reset each, what the system draws, who steps it, and what a failure leaves."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from test_algorithm import flown, twinning
from test_real_system import Rig, connected

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.safety import SafetyConfig, SafetyLayer

HORIZON = 2.0


def algorithm(env):
    """The algorithm on this real system."""
    parts = twinning(LinearQuadratic(horizon=HORIZON))
    generator = torch.Generator().manual_seed(0)
    return ReinforcementTwinning(env, parts.twin, config=parts.config, generator=generator, **parts.policies)


class Machine(Rig):
    """A rig that counts what is done to it, and fails in a step where the test says so."""

    def __init__(self, plant, **options):
        super().__init__(plant, **options)
        self.done, self.fails_at = [], None

    def _reset(self, tensordict=None, **kwargs):
        self.done.append("reset")
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict):
        self.done.append("step")
        if self.count == self.fails_at:
            raise ConnectionError("no answer")
        return super()._step(tensordict)


def test_a_machine_is_reset_once_an_episode_at_its_beginning():
    plant = LinearQuadratic(horizon=HORIZON)
    machine = Machine(plant)
    found = algorithm(connected(plant, rig=machine))
    assert machine.done == []
    for _ in range(3):
        found.episode()
    assert machine.done == ["reset", *["step"] * 20] * 3


def test_after_a_failure_the_next_episode_begins_with_a_reset():
    plant = LinearQuadratic(horizon=HORIZON)
    machine = Machine(plant)
    found = algorithm(connected(plant, rig=machine))
    found.episode()
    machine.fails_at = 7  # too little of the episode is sound then
    for _ in range(2):
        with pytest.raises(ValueError, match="3 real episodes in a row .*in interval 7, at 0.7 s: Connection"):
            found.episode()
    assert len(found.learner.memory) == 20 and len(found.short_term) == 1 and found.episodes_done == 1
    machine.fails_at = None
    machine.done.clear()
    assert found.episode()["real_cost"].isfinite()
    assert machine.done == ["reset", *["step"] * 20] and len(found.learner.memory) == 40


@pytest.mark.parametrize("guarded", [False, True])
def test_episodes_of_a_simulation_are_every_second_draw_of_its_seed(guarded):
    """As in version 0.1, whose figures rest on them."""
    plant = LinearQuadratic(horizon=HORIZON)
    env = PlantEnv(plant, seed=4)
    found = algorithm(SafetyLayer(env, SafetyConfig(interval=0.1), fallback=(0.0,)) if guarded else env)
    generator = torch.Generator().manual_seed(4)
    for _ in range(3):
        flown(found)
        for _ in range(2):
            state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
        record = found.short_term[-1]
        assert torch.equal(record.states[0], state[0]) and torch.equal(record.exogenous, exogenous[0])


class Costly(PlantEnv):
    """A simulation of somebody's own that costs twice as much, and starts at rest."""

    def _reset(self, tensordict=None, **kwargs):
        found = super()._reset(tensordict, **kwargs)
        self._state = torch.zeros_like(self._state)
        return found.set("state", self._state.clone()).set("observation", self._state.clone())

    def _step(self, tensordict):
        found = super()._step(tensordict)
        return found.set("reward", 2.0 * found["reward"])


def test_what_a_subclass_overrides_takes_effect():
    plant = LinearQuadratic(horizon=HORIZON)
    found = algorithm(Costly(plant, seed=4))
    report, record = flown(found), found.short_term[-1]
    assert torch.equal(record.states[0], torch.zeros(2).double())
    cost = plant.running_cost(torch.zeros(20).double(), record.states[:-1], record.actions, record.exogenous)
    # Rounding of twenty sums.
    torch.testing.assert_close(report["real_cost"], 2.0 * cost.mean(), rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("batch", [2, 3])
def test_several_systems_at_once_are_refused(batch):
    with pytest.raises(ValueError, match=rf"batch_size=\({batch},\) of the real system .* one episode .* batch_size=1"):
        algorithm(PlantEnv(LinearQuadratic(horizon=HORIZON), batch_size=batch))


def test_a_system_without_a_batch_is_refused():
    with pytest.raises(ValueError, match=r"batch_size=\(\) of the real system .* RealSystem"):
        algorithm(Rig(LinearQuadratic(horizon=HORIZON)))


class Ends(PlantEnv):
    """Falls over after seven intervals."""

    def _step(self, tensordict):
        found = super()._step(tensordict)
        over = torch.full((1, 1), int(self._step_count) == 7)
        return found.update({"terminated": over, "done": found["done"] | over})


def test_an_environment_that_terminates_is_refused_with_what_to_do():
    plant = LinearQuadratic(horizon=HORIZON)
    message = "terminated the episode after 7 of 20 control intervals .* at most 0.7 s"
    found = algorithm(Ends(plant))
    with pytest.raises(ValueError, match=message):
        found.episode()
    assert not len(found.learner.memory) and not found.short_term
    found = algorithm(connected(plant, rig=Rig(plant, ends_after=7, terminates=True)))
    with pytest.raises(ValueError, match=message):
        found.episode()


def test_a_layer_that_loses_patience_is_refused_with_what_to_do():
    """The layer's shutdown truncates the episode, which then is not whole."""
    plant = LinearQuadratic(horizon=HORIZON)
    config = SafetyConfig(interval=0.1, patience=0.0)
    layer = SafetyLayer(Blind(plant), config, fallback=(0.0,))
    with pytest.raises(ValueError, match="truncated the episode after 4 of 20 control intervals"):
        algorithm(layer).episode()


class Blind(PlantEnv):
    """A system that reports NaN from its fourth interval on."""

    def _step(self, tensordict):
        found = super()._step(tensordict)
        return found.set("observation", found["observation"] * torch.nan) if self._step_count >= 4 else found


def test_a_layer_that_has_flown_nothing_has_an_empty_report():
    """A check of a protocol reads it before the first episode, in some processes."""
    layer = SafetyLayer(PlantEnv(LinearQuadratic(horizon=HORIZON), seed=4), SafetyConfig(interval=0.1), fallback=(0.0,))
    assert not layer.reports and not layer.report.events and not layer.report.counts
