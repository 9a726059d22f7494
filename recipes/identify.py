"""Train a plant's twin on a recorded log, without control: ``identify.py log.csv --plant wind_turbine``."""

import dataclasses
import json
import math
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

if __name__ == "__main__":
    print("loading PyTorch and TorchRL", file=sys.stderr)  # at once, because this takes seconds

import torch
import tyro

from rt_torchrl import Identification, IdentificationConfig, Plant, check_options, main_of, read_log
from rt_torchrl.identification.identification import Identified, held_back, measured_states
from rt_torchrl.identification.resampling import Resampled, hold_out, resample
from rt_torchrl.identification.sensor_log import Column, checked
from rt_torchrl.runs.loaded_run import config_class_of
from rt_torchrl.runs.shipped_plants import plant_class


@dataclass(frozen=True, kw_only=True)
class Config:
    """Train a plant's twin on a recorded log, without control.

    Args:
        log: CSV or Parquet file with a column for the time, each action, each exogenous input and each measured state.
        plant: plant of the log, as the name of a folder under envs, or as FILE.py:NAME or package.module:NAME of your
            own.
        recipe: recipe whose Config makes the plant instead, with default options.
        columns: columns with another name than their signal or another unit, as HEADER=SIGNAL[UNIT] or
            HEADER=SIGNAL*FACTOR+OFFSET.
        drop: leave out rows with a value that is missing or out of range; they become gaps.
        dt: control interval of the twin [s]; by default the plant's own.
        gap: longest time between two rows that is bridged [s]; by default three sampling intervals.
        shortest: least number of control intervals of a part between gaps; shorter parts are left out.
        held_out: share at the end of the log on which the twin is judged and not trained.
        seed: seed of the closure's first weights, if these are random.
        log_dir: folder of the results; by default runs/identify/PLANT/TIME.
        identification: options of the search for the weights.
    """

    log: Annotated[Path, tyro.conf.Positional]
    plant: str | None = None
    recipe: Path | None = None
    columns: tuple[str, ...] = ()
    drop: bool = False
    dt: float | None = None
    gap: float | None = None
    shortest: int = 10
    held_out: float = 0.25
    seed: int = 0
    log_dir: Path | None = None
    identification: Annotated[IdentificationConfig, tyro.conf.arg(name="")] = field(
        default_factory=IdentificationConfig
    )

    def __post_init__(self):
        check_options(self)
        if (self.plant is None) == (self.recipe is None):
            raise ValueError("the physics is not known: give one of --plant and --recipe.")
        if self.dt is not None and not self.dt > 0.0:
            raise ValueError(f"dt={self.dt} s must be positive.")
        if self.seed < 0:
            raise ValueError(f"seed={self.seed} must not be negative.")
        if self.log_dir == Path():
            raise ValueError("log_dir='' is the current folder; name a folder of its own for the results.")

    def make_plant(self) -> Plant:
        """The plant with the requested control interval."""
        make = plant_class(self.plant) if self.plant else self._plant_of_recipe
        try:
            plant = make()
            if self.dt is None:
                return plant
            return make(dt=self.dt, horizon=max(1, round(plant.horizon / self.dt)) * self.dt)
        except TypeError as error:
            source = f"plant={self.plant!r}" if self.plant else f"recipe={self.recipe}"
            raise ValueError(
                f"{source} cannot be made ({error}): its options must have defaults, and for --dt it needs dt and "
                "horizon. A recipe with a method plant() can fill them in."
            ) from error

    def _plant_of_recipe(self, **options: float) -> Plant:
        config = dataclasses.replace(config_class_of(self.recipe)(), **options)
        if not hasattr(config, "plant"):
            raise ValueError(f"recipe={self.recipe}: its Config has no method plant(); write one, or give --plant.")
        return config.plant()

    def make_folder(self, plant: str) -> Path:
        """Create the folder of the results and return its path."""
        folder = self.log_dir or Path("runs") / "identify" / plant / time.strftime("%Y%m%d-%H%M%S")
        try:
            (folder / "figures").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"log_dir={folder} cannot be written ({error}); choose another with --log-dir.") from error
        return folder


