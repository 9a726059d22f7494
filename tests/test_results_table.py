"""The closure's weights and the twin's errors on the terminal."""

import torch

from rt_torchrl.envs.pendulum.plant import UniformRod
from rt_torchrl.plants.closures import described_weights
from rt_torchrl.runs.results_table import closure_lines, fit_lines, progress


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


def test_standard_errors_stand_beside_the_weights():
    closure = {"start": {"a": 1.0, "b": 2.0}, "found": {"a": 1.5, "b": 2.5}, "true": {"a": 1.25, "b": 2.0}}
    shown = [line.split() for line in closure_lines(closure, errors={"a": 0.25, "b": None})]
    assert shown[1:] == [["a", "1", "1.5", "0.25", "1.25"], ["b", "2", "2.5", "-", "2"]]
    assert shown[0] == ["closure", "weight", "start", "found", "std.", "error", "true"]


def test_errors_of_the_twin_are_told_in_units_over_what_was_fitted():
    rms = {"rotor_speed [rad/s]": 0.0123456, "shares [-]": None, "height [m]": 2.0}
    found = {"rms": rms, "segment": 0, "standard_errors": {}}
    line = "RMS rotor_speed 0.0123 rad/s, shares diverges, height 2 m"
    assert fit_lines(found) == [f"  twin over its last records: {line}"]
    assert fit_lines(found | {"segment": 22}) == [f"  twin over segments of 22 intervals: {line}"]
    assert fit_lines({"rms": {}, "segment": 0, "standard_errors": {}}) == fit_lines(None) == []
    record = {"J_p": 1.0, "real_cost": 0.5, "live": "model_free"}
    record |= {f"rms/{name}": value for name, value in rms.items()}
    assert progress(record) == "RMS rotor_speed 0.0123 rad/s, shares diverges, real 0.5, live model-free"
