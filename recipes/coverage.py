"""Count how often the intervals of an identification hold the truth, on each plant."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import torch
from torch import Tensor, nn

from rt_torchrl import EstimationConfig, Plant, Trajectory, check_options, main_of, sensors_of
from rt_torchrl.envs.cascaded_tanks.closures import Hydraulics, NeuralHydraulics
from rt_torchrl.envs.cascaded_tanks.plant import CascadedTanks
from rt_torchrl.envs.cryogenic_tank.closures import ConstantCoefficients
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.closures import NeuralPolar, QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.jonkman import JonkmanController
from rt_torchrl.envs.wind_turbine.models import SaintDrenan
from rt_torchrl.envs.wind_turbine.neural import NeuralPowerCoefficient
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.evaluation.closure_error import visited_features
from rt_torchrl.fit.coverage import Flights, coverage, curve_coverage, random_flight


class Case(NamedTuple):
    """What is simulated: plant, closure of the real system, sensors, and episodes of one simulation."""

    plant: Callable[[], Plant]
    closure: Callable[[Any], nn.Module]
    sensors: tuple[str, ...]
    flights: Flights | None = None


@torch.no_grad()
def turbine_flights(plant: Plant, closure: nn.Module, generator: torch.Generator) -> list[Trajectory]:
    """An episode of the classical controller, and two under random commands in their whole ranges.

    In the middle of the ranges the blades are never flat, and nothing tells the weights of what they do there.
    """
    start, wind = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    (usual,) = JonkmanController(plant).fly(start, wind, closure).each()
    return [usual, *(random_flight(plant, closure, generator, low=0.0, high=1.0) for _ in range(2))]


CASES: dict[str, Case] = {
    # The law that fits the rotor's own table: sets with c_5 = 0 say nothing of x, its exponent.
    "wind_turbine": Case(
        lambda: WindTurbine(closure=SaintDrenan.from_set("BestFitToROSCOTable")),
        lambda plant: plant.closure,
        ("rotor_speed",),
        turbine_flights,
    ),
    "flapping_wing": Case(
        lambda: FlappingWing(horizon=1.0),
        lambda plant: QuasiSteadyPolar.true(),
        ("forward_position", "height", "forward_speed", "climb_speed"),
    ),
    "cryogenic_tank": Case(
        lambda: CryogenicTank(horizon=43200.0),
        lambda plant: ConstantCoefficients.true(),
        ("wall_temperature", "liquid_volume", "pressure"),
    ),
    "cascaded_tanks": Case(CascadedTanks, lambda plant: plant.closure, ("sensed_level",)),
    "pendulum": Case(lambda: Pendulum(horizon=5.0), lambda plant: plant.closure, ("angle", "angular_speed")),
}
"""The simulations, by the plant's name."""


class CurveCase(NamedTuple):
    """What is simulated for a curve: a true law that the closure's own law does not hold, and a neural closure."""

    plant: Callable[[], Plant]
    start: Callable[[torch.Generator], nn.Module]
    sensors: tuple[str, ...]
    prior: float
    curve: str
    flights: Flights | None = None


class Bent(nn.Module):
    """A law beside which something is that only a perceptron can learn.

    Args:
        law: the law.
        bend: function of the features that is added.
    """

    def __init__(self, law: nn.Module, bend: Callable[[Tensor], Tensor]):
        super().__init__()
        self.law, self.bend = law, bend

    def forward(self, features: Tensor) -> Tensor:
        return self.law(features) + self.bend(features)


def swollen(features: Tensor) -> Tensor:
    """More power where the blades are flat, by 0.03 of C_p at λ = 7."""
    lam, beta = features.unbind(-1)
    return 0.03 * torch.exp(-(((lam - 7.0) / 2.0) ** 2) - (beta / 8.0) ** 2).unsqueeze(-1)


def late_stall(features: Tensor) -> Tensor:
    """More lift and drag at small angles of attack."""
    sine, cosine = features.unbind(-1)
    return torch.stack([0.2 * sine * cosine**3, 0.1 * sine**2 * cosine**2], -1)


def wavy_outlet(features: Tensor) -> Tensor:
    """An upper outlet whose flow is not in proportion to its level."""
    flow = 0.015 * torch.sin(features[..., 0] / 6.0)
    return torch.stack([-flow, flow], -1)


