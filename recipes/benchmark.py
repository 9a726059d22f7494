"""Measure time and memory of forward and gradient by each engine, JAX and CasADi; all take turns in one process."""

import dataclasses
import json
import platform
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

from benchmarking import cores, fresh_process
from benchmarking.case import Case, ClosureKind, PlantName, PolicyKind, system_of
from benchmarking.contenders import Casadi, Contenders, Jax
from benchmarking.sizes import Grid
from benchmarking.summary import Summary
from benchmarking.tables import start_table, time_table, training_table, update_table
from benchmarking.timing import Cell, Stopwatch
from benchmarking.trainings import seconds_of_steps

from rt_torchrl import Engine, main_of
from rt_torchrl.atomic_file import new_folder
from rt_torchrl.trajectories.rollout import ENGINES

SHARES = {"times": 0.5, "starts": 0.75, "trainings": 1.0, "updates": 1.0}
"""Shares of the minutes after which the parts of the benchmark begin nothing more."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Time J_a and its gradient with respect to the policy by the gradient engines, by JAX and by CasADi.

    Args:
        plants: plants; the first one matters most.
        closures: closures, law for the plant's own and mlp for one with a perceptron of 32 x 32.
        policies: policies, affine for the plant's own and mlp for a perceptron of 32 x 32.
        horizons: numbers of control intervals.
        realisations: numbers of trajectories N_z.
        at_horizon: number of control intervals with which the realisations vary.
        at_realisations: number of trajectories with which the horizons vary.
        all_pairs: whether to time all pairs of horizons and realisations instead of these two lines.
        threads: numbers of CPU threads, which take turns; on Linux JAX has as many cores.
        engines: gradient engines; those that cannot roll a plant out are left out. Ratios are of native, or else of the
            first one.
        jax: jax_scan for one scan that JAX differentiates, jax_sweep for a reverse sweep by hand; both need the extra
            bench.
        casadi: casadi_scalar for C code of one realisation after another, casadi_lanes for the same code with vectors
            over realisations; both are written for the drone with its law, and need the extra bench and g++.
        compiled: compile the engines.
        eager: engines that are not compiled all the same, such as odeint_adjoint as torchdiffeq ships it.
        repeats: greatest number of turns behind a median, each of calls for a tenth of a second, at least one.
        limit: predicted time of one evaluation [s] above which a size is left out.
        minutes: time [min] after which nothing new begins; 0 sets no end.
        starts: whether to measure compilation and memory in fresh processes.
        episodes: number of episodes of a short training of each plant with the engine that the ratios are of; its steps
            are timed. 0 leaves the trainings out.
        updates: number of iterations of critic and policy in an update of step 2, which is timed with the learner of
            each plant's recipe. 0 leaves the updates out.
        quick: whether to make a small benchmark with all its parts but the trainings and updates.
        log_dir: folder of tables and figures; by default runs/benchmark/TIME.
    """

    plants: tuple[PlantName, ...] = get_args(PlantName)
    closures: tuple[ClosureKind, ...] = ("law",)
    policies: tuple[PolicyKind, ...] = ("affine",)
    horizons: tuple[int, ...] = (100, 1_000, 10_000, 100_000)
    realisations: tuple[int, ...] = (1, 5, 25, 125)
    at_horizon: int = 10_000
    at_realisations: int = 5
    all_pairs: bool = False
    threads: tuple[int, ...] = (1, 2)
    engines: tuple[Engine, ...] = tuple(ENGINES)
    jax: tuple[Jax, ...] = get_args(Jax)
    casadi: tuple[Casadi, ...] = get_args(Casadi)
    compiled: bool = True
    eager: tuple[Engine, ...] = ("odeint_adjoint", "autograd")
    repeats: int = 5
    limit: float = 10.0
    minutes: float = 10.0
    starts: bool = True
    episodes: int = 2
    updates: int = 300
    quick: bool = False
    log_dir: Path | None = None

    def __post_init__(self):
        for name in ("plants", "closures", "policies", "horizons", "realisations", "threads", "engines"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name}={values} must be one value or several different ones.")
        for name in ("horizons", "realisations", "threads"):
            if min(getattr(self, name)) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must all be at least 1.")
        for name, least in (("at_horizon", 1), ("at_realisations", 1), ("repeats", 1), ("episodes", 0), ("updates", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)} must be at least {least}.")
        if max(self.threads) > cores.available():
            raise ValueError(f"threads={self.threads} must be at most {cores.available()}, the cores of this process.")
        if not self.limit > 0 or not self.minutes >= 0:
            raise ValueError(f"limit={self.limit} s must be positive, and minutes={self.minutes} zero or above.")

    def effective(self) -> "Config":
        """The options that are carried out, in which ``quick`` has replaced other options."""
        if not self.quick:
            return self
        sizes = {"horizons": (20, 60), "realisations": (1, 2), "at_horizon": 20, "at_realisations": 2}
        return dataclasses.replace(self, **sizes, repeats=1, episodes=0, updates=0, quick=False)

    def grid(self) -> Grid:
        cases = [Case(p, c, a) for c in self.closures for a in self.policies for p in self.plants]
        lines = (self.horizons, self.realisations, self.at_horizon, self.at_realisations)
        return Grid(cases, self.threads, *lines, all_pairs=self.all_pairs)

    def contenders(self) -> Contenders:
        return Contenders(self.engines, self.jax, self.casadi, self.compiled, self.eager)

    def subject(self) -> Engine:
        """The engine that is compared with the others."""
        return next((engine for engine in self.engines if engine == "native"), self.engines[0])


