"""How far from the best possible is this? The clairvoyant optimum of a plant, and controllers beside it."""

import dataclasses
from collections.abc import Iterator
from dataclasses import field
from pathlib import Path
from typing import Annotated, Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import torch
import tyro
from pydantic import Field

from rt_torchrl import (
    LimitConfig,
    LoadedRun,
    Plant,
    RunConfig,
    configuration,
    load_run,
    main_of,
)
from rt_torchrl.atomic_file import make_folder, write_results
from rt_torchrl.control.command_cost import BoundedDescentConfig
from rt_torchrl.evaluation.limits import (
    Contender,
    fitting,
    flown_starts,
    forecasts,
    general_starts,
    judged,
    limit,
    receding,
)
from rt_torchrl.evaluation.unseen import UNSEEN_SEED, UnseenEpisodes
from rt_torchrl.options import Count, NotNegative
from rt_torchrl.runs.command_line import load_recipe
from rt_torchrl.runs.run_config import plant_of

TO_THE_END = BoundedDescentConfig(iterations=8000, tolerance=1e-15, gradient=1e-12)
"""Descents until nothing more is gained; each of the turbine's takes five to eight thousand gradients."""


@configuration
class Config:
    """Compute the limit of a plant's cost, and compare classical controllers and model predictive control with it.

    Args:
        plant: plant whose limit is computed, with the paper's cost.
        episodes: number of episodes, at least 2.
        seed: seed of the episodes; by default that of the unseen episodes of the trainings.
        horizon: length of an episode [s]; by default the plant's. A run has its own.
        hold: number of control intervals for which a command of the optimum is held; 0 for the plant's own.
        starts: all, or classical to leave out constant and random commands; the policies of a run are always
            among them.
        mpc: forecasts of model predictive control: some of held, decaying, scattered and preview; the tank has none
            while it commands the drop.
        mpc_horizon: length of the window of model predictive control [s]; 0 for the recipe's.
        run: folder of a training. Its plant takes the place of plant, with its cost, command and limits; its policies
            are judged beside the controllers, and model predictive control plans on its closure, too.
        folder: folder of the results, which are in PLANT.json.
        descent: parameters of the descents to the optimum.
    """

    plant: Literal["wind_turbine", "flapping_wing", "cryogenic_tank"] | None = None
    episodes: Annotated[int, Field(ge=2)] = 8
    seed: Count = UNSEEN_SEED
    horizon: float | None = None
    hold: Count = 0
    starts: Literal["all", "classical"] = "all"
    mpc: tuple[Literal["held", "decaying", "scattered", "preview"], ...] = ("held", "decaying", "scattered", "preview")
    mpc_horizon: NotNegative = 0.0
    run: Path | None = None
    folder: Annotated[Path, tyro.conf.arg(name="log-dir", aliases=("--folder",))] = Path("runs/limit")
    descent: BoundedDescentConfig = field(default_factory=lambda: TO_THE_END)

    def __post_init__(self):
        if self.run is not None and (self.plant is not None or self.horizon is not None):
            raise ValueError("run has a plant and a horizon of its own; leave out plant and horizon, or run.")


def main(config: Config) -> None:
    torch.set_num_threads(1)
    make_folder("folder", config.folder)
    run = None if config.run is None else load_run(config.run)
    options = settings(config) if run is None else run.config
    plant = plant_of(options) if run is None else run.plant
    known, path, found = options.limit(), config.folder / f"{plant.name}.json", {}
    if known is None:
        raise ValueError(f"{type(options).__qualname__} has no limit; override RunConfig.limit() in the recipe.")
    print(f"seeking the clairvoyant optimum of {config.episodes} episodes", flush=True)
    for name, contender in contenders(config, plant, known, run):
        if not found:
            print(header(contender), flush=True)
        found[name] = contender
        print(row(name, contender, found["clairvoyant"]), flush=True)
        write_results(path, {"config": config, "contenders": found})
    print(evidence_of(found["clairvoyant"]))
    print(f"results in {path}")


def settings(config: Config) -> RunConfig:
    """The options of a training as in the paper; that of the turbine if no plant is named."""
    recipe = load_recipe(Path(__file__).with_name(f"{config.plant or 'wind_turbine'}.py"))
    horizon = {} if config.horizon is None else {"horizon": config.horizon}
    return dataclasses.replace(recipe.Config(preset="paper").defaults(), **horizon)


def contenders(
    config: Config, plant: Plant, known: LimitConfig, run: LoadedRun | None
) -> Iterator[tuple[str, Contender]]:
    """The clairvoyant optimum and all controllers, as they are found."""
    episodes = UnseenEpisodes(plant, config.episodes, seed=config.seed)
    if run is not None:
        episodes.physics, episodes.closure = run.physics, run.true_closure()
    policies = {} if run is None else {role.replace("_", "-"): policy for role, policy in run.policies.items()}
    starts = flown_starts(episodes, known) | {role: episodes.fly(policy).actions for role, policy in policies.items()}
    chosen = starts | general_starts(episodes, seed=config.seed) if config.starts == "all" else starts
    yield "clairvoyant", limit(episodes, chosen, hold=config.hold or known.hold, config=config.descent)
    flying = {name: kind(episodes.physics) for name, kind in known.starts.items()} | policies
    for name, policy in flying.items():
        yield name, judged(episodes, episodes.fly(policy))
    if known.window is None:
        return
    asked = {"horizon": config.mpc_horizon} if config.mpc_horizon else {}
    window = fitting(dataclasses.replace(known.window, **asked), plant)
    foreseen = forecasts(plant, episodes.exogenous, window)
    models = {"exact": (plant, episodes.known_closure())}
    models |= {} if run is None else {"fitted": (run.physics, run.closure)}
    for title, model in models.items():
        for name in config.mpc:
            yield f"MPC, {title}, {name}", receding(episodes, *model, window, foreseen[name])


def header(best: Contender) -> str:
    """The names of the columns, for the terminal; times are those of a solve of model predictive control."""
    times = f"{'ms, median':>12}{'ms, max':>12}"
    return f"{'':<24}{'J_a':>12}{'over limit':>12}{times}" + "".join(f"  {merit}" for merit in best.merit)


def row(name: str, contender: Contender, best: Contender) -> str:
    """Cost, its ratio to the limit, times and merits, for the terminal."""
    times = contender.details.get("milliseconds", {})
    shown = "".join(f"{times[key]:>12.3g}" if key in times else f"{'-':>12}" for key in ("median", "max"))
    numbers = "".join(f"  {value:>{len(merit)}.4g}" for merit, value in contender.merit.items())
    return f"{name:<24}{contender.mean:>12.6g}{contender.mean / best.mean:>12.4f}{shown}{numbers}"


def evidence_of(best: Contender) -> str:
    """What says that the clairvoyant optimum is one, for the terminal."""
    starts = [f"{name} {share:.1e}" for name, share in best.details["above_the_best"].items()]
    gradient = best.details["projected_gradient"]
    return f"clairvoyant optimum: projected gradient {gradient:.2g}\nstarts above it: {', '.join(starts)}"


if __name__ == "__main__":
    main_of(Config, main)
