"""Identify the Cascaded Tanks benchmark from its record: physics, and physics with a perceptron."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import rt_torchrl as rt

rt.begin_loading(__name__)

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from rt_torchrl.atomic_file import make_folder, write_json
from rt_torchrl.envs.cascaded_tanks.closures import Hydraulics, NeuralHydraulics
from rt_torchrl.envs.cascaded_tanks.plant import CascadedTanks
from rt_torchrl.envs.cascaded_tanks.record import read_benchmark
from rt_torchrl.options import AtLeastOne, NotNegative

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HIDDEN = (5,)
"""Widths of the perceptron's hidden layers."""
FIRST = 50
"""Number of samples that the initial state of a simulation is estimated from; their errors count as well."""
UPPER_LEVEL = 20.0
"""First guess of the upper level, which has no sensor [V]."""


@rt.configuration
class Config:
    """Identify the Cascaded Tanks benchmark: physics, and physics with a perceptron.

    Args:
        data: CSV file with the columns uEst, uVal, yEst, yVal; by default the package nonlinear-benchmarks loads the
            record, and downloads it at its first use.
        folds: number of parts of the estimation record, each of which is simulated by a twin of the others.
        priors: stiffnesses of the perceptron's prior, of which the folds choose one.
        starts: number of first weights of the physics.
        iterations: trial steps of each descent.
        test: whether to simulate the test record.
        log_dir: folder of the results.
    """

    data: Path | None = None
    folds: Annotated[int, Field(ge=2, le=10)] = 4
    priors: Annotated[tuple[NotNegative, ...], Field(min_length=1)] = (100.0, 300.0, 1000.0, 3000.0)
    starts: AtLeastOne = 6
    iterations: AtLeastOne = 40
    test: bool = False
    log_dir: Path = Path("runs/cascaded_tanks")

    def estimation(self, closure: nn.Module, **options: Any) -> rt.Estimation:
        """The estimation of a closure of the tanks from the lower level."""
        plant, config = CascadedTanks(), rt.EstimationConfig(iterations=self.iterations, errors="robust", **options)
        return rt.Estimation(rt.DigitalTwin(plant, closure), rt.sensors_of(plant, ["sensed_level"]), config=config)


Found = tuple[rt.Estimation, rt.Estimate]


def physics(records: list[rt.SensorRecord], config: Config) -> Found:
    """The physics, identified from records."""
    estimation = config.estimation(CascadedTanks().make_closure(torch.Generator()), starts=config.starts)
    return estimation, estimation.run(records)


def with_perceptron(law: nn.Module, records: list[rt.SensorRecord], prior: float, config: Config) -> Found:
    """The physics with a perceptron, which starts from an identified law."""
    assert isinstance(law, Hydraulics)
    start, generator = Hydraulics(law.coefficients.detach()), torch.Generator().manual_seed(0)
    closure = NeuralHydraulics(start, hidden=HIDDEN, generator=generator)
    estimation = config.estimation(closure, prior=prior, rounds=3)
    return estimation, estimation.run(records)


def simulated(
    estimation: rt.Estimation, estimate: rt.Estimate, record: rt.SensorRecord, *, first: int = FIRST
) -> Tensor:
    """The readings along a record by an identified twin, from a start that the first samples tell."""
    readings, noise = record.readings.clone(), estimate.likelihood.noise
    readings[first:] = torch.nan
    return estimation.fit_initial_states([record._replace(readings=readings)], noise).simulated()[0]


def folds_of(record: rt.SensorRecord, count: int) -> Iterator[tuple[list[rt.SensorRecord], rt.SensorRecord]]:
    """Parts of a record of equal length: what is left of the record without the part, and the part itself."""
    n, dt = len(record.actions), CascadedTanks().dt
    cuts = [round(k * n / count) for k in range(count + 1)]

    def part(first: int, last: int) -> rt.SensorRecord:
        return record.part(first, last, dt)._replace(guess=guess(record.readings[first]))

    for first, last in itertools.pairwise(cuts):
        yield [part(*ends) for ends in ((0, first), (last, n)) if ends[1] > ends[0]], part(first, last)


