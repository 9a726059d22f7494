"""The recipes that measure twins: from some sensors, in a few episodes, and with other memories."""

import math

import pytest
import torch
from test_export_recipe import recipe

from rt_torchrl.figures import save_figure
from rt_torchrl.fit.sensors import sensors_of
from rt_torchrl.runs.command_line import from_command_line, load_recipe


def test_plans_from_some_sensors_see_nothing_else(tmp_path):
    """The options of every training are taken, the sensors exist, and no state of the body is observed beside them."""
    partial = recipe("partial")
    config = partial.Config(log_dir=tmp_path, seeds=1)
    for plant in config.plants:
        (whole,), (training,) = (config.trainings(plant, partial=one) for one in (False, True))
        made = from_command_line(load_recipe(training.recipe).Config, training.arguments())
        assert made.twinning.assimilation.sensors == partial.SENSORS[plant]
        assert sensors_of(made.plant(), made.twinning.assimilation.sensors)
        other = from_command_line(load_recipe(whole.recipe).Config, whole.arguments())
        assert not other.twinning.assimilation.sensors and whole.folder != training.folder
        require_unseen(made.plant(), partial.SENSORS[plant])


def require_unseen(plant, sensors):
    """No change of a state that neither a sensor reads nor a controller holds changes the observation."""
    state = plant.draw_initial_state(1, torch.Generator().manual_seed(0))
    exogenous = plant.draw_exogenous(1, torch.Generator().manual_seed(0))[:, 0]
    seen = plant.observe(torch.zeros(1).double(), state, exogenous)
    for k, signal in enumerate(plant.states):
        if signal.name not in (*sensors, *plant.controller_states):
            moved = state.clone()
            moved[:, k] += 0.01
            assert torch.equal(plant.observe(torch.zeros(1).double(), moved, exogenous), seen), signal.name


def test_costs_are_compared_by_their_medians():
    partial = recipe("partial")
    shown = partial.table({"cryogenic_tank": {"state": [2.0, 4.0, 3.0], "sensors": [3.03, 1.0, 9.0]}})
    assert "| cryogenic_tank, pressure | 2 … 4 | 1 … 9 | 1.0100 |" in shown
    for options in ({"seeds": 0}, {"unseen": 1}, {"jobs": 0}):
        with pytest.raises(ValueError, match=next(iter(options))):
            partial.Config(**options)


class Kept:
    """A training with results."""

    def __init__(self, found, true):
        self.laws = {"found": found, "true": true}

    def metrics(self):
        return {"summary": {"closure": self.laws}}


def test_the_greatest_error_of_a_weight_counts():
    accuracy = recipe("accuracy")
    assert accuracy.weight_error(Kept({"a": 1.01, "b": 0.49}, {"a": 1.0, "b": 0.5})) == pytest.approx(0.02)
    assert "| flapping_wing | 2 | 0.1 %, 20 % |" in accuracy.table({"flapping_wing": [0.001, 0.2]}, {})
    assert "on its records | 1 %, 0.02 % |" in accuracy.table({}, {"records": [0.01, 0.0002]})
    assert [len(accuracy.Config().trainings(plant)) for plant in accuracy.EPISODES] == [5, 5, 5]
    with pytest.raises(ValueError, match="seeds=0"):
        accuracy.Config(seeds=0)


def test_memories_are_compared_over_the_second_half(tmp_path):
    memory = recipe("memory")
    one = [{"J_p": 100.0, "J_a": 1.0}, {"J_p": 2.0, "J_a": 3.0}]
    other = [{"J_p": 100.0, "J_a": 1.0}, {"J_p": 8.0, "J_a": 3.0}]
    found = {name: [one, other] for name in memory.MEMORIES}
    assert f"| last | {math.sqrt(2.0 * 8.0):g} | 3 |" in memory.table(found)
    figure = memory.figure(found)
    assert [line.get_ydata()[-1] for line in figure.axes[0].lines] == pytest.approx([4.0] * len(memory.MEMORIES))
    save_figure(figure, tmp_path / "memory.png")
    with pytest.raises(ValueError, match="episodes=0"):
        memory.Config(episodes=0)


@pytest.mark.nightly
def test_a_drone_and_a_tank_are_known_after_two_and_three_episodes(tmp_path):
    """Without noise the twin has the true form, so that its weights are those of the real system."""
    accuracy = recipe("accuracy")
    for plant, most in (("flapping_wing", 1e-3), ("cryogenic_tank", 1e-2)):
        (training,) = accuracy.Config(seeds=1, log_dir=tmp_path).trainings(plant)
        training.run()
        assert accuracy.weight_error(training) < most


@pytest.mark.nightly
def test_a_twin_with_every_memory_is_judged_after_every_episode(tmp_path):
    memory = recipe("memory")
    memory.main(memory.Config(seeds=1, episodes=2, unseen=2, log_dir=tmp_path))
    assert {"memory.json", "memory.png"} <= {path.name for path in tmp_path.iterdir()}
