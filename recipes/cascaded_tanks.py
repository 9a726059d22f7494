"""Identify the Cascaded Tanks benchmark from its record, and plan a controller on the identified twin."""

import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import numpy as np
import torch
from torch import Tensor, nn

from rt_torchrl import (
    DigitalTwin,
    Estimate,
    Estimation,
    EstimationConfig,
    Plant,
    Rollout,
    SaturatedMLP,
    SensorRecord,
    check_options,
    main_of,
    sensors_of,
)
from rt_torchrl.atomic_file import write_results
from rt_torchrl.envs.cascaded_tanks.closures import Hydraulics, NeuralHydraulics
from rt_torchrl.envs.cascaded_tanks.plant import CascadedTanks
from rt_torchrl.envs.cascaded_tanks.record import read_benchmark
from rt_torchrl.fit.likelihood import Likelihood
from rt_torchrl.fit.uncertainty import inverse_information

VIRTUAL, UNSEEN = 20, 100
"""Numbers of virtual episodes that a plan is made on, and judged on."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Identify the Cascaded Tanks benchmark: physics, physics with a perceptron, and a controller on the twin.

    Args:
        data: CSV file with the columns uEst, uVal, yEst, yVal; by default the package nonlinear-benchmarks loads the
            record, and downloads it at its first use.
        folds: number of parts of the estimation record, each of which is simulated by a twin of the others.
        hidden: widths of the perceptron's hidden layers.
        priors: stiffnesses of the perceptron's prior, of which the folds choose one.
        starts: number of first weights of the physics.
        iterations: trial steps of each descent.
        first: number of samples that the initial state of a simulation is estimated from; they count as well.
        test: whether to simulate the test record. Every look is counted in looks.json beside the results.
        plan: gradients of the policy that is planned on the twin; 0 plans none.
        draws: number of twins drawn from the uncertainty that the policy is planned on.
        seed: seed of the perceptron's weights and of the virtual episodes.
        log_dir: folder of the results.
    """

    data: Path | None = None
    folds: int = 4
    hidden: tuple[int, ...] = (5,)
    priors: tuple[float, ...] = (100.0, 300.0, 1000.0, 3000.0)
    starts: int = 6
    iterations: int = 40
    first: int = 50
    test: bool = False
    plan: int = 0
    draws: int = 5
    seed: int = 0
    log_dir: Path = Path("runs/cascaded_tanks")

    def __post_init__(self):
        check_options(self)
        for argument in ("starts", "iterations", "first", "draws"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least 1.")
        if self.plan < 0 or self.seed < 0:
            raise ValueError(f"plan={self.plan} and seed={self.seed} must not be negative.")
        if not self.priors or min(self.priors) < 0.0:
            raise ValueError(f"priors={self.priors} must hold stiffnesses that are not negative, one at least.")


class Identified:
    """Twins of one set of records: the physics, then the physics with a perceptron.

    Args:
        records: records to identify from.
        config: options of the recipe.
    """

    def __init__(self, records: list[SensorRecord], config: Config):
        self.plant, self.records, self.config = CascadedTanks(), records, config
        law = self.plant.make_closure(torch.Generator())
        assert isinstance(law, Hydraulics)
        self.law, self.physics = law, self._estimation(law, starts=config.starts)
        self.of_physics = self.physics.run(records)

    def _estimation(self, closure: Any, **options: Any) -> Estimation:
        config = EstimationConfig(iterations=self.config.iterations, errors="robust", **options)
        return Estimation(DigitalTwin(self.plant, closure), sensors_of(self.plant, ["sensed_level"]), config=config)

    def with_perceptron(self, prior: float) -> tuple[Estimation, Estimate]:
        """The physics with a perceptron, which starts from the identified physics."""
        law = Hydraulics(self.law.coefficients.detach())
        generator = torch.Generator().manual_seed(self.config.seed)
        closure = NeuralHydraulics(law, hidden=self.config.hidden, generator=generator)
        estimation = self._estimation(closure, prior=prior, rounds=3)
        return estimation, estimation.run(self.records)


def guess(readings: torch.Tensor) -> torch.Tensor:
    """A first guess of both levels; the upper one has no sensor."""
    return torch.stack([torch.tensor(20.0, dtype=torch.float64), readings[0]])


class Fold(NamedTuple):
    """A part of a record that is simulated, and the parts that the twin is identified from."""

    training: list[SensorRecord]
    held_out: SensorRecord


def folds(
    record: SensorRecord, count: int, dt: float, guess: Callable[[Tensor], Tensor], *, shortest: int = 100
) -> list[Fold]:
    """Divide a record into parts of equal length, each of which is held out once.

    Args:
        record: the record.
        count: number of parts.
        dt: control interval [s].
        guess: makes the first guess of a state from the readings in its sample.
        shortest: number of control intervals that a part needs.

    Raises:
        ValueError: if there are fewer than two parts, or they are too short.
    """
    n = len(record.actions)
    if count < 2 or n // count < shortest:
        raise ValueError(
            f"folds={count} of a record of {n} control intervals must be at least 2, and each at least {shortest} "
            "intervals long."
        )
    cuts = [round(k * n / count) for k in range(count + 1)]

    def part(first: int, last: int) -> SensorRecord:
        return record.part(first, last, dt, guess(record.readings[first]))

    return [
        Fold([part(*ends) for ends in ((0, first), (last, n)) if ends[1] > ends[0]], part(first, last))
        for first, last in zip(cuts[:-1], cuts[1:], strict=True)
    ]


def pooled(rms: list[float], held_out: list[SensorRecord]) -> float:
    """RMS error over all parts together, from those of each part."""
    lengths = torch.tensor([len(record.readings) for record in held_out], dtype=torch.float64)
    squares = torch.tensor(rms, dtype=torch.float64).square()
    return float((lengths * squares).sum() / lengths.sum()) ** 0.5


class Prediction(NamedTuple):
    """A simulated record.

    Args:
        readings: simulated readings.
        errors: measured readings less simulated ones; NaN where a sample is missing.
        deviation: standard deviation of the simulated readings by the uncertainty of weights and initial state.
        noise: standard deviation of the sensors' noise.
        initial: initial state.
    """

    readings: Tensor
    errors: Tensor
    deviation: Tensor
    noise: Tensor
    initial: Tensor

    @property
    def rms(self) -> Tensor:
        """Root mean square error of every sensor over all samples, the first ones included."""
        return self.errors.square().nanmean(0).sqrt()

    def rms_interval(self, block: int, *, draws: int = 2000, seed: int = 0) -> tuple[float, float]:
        """95 % interval of the RMS error of the first sensor, by a bootstrap of blocks of neighbouring samples.

        Args:
            block: number of samples of a block, longer than the memory of the errors.
            draws: number of bootstrap samples.
            seed: seed of the draws.

        Raises:
            ValueError: if a block is not shorter than the record.
        """
        squares = self.errors[:, 0].square()
        squares = squares[~squares.isnan()]
        if not 1 <= block < len(squares):
            raise ValueError(f"block={block} of the bootstrap must lie between 1 and {len(squares) - 1} samples.")
        sums = squares.cumsum(0)
        means = (sums[block:] - sums[:-block]) / block
        count = math.ceil(len(squares) / block)
        picked = torch.randint(len(means), (draws, count), generator=torch.Generator().manual_seed(seed))
        found = means[picked].mean(-1).sqrt().quantile(torch.tensor([0.025, 0.975], dtype=torch.float64))
        low, high = found.tolist()
        return low, high


def predict(estimation: Estimation, estimate: Estimate, record: SensorRecord, *, first: int = 50) -> Prediction:
    """Simulate a record, with the initial state from its first samples.

    Args:
        estimation: the estimation, with the twin under the identified weights.
        estimate: its result, from other records or from this one.
        record: record to simulate.
        first: number of samples that the initial state is estimated from.

    Raises:
        ValueError: if there is no such sample.
        DivergenceError: if the twin diverges.
    """
    if first < 1:
        raise ValueError(f"first={first} samples of the record must be at least 1.")
    noise = estimate.likelihood.noise
    readings = record.readings.clone()
    readings[first:] = torch.nan
    begun = estimation.fit_initial_states([record._replace(readings=readings)], noise)
    start = inverse_information(begun.normal_equations().matrix)
    whole = Likelihood(estimation.twin, [record], estimation.sensors, begun.initial, noise, biases=begun.biases)
    (block,) = whole.residuals()
    n = whole.weight_count
    C = estimate.uncertainty.weights_covariance
    by_weights, by_start = block.jacobian[0].split([n, block.jacobian.shape[-1] - n], -1)
    variance = ((by_weights @ C) * by_weights).sum(-1) + ((by_start @ start.matrix) * by_start).sum(-1)
    untold = estimate.uncertainty.untold(by_weights) | start.unknown(by_start)
    variance = torch.where(untold, torch.inf, variance)
    (simulated,) = whole.simulated()
    deviation = torch.where(record.seen, noise * variance.clamp_min(0.0).sqrt(), torch.nan)
    return Prediction(simulated, record.readings - simulated, deviation, noise.clone(), whole.initial().detach()[0])


class ResidualTests(NamedTuple):
    """Whether the errors of a simulation are noise: their correlations, with the bound for white noise.

    Args:
        auto: autocorrelation of the errors at lags 1, 2 ….
        cross: correlation of the errors with an action, at lags 0, 1 … of the action behind.
        bound: value that 95 % of the correlations of white noise do not exceed.
    """

    auto: Tensor
    cross: Tensor
    bound: float

    def describe(self) -> str:
        """The outcome in a sentence."""
        outside = [(x.abs() > self.bound).double().mean().item() for x in (self.auto, self.cross)]
        return (
            f"{outside[0]:.0%} of the autocorrelations and {outside[1]:.0%} of the correlations with the action lie "
            f"outside ±{self.bound:.3f}, where 5 % of those of white noise lie; neighbouring errors correlate by "
            f"{self.auto[0].item():.2f}"
        )


def residual_tests(prediction: Prediction, record: SensorRecord, *, lags: int = 25) -> ResidualTests:
    """Correlations of the errors of the first sensor, with themselves and with the first action.

    Raises:
        ValueError: if the record is not longer than the lags, or samples are missing.
    """
    e = prediction.errors[:-1, 0]
    if not 1 <= lags < len(e) or e.isnan().any():
        raise ValueError(f"lags={lags} of the residual tests need a longer record, without missing samples.")
    e, u = e - e.mean(), record.actions[:, 0] - record.actions[:, 0].mean()
    scale = e.norm() * u.norm()
    auto = torch.stack([(e[k:] * e[:-k]).sum() for k in range(1, lags + 1)]) / e.square().sum()
    cross = torch.stack([(e[k:] * u[: len(u) - k]).sum() for k in range(lags)]) / scale
    return ResidualTests(auto, cross, 1.96 / math.sqrt(len(e)))


def cross_validated(parts: list[Fold], config: Config) -> dict[str, Any]:
    """RMS error over all parts, of the physics and of every prior of the perceptron [V]."""
    found: dict[str, list[float]] = {}
    for k, part in enumerate(parts):
        print(f"fold {k + 1} of {len(parts)}", file=sys.stderr)
        one = Identified(part.training, config)
        found.setdefault("physics", []).append(
            error(predict(one.physics, one.of_physics, part.held_out, first=config.first))
        )
        for prior in config.priors:
            prediction = predict(*one.with_perceptron(prior), part.held_out, first=config.first)
            found.setdefault(f"{prior:g}", []).append(error(prediction))
    held_out = [part.held_out for part in parts]
    return {name: {"rms": pooled(each, held_out), "folds": each} for name, each in found.items()}


def error(prediction: Prediction) -> float:
    """RMS error of the level [V]."""
    return prediction.rms[0].item()


def main(config: Config) -> None:
    from rt_torchrl.figures import save_figure

    benchmark = read_benchmark(config.data)
    record = sensor_record_of(benchmark.voltage, benchmark.level)
    config.log_dir.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = {"folds": cross_validated(folds(record, config.folds, 4.0, guess), config)}
    scores = {prior: found["folds"][f"{prior:g}"]["rms"] for prior in config.priors}
    found["prior"] = min(scores, key=lambda prior: scores[prior])
    twins = Identified([record], config)
    neural = twins.with_perceptron(found["prior"])
    estimates = {"physics": (twins.physics, twins.of_physics), "physics and perceptron": neural}
    found["looks"] = look(config.log_dir) if config.test else looks(config.log_dir)
    judged = {"estimation": record}
    judged |= {"test": sensor_record_of(benchmark.test_voltage, benchmark.test_level)} if config.test else {}
    for name, pair in estimates.items():
        found[name] = summary(pair[1])
        for which, one in judged.items():
            prediction = predict(*pair, one, first=config.first)
            found[name][which] = judgement(prediction, one)
            title = f"{name}, {which} record"
            file = f"{which}_{name.split()[-1]}.png"
            save_figure(simulated_and_measured(prediction, one, twins.plant.dt, title=title), config.log_dir / file)
    if config.plan:
        closures = list(drawn_closures(neural[1], config.draws, config.seed))
        found["plan"] = planned_under_uncertainty(twins.plant, closures, iterations=config.plan, seed=config.seed)
    write_results(config.log_dir / "results.json", found)
    print(table(found))
    print(f"results in {config.log_dir}")


def planned_under_uncertainty(
    plant: Plant, closures: Sequence[nn.Module], *, iterations: int, seed: int = 0
) -> dict[str, float]:
    """Plan a perceptron on the mean cost over twins, and judge it on each of them with other episodes.

    Args:
        plant: the tanks.
        closures: the identified closure first, then those drawn from its uncertainty.
        iterations: gradients of L-BFGS.
        seed: seed of the policy's weights and of all episodes.

    Returns:
        J_a of the policy before and after, with the identified closure and with the worst of all.
    """
    generator = torch.Generator().manual_seed(seed)
    policy = SaturatedMLP(len(plant.observations), plant.actions, hidden=(16, 16), generator=generator)
    rollouts = [Rollout(plant, closure.requires_grad_(False), policy) for closure in closures]
    drawn = [(plant.draw_initial_state(n, generator), plant.draw_exogenous(n, generator)) for n in (VIRTUAL, UNSEEN)]

    def costs(which: int) -> torch.Tensor:
        return torch.stack([rollout.costs(*drawn[which]).mean() for rollout in rollouts])

    before = costs(1).detach()
    optimiser = torch.optim.LBFGS(policy.parameters(), max_iter=iterations, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        cost = costs(0).mean()
        cost.backward()
        return cost

    optimiser.step(closure)
    after = costs(1).detach()
    return {
        "J_a before [V^2]": before[0].item(),
        "J_a after [V^2]": after[0].item(),
        "J_a after, worst twin [V^2]": after.max().item(),
        "J_a after, least twin [V^2]": after.min().item(),
    }


def sensor_record_of(voltage: np.ndarray, level: np.ndarray) -> SensorRecord:
    """A record of the benchmark; the voltage of the last sample acts on nothing."""
    readings = torch.from_numpy(np.ascontiguousarray(level)).double()[:, None]
    actions = torch.from_numpy(np.ascontiguousarray(voltage)).double()[:-1, None]
    return SensorRecord(readings, actions, torch.zeros_like(actions), guess(readings[0]))


def simulated_and_measured(prediction: Prediction, record: SensorRecord, dt: float, *, title: str) -> Any:
    """The first sensor over time, as measured and as simulated with the 95 % interval of a reading; the errors below.

    Args:
        prediction: the simulated record.
        record: the measured record.
        dt: control interval [s].
        title: title of the figure.
    """
    from rt_torchrl.figures.style import REAL, TWIN, array, caption, legend_below, panels, time_unit, with_unit

    unit, length = time_unit(dt * len(record.actions))
    t = (record.start + dt * np.arange(len(record.readings))) / length
    figure, axes = panels(2, title=title, size=(9.0, 5.6), sharex=True, height_ratios=[2, 1])
    above, below = axes[:, 0]
    middle = array(prediction.readings[:, 0])
    half = 1.96 * array((prediction.deviation[:, 0] ** 2 + prediction.noise[0] ** 2).sqrt())
    above.fill_between(t, middle - half, middle + half, color=TWIN, alpha=0.25, linewidth=0, label="95 % interval")
    above.plot(t, array(record.readings[:, 0]), color=REAL, linewidth=1.2, label="measured")
    above.plot(t, middle, color=TWIN, linewidth=1.2, label="simulated")
    below.plot(t, array(prediction.errors[:, 0]), color=REAL, linewidth=0.9)
    caption(above, "level [V]", f"RMS error {with_unit(prediction.rms[0].item(), 'V')}")
    caption(below, "measured less simulated [V]")
    below.set_xlabel(f"time [{unit}]")
    legend_below(figure, [above])
    return figure


def drawn_closures(estimate: Estimate, count: int, seed: int):
    """The identified closure, and closures drawn from its uncertainty."""
    import copy

    closure = estimate.likelihood.twin.closure
    yield closure
    generator = torch.Generator().manual_seed(seed)
    values, vectors = torch.linalg.eigh(estimate.uncertainty.weights_covariance)
    for _ in range(count):
        normal = torch.randn(len(values), generator=generator, dtype=torch.float64)
        change = vectors @ (values.clamp_min(0.0).sqrt() * normal)
        drawn = copy.deepcopy(closure)
        with torch.no_grad():
            for w, part in zip(drawn.parameters(), change.split([w.numel() for w in drawn.parameters()]), strict=True):
                w.add_(part.view_as(w))
        yield drawn


def summary(estimate: Estimate) -> dict[str, Any]:
    """Weights with their intervals, noise level, and what the data cannot tell."""
    errors, intervals = estimate.uncertainty.standard_errors(), estimate.uncertainty.intervals()
    weights = {
        name: {"value": value, "standard_error": errors[name], "interval": list(intervals[name])}
        for name, value in estimate.after.items()
    }
    return {"weights": weights, "noise": estimate.noise, "warnings": estimate.uncertainty.warnings()}


def judgement(prediction: Prediction, record: SensorRecord) -> dict[str, Any]:
    """RMS error [V] with its interval, the share of samples within their interval, and the residual tests."""
    total = (prediction.deviation**2 + prediction.noise**2).sqrt()
    inside = (prediction.errors.abs() <= 1.96 * total).double().mean().item()
    return {
        "rms": error(prediction),
        "interval": list(prediction.rms_interval(64)),
        "inside": inside,
        "residuals": residual_tests(prediction, record).describe(),
    }


def looks(folder: Path) -> list[str]:
    """When the test record was looked at."""
    file = folder / "looks.json"
    return json.loads(file.read_text()) if file.exists() else []


def look(folder: Path) -> list[str]:
    """Count one more look at the test record."""
    found = [*looks(folder), time.strftime("%Y-%m-%d %H:%M:%S")]
    (folder / "looks.json").write_text(json.dumps(found, indent=2) + "\n")
    return found


def table(found: dict[str, Any]) -> str:
    """The results, for the terminal."""
    lines = ["RMS error of the simulated level [V]", "  over the folds of the estimation record:"]
    lines += [f"    {name:<12}{entry['rms']:8.4f}" for name, entry in found["folds"].items()]
    lines.append(f"  the folds choose the prior {found['prior']:g}")
    for name in ("physics", "physics and perceptron"):
        for which in ("estimation", "test"):
            if which in found[name]:
                one = found[name][which]
                low, high = one["interval"]
                lines.append(f"  {name}, {which} record: {one['rms']:.4f} ({low:.3f} ... {high:.3f})")
                lines.append(f"    {one['inside']:.1%} of the samples within their 95 % interval; {one['residuals']}")
        lines += [f"  note on {name}: {warning}" for warning in found[name]["warnings"]]
    lines.append(f"  the test record was looked at {len(found['looks'])} times")
    lines += [f"  {name}: {value:.4g}" for name, value in found.get("plan", {}).items()]
    return "\n".join(lines)


if __name__ == "__main__":
    main_of(Config, main)
