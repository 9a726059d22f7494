"""How much room there is on real systems that their twin does not know: planned policies against the optimum."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import tyro

from rt_torchrl import configuration, main_of
from rt_torchrl.atomic_file import make_folder, write_results
from rt_torchrl.envs.unknown_systems import SYSTEMS, require_unknown
from rt_torchrl.study.cases import UNSEEN, names, optimum, options_of
from rt_torchrl.study.results import numeric
from rt_torchrl.study.room import Room, require_page, room_table, write_into
from rt_torchrl.study.scheduling import on_this_machine
from rt_torchrl.study.training import Training
from rt_torchrl.study.yardstick import Yardstick

if TYPE_CHECKING:
    from rt_torchrl.study.task import Task

WITH_HYPOTHESES = (
    *("--twinning.hypotheses.which", "automatic"),
    *("--twinning.referee.rule", "expected_cost"),
)
ALONE = (
    *("--twinning.hypotheses.which", "none"),
    *("--twinning.referee.rule", "decision_tree"),
)


@configuration
class Config:
    """Plan on the fitted twin of a real system that it does not know, and compare with the optimum on the true system.

    A training of the model-based half alone makes a few rounds of record, fit and plan; another one does so with
    hypotheses about what the twin lacks, and a referee that weighs evidence. The folder keeps finished results, so that
    the same command goes on where it was interrupted.

    Args:
        plant: wind_turbine, flapping_wing or cryogenic_tank.
        systems: what the real system has beside its twin, as names of --unknown of the plant's recipe; a plus combines
            names, such as inflow+pitch; nothing is the system as its twin knows it. By default that and all systems.
        task: task of the drone, paper or hop.
        seeds: number of trainings of each system.
        episodes: number of rounds of record, fit and plan.
        unseen: number of unseen episodes that judge everything; by default 50, or 100 of the drone, and 192 hops.
        hypotheses: whether to train with hypotheses, too.
        starts: number of random starts of the search for the optimum.
        iterations: number of gradients of each start on ten episodes; a third as many follow on all.
        jobs: number of trainings side by side.
        folder: folder of the runs and of the results, room.json and room.md of each plant and task.
        page: page in which the table is written, too.
    """

    plant: Annotated[Literal["wind_turbine", "flapping_wing", "cryogenic_tank"], tyro.conf.Positional]
    systems: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    task: Literal["paper", "hop"] = "paper"
    seeds: int = 3
    episodes: int = 3
    unseen: int | None = None
    hypotheses: bool = True
    starts: int = 3
    iterations: int = 60
    jobs: int = 1
    folder: Annotated[Path, tyro.conf.arg(name="log-dir", aliases=("--folder",))] = Path("runs/unknown")
    page: Path | None = None

    def __post_init__(self):
        for argument, least in (("seeds", 1), ("episodes", 1), ("starts", 1), ("iterations", 1), ("jobs", 1)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least {least}.")
        if self.unseen is not None and self.unseen < 2:
            raise ValueError(f"unseen={self.unseen} must be at least 2.")
        if self.task == "hop" and self.plant != "flapping_wing":
            raise ValueError(f"task='hop' is a task of the drone; the plant is {self.plant}.")
        for system in self.systems:
            require_unknown(self.plant, names(system))

    def rows(self) -> tuple[str, ...]:
        """The systems of the table, in its order."""
        return self.systems or ("nothing", *SYSTEMS[self.plant])

    @property
    def title(self) -> str:
        """Name of the table."""
        return f"{self.plant}, {self.task}"

    @property
    def kept(self) -> Path:
        """Folder of the plant and its task."""
        return self.folder / f"{self.plant}_{self.task}"

    @property
    def case(self) -> str:
        """The plant, or the drone's hop."""
        return "hop" if self.task == "hop" else self.plant

    @property
    def judged(self) -> int:
        """Number of unseen episodes."""
        return self.unseen or UNSEEN[self.case]

    def trainings(self, system: str, *, helped: bool = False) -> list[Training]:
        """A training of the model-based half for each seed, alone or with hypotheses."""
        arm, kind = (WITH_HYPOTHESES, "-hypotheses") if helped else (ALONE, "")
        options = (*options_of(self.case, system), "--unseen", str(self.judged), *arm)
        return [
            Training(
                recipe=self.recipe,
                arm="model_based",
                seed=seed,
                variant="nominal",
                folder=self.kept / system / f"seed-{seed}{kind}",
                episodes=self.episodes,
                options=options,
            )
            for seed in range(self.seeds)
        ]

    def tasks(self, system: str) -> "list[Task]":
        """All that a row needs."""
        helped = self.trainings(system, helped=True) if self.hypotheses else []
        return [self.optimum(system), *self.trainings(system), *helped]

    def optimum(self, system: str) -> Yardstick:
        """The best policy of the class on the true system."""
        kept = "oracle.json" if self.unseen is None else f"oracle-{self.judged}.json"
        effort = {"starts": self.starts, "iterations": self.iterations}
        options = options_of(self.case, system)
        return optimum(self.kept / system / kept, self.recipe, options, unseen=self.judged, **effort)

    @property
    def recipe(self) -> Path:
        """The recipe of the plant."""
        return Path(__file__).with_name(f"{self.plant}.py")


def row(config: Config, system: str) -> Room:
    """The costs on a system, of what is kept."""
    found = [training.metrics() for training in config.trainings(system)]
    unseen = [metrics["summary"]["unseen"] for metrics in found]
    helped = (
        [training.metrics()["summary"] for training in config.trainings(system, helped=True)]
        if config.hypotheses
        else []
    )
    baselines = {name: judged["J_a"]["mean"] for name, judged in unseen[0]["baselines"].items()}
    return Room(
        system=" + ".join(names(system)),
        oracle=config.optimum(system).run()["J_a"]["mean"],
        planned=[numeric(judged["J_a_model_based"]["mean"]) for judged in unseen],
        said=[numeric(metrics["episodes"][-1]["J_a_plan"]) for metrics in found],
        classical=baselines,
        helped=[numeric(summary["unseen"]["J_a_model_based"]["mean"]) for summary in helped],
        paid=[metrics["summary"]["cost_of_learning"]["sum"] for metrics in found],
        helped_paid=[summary["cost_of_learning"]["sum"] for summary in helped],
    )


def command(config: Config) -> str:
    """The command line that makes the table."""
    usual = Config(plant=config.plant)
    changed = {name: getattr(config, name) for name in ("task", "seeds", "episodes", "unseen", "starts", "iterations")}
    options = [f"--{name} {value}" for name, value in changed.items() if value != getattr(usual, name)]
    options += [] if config.hypotheses else ["--no-hypotheses"]
    return " ".join(["uv run recipes/unknown.py", config.plant, *config.systems, *options])


def main(config: Config) -> None:
    make_folder("folder", config.kept)
    require_page(config.page)
    tasks = [task for system in config.rows() for task in config.tasks(system)]
    on_this_machine(tasks, config.jobs)
    rows = [row(config, system) for system in config.rows()]
    shown = room_table(rows)
    write_results(config.kept / "room.json", {"config": config, "rows": [vars(one) | {"gap": one.gap} for one in rows]})
    (config.kept / "room.md").write_text(f"`{command(config)}`\n\n{shown}\n", encoding="utf-8")
    if config.page is not None:
        write_into(config.page, config.title, f"`{command(config)}`\n\n{shown}")
    print(shown)
    print(f"results in {config.kept / 'room.json'}: {json.dumps({one.system or 'nothing': one.gap for one in rows})}")


if __name__ == "__main__":
    main_of(Config, main)
