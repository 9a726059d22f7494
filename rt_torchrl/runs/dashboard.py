"""What a training shows while it runs: the TensorBoard dashboard, other loggers, and the progress bar."""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import nn
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from tqdm import tqdm

from rt_torchrl.runs.metrics import on_the_twin
from rt_torchrl.runs.results import progress
from rt_torchrl.runs.run_config import LoggerName
from rt_torchrl.steps.config import ROLES, Role

if TYPE_CHECKING:
    from torchrl.record.loggers import Logger  # only its type


TAGS = {
    "real_cost": "cost/real episode (live policy)",
    "J_a_model_based": "cost/J_a model-based (twin)",
    "J_a_model_free": "cost/J_a model-free (twin)",
    "J_a_unseen": "cost/J_a live policy (real system, unseen episodes)",
    "J_a_unseen_on_the_twin": "cost/J_a live policy (twin, unseen episodes)",
    "J_a_plan_before": "cost/expected J_a before planning",
    "J_a_plan": "cost/expected J_a after planning",
    "plan_accepted": "switch/plan accepted",
    "start": "switch/start of the plan that stays",
    "J_p_before": "twin/J_p before assimilation",
    "J_p": "twin/J_p after assimilation",
    "closure_refused": "twin/closure refused",
    "closure_gradient": "gradient norm/closure (J_p)",
    "policy_gradient": "gradient norm/model-based policy (J_a)",
    "actor_gradient": "gradient norm/model-free policy",
    "critic_gradient": "gradient norm/critic",
    "reward": "model-free/mean reward",
    "td_error": "model-free/mean absolute TD error",
    "critic_loss": "model-free/critic loss",
    "value": "model-free/mean value of the policy",
    "exploration": "model-free/exploration strength",
    "ended_after": "cost/control intervals until the early end of the real episode",
    "solve_median": "predictive control/median time of a solve (ms)",
    "solve_max": "predictive control/longest solve (ms)",
    "diverged_solves": "predictive control/solves whose model diverged",
    "paired_difference": "twin/log of the real cost over the twin's, same policy and inputs",
    "alarm": "twin/alarm: the twin is wrong where it matters",
    "predicted_violations": "violations/predicted share of intervals (twin, the policy that acts)",
    "weight_change": "switch/relative weight change of the idle policy",
    "distillation_error": "switch/RMS action error of a distilled clone, share of range",
    "distillation_cost_ratio": "switch/J_a of a distilled clone over that of the live policy (twin)",
}
"""Tag of each scalar entry of an episode's record."""


GROUPS = {
    "hypothesis/": "hypotheses/weight/",
    "misfit/": "hypotheses/misfit/",
    "rms/": "twin/rms/",
    **{kind: kind for kind in ("faults/", "violations/", "excess/", "multiplier/")},
}
"""Tags of entries of which an episode has several, by what they begin with."""
REFUSED = re.compile(r"[^\w\-. /]")
"""What only TensorBoard gets in a name: MLflow refuses brackets and commas, names of files on Windows colons."""
COSTS = [
    TAGS[key] for key in ("real_cost", "J_a_model_based", "J_a_model_free", "J_a_unseen", "J_a_unseen_on_the_twin")
]
"""Curves that one chart of TensorBoard's custom scalars shows together."""