class Benchmark:
    """The parts of a benchmark, which share its time; each leaves out what it has no time for, and says so."""

    def __init__(self, config: Config, folder: Path):
        self.config, self.folder, self.began = config, folder, time.monotonic()
        self.stopwatch = Stopwatch(config.contenders(), config.repeats, config.limit, _tell)
        self.starts: dict[str, dict[str, dict[str, float]]] = {}
        self.trainings: dict[str, list[float]] = {}
        self.updates: dict[str, dict[str, float]] = {}
        self.out_of_time: list[str] = []

    def run(self) -> None:
        self._times()
        if self.config.starts:
            self._starts()
        if self.config.episodes:
            self._trainings()
        if self.config.updates:
            self._updates()

    def _late(self, part: str, what: str) -> bool:
        late = 0 < 60.0 * self.config.minutes * SHARES[part] < time.monotonic() - self.began
        if late:
            self.out_of_time.append(what)
        return late

    def _times(self) -> None:
        shortest, timed = min(self.config.horizons), set()
        for sizes in self.config.grid():
            if self._late("times", f"{sizes[0].case.name}, {sizes[0].steps} x {sizes[0].realisations}"):
                continue
            found = self.stopwatch.time(sizes)
            timed.add(sizes[0])
            slow = list(dict.fromkeys(cell.contender for cell in found if "predicted" in cell.left_out))
            short = [dataclasses.replace(size, steps=shortest) for size in sizes]
            if slow and short[0] not in timed:  # what is too slow is timed over a short horizon, and scaled per step
                timed.add(short[0])
                self.stopwatch.time(short, slow)

    def _starts(self) -> None:
        config, cells = self.config, self.stopwatch.cells
        for case in config.grid().cases:
            system = system_of(case)
            for name in config.contenders().names:
                if config.contenders().refusal(name, system) or self._late("starts", f"start, {case.name}: {name}"):
                    continue
                _tell(f"start of {name}, {case.name}")
                found = fresh_process.started(config.contenders(), name, case, self._longest(cells, name, case))
                self.starts.setdefault(case.name, {})[name] = found

    def _longest(self, cells: list[Cell], name: str, case: Case) -> tuple[int, int] | None:
        """The longest horizon at which a contender's gradient has been timed with ``at_realisations``."""
        steps = [
            cell.size.steps
            for cell in cells
            if (cell.contender, cell.size.case, cell.quantity) == (name, case, "gradient")
            and cell.size.realisations == self.config.at_realisations
            and not cell.left_out
        ]
        return (max(steps), self.config.at_realisations) if steps else None

    def _trainings(self) -> None:
        config, engine = self.config, self.config.subject()
        for plant in config.plants:
            name = f"{plant}, {engine}"
            if self._late("trainings", f"training, {name}"):
                continue
            _tell(f"training, {name}")
            with tempfile.TemporaryDirectory() as run:
                steps = seconds_of_steps(plant, engine, Path(run), config.episodes, compiled=config.compiled)
            self.trainings[name] = steps

    def _updates(self) -> None:
        from benchmarking.updates import milliseconds_of_update  # here, because --help need not wait for TorchRL

        config = self.config
        for plant in config.plants:
            if not self._late("updates", f"update, {plant}"):
                _tell(f"update, {plant}")
                self.updates[plant] = milliseconds_of_update(plant, config.updates, config.repeats)

    def report(self) -> str:
        """The tables and the summary."""
        parts = [time_table(self.stopwatch.cells)]
        parts += [start_table(self.starts)] if self.starts else []
        parts += [training_table(self.trainings)] if self.trainings else []
        parts += [update_table(self.updates)] if self.updates else []
        if self.out_of_time:
            parts.append(f"no time within minutes={self.config.minutes:g} for:\n  " + "\n  ".join(self.out_of_time))
        return "\n\n".join([*parts, "summary\n" + "\n".join(f"  {line}" for line in self.summary())])

    def summary(self) -> list[str]:
        """The ratios, and the compilation of the engine that they are about."""
        lines = Summary(self.stopwatch.cells, self.config.subject()).lines()
        for case, found in self.starts.items():
            own = found.get(self.config.subject())
            lines += [f"{case}: {self.config.subject()} compiles in {own['cold']:.2f} s cold"] if own else []
        return lines

    def save(self) -> None:
        """Write ``benchmark.json``, ``benchmark.txt`` and the figures."""
        machine = {"machine": platform.platform(), "processor": platform.machine(), "cores": cores.available()}
        result: dict[str, Any] = {**machine, "python": platform.python_version(), "command": sys.argv}
        result |= {"cells": [cell.record() for cell in self.stopwatch.cells], "starts": self.starts}
        result |= {"trainings": self.trainings, "updates": self.updates}
        result |= {"out_of_time": self.out_of_time, "summary": self.summary()}
        (self.folder / "benchmark.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        (self.folder / "benchmark.txt").write_text(self.report() + "\n", encoding="utf-8")
        from benchmarking.figures import save_figures  # here, because --help need not wait for Matplotlib

        save_figures(self.stopwatch.cells, self.folder)


def _tell(doing: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\033[K{doing}", end="", file=sys.stderr, flush=True)


def main(config: Config) -> None:
    config = config.effective()
    folder = config.log_dir or new_folder(Path("runs") / "benchmark")
    folder.mkdir(parents=True, exist_ok=True)
    benchmark = Benchmark(config, folder)
    try:
        benchmark.run()
    finally:  # an interrupted benchmark reports what it has
        _tell("")
        benchmark.save()
        print(benchmark.report())
        print(f"results in {folder}")


if __name__ == "__main__":
    main_of(Config, main)
