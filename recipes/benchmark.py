"""Time an episode's cost and its gradient by each engine; all take turns in one process."""

import itertools
import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import rt_torchrl as rt

rt.begin_loading(__name__)

import torch
from torch import Tensor, nn
from torch.utils.benchmark import Timer

from rt_torchrl.atomic_file import make_folder, write_json
from rt_torchrl.options import AtLeastOne, File, Positive
from rt_torchrl.trajectories.rollout import refusal

PlantName = Literal["flapping_wing", "wind_turbine", "cryogenic_tank"]
QUANTITIES = ("forward", "gradient")
TURN = 0.1
"""Least time [s] that the calls of a turn take together."""
COLOURS = {"native": "#D55E00", "parallel": "#0072B2", "odeint_adjoint": "#009E73", "autograd": "#222222"}


@rt.configuration
class Config:
    """Time J_a and its gradient by the policy's weights by the gradient engines.

    Args:
        plants: plants, with their own closures, and their own policies with random weights.
        horizons: numbers of control intervals.
        realisations: numbers of trajectories N_z; each is timed with each horizon.
        engines: gradient engines; ratios are over the first one. An engine that cannot roll a plant out is left out.
        threads: number of CPU threads. On one thread the times are CPU times, which other processes on the machine
            change least; on more threads they are wall times.
        repeats: number of turns behind a median, each of calls for a tenth of a second, at least one.
        limit: time of one call [s], predicted by smaller sizes, above which an engine is left out.
        output: folder for benchmark.json and a figure of each plant; by default nothing is written.
    """

    plants: tuple[PlantName, ...] = get_args(PlantName)
    horizons: tuple[AtLeastOne, ...] = (100, 1_000, 10_000)
    realisations: tuple[AtLeastOne, ...] = (5, 25)
    engines: tuple[rt.Engine, ...] = get_args(rt.Engine)
    threads: AtLeastOne = 1
    repeats: AtLeastOne = 5
    limit: Positive = 2.0
    output: File | None = None


class System(NamedTuple):
    """A plant with a closure and a policy of random weights; those of the closure are fixed, as when one plans."""

    plant: rt.Plant
    closure: nn.Module
    policy: nn.Module


class Calls(NamedTuple):
    """What is timed, of one scenario: the mean cost, and its gradient by the policy's weights, flat in their order."""

    forward: Callable[[], float]
    gradient: Callable[[], Tensor]


Contender = Callable[[rt.Scenario], Calls]


class Row(NamedTuple):
    """The median times [s] of one contender at one size.

    ``ratio`` is that of the gradient over the first contender's, and ``gap`` the relative difference of the gradient
    from that of the first contender.
    """

    plant: str
    steps: int
    realisations: int
    contender: str
    forward: float
    gradient: float
    ratio: float
    gap: float


def plant_of(name: PlantName, steps: int = 100) -> rt.Plant:
    """A plant, with episodes of this many control intervals."""
    kind = rt.shipped_plants()[name]
    return kind(horizon=steps * kind().dt)


def system_of(name: PlantName) -> System:
    """The plant of a name with its closure and a policy."""
    plant, generator = plant_of(name), torch.Generator().manual_seed(0)
    closure = plant.make_closure(generator).requires_grad_(False)
    return System(plant, closure, plant.make_policy(generator))


def engine_of(engine: rt.Engine, system: System) -> Contender:
    """An engine of the library, called as a planner calls it."""
    rollout, weights = rt.Rollout(*system, engine=engine), list(system.policy.parameters())

    def calls(scenario: rt.Scenario) -> Calls:
        @torch.no_grad()
        def forward() -> float:
            return rollout.costs(*scenario).mean().item()

        def gradient() -> Tensor:
            gradients = torch.autograd.grad(rollout.costs(*scenario).mean(), weights)
            return torch.cat([g.flatten() for g in gradients])

        return Calls(forward, gradient)

    return calls


