"""Step 4 from some sensors: the closure is trained until the twin replays what they read."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.fit.least_squares import Estimate, Estimation, EstimationConfig, usual_sizes
from rt_torchrl.fit.prior import Belief, BeliefPrior
from rt_torchrl.fit.record import SensorRecord, chained, sensor_records
from rt_torchrl.fit.sensors import Sensor, sensors_of, state_places, with_biases
from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.optimisers.levenberg_marquardt import NormalEquations
from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import Assimilation, AssimilationConfig

STARTS = 10
"""Number of first weights in the first episode, because one sensor may leave several local minima."""
ROUNDS = 4
"""Greatest number of rounds in which the noise levels follow the residuals, in an episode."""
KNOWN = 1e-6
"""Spread of first states that are known, as a share of their usual size, where pushes make all states unknowns."""
DRAWS = 200
"""Number of initial states that a plant draws, to learn how hidden ones depend on those that are read."""


class SensorAssimilation(Assimilation):
    """Estimates weights, first states and noise levels from some sensors; of records it uses nothing else.

    Args:
        twin: twin whose closure is updated in place.
        config: parameters of step 4, with ``sensors``.

    Raises:
        ValueError: if the plant has no such state or measurement.
    """

    def __init__(self, twin: DigitalTwin, config: AssimilationConfig):
        super().__init__(twin, config)
        self.sensors = with_biases(sensors_of(twin.plant, config.sensors), config.biased)
        self.estimate: Estimate | None = None
        self.begun = False
        self.belief: Belief | None = None

    def _descend(self, replayed: Trajectory) -> Descended:
        plant, config = self.twin.plant, self.config
        records = sensor_records(plant, self.sensors, replayed)
        first = FirstStates(plant, self.sensors)
        records = [record._replace(guess=first.guess(record), course=None) for record in records]
        estimation, records = self._task(records, first.spread)
        if not config.iterations:
            return Descended(float("nan"), float("nan"), float("nan"), 0)
        start = [w.detach().clone() for w in self.twin.closure.parameters()]
        closure, drift = self.twin.closure, config.drift
        believed = BeliefPrior(closure, self.belief, drift) if drift and self.belief is not None else None
        self.estimate = estimation.run(records, believed)
        self.begun, self.belief = True, self.estimate.uncertainty.belief() if drift else None
        found = [w.detach().clone() for w in self.twin.closure.parameters()]
        noise, samples = self.estimate.likelihood.noise, sum(int(record.seen.sum()) for record in records)
        costs = [self._misfit(estimation, records, noise, weights) for weights in (start, found)]
        before, after = (found.cost.item() / samples for found in costs)
        return Descended(before, after, costs[0].gradient.norm().item(), self.estimate.iterations)

    def _task(
        self, records: list[SensorRecord], spread: Float[Tensor, " n_s"]
    ) -> tuple[Estimation, list[SensorRecord]]:
        """The estimation, and the records in the parts between which something may push."""
        plant, config, process = self.twin.plant, self.config, None
        if config.pushes > 1:
            sizes = usual_sizes(plant, torch.stack([record.guess for record in records]), self.sensors, records)
            process, spread = config.push * sizes, torch.maximum(spread, KNOWN * sizes)
            length = -(-len(records[0].actions) // config.pushes)
            records = [part for record in records for part in chained(record, length, plant.dt)]
        options = EstimationConfig(
            iterations=max(config.iterations, 1),
            rounds=ROUNDS,
            prior=config.prior,
            starts=1 if self.begun else STARTS,
        )
        return Estimation(self.twin, self.sensors, spread=spread, process=process, config=options), records

    @torch.no_grad()
    def _misfit(
        self, estimation: Estimation, records: list[SensorRecord], noise: Float[Tensor, " n_y"], weights: list[Tensor]
    ) -> NormalEquations:
        """The likelihood's equations for these weights, at the first states that suit them best."""
        for held, value in zip(self.twin.closure.parameters(), weights, strict=True):
            held.copy_(value)
        return estimation.fit_initial_states(records, noise).normal_equations()

    def report(self) -> dict[str, float]:
        """Noise levels, biases and standard errors of the last update, by name."""
        if self.estimate is None:
            return {}
        errors = self.estimate.uncertainty.standard_errors()
        found = {f"noise/{name}": value for name, value in self.estimate.noise.items()}
        found |= {f"bias/{name}": self.estimate.biases[name] for name in self.config.biased}
        return found | {f"standard_error/{name}": value for name, value in errors.items()}

    def state_dict(self) -> dict[str, Any]:
        belief = None if self.belief is None else self.belief._asdict()
        return super().state_dict() | {"begun": self.begun, "belief": belief}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.begun, belief = state["begun"], state["belief"]
        self.belief = None if belief is None else Belief(**belief)


class FirstStates:
    r"""What the first state of an episode is, given the states that sensors read in its first sample.

    .. math:: \hat s = \bar s + C_{sy}C_{yy}^{-1}(y - \bar y)

    Mean and covariance are those of the initial states that the plant draws. A state that always begins with the same
    value, or follows from one that is read, is known.

    Args:
        plant: the plant.
        sensors: the sensors.

    Attributes:
        spread: standard deviation of the first state about that guess; infinite for states that are read.
    """

    def __init__(self, plant: Plant, sensors: tuple[Sensor, ...]):
        drawn = plant.draw_initial_state(DRAWS, torch.Generator().manual_seed(0))
        own = state_places(plant, sensors)
        self._columns = [column for column, k in enumerate(own) if k is not None]
        self._read = [k for k in own if k is not None]
        self._mean = drawn.mean(0)
        centred = drawn - self._mean
        self._gain = torch.linalg.pinv(centred[:, self._read]) @ centred
        left = centred - centred[:, self._read] @ self._gain
        scale = centred.abs().amax(0)
        deviation = left.square().mean(0).sqrt()
        self.spread = torch.where(deviation > 1e-9 * scale, deviation, 0.0)
        self.spread[self._read] = torch.inf

    def guess(self, record: SensorRecord) -> Float[Tensor, " n_s"]:
        """The guess of a record's first state."""
        first = record.readings[0, self._columns]
        first = torch.where(first.isnan(), self._mean[self._read], first)
        found = self._mean + (first - self._mean[self._read]) @ self._gain
        found[self._read] = first
        return found
