r"""Sensors: what is measured of a real system, as the likelihood of an identification sees it, and records of that.

.. math:: y_k = h(t_k, s_k, z_k) + b + e_k, \qquad e_k \sim \mathcal N(0, \sigma^2)

The plant knows nothing of its sensors here: they belong to the log or to the real system.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Input, Inputs, State, States, Time
from rt_torchrl.plants.signal import Measurement, Named, Preview, differences, state_read
from rt_torchrl.trajectories.engines.interval import batched
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of
from rt_torchrl.trajectories.twin import DigitalTwin

SHIFT = 1e-4
"""Step of the differences that give the Jacobian A of an interval, as a share of the scatter of each reading."""
MOST = 0.5
"""Share of the mean square of increments that noise explains of a sensor that has some."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A sensor with white noise and, if wanted, a constant bias that is estimated.

    Args:
        measurement: signal that the sensor gives, and the function h that reads it from time, state and input.
        noise: standard deviation σ of the noise, in the unit of the signal; None estimates it from the residuals.
        bias: whether a constant offset b of the sensor is an unknown.

    Raises:
        ValueError: if the noise is not positive and finite.
    """

    measurement: Measurement
    noise: float | None = None
    bias: bool = False

    def __post_init__(self) -> None:
        if self.noise is not None and not 0.0 < self.noise < math.inf:
            raise ValueError(f"noise={self.noise} of sensor {self.name!r} must be positive, or None to estimate it.")

    @property
    def name(self) -> str:
        """Name of the signal, and of its column in a log."""
        return self.measurement.name


def known_sensors(plant: Plant) -> dict[str, Sensor]:
    """A sensor for every signal of a plant that can be measured, by name: its states and its ``measurements``.

    A measurement with the name of a state is the sensor of that state, and reads it as the plant says. What drives the
    plant, its actions and inputs, is known and is no sensor.
    """
    driven = {signal.name for signal in (*plant.actions, *plant.inputs)}
    states = {
        signal.name: Measurement.of(signal) for signal in plant.states
    }  # some are there only if they are asked for
    known = {m.name: m for m in plant.measurements if not isinstance(m.read, Preview)}
    # Some states are there only if they are asked for.
    known = {k: m for k, m in known.items() if not isinstance(m.read, Named) or m.read.name in states}
    known |= {k: m for k, m in states.items() if k not in known or known[k].read == Named(k)}
    return {name: Sensor(measurement=m) for name, m in known.items() if name not in driven}


def state_places(plant: Plant, sensors: Sequence[Sensor]) -> list[int | None]:
    """Places of the states that sensors read as they are; None for a sensor of anything else."""
    return [state_read(sensor.measurement.read, plant.states) for sensor in sensors]


def state_sensors(plant: Plant) -> tuple[Sensor, ...]:
    r"""Sensors of the states that J_p compares, with the noise that makes J_p their likelihood.

    .. math:: \sigma_i = c_i / \sqrt{\Delta t}

    With these noises J of :mod:`rt_torchrl.fit.likelihood` is the sum of J_p over all records, with the scales c of
    :attr:`Plant.discrepancy_scales`.
    """
    return tuple(
        Sensor(measurement=Measurement.of(signal), noise=scale / math.sqrt(plant.dt))
        for signal, scale in zip(plant.states, plant.discrepancy_scales, strict=True)
        if scale < math.inf
    )


def sensors_of(plant: Plant, names: Sequence[str], biased: Sequence[str] = ()) -> tuple[Sensor, ...]:
    """The sensors of the named states and measurements of a plant, with unknown noise.

    Args:
        plant: the plant.
        names: names of the sensors.
        biased: names of those that have a constant bias that is estimated.

    Raises:
        ValueError: if there is no name, a name is no state and no measurement of the plant, or a biased sensor is none
            of the sensors.
    """
    known = known_sensors(plant)
    for argument, chosen, among in (("sensors", names, known), ("biased", biased, names)):
        unknown = [name for name in chosen if name not in among]
        if unknown or not names:
            raise ValueError(
                f"{argument}={tuple(chosen)} of plant {plant.name!r}: {', '.join(unknown) or 'nothing'} cannot be "
                f"measured; choose among {', '.join(among)}."
            )
    return tuple(dataclasses.replace(known[name], bias=name in biased) for name in names)


def read(
    sensors: Sequence[Sensor], plant: Plant, t: Time, state: State, exogenous: Input
) -> Float[Tensor, "*batch n_y"]:
    """What the sensors would read without noise and bias."""
    values = [sensor.measurement.read(plant, t, state, exogenous) for sensor in sensors]
    return torch.stack([value.expand(state.shape[:-1]) for value in values], -1)


def read_slopes(
    sensors: Sequence[Sensor], plant: Plant, t: Float[Tensor, "batch n"], states: States, exogenous: Inputs
) -> Float[Tensor, "batch n n_y n_s"]:
    """Derivatives of the readings by the state, in every sample."""

    def slopes(sensor: Sensor) -> Tensor:  # of each alone, so that one that is NaN leaves the others
        def reading(t: Tensor, state: Tensor, z: Tensor) -> Tensor:
            return read([sensor], plant, t, state, z).squeeze(-1)

        found: Tensor = batched(torch.func.vmap(torch.func.jacrev(reading, argnums=1)))(t, states, exogenous)
        return found

    return torch.stack([slopes(sensor) for sensor in sensors], -2)


class SensorRecord(NamedTuple):
    """Readings and actions of a real system over n control intervals.

    Args:
        readings: what the sensors read in the samples t_0 ... t_n; NaN where a sample is missing.
        actions: actions that were applied in the n intervals.
        exogenous: exogenous inputs z, held over the same intervals, and in a last row those in t_n, which sensors alone
            read; NaN where they are not known, as after a flight, and with them the readings that depend on them.
        guess: first guess of the state in t_0.
        start: time t_0 on the plant's clock [s].
        course: guesses of the states in all samples, from which parts of the record begin; None if there are none.
    """

    readings: Float[Tensor, "n+1 n_y"]
    actions: Float[Tensor, "n n_a"]
    exogenous: Float[Tensor, "n+1 n_z"]
    guess: Float[Tensor, " n_s"]
    start: float = 0.0
    course: Float[Tensor, "n+1 n_s"] | None = None

    @property
    def seen(self) -> Bool[Tensor, "samples n_y"]:
        """Whether there is a sample."""
        return ~self.readings.isnan()

    def part(self, first: int, last: int, dt: float) -> "SensorRecord":
        """The intervals ``first`` to ``last`` − 1 of length ``dt`` [s], with the samples around them.

        Its first state is guessed by the course, or else by the record's own guess.
        """
        steps, samples = slice(first, last), slice(first, last + 1)
        course = None if self.course is None else self.course[samples]
        guess, start = self.guess if course is None else course[0], self.start + first * dt
        return SensorRecord(self.readings[samples], self.actions[steps], self.exogenous[samples], guess, start, course)


def sensor_record(plant: Plant, sensors: Sequence[Sensor], record: Trajectory) -> SensorRecord:
    """What sensors read along a trajectory; its first state is the guess."""
    return sensor_records(plant, sensors, batch_of([record]))[0]


@torch.no_grad()
def sensor_records(plant: Plant, sensors: Sequence[Sensor], batch: Trajectory) -> list[SensorRecord]:
    """What sensors read along each trajectory of a batch; the first states are the guesses.

    A trajectory has no inputs in its last sample, and so no readings there of sensors that depend on them.
    """
    states, actions, exogenous, start, seen, _ = batch
    first = torch.as_tensor(start, dtype=torch.float64, device=states.device).expand(len(states))
    t = first.unsqueeze(-1) + plant.dt * torch.arange(states.shape[1], dtype=torch.float64, device=states.device)
    exogenous = pad(exogenous, (0, 0, 0, 1), value=math.nan)
    readings = read(sensors, plant, t, states, exogenous)
    if seen is not None:
        readings = torch.where(seen.unsqueeze(-1), readings, torch.nan)
    rows = zip(readings, actions, exogenous, states, first.tolist(), strict=True)
    return [SensorRecord(y, a, z, course[0], start, course=course) for y, a, z, course, start in rows]


def scatter_of(sensors: Sequence[Sensor], records: Sequence[SensorRecord]) -> Float[Tensor, " n_y"]:
    r"""Standard deviation of each sensor's readings, in the unit of its signal.

    .. math:: \sqrt{\overline{(d - \bar d)^2}}, \qquad d_k = y_k - y_1

    where the differences d are taken the short way round if the signal is periodic.

    Raises:
        ValueError: if there is no record, or a sensor has no sample.
    """
    if not records:
        raise ValueError("records=[] of the estimation must hold at least one record.")
    readings = torch.cat([record.readings for record in records])
    scatter = []
    for sensor, values in zip(sensors, readings.T, strict=True):
        samples = values[~values.isnan()]
        if not len(samples):
            raise ValueError(f"sensor {sensor.name!r} has no sample in any record; leave it out.")
        origin = samples[:1].expand_as(samples)
        change = differences([sensor.measurement], samples[:, None], origin[:, None])
        scatter.append((change - change.mean()).square().mean().sqrt())
    return torch.stack(scatter)


def segments(record: SensorRecord, length: int, dt: float) -> list[SensorRecord]:
    """A record cut into segments, each with a first state of its own (multiple shooting).

    The sample at a cut belongs to the segment that ends there.

    Args:
        record: the record.
        length: number of control intervals of a segment; the last one takes what is left.
        dt: control interval [s].
    """
    n, parts = len(record.actions), []
    for first in range(0, n, length):
        part = record.part(first, min(first + length, n), dt)
        if first:
            readings = part.readings.clone()
            readings[0] = torch.nan
            part = part._replace(readings=readings)
        parts.append(part)
    return parts


@torch.no_grad()
def noise_levels(twin: DigitalTwin, records: Sequence[Trajectory]) -> Float[Tensor, " n_r"]:
    r"""Standard deviation σ of the white noise of each sensor that reads a state, zero where increments show none.

    A sensor reads :math:`y_k = s_k + n_k`. The increments that a right twin misses are

    .. math:: e_k = y_{k+1} - \Phi(y_k, a_k, z_k) \approx n_{k+1} - A_k n_k, \qquad A_k = \partial\Phi/\partial s

    Neighbours of them are alike by :math:`E[e_k n_k^\top] = -A_k\Sigma`, with the diagonal Σ of the variances of the
    noise, which what the twin lacks is not: it is smooth, or new in each interval. Least squares give

    .. math:: \sigma_j^2 = -\sum_k e_{k-1,j}\,A_{k,j}^\top We_k \Big/ \sum_k A_{k,j}^\top WA_{k,j}

    with the column :math:`A_{k,j}` and the weights W, one over the mean square of each increment. A sensor whose
    increments are mostly something else has none. Only three measured samples in a row tell something. What a
    controller computes from readings (:attr:`Plant.controller_states`) tells nothing of their noise: it holds what was
    read, and the twin misses nothing of it.

    Args:
        twin: the twin, fitted to the records.
        records: what sensors have read in real episodes, and what was applied.

    Raises:
        DivergenceError: if the twin diverges within an interval that begins with what was read.

    Source: Odelson, Rajamani, Rawlings, Automatica 42 (2006) 303, who estimate covariances of noise by
    autocovariances.
    """
    signals, earlier, later, slopes = twin.plant.readings, list[Tensor](), list[Tensor](), list[Tensor]()
    for record in records:
        sizes = SHIFT * record.states.std(0)
        shifts = torch.cat([torch.zeros_like(sizes)[None], sizes.diag()])
        ends = twin.followed_from(record, shifts)[1:, :, : len(signals)]
        missed = differences(signals, record.states[1:], ends[:, 0])
        slope = differences(signals, ends[:, 1:], ends[:, :1]) / sizes[:, None]  # of the second index by the first
        seen = torch.ones_like(record.states[:, 0], dtype=torch.bool) if record.seen is None else record.seen
        measured = seen[:-2] & seen[1:-1] & seen[2:]
        earlier.append(missed[:-1][measured])
        later.append(missed[1:][measured])
        slopes.append(slope[1:][measured].nan_to_num(posinf=0.0, neginf=0.0))
    e, following, A = torch.cat(earlier), torch.cat(later), torch.cat(slopes)
    computed = torch.tensor([signal.name in twin.plant.controller_states for signal in signals], device=A.device)
    A = torch.where(computed & ~computed.unsqueeze(-1), 0.0, A)
    squares = following.square().mean(0)
    weighted = A * squares.reciprocal().nan_to_num(posinf=0.0)
    products = -(e * (weighted * following.unsqueeze(1)).sum(-1)).sum(0)
    variances = (products / (weighted * A).sum((0, 2))).nan_to_num().clamp_min(0.0)
    explained = variances + variances @ A.square().mean(0)
    return torch.where(explained > MOST * squares, variances, 0.0).sqrt()