def rows_of(config: Config, name: PlantName, peers: Mapping[str, Callable[[System], Contender]]) -> list[Row]:
    """The times of all contenders on one plant, the smaller sizes first; each is printed at once."""
    system, rows = system_of(name), list[Row]()
    engines = [engine for engine in config.engines if refusal(engine, system.plant) is None]
    contenders = {engine: engine_of(engine, system) for engine in engines}
    contenders |= {peer: make(system) for peer, make in peers.items()}
    for steps, batch in sorted(itertools.product(config.horizons, config.realisations), key=math.prod):
        plant, generator = plant_of(name, steps), torch.Generator().manual_seed(1)
        scenario = rt.Scenario(plant.draw_initial_state(batch, generator), plant.draw_exogenous(batch, generator))
        calls = {
            contender: make(scenario)
            for contender, make in contenders.items()
            if predicted(rows, contender, steps, batch) <= config.limit
        }
        gradients = {contender: call.gradient() for contender, call in calls.items()}
        forward, gradient = (
            medians({who: getattr(call, quantity) for who, call in calls.items()}, config) for quantity in QUANTITIES
        )
        for who in calls:
            best = next(iter(calls))
            ratio = gradient[who] / gradient[best]
            gap = ((gradients[who] - gradients[best]).norm() / gradients[best].norm()).item()
            rows.append(Row(name, steps, batch, who, forward[who], gradient[who], ratio, gap))
            print(line(rows[-1]), flush=True)
    return rows


def predicted(rows: Sequence[Row], contender: str, steps: int, realisations: int) -> float:
    """Time of a gradient [s] that smaller sizes predict, in proportion to the steps and to more realisations."""
    earlier = [row for row in rows if row.contender == contender]
    times = [r.gradient * steps / r.steps * max(1.0, realisations / r.realisations) for r in earlier]
    return min(times, default=0.0)


def medians(functions: Mapping[str, Callable[[], Any]], config: Config) -> dict[str, float]:
    """Median time of one call of each function [s]; in each turn every function has its calls, one after another."""
    clock = time.process_time if config.threads == 1 else time.perf_counter
    seconds = {name: list[float]() for name in functions}
    for _ in range(config.repeats):
        for name, function in functions.items():
            timer = Timer("function()", globals={"function": function}, timer=clock, num_threads=config.threads)
            seconds[name].append(timer.blocked_autorange(min_run_time=TURN).median)
    return {name: statistics.median(values) for name, values in seconds.items()}


def line(row: Row) -> str:
    """A line of the table."""
    size = f"{row.plant:<15}{row.steps:>9}{row.realisations:>6}  {row.contender:<15}"
    times = f"{1e3 * row.forward:>11.3f}{1e3 * row.gradient:>10.3f}{row.ratio:>9.1f}"
    return f"{size}{times}{row.gap:>9.1e}"


def save(rows: Sequence[Row], config: Config, folder: Path) -> None:
    """Write ``benchmark.json``, and a figure of each plant: times over the horizons at the first N_z."""
    from rt_torchrl.figures.style import caption, legend_below, panels  # here, because --help need not wait for it

    content = {"command": sys.argv, "threads": config.threads, "rows": [row._asdict() for row in rows]}
    write_json(folder / "benchmark.json", content)
    batch = config.realisations[0]
    for plant in config.plants:
        title = f"{plant}, threads: {config.threads}"
        figure, axes = panels(1, 2, title=title, size=(10.5, 4.0), sharey="row")
        for ax, quantity in zip(axes[0], QUANTITIES, strict=True):
            timed = [row for row in rows if (row.plant, row.realisations) == (plant, batch)]
            for k, name in enumerate(dict.fromkeys(row.contender for row in timed)):
                x, y = zip(*((r.steps, getattr(r, quantity)) for r in timed if r.contender == name), strict=True)
                ax.plot(x, y, "osv^D*P"[k % 7] + "-", color=COLOURS.get(name, f"C{k}"), label=name.replace("_", " "))
            ax.set(xscale="log", yscale="log", xlabel="control intervals")
            caption(ax, f"{quantity} [s]", f"{batch} realisations")
        legend_below(figure, list(axes.flat))
        figure.savefig(folder / f"{plant}.png")


def main(config: Config, peers: Mapping[str, Callable[[System], Contender]] | None = None) -> None:
    """Time the engines, and others beside them, and print the times.

    A size and engine that are not in the table would have taken longer than the limit.

    Args:
        config: the options.
        peers: others that compute the same, by name; each is a function of the system that gives a contender.
    """
    if config.output is not None:
        make_folder("output", config.output)
    torch.set_num_threads(config.threads)
    clock = "CPU" if config.threads == 1 else "wall"
    head = f"{'plant':<15}{'intervals':>9}{'N_z':>6}  {'engine':<15}{clock + ' ms':>11}{'gradient':>10}"
    print(f"{head}{'ratio':>9}{'gap':>9}", flush=True)
    rows = [row for name in config.plants for row in rows_of(config, name, peers or {})]
    if config.output is not None:
        save(rows, config, config.output)


if __name__ == "__main__":
    rt.main_of(Config, main)
