"""Time an episode's cost and its gradient by each engine; all take turns in one process."""

import itertools
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import torch
from torch import Tensor, nn

from rt_torchrl import Engine, Plant, Rollout, SaturatedMLP, Scenario, configuration, main_of, shipped_plants
from rt_torchrl.atomic_file import make_folder, write_json
from rt_torchrl.options import AtLeastOne, File, Positive
from rt_torchrl.trajectories.rollout import refusal

PlantName = Literal["flapping_wing", "wind_turbine", "cryogenic_tank"]
Policy = Literal["affine", "mlp"]
QUANTITIES = ("forward", "gradient")
TURN = 0.1
"""Time [s] that the calls of a turn take together. A single call of a millisecond would measure what the engine before
it left in the caches."""
STEPS_OF: dict[PlantName, float] = {"cryogenic_tank": 4.32}
"""Control intervals that differ from the plants' own [s]: with 30 s the tank would run empty within 1e5 intervals."""
HIDDEN = (32, 32)
COLOURS = {"native": "#D55E00", "parallel": "#0072B2", "odeint_adjoint": "#009E73", "autograd": "#222222"}


@configuration
class Config:
    """Time J_a and its gradient by the policy's weights by the gradient engines.

    Args:
        plants: plants, with their own closures.
        policy: affine for the plant's own policy, mlp for a perceptron of 32 x 32; its weights are random.
        horizons: numbers of control intervals.
        realisations: numbers of trajectories N_z; each is timed with each horizon.
        engines: gradient engines; ratios are over the first one. An engine that cannot roll a plant out is left out.
        threads: number of CPU threads. On one thread the times are CPU times, which other processes on the machine
            change least; on more threads they are wall times.
        repeats: number of turns behind a median, each of calls for a tenth of a second, at least one.
        limit: time of one call [s], predicted by smaller sizes, above which an engine is left out.
        quick: whether to time two small sizes once.
        output: folder for benchmark.json and a figure of each plant; by default nothing is written.
    """

    plants: tuple[PlantName, ...] = get_args(PlantName)
    policy: Policy = "affine"
    horizons: tuple[AtLeastOne, ...] = (100, 1_000, 10_000)
    realisations: tuple[AtLeastOne, ...] = (5, 25)
    engines: tuple[Engine, ...] = get_args(Engine)
    threads: AtLeastOne = 1
    repeats: AtLeastOne = 5
    limit: Positive = 2.0
    quick: bool = False
    output: File | None = None

    def __post_init__(self) -> None:
        for name in ("plants", "horizons", "realisations", "engines"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name}={values} must be one value or several different ones.")

    def effective(self) -> "Config":
        """The options that are carried out, in which ``quick`` has replaced other options."""
        return replace(self, horizons=(20, 60), realisations=(2,), repeats=1, quick=False) if self.quick else self


class System(NamedTuple):
    """A plant with a closure and a policy of random weights; those of the closure are fixed, as when one plans."""

    plant: Plant
    closure: nn.Module
    policy: nn.Module


class Calls(NamedTuple):
    """What is timed, of one scenario: the mean cost, and its gradient by the policy's weights, flat in their order."""

    forward: Callable[[], float]
    gradient: Callable[[], Tensor]


Contender = Callable[[Scenario], Calls]


class Row(NamedTuple):
    """The times of one contender at one size.

    Args:
        plant: name of the plant.
        steps: number of control intervals.
        realisations: number of trajectories.
        contender: name of the engine.
        forward: median time of the cost [s].
        gradient: median time of its gradient [s].
        ratio: time of the gradient over that of the first contender.
        first: wall time of the first gradient of this size [s], which may compile.
        gap: relative difference of the gradient from that of the first contender.
    """

    plant: str
    steps: int
    realisations: int
    contender: str
    forward: float
    gradient: float
    ratio: float
    first: float
    gap: float


def plant_of(name: PlantName, steps: int | None = None) -> Plant:
    """A plant, with episodes of this many control intervals or of its own number."""
    kind = shipped_plants()[name]
    options: dict[str, float] = {"dt": STEPS_OF[name]} if name in STEPS_OF else {}
    return kind(**options) if steps is None else kind(**options, horizon=steps * kind(**options).dt)


def system_of(name: PlantName, policy: Policy) -> System:
    """The plant of a name with its closure and a policy."""
    plant, generator = plant_of(name), torch.Generator().manual_seed(0)
    closure = plant.make_closure(generator).requires_grad_(False)
    if policy == "affine":
        return System(plant, closure, plant.make_policy(generator))
    made = SaturatedMLP(len(plant.observations), plant.actions, hidden=HIDDEN, generator=generator)
    return System(plant, closure, made)


def engine_of(engine: Engine, system: System) -> Contender:
    """An engine of the library, called as a planner calls it."""
    rollout, weights = Rollout(*system, engine=engine), list(system.policy.parameters())

    def calls(scenario: Scenario) -> Calls:
        @torch.no_grad()
        def forward() -> float:
            return rollout.costs(*scenario).mean().item()

        def gradient() -> Tensor:
            parts = torch.autograd.grad(rollout.costs(*scenario).mean(), weights)
            return torch.cat([part.flatten() for part in parts])

        return Calls(forward, gradient)

    return calls