HIDDEN = (8,)
"""Width of the perceptrons' hidden layers; more weights are told less by one record."""
CURVES: dict[str, CurveCase] = {
    "wind_turbine": CurveCase(
        lambda: WindTurbine(closure=Bent(SaintDrenan.from_set("BestFitToROSCOTable"), swollen)),
        lambda g: NeuralPowerCoefficient(SaintDrenan.from_set("BestFitToROSCOTable"), hidden=HIDDEN, generator=g),
        ("rotor_speed",),
        0.1,
        "C_p",
        turbine_flights,
    ),
    "flapping_wing": CurveCase(
        lambda: FlappingWing(horizon=0.5, closure=Bent(QuasiSteadyPolar.true(), late_stall)),
        lambda g: NeuralPolar(QuasiSteadyPolar.draw(g, spread=0.1), hidden=HIDDEN, generator=g),
        ("forward_position", "height", "forward_speed", "climb_speed"),
        3.0,
        "C_L",
    ),
    "cascaded_tanks": CurveCase(
        lambda: CascadedTanks(closure=Bent(Hydraulics.true(), wavy_outlet)),
        lambda g: NeuralHydraulics(Hydraulics.true().requires_grad_(True), hidden=HIDDEN, generator=g),
        ("upper_level", "lower_level"),
        3.0,
        "the upper tank's rate",
    ),
}
"""The simulations of curves, by the plant's name; each prior lets the weights of a perceptron be of order one."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Simulate records with noise, identify each, and count the intervals that hold the truth.

    With curves, the bands of neural closures are counted at the points that the records have visited.

    Args:
        plants: plants.
        simulations: number of simulated records of each plant.
        noise: standard deviation of the sensors' noise, as a share of the scatter of their readings.
        seed: seed of all draws.
        curves: count the bands of the curves of neural closures instead; the default of plants is then those that have
            such closures.
    """

    plants: tuple[str, ...] = ()
    simulations: int = 200
    noise: float = 0.01
    seed: int = 0
    curves: bool = False

    def __post_init__(self):
        check_options(self)
        known = CURVES if self.curves else CASES
        unknown = [name for name in self.plants if name not in known]
        if unknown:
            raise ValueError(f"plants={unknown} do not exist; choose among {', '.join(known)}.")
        if self.seed < 0:
            raise ValueError(f"seed={self.seed} must not be negative.")


def main(config: Config) -> None:
    torch.set_num_threads(1)
    for name in config.plants or (CURVES if config.curves else CASES):
        (count_curves if config.curves else count_intervals)(name, config)


def count_intervals(name: str, config: Config) -> None:
    case = CASES[name]
    plant = case.plant()
    found = coverage(
        plant,
        case.closure(plant),
        sensors_of(plant, case.sensors),
        simulations=config.simulations,
        share=config.noise,
        generator=torch.Generator().manual_seed(config.seed),
        config=EstimationConfig(iterations=20),
        flights=case.flights,
    )
    print(f"{name}: {found.mean:.1%} of the 95 % intervals hold the truth ({config.simulations} simulations)")
    rows = zip(found.names, found.inside.tolist(), found.told.tolist(), found.error_over_bound.tolist(), strict=True)
    for value, inside, told, ratio in rows:
        print(f"  {value:<16} inside {inside:6.1%}  told {told:6.1%}  RMS error over its bound {ratio:.2f}")


def count_curves(name: str, config: Config) -> None:
    case = CURVES[name]
    found = curves_of(case, config.simulations, config.noise, config.seed)
    print(f"{name}: the 95 % band of {case.curve} holds {found.mean().item():.1%} of the visited points", end=" ")
    print(f"(least of {config.simulations} simulations: {found.min().item():.1%})", flush=True)


def curves_of(case: CurveCase, simulations: int, noise: float, seed: int) -> Tensor:
    """Share of the visited points whose band holds the true curve, in each simulation."""
    plant = case.plant()
    return curve_coverage(
        plant,
        case.start,
        sensors_of(plant, case.sensors),
        visited_features,
        simulations=simulations,
        share=noise,
        generator=torch.Generator().manual_seed(seed),
        config=EstimationConfig(iterations=60, rounds=4, prior=case.prior),
        flights=case.flights,
    )


if __name__ == "__main__":
    main_of(Config, main)
