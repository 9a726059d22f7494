"""What a recipe's main calls: the algorithm with progress, dashboard, checkpoints and results around it."""

import copy
import functools
import json
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from rt_torchrl import figures
from rt_torchrl.contract.check import check_plant
from rt_torchrl.evaluation.gradient_check import engine_gap
from rt_torchrl.evaluation.real_episodes import Baseline, RealController, RealEpisodes
from rt_torchrl.evaluation.unseen import Judged, UnseenEpisodes, exact_optimum, untrained_costs
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.plants.closures import named_weights
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs import checkpoint, results
from rt_torchrl.runs.command_line import from_command_line
from rt_torchrl.runs.dashboard import Dashboard
from rt_torchrl.runs.results_table import progress, results_table
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.runs.settings import settings_of
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.trajectories.engines.compilation import missing_for_compilation
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.algorithm import ReinforcementTwinning
from rt_torchrl.twinning.referees import Role

CHECKED_STEPS = 10
"""Control intervals that a plant is checked on before a run; ``check_plant`` alone looks at more."""
PlantFigures = Callable[[Snapshot], dict[str, Figure]]


class Run:
    """One training with everything around it.

    Args:
        config: see :class:`RunConfig`.
        plant: the real system in simulation, and the twin's physics.
        env: the real system, where it is not a plant in simulation. It is judged on ``plant`` under ``env.closure``;
            where that is not known, on real episodes: four times ``unseen`` of them (both policies before and after),
            and one for each of the random starts, ``untrained``.
        believed: the twin's physics where they are not those of the real system; None where they are.
        plant_figures: figures only this plant has.
        baselines: controllers to judge beside the policies, by name: classical ones, or with an ``env`` of unknown
            closure a :class:`RealController`.
        animate: writes an animation of the last real episode to a path, ``figures/animation.gif``.

    Raises:
        PlantContractError: before any work, if a plant breaks its contract; what takes seconds to find, ``check_plant``
            finds.
        ValueError: before any work, if the device does not exist, the run folder cannot be written or is taken, the
            checkpoint to resume from does not fit, or options need a plant in simulation and there is an ``env``.
    """

    def __init__(
        self,
        config: RunConfig,
        plant: Plant,
        *,
        env: RealSystem | None = None,
        believed: Plant | None = None,
        plant_figures: PlantFigures = lambda snapshot: {},
        baselines: dict[str, type[Baseline]] | None = None,
        animate: Callable[[Snapshot, Path], None] | None = None,
    ):
        self.started = time.perf_counter()
        self.asked, self.config = config, config.effective()
        self.plant_figures, self.animate = plant_figures, animate
        device = require_device(config.device)
        compiled = can_compile(device) if config.compiled is None else config.compiled
        require_simulation(config, plant, env, baselines)
        for physics in filter(None, (plant, believed)):
            check_plant(physics, steps=CHECKED_STEPS, traced=False)
        if config.threads:
            torch.set_num_threads(config.threads)
        logging.getLogger("torchrl").setLevel(logging.WARNING)
        self.folder = require_folder(config, plant.name)
        generator = torch.Generator(device=device).manual_seed(config.seed)
        self.make_policy = functools.partial(config.make_policy, plant)
        policies = {role: policy.to(device) for role, policy in config.make_policies(plant, generator).items()}
        closure = config.make_closure(plant, generator).to(device)
        self.initial_policies, self.initial_closure = copy.deepcopy(policies), copy.deepcopy(closure)
        self.algorithm = ReinforcementTwinning(
            simulated(plant, config, device=device, compiled=compiled) if env is None else env,
            DigitalTwin(believed or plant, closure, engine=config.engine, compiled=compiled),
            **policies,
            config=self.config.twinning,
            generator=generator,
        )
        self.unseen = judged_on(plant, env, self.config.unseen, device=device, compiled=compiled)
        self.baselines = {name: law(plant, compiled=compiled).to(device) for name, law in (baselines or {}).items()}
        self.episodes: list[dict[str, Any]] = []
        if config.resume:
            self.episodes = checkpoint.load(self.folder / "checkpoint.pt", self.algorithm)

    def train(self) -> dict[str, Any]:
        """Train, evaluate and write the results; Ctrl-C ends the training after the episodes done so far.

        Returns:
            The content of ``metrics.json``.
        """
        settings = settings_of(self.asked, self.algorithm.twin.plant.name)
        (self.folder / "config.json").write_text(json.dumps(settings, indent=2, default=str) + "\n")
        dashboard = Dashboard(self.folder)
        gap = engine_gap(self.initial_closure, self.initial_policies["model_based"], self.unseen)
        dashboard.scalar("gradient/relative gap of parallel to the reference engine, short horizon", gap)
        with tqdm(total=self.config.episodes, initial=len(self.episodes), unit="episode", dynamic_ncols=True) as bar:
            try:
                while len(self.episodes) < self.config.episodes:
                    self._episode(dashboard)
                    bar.set_postfix_str(progress(self.episodes[-1]))
                    bar.update()
            except KeyboardInterrupt:
                bar.write(f"interrupted: going on with the {len(self.episodes)} episodes done (again to leave at once)")
        if not self.episodes:
            raise SystemExit("interrupted before the first episode was done; nothing to report.")
        self._drop_half_an_episode()
        self._follow_wear()
        flights = {role: self.unseen.fly(self.algorithm.policies[role]) for role in results.ROLES}
        judged = results.judge(self.unseen, flights, self.baselines)
        metrics = self._results(gap, flights, judged)
        if self.config.figures:
            self._draw(dashboard, judged)
        dashboard.close()
        print(results_table(metrics))
        print(f"results in {self.folder}; look at them with: tensorboard --logdir {self.folder}")
        return metrics

    def _episode(self, dashboard: Dashboard) -> None:
        live = self.algorithm.referee.live
        record = results.episode_record(self.algorithm.episode(), episode=len(self.episodes), live=live)
        record["closure"] = named_weights(self.algorithm.twin.closure)
        every = self.config.unseen_every
        if every and (len(self.episodes) + 1) % every == 0:
            self._follow_wear()
            acting = self.algorithm.policies[self.algorithm.referee.live]
            record["J_a_unseen"] = self.unseen.control_costs(acting).mean().item()
        self.episodes.append(record)
        checkpoint.save(self.folder / "checkpoint.pt", self.algorithm, self.episodes)
        dashboard.episode(record)
        every = self.config.figures_every if self.config.figures else 0
        if every and len(self.episodes) % every == 0 and len(self.episodes) < self.config.episodes:
            dashboard.figures(self._figures(self._snapshot()), len(self.episodes) - 1)

    def _follow_wear(self) -> None:
        """Judge on the real system as it is now; one of unknown closure is judged itself."""
        if self.algorithm.env.closure is not None:
            self.unseen.closure = self.algorithm.env.closure

    def _drop_half_an_episode(self) -> None:
        """After an interrupt, go back to the end of the last whole episode."""
        if self.algorithm.episodes_done != len(self.episodes) or len(self.episodes) < self.config.episodes:
            self.episodes = checkpoint.load(self.folder / "checkpoint.pt", self.algorithm)

    def _results(self, gap: float, flights: dict[Role, Trajectory], judged: dict[str, Judged]) -> dict[str, Any]:
        optimum = exact_optimum(self.unseen, self.make_policy) if self.config.reference else None
        starts = self.config.untrained
        untrained = untrained_costs(self.unseen, self.make_policy, starts=starts) if starts else None
        initial = self.initial_policies, self.initial_closure
        found = self.episodes, untrained, optimum
        summary = results.summarise(self.algorithm, self.unseen, flights, judged, *initial, *found)
        summary["engine_gap"] = gap
        summary["seconds"]["total"] = time.perf_counter() - self.started
        metrics = {"plant": self.algorithm.twin.plant.name, "episodes": self.episodes, "summary": summary}
        (self.folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
        weights = {role: policy.state_dict() for role, policy in self.algorithm.policies.items()}
        torch.save(weights | {"closure": self.algorithm.twin.closure.state_dict()}, self.folder / "weights.pt")
        return metrics

    def _snapshot(self) -> Snapshot:
        return Snapshot.take(self.algorithm, self.initial_closure, self.episodes)

    def _figures(self, snapshot: Snapshot) -> dict[str, Figure]:
        return figures.figures_of(snapshot) | self.plant_figures(snapshot)

    def _draw(self, dashboard: Dashboard, judged: dict[str, Judged]) -> None:
        snapshot = self._snapshot()
        drawn = self._figures(snapshot) | {"unseen": figures.unseen(judged, self.unseen.categories())}
        (self.folder / "figures").mkdir(exist_ok=True)
        for name, figure in drawn.items():
            figure.savefig(self.folder / "figures" / f"{name}.png", dpi=120)
        dashboard.figures(drawn, len(self.episodes) - 1)
        if self.animate:
            self.animate(snapshot, self.folder / "figures" / "animation.gif")


def main_of(config_class: type, main: Callable[[Any], None]) -> None:
    """Run a recipe's main on its command line; what the user can mend is told in one line, without a traceback."""
    try:
        main(from_command_line(config_class))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error


def can_compile(device: torch.device) -> bool:
    """Whether this machine has what torch.compile needs; if not, says on the terminal what is missing."""
    missing = missing_for_compilation() if device.type == "cpu" else None
    if missing:
        print(f"This machine lacks {missing}: running without torch.compile, several times slower.")
    return missing is None


def simulated(plant: Plant, config: RunConfig, *, device: torch.device, compiled: bool) -> PlantEnv:
    """The real system in simulation, with the sensors and the wear of the configuration."""
    system = {"noise": config.noise, "wear": config.wear(plant)}
    return PlantEnv(plant, seed=config.seed, device=device, compiled=compiled, **system)


def judged_on(
    plant: Plant, env: RealSystem | None, count: int, *, device: torch.device, compiled: bool
) -> UnseenEpisodes:
    """The unseen episodes: on the plant, or on a real system of which no closure is known."""
    if env is None or env.closure is not None:
        return UnseenEpisodes(plant, count, compiled=compiled, device=device)
    return RealEpisodes(env, count, device=device)


def require_simulation(
    config: RunConfig, plant: Plant, env: RealSystem | None, baselines: dict[str, type[Baseline]] | None
) -> None:
    """Refuse with a real system what only a plant in simulation can do.

    Raises:
        ValueError: naming the option.
    """
    if env is None:
        return
    if config.noise or config.wear(plant) is not None:
        raise ValueError(f"noise={config.noise} and wear are of a plant in simulation; this run has a real system.")
    on_the_plant = [name for name, law in (baselines or {}).items() if not issubclass(law, RealController)]
    if env.closure is None and (config.reference or on_the_plant):
        raise ValueError(
            f"reference={config.reference} and baselines {on_the_plant} are flown on the plant under the true closure, "
            "and the real system's is not known; leave them out, or give the RealSystem its closure."
        )


def require_device(name: str) -> torch.device:
    """The device of that name.

    Raises:
        ValueError: if there is no such device on this machine.
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device={name!r} cannot be used on this machine ({error}); use cpu.") from error
    return device


def require_folder(config: RunConfig, plant: str) -> Path:
    """The run folder, created and proved writable.

    Raises:
        ValueError: if it cannot be written, or holds another run and neither resume nor overwrite is asked for.
    """
    stamp = time.strftime("%Y%m%d-%H%M%S")
    folder = config.log_dir or Path("runs") / plant / f"{stamp}-seed-{config.seed}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"log_dir={folder} cannot be written ({error}); choose another with --log-dir.") from error
    if (folder / "config.json").exists() and not (config.resume or config.overwrite):
        raise ValueError(
            f"log_dir={folder} holds a run already; choose another folder, or --resume it, or --overwrite it."
        )
    if config.overwrite:
        for old in (*folder.glob("events.out.tfevents.*"), folder / "checkpoint.pt"):
            old.unlink(missing_ok=True)
    return folder
