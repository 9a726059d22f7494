"""How many real episodes a twin should remember."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import numpy as np
import torch

from rt_torchrl import configuration, main_of, require_finished
from rt_torchrl.atomic_file import make_folder, write_results
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs.command_line import from_command_line, load_recipe

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEMORIES = {"last": 1, "last four": 4}
"""Numbers of latest episodes, by name."""
TITLE = "Twins that remember other real episodes, on unseen winds (mean of the seeds; band: their range)"
OPTIONS = ("--twinning.arm", "model_based", "--untrained", "0", "--unseen", "2", "--threads", "1", "--no-figures")
RECORDED = ("--twinning.assimilation.inputs", "record", "--twinning.hypotheses.which", "none")


@configuration
class Config:
    """Compare memories of the turbine's twin: the last real episode, and the last four.

    After every real episode the twin is judged by J_p on unseen winds, as the classical controller flies them and as
    the present policy flies them, and the policy by J_a on the true turbine.

    Args:
        closure: law of the twin, paper or mlp.
        seeds: number of trainings with each memory.
        episodes: number of real episodes, beside the first one that the classical controller flies.
        unseen: number of unseen episodes.
        log_dir: folder of the trainings, and of memory.json and memory.png.
    """

    closure: Literal["paper", "mlp"] = "paper"
    seeds: int = 3
    episodes: int = 8
    unseen: int = 20
    log_dir: Path = Path("runs/memory")

    def __post_init__(self):
        for argument, least in (("seeds", 1), ("episodes", 1), ("unseen", 2)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least {least}.")


def trained(config: Config, memory: str, seed: int) -> list[dict[str, float]]:
    """Costs after every real episode of a training."""
    from rt_torchrl import Run  # here, because --help need not wait for TorchRL

    kept = ("--twinning.records", str(MEMORIES[memory]))
    folder = config.log_dir / memory.replace(" ", "-") / f"seed-{seed}"
    named = ("--seed", str(seed), "--episodes", str(config.episodes), "--log-dir", str(folder), "--overwrite")
    recipe = load_recipe(Path(__file__).with_name("wind_turbine.py"))
    options = from_command_line(recipe.Config, [*OPTIONS, *RECORDED, *kept, *named, "--closure", config.closure])
    plant, found = options.plant(), []
    unseen = UnseenEpisodes(plant, config.unseen)
    classical = unseen.fly_baseline(JonkmanController(plant))

    def judge(episodes: Sequence[dict[str, Any]]) -> None:
        policy, closure = run.algorithm.policies["model_based"], run.algorithm.twin.closure
        flown = unseen.fly(policy)
        found.append(
            {
                "J_p, classical": unseen.identification_costs(plant, closure, classical).mean().item(),
                "J_p, policy": unseen.identification_costs(plant, closure, flown).mean().item(),
                "J_a": unseen.control_costs(policy).mean().item(),
            }
        )

    run = Run(options, plant, first=JonkmanController, callbacks=[judge])
    run.train()
    require_finished(len(found), config.episodes)
    return found


def main(config: Config) -> None:
    from rt_torchrl.figures import save_figure

    make_folder("log_dir", config.log_dir)
    torch.set_num_threads(1)
    found = {memory: [trained(config, memory, seed) for seed in range(config.seeds)] for memory in MEMORIES}
    write_results(config.log_dir / "memory.json", {"config": dataclasses.asdict(config), "costs": found})
    save_figure(figure(found), config.log_dir / "memory.png")
    print(table(found))
    print(f"results and figure in {config.log_dir}")


def curves(trainings: list[list[dict[str, float]]], name: str) -> np.ndarray:
    """One kind of costs, a row for each seed."""
    return np.array([[episode[name] for episode in training] for training in trainings])


def table(found: dict[str, list[list[dict[str, float]]]]) -> str:
    """Geometric means over the seeds and the second half of the episodes, as Markdown."""
    names = list(next(iter(found.values()))[0][0])
    lines = ["| memory | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for memory, trainings in found.items():
        each = [curves(trainings, name) for name in names]
        means = [np.exp(np.log(one[:, one.shape[1] // 2 :]).mean()) for one in each]
        lines.append(f"| {memory} | " + " | ".join(f"{mean:.4g}" for mean in means) + " |")
    return "\n".join(lines)


def figure(found: dict[str, list[list[dict[str, float]]]]) -> "Figure":
    """All costs over the real episodes: the geometric mean of the seeds, and their range."""
    from matplotlib.ticker import MaxNLocator

    from rt_torchrl.figures.style import REAL, ROLES, caption, legend_below, panels

    names = list(next(iter(found.values()))[0][0])
    drawn, axes = panels(1, len(names), title=TITLE, size=(3.6 * len(names), 3.6))
    for ax, name in zip(axes.flat, names, strict=True):
        for (memory, trainings), colour in zip(found.items(), (REAL, *ROLES.values()), strict=False):
            costs = curves(trainings, name)
            number = np.arange(1, costs.shape[1] + 1)
            ax.fill_between(number, costs.min(0), costs.max(0), color=colour, alpha=0.15, linewidth=0)
            ax.plot(number, np.exp(np.log(costs).mean(0)), "o-", color=colour, markersize=3, label=memory)
        if name.startswith("J_p"):  # of which a good twin has a hundredth
            ax.set_yscale("log")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.set_xlabel("real episodes")
        caption(ax, name, "")
    legend_below(drawn, [axes.flat[0]])
    return drawn


if __name__ == "__main__":
    main_of(Config, main)
