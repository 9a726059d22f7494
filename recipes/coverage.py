"""Count how often the intervals of an identification hold the truth, on each plant."""

import sys
from dataclasses import dataclass
from typing import Any

if __name__ == "__main__":
    print("loading PyTorch and TorchRL", file=sys.stderr)  # at once, because this takes seconds

import torch

from rt_torchrl import EstimationConfig, check_options, main_of, sensors_of
from rt_torchrl.envs.cascaded_tanks.plant import CascadedTanks
from rt_torchrl.envs.cryogenic_tank.models import ConstantCoefficients
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.models import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.models import SaintDrenan
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.identification.coverage import coverage

CASES: dict[str, tuple[Any, Any, tuple[str, ...]]] = {
    "wind_turbine": (
        lambda: WindTurbine(closure=SaintDrenan.from_set("Dai2016")),
        lambda plant: plant.closure,
        ("rotor_speed",),
    ),
    "flapping_wing": (
        lambda: FlappingWing(horizon=1.0),
        lambda plant: QuasiSteadyPolar.true(),
        ("forward_position", "height", "forward_speed", "climb_speed"),
    ),
    "cryogenic_tank": (
        lambda: CryogenicTank(horizon=43200.0),
        lambda plant: ConstantCoefficients.true(),
        ("wall_temperature", "liquid_volume", "pressure"),
    ),
    "cascaded_tanks": (CascadedTanks, lambda plant: plant.closure, ("sensed_level",)),
    "pendulum": (lambda: Pendulum(horizon=5.0), lambda plant: plant.closure, ("angle", "angular_speed")),
}
"""Plant, closure of the simulated system and sensors, by the plant's name."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Simulate records with noise, identify each, and count the intervals that hold the truth.

    Args:
        plants: plants.
        simulations: number of simulated records of each plant.
        noise: standard deviation of the sensors' noise, as a share of the scatter of their readings.
        seed: seed of all draws.
    """

    plants: tuple[str, ...] = tuple(CASES)
    simulations: int = 200
    noise: float = 0.01
    seed: int = 0

    def __post_init__(self):
        check_options(self)
        unknown = [name for name in self.plants if name not in CASES]
        if unknown:
            raise ValueError(f"plants={unknown} do not exist; choose among {', '.join(CASES)}.")
        if self.seed < 0:
            raise ValueError(f"seed={self.seed} must not be negative.")


def main(config: Config) -> None:
    for name in config.plants:
        make, closure_of, sensors = CASES[name]
        plant = make()
        generator = torch.Generator().manual_seed(config.seed)
        found = coverage(
            plant,
            closure_of(plant),
            sensors_of(plant, sensors),
            simulations=config.simulations,
            share=config.noise,
            generator=generator,
            config=EstimationConfig(iterations=20),
        )
        print(f"{name}: {found.mean:.1%} of the 95 % intervals hold the truth ({config.simulations} simulations)")
        rows = zip(
            found.names, found.inside.tolist(), found.told.tolist(), found.error_over_bound.tolist(), strict=True
        )
        for value, inside, told, ratio in rows:
            print(f"  {value:<16} inside {inside:6.1%}  told {told:6.1%}  RMS error over its bound {ratio:.2f}")


if __name__ == "__main__":
    main_of(Config, main)