class Dashboard:
    """A dashboard, which writes TensorBoard events, and the same curves to other loggers.

    Args:
        folder: folder of the event file.
        loggers: further loggers.
    """

    def __init__(self, folder: Path, loggers: "Sequence[Logger]" = ()):
        self._writer, self._loggers = SummaryWriter(str(folder)), loggers
        self._writer.add_custom_scalars({"cost": {"all costs": ["Multiline", COSTS]}})

    def scalar(self, tag: str, value: float, step: int = 0) -> None:
        """Write a scalar of an episode, or one of the run as a whole."""
        self._writer.add_scalar(tag, value, step)
        name = REFUSED.sub("", tag)
        for logger in self._loggers:
            logger.log_scalar(name, value, step=step)

    def settings(self, options: Mapping[str, Any]) -> None:
        """Tell the other loggers the options of the run, by their dotted names."""
        for logger in self._loggers:
            logger.log_hparams(dict(options))

    def results(self, options: Mapping[str, Any], summary: Mapping[str, Any], table: str) -> None:
        """Write what the run has come to: final costs as scalars, the options beside them (HParams), and the table.

        Args:
            options: options of the run by their dotted names.
            summary: entry ``summary`` in ``metrics.json``.
            table: table of results as the terminal shows it.
        """
        final = {f"final/{name}": value for name, value in final_costs(summary).items()}
        for tag, value in final.items():
            self.scalar(tag, value)
        shown = {key: value if isinstance(value, bool | int | float) else str(value) for key, value in options.items()}
        for part in hparams(shown, final):
            self._writer._get_file_writer().add_summary(part)
        unseen = summary["unseen"]
        each = {"J_p": unseen["J_p_each"]} | {f"J_a {name}": costs for name, costs in unseen["costs"].items()}
        for name, values in each.items():
            if None not in values:  # which stands for a cost that is not finite
                self._writer.add_histogram(f"unseen episodes/{name}", np.asarray(values), 0)
        # TensorBoard shows Markdown, in which indented lines are code.
        self._writer.add_text("results", "\n".join("    " + line for line in table.splitlines()), 0)

    def episode(self, record: Mapping[str, Any], policies: Mapping[Role, nn.Module]) -> None:
        """Write the scalars of one episode, and the weights after it.

        Args:
            record: entry of the episode in ``metrics.json``.
            policies: both policies by role.
        """
        step, live = record["episode"], record["live"].replace("_", "-")
        for key, tag in TAGS.items():
            if key in record:
                self.scalar(tag, record[key], step)
        self.scalar(f"cost/real episode ({live})", record["real_cost"], step)
        self._weights(record, policies)
        self.scalar("switch/live is model-based", float(record["live"] == "model_based"), step)
        for event in ("swap", "clone"):
            self.scalar(f"switch/{event}", float(record.get("event") == event), step)
        self._texts(record)
        for key, value in record.items():
            for prefix in (prefix for prefix in GROUPS if key.startswith(prefix)):
                self.scalar(key.replace(prefix, GROUPS[prefix]), value, step)
        for name, seconds in record["seconds"].items():
            self.scalar(f"seconds/{name}", seconds, step)

    def _weights(self, record: Mapping[str, Any], policies: Mapping[Role, nn.Module]) -> None:
        """Write the closure's coefficients, or the weights of a perceptron, and those of both policies."""
        step = record["episode"]
        for name, weight in (record["closure"] or {}).items():
            if isinstance(weight, float):
                self.scalar(f"closure/{name}", weight, step)
            else:
                self._writer.add_histogram(f"closure/{name}", np.ravel(weight), step)
        for role, policy in policies.items():
            for name, values in policy.named_parameters():
                self._writer.add_histogram(f"weights of {role.replace('_', '-')}/{name}", values, step)

    def _texts(self, record: Mapping[str, Any]) -> None:
        """Write what an episode says in words: the alarm, the hypothesis that is believed, and faults."""
        step = record["episode"]
        for tag, key in (("alarm", "warning"), ("believed", "believed")):
            if record.get(key):
                self._writer.add_text(tag, str(record[key]), step)
        faults = record.get("faults", ())
        if faults:
            rows = [f"| {fault['time']:g} | {fault['kind']} | {fault['detail']} |" for fault in faults]
            table = "\n".join(["| time in the episode [s] | fault | detail |", "|---|---|---|", *rows])
            self._writer.add_text("faults", table, step)

    def images(self, images: Mapping[str, np.ndarray], step: int) -> None:
        """Write the figures of an episode, whose number is ``step``, as pixels (height, width, 3) of ``uint8``."""
        for name, image in images.items():
            self._writer.add_image(name, image, step, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()
        for logger in self._loggers:
            logger.close()
            if isinstance(logger.experiment, AbstractContextManager):  # MLflow's run, which is active until it exits
                logger.experiment.__exit__(None, None, None)


def final_costs(summary: Mapping[str, Any]) -> dict[str, float]:
    """Final costs of a run by name; those that are not finite are left out."""
    unseen, paid = summary["unseen"], summary["cost_of_learning"]
    where = " on the twin" if on_the_twin(unseen) else ""
    found = {f"J_a {role.replace('_', '-')}{where}": unseen[f"J_a_{role}"]["mean"] for role in ROLES}
    found[f"J_a live{where}"] = unseen[f"J_a_{summary['live']}"]["mean"]
    found |= {f"J_a {name}": baseline["J_a"]["mean"] for name, baseline in unseen["baselines"].items()}
    flown = summary.get("real_unseen", {}).get("controllers", {})
    found |= {f"J_a {name} on the real system": one["J_a"]["mean"] for name, one in flown.items()}
    found |= {"J_p": unseen["J_p"]["mean"], "sum of the real costs": paid["sum"], "largest real cost": paid["largest"]}
    return {name: float(value) for name, value in found.items() if value is not None and np.isfinite(value)}


def make_loggers(names: Sequence[LoggerName], folder: Path, plant: str) -> "list[Logger]":
    """TorchRL's loggers of a run.

    Args:
        names: which ones.
        folder: run folder; CSV files go to ``csv/`` in it, W&B's run has its name, and MLflow's store is ``mlflow.db``
            in it or, if it is set, the one that ``MLFLOW_TRACKING_URI`` names.
        plant: name of the plant, which is the project of W&B and the experiment of MLflow.
    """
    if not names:
        return []
    from torchrl.record import loggers  # here, because it loads TorchRL

    store = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{(folder / 'mlflow.db').resolve()}"
    make: dict[LoggerName, Callable[[], Logger]] = {
        "csv": lambda: loggers.CSVLogger("csv", log_dir=str(folder)),
        "wandb": lambda: loggers.WandbLogger(folder.name, log_dir=str(folder), project=f"rt_torchrl {plant}"),
        "mlflow": lambda: loggers.MLFlowLogger(plant, tracking_uri=store),
    }
    return [make[name]() for name in names]


WORDS = {
    "start": "learning from what is known",
    "interact": "real episode",
    "learn": "model-free update",
    "inputs": "fitting the input",
    "assimilate": "assimilating",
    "plan": "planning",
    "switch": "comparing policies",
}
"""Words in which the bar shows each step of the algorithm."""


class Progress:
    """A bar over the real episodes, with the costs of the last one and the present step.

    Args:
        total: number of real episodes of the training.
        done: number of episodes that were done before.
    """

    def __init__(self, total: int, done: int = 0):
        self._bar = tqdm(total=total, initial=done, unit="episode", dynamic_ncols=True)
        self._costs, self._doing, self._alarm = "", "starting", False
        self._believed: str | None = None

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *raised: object) -> None:
        self._doing = ""
        self._show()
        self._bar.close()

    def doing(self, what: str) -> None:
        """Show what begins now: the name of a step of the algorithm, or any other words."""
        self._doing = WORDS.get(what, what)
        self._show()

    def episode(self, record: dict[str, Any]) -> None:
        """Count an episode and show its costs.

        A line says when the twin's predictions begin or cease to be wrong, and when another twin is believed.
        """
        self._costs = progress(record)
        alarm = bool(record.get("alarm", self._alarm))
        if alarm != self._alarm:
            found = record.get("warning", "the twin's predictions hold again")
            self.write(f"episode {record['episode'] + 1}: {found}")
        self._alarm = alarm
        believed = record.get("believed")
        if believed != self._believed:
            said = f"the twin with {believed!r}" if believed else "the twin alone"
            self.write(f"episode {record['episode'] + 1}: {said} is the likeliest; J_p and closure are its own")
        self._believed = believed
        self._bar.update()
        self._show()

    def write(self, line: str) -> None:
        """Write a line above the bar."""
        self._bar.write(line)

    def _show(self) -> None:
        self._bar.set_postfix_str("; ".join(part for part in (self._costs, self._doing) if part))