def rows_of(config: Config, name: PlantName, peers: Mapping[str, Callable[[System], Contender]]) -> list[Row]:
    """The times of all contenders on one plant, the smaller sizes first."""
    system, rows = system_of(name, config.policy), list[Row]()
    contenders = {
        engine: engine_of(engine, system) for engine in config.engines if refusal(engine, system.plant) is None
    }
    contenders |= {peer: make(system) for peer, make in peers.items()}
    for steps, batch in sorted(
        itertools.product(config.horizons, config.realisations), key=lambda pair: pair[0] * pair[1]
    ):
        plant, generator = plant_of(name, steps), torch.Generator().manual_seed(1)
        scenario = Scenario(plant.draw_initial_state(batch, generator), plant.draw_exogenous(batch, generator))
        calls = {
            contender: made(scenario)
            for contender, made in contenders.items()
            if predicted(rows, contender, steps, batch) <= config.limit
        }
        _tell(f"{name}, {steps} intervals, {batch} realisations: {', '.join(calls)}")
        gradients, first = dict[str, Tensor](), dict[str, float]()
        for contender, call in calls.items():
            start = time.perf_counter()
            gradients[contender] = call.gradient()
            first[contender] = time.perf_counter() - start
        forward, gradient = (
            medians({who: getattr(call, quantity) for who, call in calls.items()}, config) for quantity in QUANTITIES
        )
        best = next(iter(calls), "")
        rows += [
            Row(
                name,
                steps,
                batch,
                who,
                forward[who],
                gradient[who],
                gradient[who] / gradient[best],
                first[who],
                ((gradients[who] - gradients[best]).norm() / gradients[best].norm()).item(),
            )
            for who in calls
        ]
    return rows


def predicted(rows: Sequence[Row], contender: str, steps: int, realisations: int) -> float:
    """Time of a gradient [s] that smaller sizes predict, in proportion to the steps and to more realisations."""
    return min(
        (
            row.gradient * steps / row.steps * max(1.0, realisations / row.realisations)
            for row in rows
            if row.contender == contender
        ),
        default=0.0,
    )


def medians(functions: Mapping[str, Callable[[], Any]], config: Config) -> dict[str, float]:
    """Median time of one call of each function [s]; in each turn every function has its calls, one after another."""
    clock = time.process_time if config.threads == 1 else time.perf_counter
    seconds, counts = {name: list[float]() for name in functions}, dict[str, int]()
    for _ in range(config.repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            count = counts.setdefault(name, max(1, round(TURN / (time.perf_counter() - start))))
            start = clock()
            for _ in range(count):
                function()
            seconds[name].append((clock() - start) / count)
    return {name: statistics.median(values) for name, values in seconds.items()}


def table(rows: Sequence[Row], config: Config) -> str:
    """The times as text; a size and engine that are not in it would have taken longer than the limit."""
    clock = "CPU" if config.threads == 1 else "wall"
    head = f"{'plant':<15}{'intervals':>9}{'N_z':>6}  {'engine':<15}{clock + ' ms':>11}{'gradient':>10}"
    lines = [f"{head}{'ratio':>9}{'first s':>9}{'gap':>9}"]
    for row in rows:
        size = f"{row.plant:<15}{row.steps:>9}{row.realisations:>6}  {row.contender:<15}"
        times = f"{1e3 * row.forward:>11.3f}{1e3 * row.gradient:>10.3f}{row.ratio:>9.1f}{row.first:>9.2f}"
        lines.append(f"{size}{times}{row.gap:>9.1e}")
    return "\n".join(lines)


def save(rows: Sequence[Row], config: Config, folder: Path) -> None:
    """Write ``benchmark.json``, and a figure of each plant: times over the horizons at the first N_z."""
    from rt_torchrl.figures.style import caption, legend_below, panels  # here, because --help need not wait for it

    content = {"command": sys.argv, "threads": config.threads, "rows": [row._asdict() for row in rows]}
    write_json(folder / "benchmark.json", content)
    clock, batch = "CPU" if config.threads == 1 else "wall", config.realisations[0]
    for plant in config.plants:
        title = f"{plant}, {config.policy} policy, threads: {config.threads}\n{clock} time [s]"
        figure, axes = panels(1, 2, title=title, size=(10.5, 4.0), sharey="row")
        for ax, quantity in zip(axes[0], QUANTITIES, strict=True):
            drawn = [row for row in rows if (row.plant, row.realisations) == (plant, batch)]
            for k, who in enumerate(dict.fromkeys(row.contender for row in drawn)):
                x, y = zip(*((r.steps, getattr(r, quantity)) for r in drawn if r.contender == who), strict=True)
                look = {"color": COLOURS.get(who, f"C{k}"), "marker": "osv^D*P"[k % 7], "markersize": 5}
                ax.plot(x, y, label=who.replace("_", " "), **look)
            ax.set(xscale="log", yscale="log", xlabel="control intervals")
            caption(ax, quantity, f"{batch} realisations")
        legend_below(figure, list(axes.flat))
        figure.savefig(folder / f"{plant}.png")


def _tell(doing: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\033[K{doing}", end="", file=sys.stderr, flush=True)


def main(config: Config, peers: Mapping[str, Callable[[System], Contender]] | None = None) -> list[Row]:
    """Time the engines, and others beside them.

    Args:
        config: the options.
        peers: others that compute the same, by name; each is a function of the system that gives a contender.

    Returns:
        The rows of the table that is printed.
    """
    config = config.effective()
    if config.output is not None:
        make_folder("output", config.output)
    torch.set_num_threads(config.threads)
    rows = [row for name in config.plants for row in rows_of(config, name, peers or {})]
    _tell("")
    print(table(rows, config))
    if config.output is not None:
        save(rows, config, config.output)
    return rows


if __name__ == "__main__":
    main_of(Config, main)
