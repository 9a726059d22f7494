"""How often intervals hold the truth: estimations from many simulated records with noise, on each plant."""

import copy
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

import rt_torchrl as rt
from rt_torchrl.envs.cascaded_tanks.plant import CascadedTanks
from rt_torchrl.envs.cryogenic_tank.closures import ConstantCoefficients
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.closures import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.closures import SaintDrenan
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.fit.uncertainty import named_values
from rt_torchrl.plants.signal import bounds

HELD = 20
"""Number of control intervals for which a random command is held."""


@torch.no_grad()
def random_flight(
    plant: rt.Plant, closure: nn.Module, generator: torch.Generator, *, low: float = 0.3, high: float = 0.7
) -> rt.Trajectory:
    """One episode of the plant under random commands, each held for some intervals.

    Args:
        plant: the plant.
        closure: closure of the simulated system.
        generator: source of initial state, inputs and commands.
        low, high: least and greatest command, as shares of its range.
    """
    start, inputs = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    least, greatest = bounds(plant.actions)
    drawn = torch.rand(1, -(-plant.n_steps // HELD), len(least), generator=generator, dtype=torch.float64)
    share = low + (high - low) * drawn.repeat_interleave(HELD, 1)[:, : plant.n_steps]
    return rt.Rollout(plant, closure)(start, inputs, least + share * (greatest - least)).each()[0]


def one_flight(plant: rt.Plant, closure: nn.Module, generator: torch.Generator) -> list[rt.Trajectory]:
    """A single episode under random commands."""
    return [random_flight(plant, closure, generator)]


@torch.no_grad()
def turbine_flights(plant: rt.Plant, closure: nn.Module, generator: torch.Generator) -> list[rt.Trajectory]:
    """An episode of the classical controller, and two under random commands in their whole ranges.

    In the middle of the ranges the blades are never flat, and nothing tells the weights of what they do there.
    """
    start, wind = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    (usual,) = JonkmanController(plant).fly(start, wind, closure).each()
    return [usual, *(random_flight(plant, closure, generator, low=0.0, high=1.0) for _ in range(2))]


class Case(NamedTuple):
    """What is simulated: plant, closure of the real system, sensors, and episodes of one simulation."""

    plant: Callable[[], rt.Plant]
    closure: Callable[[Any], nn.Module]
    sensors: tuple[str, ...]
    flights: Callable[[rt.Plant, nn.Module, torch.Generator], list[rt.Trajectory]] = one_flight


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


def values_of(closure: nn.Module) -> Tensor:
    """The named values of a closure."""
    return torch.stack(list(named_values(closure).values())).detach()


def coverage(case: Case, simulations: int) -> tuple[float, Tensor]:
    """Share of all 95 % intervals that hold the truth, and each value's RMS error over its Cramér-Rao bound.

    Every estimation begins with the true weights, because this is about intervals and not about local minima. Records
    have white noise of 1 % of the readings' RMS deviation from their mean, whose levels are estimated.
    """
    plant, generator, errors, scatter = case.plant(), torch.Generator().manual_seed(0), [], []
    closure, sensors = case.closure(plant), rt.sensors_of(plant, case.sensors)
    twin = rt.DigitalTwin(plant, copy.deepcopy(closure).requires_grad_(True))
    for _ in range(simulations):
        records = [rt.sensor_record(plant, sensors, flown) for flown in case.flights(plant, closure, generator)]
        readings = torch.cat([record.readings for record in records])
        scale = 0.01 * (readings - readings.mean(0)).square().mean(0).sqrt()
        for k, record in enumerate(records):
            noise = torch.randn(record.readings.shape, generator=generator, dtype=torch.float64)
            records[k] = record._replace(readings=record.readings + scale * noise)
        twin.closure.load_state_dict(closure.state_dict())
        found = rt.Estimation(twin, sensors, config=rt.EstimationConfig(iterations=20)).run(records)
        errors.append(values_of(twin.closure) - values_of(closure))
        scatter.append(torch.tensor(list(found.uncertainty.standard_errors().values()), dtype=torch.float64))
    z, bound = torch.stack(errors) / torch.stack(scatter), torch.stack(scatter)
    known = bound.isfinite() & (bound > 0.0)  # without scatter it is a constant
    inside = (z.abs() <= 1.959964)[known].double().mean().item()
    return inside, torch.where(known, z, torch.nan).square().nanmean(0).sqrt()
