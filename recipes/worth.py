"""What twinning is worth: every arm, with each part off in turn, on systems that the twin knows and on others."""

import json
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import tyro

from rt_torchrl import check_options, main_of
from rt_torchrl.envs.unknown_systems import SYSTEMS, require_unknown
from rt_torchrl.runs.results_file import make_folder, write_results
from rt_torchrl.study.arms import SystemResult, classical_arms, trained_arm
from rt_torchrl.study.cases import CASES, UNSEEN, names, optimum, options_of
from rt_torchrl.study.results import yardstick_entry
from rt_torchrl.study.room import require_page, write_into
from rt_torchrl.study.scheduling import on_this_machine
from rt_torchrl.study.training import Training
from rt_torchrl.study.worth import WHOLE, findings_page
from rt_torchrl.study.yardstick import Yardstick
from rt_torchrl.study.yardsticks import Options

if TYPE_CHECKING:
    from rt_torchrl.study.task import Task

FEW = 8
"""Number of unseen episodes that model predictive control flies, which takes long."""

HYPOTHESES: Options = ("--twinning.hypotheses.which", "automatic")
ALONE: Options = ("--twinning.hypotheses.which", "none")
EVIDENCE: Options = ("--twinning.referee.rule", "expected_cost")
TREE: Options = ("--twinning.referee.rule", "decision_tree")
RANDOM: Options = ("--start", "random")
PARTS = {
    "without hypotheses": "hypotheses",
    "without the belief": "the belief about costs on the real system",
}
"""Name of each part, by the arm that lacks it."""


def arms_of(case: str) -> dict[str, Options]:
    """Options of every arm on a plant, by name."""
    every = (*HYPOTHESES, *EVIDENCE)
    planned = ("--twinning.arm", "model_based")
    free = ("--preset", "paper", "--twinning.arm", "model_free")
    found: dict[str, Options] = {
        WHOLE: every,
        "twinning of the paper": (
            "--preset",
            "paper",
        ),
        "model-free, DDPG": free,
        "twinning from random weights": (*every, *RANDOM),
        "the same without the belief": (*HYPOTHESES, *TREE, *RANDOM),
        "model-based": (*planned, *ALONE, *TREE),
        "model-based, hypotheses": (*planned, *every),
        "without hypotheses": (*ALONE, *EVIDENCE),
        "without the belief": (*HYPOTHESES, *TREE),
    }
    if case == "wind_turbine":  # it plans in real time there; the tank's half-open valve has no plans by gradients
        mpc = ("--twinning.planner.method", "receding_horizon")
        found["predictive control"] = (*planned, *ALONE, *TREE, *mpc)
    return found


ARMS = tuple(arms_of("wind_turbine"))


