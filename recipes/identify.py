"""Train a plant's twin on a recorded log, without control: ``identify.py log.csv --plant wind_turbine``."""

import dataclasses
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

import rt_torchrl as rt

rt.begin_loading(__name__)

import torch
import tyro
from pydantic import Field

from rt_torchrl.atomic_file import finite, make_folder, new_folder, write_json
from rt_torchrl.fit import resampling
from rt_torchrl.fit.least_squares import Identified, autocorrelation, identify
from rt_torchrl.fit.log import Column, checked, pandas
from rt_torchrl.options import Count, Positive
from rt_torchrl.runs.command_line import plant_class
from rt_torchrl.runs.run_folder import save_tensors

SHOWN = ("before", "after", "standard_error")
"""What the terminal shows of a weight."""


@rt.configuration
class Config:
    """Train a plant's twin on a recorded log, without control.

    Args:
        log: CSV or Parquet file with a column for the time, each action, each exogenous input and each measured state.
        plant: plant of the log, as the name of a folder under envs, or as FILE.py:NAME of your own.
        columns: columns with another name than their signal or another unit, as HEADER=SIGNAL[UNIT] or
            HEADER=SIGNAL*FACTOR+OFFSET.
        drop: leave out rows with a value that is missing or out of range; they become gaps.
        missing: keep rows in which a sensor lacks its sample; only that sample is left out.
        sensors: states and measurements whose columns the twin is fitted to; by default all that the log holds.
        biased: sensors that may be off by a constant, which is estimated.
        guess: first guesses of the initial values of states that are not measured, as STATE=VALUE.
        dt: control interval of the twin [s]; by default the plant's own.
        gap: longest time between two rows that is bridged [s]; by default three sampling intervals.
        shortest: least number of control intervals of a part between gaps; shorter parts are left out.
        held_out: share at the end of the log on which the twin is judged and not trained.
        seed: seed of the closure's first weights, if these are random.
        log_dir: folder of the results, which holds none yet; by default runs/identify/PLANT/TIME.
        estimation: options of the search for the weights, by maximum likelihood.
    """

    log: Annotated[Path, tyro.conf.Positional]
    plant: str
    columns: tuple[str, ...] = ()
    drop: bool = False
    missing: bool = False
    sensors: tuple[str, ...] = ()
    biased: tuple[str, ...] = ()
    guess: tuple[str, ...] = ()
    dt: Positive | None = None
    gap: Positive | None = None
    shortest: Annotated[int, Field(ge=2)] = 10
    held_out: Annotated[float, Field(gt=0, lt=1)] = 0.25
    seed: Count = 0
    log_dir: Path | None = None
    estimation: rt.EstimationConfig = field(default_factory=lambda: rt.EstimationConfig(errors="robust"))

    def __post_init__(self):
        if self.log_dir == Path():
            raise ValueError("log_dir='' is the current folder; name a folder of its own for the results.")

    def make_plant(self) -> rt.Plant:
        """The plant with the requested control interval."""
        make = plant_class(self.plant)
        try:
            plant = make()
            return plant if self.dt is None else make(dt=self.dt, horizon=round(plant.horizon / self.dt) * self.dt)
        except TypeError as error:
            raise ValueError(
                f"plant={self.plant!r} cannot be made ({error}): arguments need defaults, and --dt needs a horizon."
            ) from error

    def guesses(self) -> dict[str, float]:
        """First guesses of hidden states, by name."""
        guesses = {}
        for text in self.guess:
            name, _, value = text.partition("=")
            try:
                guesses[name] = float(value)
            except ValueError:
                raise ValueError(f"guess={text!r} is not understood; write STATE=VALUE, such as wall=15.") from None
        return guesses

    def make_folder(self, plant: str) -> Path:
        """Create the folder of the results and return its path.

        Raises:
            ValueError: if the folder holds a training or an identification already, or cannot be written.
        """
        from rt_torchrl.runs.run_folder import WRITTEN  # here, because --help need not wait for TorchRL

        folder = self.log_dir or new_folder(Path("runs") / "identify" / plant)
        present = [name for name in WRITTEN if (folder / name).exists()]
        if present:
            raise ValueError(f"log_dir={folder} holds results already ({', '.join(present)}); choose another folder.")
        make_folder("log_dir", folder / "figures")
        return folder


