"""Values that an option of their type cannot have are refused when a configuration is made in code."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import pytest

from rt_torchrl.fit.least_squares import EstimationConfig
from rt_torchrl.optimisers.descent import DescentConfig
from rt_torchrl.options import check_options, choices, require_widths
from rt_torchrl.steps.config import (
    ExogenousConfig,
    LearnerConfig,
    LongTermMemoryConfig,
    PlannerConfig,
    RefereeConfig,
    ShortHorizonConfig,
)
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.systems.safety import SafetyConfig
from rt_torchrl.twinning.assimilation import AssimilationConfig
from rt_torchrl.twinning.config import TwinningConfig


@dataclass(frozen=True, kw_only=True)
class Example:
    law: Literal["affine", "cubic", "mlp"] = "affine"
    other: Literal["affine", "cubic"] | None = None
    laws: tuple[Literal["affine", "cubic"], ...] = ()
    count: int = 1
    most: int | None = None
    rate: float = 0.1
    deadline: float = math.inf
    limits: tuple[float, ...] | None = None
    widths: Sequence[int] = (8, 8)
    free: str = "anything"

    def __post_init__(self):
        check_options(self, infinite=("deadline",))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"law": "quartic"}, r"law='quartic' does not exist; choose affine, cubic or mlp\."),
        ({"other": "mlp"}, r"other='mlp' does not exist; choose affine or cubic\."),
        ({"laws": ("affine", "mlp")}, r"laws\[1\]='mlp' does not exist"),
        ({"count": math.nan}, r"count=nan must be a whole number\."),
        ({"count": 2.5}, r"count=2\.5 must be a whole number\."),
        ({"count": True}, r"count=True must be a whole number\."),
        ({"most": math.inf}, r"most=inf must be a whole number\."),
        ({"rate": math.nan}, r"rate=nan must be a finite number\."),
        ({"rate": -math.inf}, r"rate=-inf must be a finite number\."),
        ({"rate": "fast"}, r"rate='fast' must be a number\."),
        ({"deadline": math.nan}, r"deadline=nan must be a number or infinite\."),
        ({"limits": (1.0, math.inf)}, r"limits\[1\]=inf must be a finite number\."),
        ({"widths": (8, 0.5)}, r"widths\[1\]=0\.5 must be a whole number\."),
    ],
)
def test_what_no_option_of_its_type_can_be_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Example(**options)


def test_every_option_of_its_type_is_accepted():
    given = {"law": "mlp", "other": "cubic", "laws": ("cubic", "affine"), "count": 0, "most": 3, "rate": 1}
    example = Example(**given, deadline=2.0, limits=(0.0, -1e300), widths=[4], free="")
    assert {name: getattr(example, name) for name in given} == given
    assert Example().deadline == math.inf


def test_the_choices_of_a_literal_are_known():
    assert choices(Example, "law") == ("affine", "cubic", "mlp")
    assert choices(Example, "free") == choices(Example, "widths") == ()


def test_layers_without_units_are_refused():
    require_widths("hidden", ())
    with pytest.raises(ValueError, match=r"hidden=\(8, 0\) must hold widths of layers, each at least 1\."):
        require_widths("hidden", (8, 0))


CONFIGS = {
    DescentConfig: {"optimiser": "newton", "rate": math.inf, "gradient_limit": math.nan},
    EstimationConfig: {"errors": "newton", "prior": math.inf, "rounds": math.nan, "iterations": math.nan},
    ExogenousConfig: {"knots": math.nan, "tube": math.inf, "penalty": math.inf, "kernel_width": math.inf},
    AssimilationConfig: {"inputs": "x", "method": "x", "initial": "x", "prior": math.inf, "segment": math.nan},
    RefereeConfig: {"patience": math.nan, "clone_patience": math.inf, "tolerance": math.inf, "stall": math.nan},
    LongTermMemoryConfig: {"capacity": math.inf, "offset": math.inf},
    PlannerConfig: {"iterations": math.nan, "realisations": 2.5, "experience": math.inf},
    LearnerConfig: {
        "critic_rate": math.inf,
        "batch_size": math.nan,
        "critic_hidden": (8, 0),
        "reward_scale": math.inf,
    },
    ShortHorizonConfig: {"window": math.nan, "policy_rate": math.inf, "critic_hidden": (0,), "critic_iterations": 0.5},
    ExplorationConfig: {"spread": "0.2", "episodes": 2.5, "correlation_time": math.inf},
    SafetyConfig: {"interval": "0.5"},
    partial(SafetyConfig, interval=0.5): {"deadline": "0.4", "hold": math.nan, "patience": True},
    TwinningConfig: {"arm": "modelfree", "records": math.nan, "realisations": math.inf, "virtual_episodes": 2.5},
}


@pytest.mark.parametrize(
    ("config", "option", "value"),
    [(config, option, value) for config, options in CONFIGS.items() for option, value in options.items()],
)
def test_every_configuration_checks_its_options(config, option, value, unchecked):
    with pytest.raises(ValueError, match=re.escape(f"{option}={value!r} ")):
        config(**{option: value})


def test_a_gradient_may_be_without_a_limit():
    assert DescentConfig(gradient_limit=math.inf).gradient_limit == math.inf
