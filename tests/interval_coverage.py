"""How often intervals hold the truth: estimations from many simulated records with noise, on each plant."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
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
from rt_torchrl.fit.log import SensorLog, checked
from rt_torchrl.fit.resampling import filled, initial_spread, logged_readings, resample
from rt_torchrl.fit.uncertainty import named_values
from rt_torchrl.plants.signal import bounds

Flights = Callable[[rt.Plant, nn.Module, torch.Generator], list[rt.Trajectory]]
"""Flies the episodes whose records are one simulation, of a plant with a closure."""
Simulated = tuple[list[rt.SensorRecord], Tensor | None]
"""Records of one simulation, and the spread of their first states; None if nothing is known of these."""
HELD = 20
"""Number of control intervals for which a random command is held."""


class Coverage(NamedTuple):
    """Result over all simulations, for each named value of the closure.

    Args:
        inside: share of the simulations in which the 95 % interval holds the truth, of those with an interval.
        inside_68: the same for the 68 % interval, which is one standard error wide on each side.
        told: share of the simulations in which the data tell the value, so that it has an interval.
        error_over_bound: RMS error over the RMS standard error, which is the Cramér-Rao bound.
    """

    inside: Tensor
    inside_68: Tensor
    told: Tensor
    error_over_bound: Tensor

    @property
    def mean(self) -> float:
        """Share of all intervals that hold the truth."""
        return ((self.inside * self.told).nansum() / self.told.sum()).item()


def values_of(closure: nn.Module) -> Tensor:
    """The named values of a closure."""
    return torch.stack(list(named_values(closure).values())).detach()


def coverage(
    plant: rt.Plant,
    closure: nn.Module,
    sensors: Sequence[rt.Sensor],
    simulated: Callable[[], Simulated],
    *,
    simulations: int,
    config: rt.EstimationConfig | None = None,
) -> Coverage:
    """Estimate from simulated records with noise, and compare with the closure of the simulated system.

    Every estimation begins with the true weights, because this is about intervals and not about local minima.

    Args:
        plant: the plant.
        closure: closure of the simulated system, which the twin can represent exactly.
        sensors: sensors; their noise levels are estimated.
        simulated: makes the records of one simulation, see :func:`recorded` and :func:`logged`.
        simulations: number of simulations.
        config: parameters of the estimation.
    """
    twin, errors, scatter = rt.DigitalTwin(plant, copy.deepcopy(closure).requires_grad_(True)), [], []
    for _ in range(simulations):
        records, spread = simulated()
        twin.closure.load_state_dict(closure.state_dict())
        found = rt.Estimation(twin, sensors, spread=spread, config=config).run(records)
        errors.append(values_of(twin.closure) - values_of(closure))
        scatter.append(torch.tensor(list(found.uncertainty.standard_errors().values()), dtype=torch.float64))
    z, bound = torch.stack(errors) / torch.stack(scatter), torch.stack(scatter)
    known = bound.isfinite() & (bound > 0.0)  # without scatter it is a constant
    inside, inside_68 = (
        torch.where(known, (z.abs() <= width).double(), torch.nan).nanmean(0) for width in (1.959964, 0.994458)
    )
    ratio = torch.where(known, z, torch.nan).square().nanmean(0).sqrt()
    return Coverage(inside, inside_68, known.double().mean(0), ratio)


def recorded(
    plant: rt.Plant,
    closure: nn.Module,
    sensors: Sequence[rt.Sensor],
    generator: torch.Generator,
    flights: Flights | None = None,
) -> Simulated:
    """Noisy records of an episode under random commands, or of other flights; nothing is said of their first states."""
    flown = flights(plant, closure, generator) if flights else [random_flight(plant, closure, generator)]
    return with_noise([rt.sensor_record(plant, sensors, one) for one in flown], generator), None


class Logging(NamedTuple):
    """How a flight is logged.

    Args:
        every: number of control intervals between two rows, of which commands are held for a multiple.
        dropped: share of the rows that hold a value that is missing, and are left out.
        missing: share of the samples that single sensors lack.
    """

    every: int = 1
    dropped: float = 0.0
    missing: float = 0.0


def logged(
    plant: rt.Plant, closure: nn.Module, sensors: Sequence[rt.Sensor], generator: torch.Generator, logging: Logging
) -> Simulated:
    """The records that ``identify.py`` makes of the log of an episode, and the spread of their first states."""
    flown = random_flight(plant, closure, generator)
    (record,) = with_noise([rt.sensor_record(plant, sensors, flown)], generator)
    rows = slice(0, None, logging.every)
    held = [torch.cat([values, values[-1:]])[rows] for values in (flown.actions, flown.exogenous)]
    readings = record.readings[rows].clone()
    readings[torch.rand(readings.shape, generator=generator, dtype=torch.float64) < logging.missing] = torch.nan
    bad = torch.rand(len(readings), generator=generator, dtype=torch.float64) < logging.dropped
    bad[[0, -1]] = False
    signals = (*plant.actions, *plant.acting_inputs)
    columns = dict(zip((s.name for s in signals), torch.cat(held, -1).T.numpy(), strict=False))
    columns[plant.actions[0].name] = np.where(bad.numpy(), np.nan, columns[plant.actions[0].name])
    columns |= {sensor.name: values.numpy() for sensor, values in zip(sensors, readings.T, strict=True)}
    log = SensorLog(times=plant.dt * logging.every * np.arange(len(readings)), columns=columns)
    log = checked(log, plant, drop=True, missing=True)
    parts = resample(filled(log, plant), plant)
    records = [logged_readings(log, plant, tuple(sensors), part, parts.gap) for part in parts.segments]
    return records, initial_spread(plant, log)


def with_noise(records: Sequence[rt.SensorRecord], generator: torch.Generator) -> list[rt.SensorRecord]:
    """Records with white noise of 1 % of the readings' RMS deviation from their mean; guesses stay the true ones."""
    readings = torch.cat([record.readings for record in records])
    scale = 0.01 * (readings - readings.mean(0)).square().mean(0).sqrt()
    found = []
    for record in records:
        noise = torch.randn(record.readings.shape, generator=generator, dtype=torch.float64)
        found.append(record._replace(readings=record.readings + scale * noise))
    return found


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


class Case(NamedTuple):
    """What is simulated: plant, closure of the real system, sensors, and episodes of one simulation."""

    plant: Callable[[], rt.Plant]
    closure: Callable[[Any], nn.Module]
    sensors: tuple[str, ...]
    flights: Flights | None = None


@torch.no_grad()
def turbine_flights(plant: rt.Plant, closure: nn.Module, generator: torch.Generator) -> list[rt.Trajectory]:
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


LOGS: dict[str, tuple[str, tuple[str, ...], Logging]] = {
    "coarse": ("pendulum", ("angle", "angular_speed"), Logging(every=5)),
    "dropped": ("pendulum", ("angle", "angular_speed"), Logging(dropped=0.05)),
    "partial": ("pendulum", ("angle",), Logging(missing=0.3)),
    "coarse, partial, dropped": ("cascaded_tanks", ("sensed_level",), Logging(every=5, dropped=0.02, missing=0.1)),
}
"""Plant, sensors and logging of the simulated logs."""
