"""How often intervals hold the truth: an estimation from many simulated records with noise."""

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.fit.least_squares import Estimation, EstimationConfig
from rt_torchrl.fit.record import SensorRecord, sensor_record
from rt_torchrl.fit.sensors import Sensor
from rt_torchrl.fit.uncertainty import band, named_values
from rt_torchrl.interruption import safe_point
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

Flights = Callable[[Plant, nn.Module, torch.Generator], list[Trajectory]]
"""Flies the episodes whose records are one simulation, of a plant with a closure."""
POINTS = 200
"""Number of visited points, or a few more, at which bands are compared with the true curve."""
HELD = 20
"""Number of control intervals for which a random command is held."""


class Coverage(NamedTuple):
    """Result over all simulations, for each named value of the closure.

    Args:
        names: names of the values.
        inside: share of the simulations in which the 95 % interval holds the truth, of those with an interval.
        told: share of the simulations in which the data tell the value, so that it has an interval.
        error_over_bound: RMS error over the RMS standard error, which is the Cramér-Rao bound.
    """

    names: list[str]
    inside: Float[Tensor, " n"]
    told: Float[Tensor, " n"]
    error_over_bound: Float[Tensor, " n"]

    @property
    def mean(self) -> float:
        """Share of all intervals that hold the truth."""
        return ((self.inside * self.told).nansum() / self.told.sum()).item()


def coverage(
    plant: Plant,
    closure: nn.Module,
    sensors: Sequence[Sensor],
    *,
    simulations: int = 200,
    share: float = 0.01,
    generator: torch.Generator,
    config: EstimationConfig | None = None,
    flights: Flights | None = None,
) -> Coverage:
    """Simulate records under the closure, add noise, estimate, and compare with the closure.

    Every estimation begins with the true weights, because this is about intervals and not about local minima.

    Args:
        plant: the plant.
        closure: closure of the simulated system, which the twin can represent exactly.
        sensors: sensors; their noise levels are estimated.
        simulations: number of simulated records.
        share: standard deviation of the noise, as a share of the RMS deviation of a sensor's readings from their mean.
        generator: source of initial states, inputs, commands and noise.
        config: parameters of the estimation.
        flights: episodes of one simulation; by default one under random commands.

    Raises:
        ValueError: if there is no simulation, or the noise is no positive share.
    """
    if simulations < 1 or not 0.0 < share < 1.0:
        raise ValueError(f"simulations={simulations} must be at least 1, and the share={share} of the noise in (0, 1).")
    truth = torch.stack(list(named_values(closure).values())).detach()
    errors, bounds_found = [], []
    twin = DigitalTwin(plant, copy.deepcopy(closure).requires_grad_(True))
    start = copy.deepcopy(twin.closure.state_dict())
    for _ in range(simulations):
        safe_point()
        flown = fly(plant, closure, generator, flights)
        records = with_noise([sensor_record(plant, sensors, one) for one in flown], share, generator)
        twin.closure.load_state_dict(start)
        found = Estimation(twin, sensors, config=config).run(records)
        errors.append(torch.stack(list(named_values(twin.closure).values())).detach() - truth)
        bounds_found.append(torch.tensor(list(found.uncertainty.standard_errors().values()), dtype=torch.float64))
    return _counted(list(named_values(closure)), torch.stack(errors), torch.stack(bounds_found))


def _counted(
    names: list[str], errors: Float[Tensor, "simulations n"], scatter: Float[Tensor, "simulations n"]
) -> Coverage:
    z, known = errors / scatter, scatter.isfinite() & (scatter > 0.0)  # without scatter it is a constant
    inside = torch.where(known, (z.abs() <= 1.959964).double(), torch.nan).nanmean(0)
    ratio = torch.where(known, z, torch.nan).square().nanmean(0).sqrt()
    return Coverage(names, inside, known.double().mean(0), ratio)


def curve_coverage(
    plant: Plant,
    start: Callable[[torch.Generator], nn.Module],
    sensors: Sequence[Sensor],
    visited: Callable[[Plant, Trajectory], Tensor],
    *,
    output: int = 0,
    simulations: int = 50,
    share: float = 0.01,
    generator: torch.Generator,
    config: EstimationConfig | None = None,
    flights: Flights | None = None,
) -> Float[Tensor, " {simulations}"]:
    """How often the bands of a neural closure hold the true curve, where the system has been.

    Args:
        plant: the plant, with its true closure.
        start: draws the closure that an estimation begins with.
        sensors: sensors; their noise levels are estimated.
        visited: features on which the plant calls its closure along a trajectory, in the last dimension.
        output: number of the closure's output.
        simulations: number of simulations.
        share: standard deviation of the noise, as a share of the RMS deviation of a sensor's readings from their mean.
        generator: source of first closures, initial states, inputs, commands and noise.
        config: parameters of the estimation, with the prior of the closure's perceptrons.
        flights: episodes of one simulation; by default one under random commands.

    Returns:
        Share of the visited points at which the 95 % interval holds the true curve, in each simulation.
    """
    found = []
    for _ in range(simulations):
        safe_point()
        flown = fly(plant, plant.closure, generator, flights)
        records = with_noise([sensor_record(plant, sensors, one) for one in flown], share, generator)
        estimate = Estimation(DigitalTwin(plant, start(generator)), sensors, config=config).run(records)
        every = torch.cat([visited(plant, one).flatten(0, -2) for one in flown])
        points = every[:: max(1, len(every) // POINTS)]
        seen = band(estimate.uncertainty, torch.arange(len(points)).double(), points, output=output)
        with torch.no_grad():
            found.append(seen.covers(plant.closure(points)[:, output]))
    return torch.tensor(found, dtype=torch.float64)


def fly(plant: Plant, closure: nn.Module, generator: torch.Generator, flights: Flights | None) -> list[Trajectory]:
    """Episodes of one simulation; by default one under random commands."""
    return [random_flight(plant, closure, generator)] if flights is None else flights(plant, closure, generator)


def with_noise(records: Sequence[SensorRecord], share: float, generator: torch.Generator) -> list[SensorRecord]:
    """Records with white noise, whose guesses of the first states stay the true ones.

    Args:
        records: the records.
        share: standard deviation of the noise, as a share of the RMS deviation of a sensor's readings from their mean.
        generator: source of the noise.
    """
    readings = torch.cat([record.readings for record in records])
    scale = share * (readings - readings.mean(0)).square().mean(0).sqrt()
    found = []
    for record in records:
        noise = torch.randn(record.readings.shape, generator=generator, dtype=torch.float64)
        found.append(record._replace(readings=record.readings + scale * noise))
    return found


@torch.no_grad()
def random_flight(
    plant: Plant, closure: nn.Module, generator: torch.Generator, *, low: float = 0.3, high: float = 0.7
) -> Trajectory:
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
    return Rollout(plant, closure)(start, inputs, least + share * (greatest - least)).each()[0]
