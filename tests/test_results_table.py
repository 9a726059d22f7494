"""The closure's weights on the terminal."""

import torch

from rt_torchrl.envs.pendulum.plant import UniformRod
from rt_torchrl.plants.closures import described_weights
from rt_torchrl.runs.results_table import closure_lines


def test_true_weights_are_shown_where_they_are_known():
    closure = {"start": {"a": 1.0, "b": 2.0}, "found": {"a": 1.5, "b": 2.5}}
    bare = [["a", "1", "1.5"], ["b", "2", "2.5"]]
    for unknown in ({}, {"true": None}, {"true": {"other": 1.0}}):
        shown = [line.split() for line in closure_lines(closure | unknown)]
        assert shown == [["closure", "weight", "start", "found"], *bare]
    shown = [line.split() for line in closure_lines(closure | {"true": {"a": 1.25}})]
    assert shown[0][-1] == "true" and [line[-1] for line in shown[1:]] == ["1.25", "-"]


def test_units_and_meanings_are_shown_where_the_closure_states_them():
    described = described_weights(UniformRod.guess(0.5))
    closure = {"start": {"mass": 0.5, "length": 0.5}, "found": {"mass": 1.0, "length": 0.75}, "described": described}
    shown = closure_lines(closure)
    assert shown[1].split() == ["mass", "[kg]", "0.5", "1", "mass", "of", "the", "rod"]
    assert shown[2].split() == ["length", "[m]", "0.5", "0.75", "length", "of", "the", "rod"]
    assert described_weights(torch.nn.Linear(1, 1)) == {}
