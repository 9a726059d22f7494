"""How far from the best possible is this? The clairvoyant optimum of a plant, and controllers beside it."""

import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

if __name__ == "__main__":
    print("loading PyTorch and TorchRL", file=sys.stderr)  # at once, because this takes seconds

import torch

from rt_torchrl import ClassicalController, RecedingHorizonConfig, check_options, load_run, main_of
from rt_torchrl.envs.cryogenic_tank.valves import OnOffValve, PIValve
from rt_torchrl.envs.flapping_wing.pd import TrimmedPD
from rt_torchrl.envs.wind_turbine.jonkman import JonkmanController
from rt_torchrl.evaluation.unseen import UNSEEN_SEED, UnseenEpisodes
from rt_torchrl.optimal_control.bounded_descent import BoundedDescentConfig
from rt_torchrl.runs.results_file import make_folder, write_results
from rt_torchrl.runs.shipped_plants import plant_class
from rt_torchrl.study.limits import Contender, classical, forecasts, general_starts, limit, receding, resting_at_the_end

CONTROLLERS: dict[str, dict[str, type[ClassicalController]]] = {
    "wind_turbine": {"Jonkman": JonkmanController},
    "flapping_wing": {"PD": TrimmedPD},
    "cryogenic_tank": {"on-off": OnOffValve, "PI": PIValve},
}


class NarrowBand(OnOffValve):
    """An on-off valve whose band is too narrow for a real one; a mixture of shut and open is close to the optimum."""

    half_band = 200.0


HORIZONS = {
    "wind_turbine": RecedingHorizonConfig(horizon=20.0),
    "flapping_wing": RecedingHorizonConfig(horizon=1.0, hold=5e-3, iterations=30, tolerance=1e-5),
}
"""Windows of model predictive control; the tank has none, because every pattern of its valve is near a minimum."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Compute the limit of a plant's cost, and compare classical controllers and model predictive control with it.

    Args:
        plant: plant whose limit is computed.
        episodes: number of episodes, at least 2.
        seed: seed of the episodes; by default that of the unseen episodes of the trainings.
        horizon: length of an episode [s]; by default the plant's.
        hold: number of control intervals for which a command of the optimum is held.
        starts: all, or classical to leave out constant and random commands.
        mpc: forecasts of model predictive control: some of held, decaying and preview; the tank has none.
        run: folder of a training; model predictive control then also plans on the closure that it has found.
        folder: folder of the results, which are in PLANT.json.
        descent: parameters of the descents to the optimum.
    """

    plant: Literal["wind_turbine", "flapping_wing", "cryogenic_tank"] = "wind_turbine"
    episodes: int = 8
    seed: int = UNSEEN_SEED
    horizon: float | None = None
    hold: int = 1
    starts: Literal["all", "classical"] = "all"
    mpc: tuple[Literal["held", "decaying", "preview"], ...] = ("held", "decaying", "preview")
    run: Path | None = None
    folder: Path = Path("runs/limit")
    descent: BoundedDescentConfig = field(
        default_factory=lambda: BoundedDescentConfig(iterations=3000, tolerance=1e-11)
    )

    def __post_init__(self):
        check_options(self)
        for argument, least in (("episodes", 2), ("seed", 0), ("hold", 1)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least {least}.")


def main(config: Config) -> None:
    torch.set_num_threads(1)
    make_folder("folder", config.folder)
    found = contenders(config)
    path = write_results(config.folder / f"{config.plant}.json", {"config": config, "contenders": found})
    print(table(found))
    print(f"results in {path}")


def contenders(config: Config) -> dict[str, Contender]:
    """The clairvoyant optimum and all controllers, by name."""
    kind = plant_class(config.plant)
    plant = kind() if config.horizon is None else kind(horizon=config.horizon)
    episodes, controllers = UnseenEpisodes(plant, config.episodes, seed=config.seed), CONTROLLERS[config.plant]
    starts = {name: episodes.fly_baseline(controller(plant)).actions for name, controller in controllers.items()}
    if config.plant == "cryogenic_tank":
        mixture = episodes.fly_baseline(NarrowBand(plant)).actions
        starts["narrow on-off, shut at the end"] = resting_at_the_end(episodes, mixture)
    chosen = starts | general_starts(episodes, seed=config.seed) if config.starts == "all" else starts
    found = {"clairvoyant": limit(episodes, chosen, hold=config.hold, config=config.descent)}
    found |= {name: classical(episodes, controller) for name, controller in controllers.items()}
    if config.plant not in HORIZONS:
        return found
    horizon = HORIZONS[config.plant]
    horizon = dataclasses.replace(horizon, horizon=min(horizon.horizon, plant.horizon))
    closures = {"exact": None} | ({} if config.run is None else {"fitted": load_run(config.run).closure})
    known = forecasts(plant, episodes.exogenous, horizon.horizon)
    for model, closure in closures.items():
        for name in config.mpc:
            found[f"MPC, {model}, {name}"] = receding(episodes, horizon, known[name], closure)
    return found


def table(found: dict[str, Contender]) -> str:
    """Costs, their ratios to the limit, merits and times, for the terminal."""
    best, merits = found["clairvoyant"], list(found["clairvoyant"].merit)
    lines = [
        f"{'':<24}{'J_a':>12}{'over limit':>12}{'ms, median':>12}{'ms, max':>12}" + "".join(f"  {m}" for m in merits)
    ]
    for name, contender in found.items():
        times = contender.milliseconds or {}
        shown = [f"{times[key]:>12.3g}" if key in times else f"{'-':>12}" for key in ("median", "max")]
        numbers = "".join(f"  {contender.merit[m]:>{len(m)}.4g}" for m in merits)
        lines.append(f"{name:<24}{contender.mean:>12.6g}{contender.mean / best.mean:>12.4f}{''.join(shown)}{numbers}")
    lines.append("clairvoyant optimum: projected gradient {projected_gradient:.2g}".format(**best.details))
    starts = best.details["above_the_best"].items()
    lines.append("starts above it: " + ", ".join(f"{name} {share:.1e}" for name, share in starts))
    return "\n".join(lines)


if __name__ == "__main__":
    main_of(Config, main)
