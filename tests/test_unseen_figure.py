"""The figure and the table of the unseen episodes, against the numbers they show."""

import numpy as np
import torch
from figure_reading import collisions, draw

from rt_torchrl import figures
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.evaluation.unseen import Judged, UnseenEpisodes
from rt_torchrl.runs.results import results
from rt_torchrl.runs.results_table import merit_lines

COUNT = 12


def judged(*names):
    generator = torch.Generator().manual_seed(0)
    values = {name: torch.rand(2, COUNT, generator=generator, dtype=torch.float64) + 0.1 for name in names}
    return {name: Judged(costs, {"final distance [m]": 100.0 * merit}) for name, (costs, merit) in values.items()}


def test_every_episode_is_a_point_and_every_mean_a_bar():
    found, strong = judged("model_based", "model_free", "PD"), torch.arange(COUNT) < 3
    figure = figures.unseen(found, {"weak": ~strong, "strong": strong})
    draw(figure)
    assert len(figure.axes) == 2
    for ax, pick in zip(figure.axes, ("costs", "merit"), strict=True):
        shown = [line for line in ax.lines if line.get_marker() in ("o", "^") and len(line.get_ydata())]
        bars = [line for line in ax.lines if line.get_marker() == "None"]
        for column, (who, values) in enumerate(found.items()):
            expected = values.control_costs if pick == "costs" else values.merit["final distance [m]"]
            weak, hard = shown[2 * column : 2 * column + 2]
            assert np.array_equal(weak.get_ydata(), expected[3:]) and np.array_equal(hard.get_ydata(), expected[:3])
            assert np.allclose(bars[column].get_ydata(), expected.mean().item()), who
            assert (np.abs(weak.get_xdata() - column) < 0.3).all()
    assert {text.get_text() for text in figure.legends[0].get_texts()} == {"weak", "strong"}


def test_names_of_four_controllers_do_not_meet():
    figure = figures.unseen(judged("model_based", "model_free", "on-off", "Jonkman"), {})
    draw(figure)
    assert not collisions(figure)


def test_kinds_of_episodes_are_counted_and_averaged_apart():
    plant = FlappingWing(horizon=2.0)
    unseen = UnseenEpisodes(plant, COUNT)
    unseen.exogenous = torch.full_like(unseen.exogenous, 1.0)
    # Too strong in the last second of three episodes; strong, but early enough, in a fourth.
    unseen.exogenous[:3, -10:] = plant.strongest_wind + 0.01
    unseen.exogenous[3, :100] = 9.0
    found = judged("model_based", "model_free")
    apart = results(unseen, found)["categories"]
    assert {kind: part["episodes"] for kind, part in apart.items()} == {
        "gust can be held": 9,
        "gust too strong to hold": 3,
    }
    strong = apart["gust too strong to hold"]["model_free"]
    assert np.isclose(strong["J_a"]["mean"], found["model_free"].control_costs[:3].mean().item())
    median = found["model_free"].merit["final distance [m]"][:3].median().item()
    assert strong["merit"]["final distance [m]"]["median"] == median
    lines = merit_lines({"episodes": COUNT, **results(unseen, found)})
    assert any("gust too strong to hold, 3 of 12 episodes" in line for line in lines)
    assert sum("final distance" in line for line in lines) == 3
