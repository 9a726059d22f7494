"""What the study of twinning compares on each plant: its arms, policies, controllers and their sizes."""

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.envs.cryogenic_tank.controllers import OnOffValve, PIValve
from rt_torchrl.envs.flapping_wing.controllers import TrimmedPD
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.study.training import CHANGED

ARMS = ("twinning", "model_free", "model_based")
CONTROLLERS: dict[str, dict[str, type[ClassicalController]]] = {
    "wind_turbine": {"Jonkman": JonkmanController},
    "flapping_wing": {"PD": TrimmedPD},
    "cryogenic_tank": {"on-off": OnOffValve, "PI": PIValve},
}
OWN_POLICY: dict[str, tuple[str, ...]] = {
    "wind_turbine": ("--start", "random", "--policy", "paper"),
    "flapping_wing": ("--start", "random", "--policy", "paper"),
    "cryogenic_tank": ("--start", "random", "--command", "drop", "--end-weight", "0"),
}
"""Options for the paper's policy and cost, which every arm has unless it says otherwise."""
PERCEPTRON = ("--policy", "mlp", "--hidden", "32", "32", "--observe", "paper")
POLICIES: dict[str, dict[str, tuple[str, ...]]] = {
    "wind_turbine": {
        "twinning, gain-scheduled": ("--policy", "scheduled"),
        "twinning, with bias": ("--policy", "bias"),
        "twinning, perceptron": PERCEPTRON,
    },
    "flapping_wing": {"twinning, perceptron": PERCEPTRON},
}
"""Policies that twinning trains beside a plant's own policy, as options of the plant's recipe."""
LONG_ONLY = ("twinning, with bias",)
"""Policies that ``quick`` leaves out, because tracing them takes a minute."""
OTHER_PLANT = ("twinning, gain-scheduled",)
"""Policies that need a plant with more signals."""
OTHER_CLOSURE = ("wind_turbine",)
"""Plants whose true closure has another type than the twin's; no training uses the graphs of their oracle."""

EPISODES = {"wind_turbine": 20, "flapping_wing": 10, "cryogenic_tank": 10}
"""Number of real episodes of a training, the same for every arm; more episodes do not improve drone and tank."""
SHORT = {"wind_turbine": 600.0, "flapping_wing": 0.75, "cryogenic_tank": 7.5e4}
"""Length of an episode with ``quick`` [s]: the whole episode of the turbine, about a sixth of the others."""
SHORT_EPISODES = 2
"""Number of real episodes of a training with ``quick``."""
QUICK_VARIANTS = ("noise 5 %", CHANGED)
"""Variants that ``quick`` trains."""
MULTIPLES = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1e3, 1e4, 1e5)
"""Multiples of the default gain at which the figure draws the cost of a controller."""
COUNTS = (2, 5, 10, 20)
"""Numbers of training episodes that exact gradients plan on."""


def policies_of(plant: str, *, quick: bool) -> dict[str, tuple[str, ...]]:
    """Policies that twinning trains beside a plant's own, as options of its recipe."""
    every = POLICIES.get(plant, {}).items()
    return {name: options for name, options in every if not (quick and name in LONG_ONLY)}
