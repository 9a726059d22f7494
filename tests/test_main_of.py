"""What a recipe's command line tells in one line instead of a traceback."""

import sys
from dataclasses import dataclass

import pytest
from linear_quadratic import LinearQuadratic

from rt_torchrl.runs.command_line import main_of
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.trajectories.rollout import DivergenceError


@dataclass(frozen=True, kw_only=True)
class Config(RunConfig):
    """Configuration of a recipe."""


@pytest.mark.parametrize(
    "error",
    [ValueError("seed=-1"), DivergenceError("the twin diverged"), FileNotFoundError(2, "no such file", "a.bts")],
)
def test_what_the_user_can_mend_is_told_in_a_line(monkeypatch, error):
    def main(config):
        raise error

    monkeypatch.setattr(sys, "argv", ["recipe.py"])
    with pytest.raises(SystemExit) as left:
        main_of(Config, main)
    assert left.value.code == f"error: {error}"


def test_an_interrupt_leaves_as_shells_report_it(monkeypatch):
    def main(config):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", ["recipe.py"])
    with pytest.raises(SystemExit) as left:
        main_of(Config, main)
    assert left.value.code == 130


@pytest.mark.parametrize("horizon", [1e308, 1e300, 1e9])
def test_an_episode_that_no_memory_holds_is_refused(horizon):
    with pytest.raises(
        ValueError, match=r"horizon=.* s of plant 'linear_quadratic' is .* steps dt=0.1 s; it must be at most 1e\+07"
    ):
        LinearQuadratic(horizon=horizon)
