"""The closure's weights on the terminal."""

from rt_torchrl.runs.results_table import closure_lines


def test_true_weights_are_shown_where_they_are_known():
    closure = {"start": {"a": 1.0, "b": 2.0}, "found": {"a": 1.5, "b": 2.5}}
    bare = [["a", "1", "1.5"], ["b", "2", "2.5"]]
    for unknown in ({}, {"true": None}, {"true": {"other": 1.0}}):
        shown = [line.split() for line in closure_lines(closure | unknown)]
        assert shown == [["closure", "weight", "start", "found"], *bare]
    shown = [line.split() for line in closure_lines(closure | {"true": {"a": 1.25}})]
    assert shown[0][-1] == "true" and [line[-1] for line in shown[1:]] == ["1.25", "-"]