def main(config: Config) -> None:
    # Here, because --help need not wait for Matplotlib.
    from rt_torchrl.figures import identification as charts
    from rt_torchrl.figures import save_figure

    plant = config.make_plant()
    log = checked(read_log(config.log, plant, [Column.parse(text) for text in config.columns]), plant, drop=config.drop)
    parts = resample(log, plant, gap=config.gap, shortest=config.shortest)
    training, held_out = hold_out(parts.segments, plant.dt, config.held_out, shortest=config.shortest)
    folder = config.make_folder(plant.name)
    print(report_of_parts(parts, plant, rows=len(log.times)))
    measured = measured_states(plant, log)
    closure = plant.make_closure(torch.Generator().manual_seed(config.seed))
    task = Identification(plant, closure, free=measured, config=config.identification)
    found = task.run(training, held_out)
    metrics = metrics_of(plant, measured, found, parts) | {
        "config": dataclasses.asdict(config),
        "held_back": held_back(plant, parts.segments),
    }
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=2, default=str) + "\n")
    torch.save({"closure": closure.state_dict()}, folder / "weights.pt")
    drawn = {"twin_and_log": charts.twin_and_log(plant, measured, training, held_out, found)}
    drawn["weights"] = charts.weights(found)
    for name, figure in drawn.items():
        save_figure(figure, folder / "figures" / f"{name}.png")
    print(table(metrics))
    print(f"results in {folder}")


def metrics_of(plant: Plant, measured: list[int], found: Identified, parts: Resampled) -> dict[str, Any]:
    """The content of ``metrics.json``, with the errors of the measured states; unknown numbers are null."""
    summary: dict[str, Any] = {"plant": plant.name, "iterations": found.iterations}
    for name in ("training", "held_out"):
        before, after = getattr(found, name)
        rms = {
            plant.states[k].name: {
                "unit": plant.states[k].unit,
                "before": before.rms[k].item(),
                "after": after.rms[k].item(),
            }
            for k in measured
        }
        summary[name] = {"seconds": after.seconds, "J_p_before": before.J_p, "J_p": after.J_p}
        summary[name] |= {"J_p_ratio": after.J_p / before.J_p, "rms": rms}
    summary["autocorrelation"] = {plant.states[k].name: found.autocorrelation[k].item() for k in measured}
    summary["weights"] = {
        name: {key: value if math.isfinite(value) else None for key, value in entry.items()}
        for name, entry in found.weights.items()
    }
    described = parts._asdict() | {"segments": [(s.start, len(s.actions)) for s in parts.segments]}
    return summary | {"log": described}


def report_of_parts(parts: Resampled, plant: Plant, *, rows: int) -> str:
    """The parts and gaps of the log, for the terminal."""
    steps = [len(segment.actions) for segment in parts.segments]
    lines = [
        f"{rows} rows, {parts.interval:g} s apart (scatter {parts.jitter:.1%}), resampled to {sum(steps)} intervals of "
        f"{plant.dt:g} s in {len(steps)} segments"
    ]
    lines += [f"  gap from {first:g} to {last:g} s (limit {parts.gap:g} s)" for first, last in parts.gaps]
    lines += [f"  left out as too short: {first:g} to {last:g} s" for first, last in parts.too_short]
    return "\n".join(lines)


def table(metrics: dict[str, Any]) -> str:
    """The results, for the terminal."""
    lines = [f"  {'':<32}{'before':>12}{'after':>12}{'ratio':>12}"]
    for name in ("training", "held_out"):
        found, shown = metrics[name], name.replace("_", " ")
        costs = (found["J_p_before"], found["J_p"], found["J_p_ratio"])
        lines.append(f"  {'J_p, ' + shown:<32}" + "".join(f"{value:>12.4g}" for value in costs))
        for state, rms in found["rms"].items():
            label = f"RMS {state} [{rms['unit']}]"
            lines.append(f"    {label:<30}{rms['before']:>12.4g}{rms['after']:>12.4g}")
    correlation = ", ".join(f"{name} {value:.2f}" for name, value in metrics["autocorrelation"].items())
    lines.append(f"  correlation of neighbouring residuals: {correlation}")
    lines.append(f"  {'weight':<32}{'before':>12}{'after':>12}{'std. error':>12}")
    for name, entry in metrics["weights"].items():
        error = "not shown" if entry["standard_error"] is None else f"{entry['standard_error']:.2g}"
        lines.append(f"  {name:<32}{entry['before']:>12.5g}{entry['after']:>12.5g}{error:>12}")
    shares = {name: share for name, share in metrics["held_back"].items() if share}
    lines += [f"  the plant's actuators hold back {name} in {share:.1%} of the log" for name, share in shares.items()]
    return "\n".join(lines)


if __name__ == "__main__":
    main_of(Config, main)