@dataclass(frozen=True, kw_only=True)
class Config:
    """Train every arm on nominal and unknown systems, find the oracles, and write a page of findings.

    The folder keeps finished results, so that the same command goes on where it was interrupted. A policy of few
    weights is trained, whose optimum on the true system exact gradients find.

    Args:
        plants: all, or some of wind_turbine, flapping_wing, hop (a task of the drone) and cryogenic_tank.
        systems: what the real system has beside its twin, as names of --unknown of a recipe; a plus combines names;
            nothing is the system as its twin knows it. A name counts for every plant that has it. By default that and
            all systems.
        arms: names of arms; by default all. Each arm that begins with without lacks a part of twinning.
        seeds: number of trainings of each arm on each system.
        episodes: number of real episodes of a training, beside that of the controller.
        unseen: number of unseen episodes that judge everything; by default 50, or 100 of the drone, and 192 hops.
        starts: number of random starts of the search for the optimum.
        iterations: number of gradients of each start on ten episodes; a third as many follow on all.
        jobs: number of trainings side by side.
        folder: folder of the runs and of the results, worth.json and worth.md.
        page: page in which the findings are written, too.
        finished: whether to compute nothing, and to write the page from the trainings that are finished so far.
    """

    plants: tuple[str, ...] = ("all",)
    systems: tuple[str, ...] = ()
    arms: tuple[str, ...] = ()
    seeds: int = 3
    episodes: int = 10
    unseen: int | None = None
    starts: int = 3
    iterations: int = 60
    jobs: int = 1
    folder: Annotated[Path, tyro.conf.arg(name="log-dir", aliases=("--folder",))] = Path("runs/worth")
    page: Path | None = None
    finished: bool = False

    def __post_init__(self):
        check_options(self)
        for argument in ("seeds", "episodes", "starts", "iterations", "jobs"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least 1.")
        if self.unseen is not None and self.unseen < FEW:
            raise ValueError(f"unseen={self.unseen} must be at least {FEW}.")
        for argument, known in (("plants", (*CASES, "all")), ("arms", ARMS)):
            if other := [name for name in getattr(self, argument) if name not in known]:
                raise ValueError(f"{argument}: {', '.join(other)} does not exist; choose among {', '.join(known)}.")
        if nowhere := [name for name in self.arms if not any(name in arms_of(case) for case in self.cases())]:
            raise ValueError(f"arms: {', '.join(nowhere)} is on none of {', '.join(self.cases())}.")
        self._check_systems()

    def _check_systems(self) -> None:
        for system in self.systems:
            if not any(system in self.systems_of(case) for case in self.cases()):
                known = dict.fromkeys(name for case in self.cases() for name in SYSTEMS[CASES[case]])
                raise ValueError(
                    f"systems: {system} is on none of {', '.join(self.cases())}; choose nothing, or names among "
                    f"{', '.join(known)}, which a plus combines."
                )
        for case, system in self.rows():
            require_unknown(CASES[case], names(system))

    def cases(self) -> list[str]:
        """The plants, and the drone's hop."""
        return [case for case in CASES if "all" in self.plants or case in self.plants]

    def systems_of(self, case: str) -> list[str]:
        """The systems of a plant, in the order of its tables."""
        known = SYSTEMS[CASES[case]]
        if not self.systems:
            return ["nothing", *known]
        return [system for system in self.systems if all(name in known for name in names(system))]

    def rows(self) -> list[tuple[str, str]]:
        """Every plant with every one of its systems."""
        return [(case, system) for case in self.cases() for system in self.systems_of(case)]

    def judged(self, case: str) -> int:
        """Number of unseen episodes."""
        return self.unseen or UNSEEN[case]

    def trainings(self, case: str, system: str) -> dict[str, list[Training]]:
        """Trainings by arm, one for each seed."""
        every = arms_of(case)
        chosen = {name: every[name] for name in self.arms or every if name in every}
        return {name: self.training(case, system, name, options) for name, options in chosen.items()}

    def training(self, case: str, system: str, name: str, options: Options) -> list[Training]:
        """The trainings of an arm; its options name the part of the algorithm that runs."""
        planned, free = "model_based" in options, "model_free" in options
        few = "receding_horizon" in options
        judged = ("--unseen", str(FEW)) if few else ("--unseen", str(self.judged(case)), "--unseen-every", "1")
        rest = tuple(part for part in options if part not in ("--twinning.arm", "model_based", "model_free"))
        return [
            Training(
                recipe=recipe_of(case),
                arm="model_based" if planned else "model_free" if free else "twinning",
                seed=seed,
                variant="nominal",
                folder=self.folder / case / system / name.replace(", ", "-").replace(" ", "-") / f"seed-{seed}",
                episodes=self.episodes,
                options=(*rest, *options_of(case, system), *judged),
            )
            for seed in range(self.seeds)
        ]

    def optimum(self, case: str, system: str) -> Yardstick:
        """The best policy of the class on the true system."""
        path = self.folder / case / system / f"oracle-{self.judged(case)}.json"
        effort = {"starts": self.starts, "iterations": self.iterations}
        return optimum(path, recipe_of(case), options_of(case, system), unseen=self.judged(case), **effort)

    def tasks(self) -> "list[Task]":
        """Everything that is computed, seed by seed, so that an interrupted study has all arms of the first seeds."""
        found: list[Task] = [self.optimum(*row) for row in self.rows()]
        every = [group for row in self.rows() for group in self.trainings(*row).values()]
        return found + [group[seed] for seed in range(self.seeds) for group in every]


def recipe_of(case: str) -> Path:
    """The recipe of a plant."""
    return Path(__file__).with_name(f"{CASES[case]}.py")


def result(config: Config, case: str, system: str) -> SystemResult | None:
    """All arms on a system, of the trainings that are finished; None if there are none, or no oracle."""
    every = config.trainings(case, system)
    done = {name: [training for training in group if training.done()] for name, group in every.items()}
    groups = {name: group for name, group in done.items() if group}
    if not groups or not config.optimum(case, system).done():
        return None
    arms = [trained_arm(name, group) for name, group in groups.items()]
    judged_on_all = [group[0] for name, group in groups.items() if name != "predictive control"]
    classical = classical_arms(judged_on_all[0]) if judged_on_all else []
    return SystemResult(
        case=case.replace("_", " "),
        system=" + ".join(names(system)),
        oracle=yardstick_entry("oracle", config.optimum(case, system).run()),
        arms=[*arms, *classical],
    )


def command(config: Config) -> str:
    """The command line that makes the page."""
    usual, found = Config(), ["uv run recipes/worth.py"]
    for name in ("plants", "systems", "arms", "seeds", "episodes", "unseen", "starts", "iterations"):
        value = getattr(config, name)
        if value != getattr(usual, name):
            found.append(f"--{name} " + (shlex.join(value) if isinstance(value, tuple) else str(value)))
    return " ".join(found)


def write(config: Config) -> Path:
    """Write the page, its figures and ``worth.json`` from what is kept; return the path of the page."""
    from rt_torchrl.figures.style import save_figure
    from rt_torchrl.study.figures import regret  # here, because --help need not wait for Matplotlib

    kept = {row: found for row in config.rows() if (found := result(config, *row)) is not None}
    if not kept:
        raise ValueError(f"folder={config.folder} holds no finished training and oracle of this study; compute them.")
    for (case, system), found in kept.items():
        save_figure(regret(found), config.folder / f"regret_{case}_{system}.png")
    results = list(kept.values())
    page = findings_page(results, PARTS, command(config))
    (config.folder / "worth.md").write_text(f"# What twinning is worth\n\n{page}\n", encoding="utf-8")
    if config.page is not None:
        write_into(config.page, f"worth of {', '.join(config.cases())} in {config.episodes} episodes", page)
    numbers = [{"case": found.case, "system": found.system, "least": found.least} for found in results]
    for number, found in zip(numbers, results, strict=True):
        number["oracle"] = found.oracle.mean
        number["arms"] = {arm.name: {"J_a": arm.entry.costs.mean(1).tolist(), "paid": arm.paid} for arm in found.arms}
    write_results(config.folder / "worth.json", {"config": asdict(config), "systems": numbers})
    print(json.dumps({found.title: {arm.name: arm.median() for arm in found.arms} for found in results}, indent=1))
    return config.folder / "worth.md"


def main(config: Config) -> None:
    make_folder("folder", config.folder)
    require_page(config.page)
    if not config.finished:
        tasks = config.tasks()
        on_this_machine(tasks, config.jobs)
    print(f"findings in {write(config)}")


if __name__ == "__main__":
    main_of(Config, main)