def main(config: Config) -> None:
    # Here, because --help need not wait for Matplotlib.
    from rt_torchrl.figures import save_figure
    from rt_torchrl.figures import uncertainty as charts

    plant = config.make_plant()
    columns = [Column.parse(text) for text in config.columns]
    log = checked(rt.read_log(config.log, plant, columns), plant, drop=config.drop, missing=config.missing)
    parts = resampling.resample(
        resampling.filled(log, plant, config.guesses()), plant, gap=config.gap, shortest=config.shortest
    )
    split = resampling.hold_out(parts.segments, plant.dt, config.held_out, shortest=config.shortest)
    folder = config.make_folder(plant.name)
    print(report_of_parts(parts, plant, rows=len(log.times)))
    closure = plant.make_closure(torch.Generator().manual_seed(config.seed))
    sensors = resampling.sensors_in(plant, log, config.sensors, config.biased)
    spread = resampling.initial_spread(plant, log)
    task = rt.Estimation(rt.DigitalTwin(plant, closure), sensors, spread=spread, config=config.estimation)
    records = [[resampling.logged_readings(log, plant, sensors, part, parts.gap) for part in side] for side in split]
    identified = identify(task, *records)
    described = parts._asdict() | {"segments": [(s.start, len(s.actions)) for s in parts.segments]}
    metrics = {"plant": plant.name} | metrics_of(identified) | {"log": described, "config": dataclasses.asdict(config)}
    write_json(folder / "metrics.json", metrics)
    save_tensors(folder / "weights.pt", {"closure": closure.state_dict()})
    figures = {
        "twin_and_log": charts.twin_and_sensors(identified),
        "correlations": charts.correlations(identified.estimate.uncertainty),
    }
    for name, figure in figures.items():
        save_figure(figure, folder / "figures" / f"{name}.png")
    print(table(metrics))
    print(f"results in {folder}")


def metrics_of(identified: Identified) -> dict[str, Any]:
    """The content of ``metrics.json``: errors of every sensor, weights, noise, initial states; unknown is null."""
    estimate, uncertainty = identified.estimate, identified.estimate.uncertainty
    sensors, states = estimate.likelihood.sensors, estimate.likelihood.plant.states
    names, units = [sensor.name for sensor in sensors], [sensor.measurement.unit for sensor in sensors]
    summary: dict[str, Any] = {"iterations": estimate.iterations, "segment": estimate.segment}
    for side in ("training", "held_out"):
        rows = zip(names, units, getattr(identified, side).rms.tolist(), strict=True)
        summary[side] = {"rms": {name: {"unit": unit, "error": error} for name, unit, error in rows}}
    summary["autocorrelation"] = dict(zip(names, autocorrelation(estimate.likelihood).tolist(), strict=True))
    summary["noise"], summary["bias"] = estimate.noise, estimate.biases
    summary["bias_standard_error"] = uncertainty.bias_errors()
    errors, intervals = uncertainty.standard_errors(), uncertainty.intervals()
    summary["weights"] = {
        name: {
            "before": estimate.before[name],
            "after": value,
            "interval": intervals[name],
            "standard_error": errors[name],
        }
        for name, value in estimate.after.items()
    }
    starts = zip(estimate.initial.tolist(), uncertainty.initial_errors().tolist(), strict=True)
    named = [state.name for state in states]
    summary["initial_states"] = [dict(zip(named, map(list, zip(*pair, strict=True)), strict=True)) for pair in starts]
    return finite(summary | {"warnings": estimate.warnings()})


def report_of_parts(parts: resampling.Resampled, plant: rt.Plant, *, rows: int) -> str:
    """The parts and gaps of the log, for the terminal."""
    steps = [len(segment.actions) for segment in parts.segments]
    apart = f"{rows} rows, {parts.interval:g} s apart (scatter {parts.jitter:.1%})"
    lines = [f"{apart}, resampled to {sum(steps)} intervals of {plant.dt:g} s in {len(steps)} segments"]
    lines += [f"  gap from {first:g} to {last:g} s" for first, last in parts.gaps]
    lines += [f"  left out as too short: {first:g} to {last:g} s" for first, last in parts.too_short]
    return "\n".join(lines)


def table(metrics: dict[str, Any]) -> str:
    """The results, for the terminal."""
    of_sensors = {
        f"{name} [{rms['unit']}], {side.replace('_', ' ')}": {"RMS error": rms["error"]}
        for side in ("training", "held_out")
        for name, rms in metrics[side]["rms"].items()
    }
    errors = {key.replace("_", " "): metrics[key] for key in ("noise", "bias", "bias_standard_error")}
    errors["neighbours' correlation"] = metrics["autocorrelation"]
    weights = {name: {key: entry[key] for key in SHOWN} for name, entry in metrics["weights"].items()}
    frame = pandas().DataFrame
    blocks = [frame(of_sensors).T, frame(errors), frame(weights).T]
    texts = [block.astype(float).to_string(float_format="{:.5g}".format, na_rep="unknown") for block in blocks]
    return "\n\n".join([*texts, "\n".join(f"note: {warning}" for warning in metrics["warnings"])])


if __name__ == "__main__":
    rt.main_of(Config, main)