def cross_validated(record: rt.SensorRecord, config: Config) -> dict[str, float]:
    """RMS error over all parts of a record by twins of the other parts, of the physics and with every prior [V]."""
    squares: dict[str, list[Tensor]] = {}
    for training, held_out in folds_of(record, config.folds):
        law = physics(training, config)
        twins = {f"{x:g}": with_perceptron(law[0].twin.closure, training, x, config) for x in config.priors}
        for name, twin in {"physics": law, **twins}.items():
            squares.setdefault(name, []).append((held_out.readings - simulated(*twin, held_out)).square())
    return {name: torch.cat(errors).mean().sqrt().item() for name, errors in squares.items()}


def guess(readings: Tensor) -> Tensor:
    """A first guess of both levels."""
    return torch.cat([readings.new_tensor([UPPER_LEVEL]), readings])


def sensor_record_of(voltage: np.ndarray, level: np.ndarray) -> rt.SensorRecord:
    """A record of the benchmark; the voltage of the last sample acts on nothing."""
    readings, actions = torch.tensor(level).double()[:, None], torch.tensor(voltage).double()[:-1, None]
    return rt.SensorRecord(readings, actions, torch.zeros_like(readings), guess(readings[0]))


def level_figure(record: rt.SensorRecord, readings: Tensor, title: str) -> "Figure":
    """The level over time, as measured and as simulated, and the errors below."""
    from rt_torchrl.figures.style import REAL, TWIN, array, caption, grid, legend_below

    figure, (above, below) = grid(2, title=title, size=(9.0, 5.6), xlabel="time [min]", height_ratios=[2, 1])
    t, error = CascadedTanks().dt / 60.0 * np.arange(len(readings)), record.readings - readings
    above.plot(t, array(record.readings[:, 0]), color=REAL, linewidth=1.2, label="measured")
    above.plot(t, array(readings[:, 0]), color=TWIN, linewidth=1.2, label="simulated")
    below.plot(t, array(error[:, 0]), color=REAL, linewidth=0.9)
    caption(above, "level [V]", f"RMS error {error.square().mean().sqrt():.3g} V")
    caption(below, "measured less simulated [V]")
    legend_below(figure, [above])
    return figure


def main(config: Config) -> None:
    from rt_torchrl.figures import save_figure

    make_folder("log_dir", config.log_dir)
    records = {name: sensor_record_of(*columns) for name, columns in read_benchmark(config.data).items()}
    if not config.test:
        del records["test"]
    folds = cross_validated(records["estimation"], config)
    prior = min(config.priors, key=lambda prior: folds[f"{prior:g}"])
    law = physics([records["estimation"]], config)
    neural = with_perceptron(law[0].twin.closure, [records["estimation"]], prior, config)
    results: dict[str, Any] = {"folds": folds, "prior": prior, "config": config}
    print("RMS error of the simulated level [V]\n  over the folds of the estimation record:")
    print("\n".join(f"    {name:<12}{rms:8.4f}" for name, rms in folds.items()))
    print(f"  the folds choose the prior {prior:g}")
    for name, (estimation, estimate) in {"physics": law, "physics and perceptron": neural}.items():
        uncertainty = estimate.uncertainty
        results[name] = {"weights": estimate.after, "intervals": uncertainty.intervals(), "noise": estimate.noise}
        for which, record in records.items():
            readings = simulated(estimation, estimate, record)
            rms = (record.readings - readings).square().mean().sqrt().item()
            results[name][which] = {"rms": rms}
            print(f"  {name}, {which} record: {rms:.4f}")
            figure = level_figure(record, readings, f"{name}, {which} record")
            save_figure(figure, config.log_dir / f"{which}_{name.split()[-1]}.png")
        print("\n".join(f"  note on {name}: {warning}" for warning in uncertainty.warnings()))
    write_json(config.log_dir / "results.json", results)
    print(f"results in {config.log_dir}")


if __name__ == "__main__":
    rt.main_of(Config, main)
