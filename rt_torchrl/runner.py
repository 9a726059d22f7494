"""What a recipe's main calls: the algorithm with progress, dashboard, checkpoints and results around it."""

import copy
import dataclasses
import functools
import json
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import tyro
from matplotlib.figure import Figure
from torch import nn
from tqdm import tqdm

from rt_torchrl import checkpoint, figures, report
from rt_torchrl.algorithm import ReinforcementTwinning, TwinningConfig
from rt_torchrl.classical import ClassicalController
from rt_torchrl.compilation import missing_for_compilation
from rt_torchrl.dashboard import Dashboard
from rt_torchrl.environment import PlantEnv
from rt_torchrl.evaluation import Judged, UnseenEpisodes, exact_optimum
from rt_torchrl.gradient_check import engine_gap
from rt_torchrl.plant import Plant
from rt_torchrl.policies import SaturatedMLP
from rt_torchrl.snapshot import Snapshot
from rt_torchrl.trajectory import Engine
from rt_torchrl.twin import DigitalTwin

QUICK_EPISODES, QUICK_ITERATIONS, QUICK_UNSEEN = 3, 200, 5


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Options every recipe has.

    Args:
        policy: paper for the plant's own, or mlp.
        hidden: widths of the hidden layers of an mlp policy.
        episodes: number of real episodes n_e.
        seed: of weights, disturbances, exploration and sampling; the same seed gives the same run.
        engine: gradient engine of steps 4 and 5: parallel (exact, fast), odeint_adjoint (the paper's continuous
            adjoint, slow) or autograd (exact, slow).
        compiled: compile with torch.compile; by default where this machine has what that needs, otherwise a notice
            says so. Without it nothing has to be compiled first, and every step is several times slower.
        device: where everything runs, such as cpu or cuda.
        threads: number of CPU threads; 0 leaves torch's default.
        log_dir: run folder; by default runs/PLANT/TIME-seed-SEED.
        resume: go on from the checkpoint in log_dir.
        overwrite: replace what an earlier run left in log_dir.
        quick: a whole small run: 3 episodes, 200 critic and actor iterations, 5 unseen episodes.
        unseen: number of unseen episodes that twin and policies are judged on at the end.
        reference: also compute what exact gradients on the true plant reach for this policy on the unseen episodes.
        figures_every: draw the figures into the dashboard every so many episodes, and at the end; 0 only at the end.
        twinning: hyper-parameters of the six steps.
    """

    policy: str = "paper"
    hidden: tuple[int, ...] = (32, 32)
    episodes: int = 20
    seed: int = 0
    engine: Engine = "parallel"
    compiled: bool | None = None
    device: str = "cpu"
    threads: int = 0
    log_dir: Path | None = None
    resume: bool = False
    overwrite: bool = False
    quick: bool = False
    unseen: int = 20
    reference: bool = False
    figures_every: int = 5
    twinning: TwinningConfig = field(default_factory=TwinningConfig)

    def __post_init__(self):
        for argument, least in (("episodes", 1), ("threads", 0), ("unseen", 2), ("figures_every", 0)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least {least}.")
        if self.resume and self.log_dir is None:
            raise ValueError("resume needs log_dir, the folder of the run to go on with.")

    def make_policy(self, plant: Plant, generator: torch.Generator) -> nn.Module:
        """The policy asked for, with random initial weights; override it for policies of your own.

        Raises:
            ValueError: if there is no policy of that name.
        """
        if self.policy == "paper":
            return plant.make_policy(generator)
        if self.policy == "mlp":
            return SaturatedMLP(len(plant.observations), plant.actions, hidden=self.hidden, generator=generator)
        raise ValueError(f"policy={self.policy!r} does not exist; choose paper or mlp.")

    def effective(self) -> "RunConfig":
        """With ``quick`` carried out."""
        if not self.quick:
            return self
        model_free = dataclasses.replace(
            self.twinning.model_free, critic_iterations=QUICK_ITERATIONS, actor_iterations=QUICK_ITERATIONS
        )
        twinning = dataclasses.replace(self.twinning, model_free=model_free)
        return dataclasses.replace(
            self, quick=False, episodes=QUICK_EPISODES, unseen=QUICK_UNSEEN, figures_every=0, twinning=twinning
        )


PlantFigures = Callable[[Snapshot], dict[str, Figure]]


class Run:
    """One training with everything around it.

    Args:
        config: see :class:`RunConfig`.
        plant: the real system in simulation, and the twin's physics.
        plant_figures: figures only this plant has.
        baselines: classical controllers to judge beside the policies, by name.
        animate: writes an animation of the last real episode to a path, ``figures/animation.gif``.

    Raises:
        ValueError: before any work, if the device does not exist, the run folder cannot be written or is taken, or the
            checkpoint to resume from does not fit.
    """

    def __init__(
        self,
        config: RunConfig,
        plant: Plant,
        *,
        plant_figures: PlantFigures = lambda snapshot: {},
        baselines: dict[str, type[ClassicalController]] | None = None,
        animate: Callable[[Snapshot, Path], None] | None = None,
    ):
        self.started = time.perf_counter()
        self.asked, self.config = config, config.effective()
        self.plant_figures, self.animate = plant_figures, animate
        device = require_device(config.device)
        compiled = can_compile(device) if config.compiled is None else config.compiled
        if config.threads:
            torch.set_num_threads(config.threads)
        logging.getLogger("torchrl").setLevel(logging.WARNING)
        self.folder = require_folder(config, plant.name)
        generator = torch.Generator(device=device).manual_seed(config.seed)
        self.make_policy = functools.partial(config.make_policy, plant)
        model_based = self.make_policy(generator).to(device)
        closure = plant.make_closure(generator).to(device)
        self.initial_policy, self.initial_closure = copy.deepcopy(model_based), copy.deepcopy(closure)
        env = PlantEnv(plant, seed=config.seed, device=device, compiled=compiled)
        self.algorithm = ReinforcementTwinning(
            env,
            DigitalTwin(plant, closure, engine=config.engine, compiled=compiled),
            model_free=copy.deepcopy(model_based),
            model_based=model_based,
            config=self.config.twinning,
            generator=generator,
        )
        self.unseen = UnseenEpisodes(plant, self.config.unseen, compiled=compiled, device=device)
        self.baselines = {name: law(plant, compiled=compiled).to(device) for name, law in (baselines or {}).items()}
        self.episodes: list[dict[str, Any]] = []
        if config.resume:
            self.episodes = checkpoint.load(self.folder / "checkpoint.pt", self.algorithm)

    def train(self) -> dict[str, Any]:
        """Train, evaluate and write the results; Ctrl-C ends the training after the episodes done so far.

        Returns:
            The content of ``metrics.json``.
        """
        settings = dataclasses.asdict(self.asked) | {"plant": self.algorithm.twin.plant.name}
        (self.folder / "config.json").write_text(json.dumps(settings, indent=2, default=str) + "\n")
        dashboard = Dashboard(self.folder)
        gap = engine_gap(self.initial_closure, self.initial_policy, self.unseen)
        dashboard.scalar("gradient/relative gap of parallel to odeint_adjoint, short horizon", gap)
        with tqdm(total=self.config.episodes, initial=len(self.episodes), unit="episode", dynamic_ncols=True) as bar:
            try:
                while len(self.episodes) < self.config.episodes:
                    self._episode(dashboard)
                    bar.set_postfix_str(report.progress(self.episodes[-1]))
                    bar.update()
            except KeyboardInterrupt:
                bar.write(f"interrupted: going on with the {len(self.episodes)} episodes done (again to leave at once)")
        if not self.episodes:
            raise SystemExit("interrupted before the first episode was done; nothing to report.")
        self._drop_half_an_episode()
        judged = report.judge(self.unseen, self.algorithm.policies, self.baselines)
        metrics = self._results(gap, judged)
        self._draw(dashboard, judged)
        dashboard.close()
        print(report.table(metrics))
        print(f"results in {self.folder}; look at them with: tensorboard --logdir {self.folder}")
        return metrics

    def _episode(self, dashboard: Dashboard) -> None:
        live = self.algorithm.switch.live
        record = report.episode_record(self.algorithm.episode(), episode=len(self.episodes), live=live)
        record["closure"] = report.named_weights(self.algorithm.twin.closure)
        self.episodes.append(record)
        checkpoint.save(self.folder / "checkpoint.pt", self.algorithm, self.episodes)
        dashboard.episode(record)
        every = self.config.figures_every
        if every and len(self.episodes) % every == 0 and len(self.episodes) < self.config.episodes:
            dashboard.figures(self._figures(self._snapshot()), len(self.episodes) - 1)

    def _drop_half_an_episode(self) -> None:
        """After an interrupt, go back to the end of the last whole episode."""
        if self.algorithm.episodes_done != len(self.episodes) or len(self.episodes) < self.config.episodes:
            self.episodes = checkpoint.load(self.folder / "checkpoint.pt", self.algorithm)

    def _results(self, gap: float, judged: dict[str, Judged]) -> dict[str, Any]:
        optimum = exact_optimum(self.unseen, self.make_policy) if self.config.reference else None
        initial = self.initial_policy, self.initial_closure
        summary = report.summary(self.algorithm, self.unseen, judged, *initial, self.episodes, optimum)
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
        main(tyro.cli(config_class))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error


def can_compile(device: torch.device) -> bool:
    """Whether this machine has what torch.compile needs; if not, says on the terminal what is missing."""
    missing = missing_for_compilation() if device.type == "cpu" else None
    if missing:
        print(f"This machine lacks {missing}: running without torch.compile, several times slower.")
    return missing is None


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
