"""The TensorBoard dashboard of a run: one scalar per quantity and episode, and the figures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter

TAGS = {
    "real_cost": "cost/real episode (live policy)",
    "J_a_model_based": "cost/J_a model-based (twin)",
    "J_a_model_free": "cost/J_a model-free (twin)",
    "J_a_unseen": "cost/J_a live policy (real system, unseen episodes)",
    "J_a_plan_before": "cost/J_a before planning (twin)",
    "J_a_plan": "cost/J_a after planning (twin)",
    "plan_accepted": "switch/plan accepted",
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
    "solve_median": "predictive control/median time of a solve (ms)",
    "solve_max": "predictive control/longest solve (ms)",
    "late_solves": "predictive control/late solves",
    "diverged_solves": "predictive control/solves whose model diverged",
    "paired_difference": "twin/log of the real cost over the twin's, same policy and inputs",
    "alarm": "twin/alarm: the twin is wrong where it matters",
    "weight_change": "switch/relative weight change of the idle policy",
    "distillation_error": "switch/RMS action error of a distilled clone, share of range",
    "distillation_cost_ratio": "switch/J_a of a distilled clone over that of the live policy (twin)",
}
"""Tag of each scalar entry of an episode's record."""


class Dashboard:
    """A dashboard, which writes TensorBoard events.

    Args:
        folder: folder of the event file.
    """

    def __init__(self, folder: Path):
        self._writer = SummaryWriter(str(folder))

    def episode(self, record: Mapping[str, Any]) -> None:
        """Write the scalars of one episode.

        Args:
            record: entry of the episode in ``metrics.json``.
        """
        step = record["episode"]
        for key, tag in TAGS.items():
            if key in record:
                self._writer.add_scalar(tag, record[key], step)
        self._writer.add_scalar("switch/live is model-based", float(record["live"] == "model_based"), step)
        for event in ("swap", "clone"):
            self._writer.add_scalar(f"switch/{event}", float(record.get("event") == event), step)
        for key in record:
            if key.startswith(("hypothesis/", "misfit/")):
                self._writer.add_scalar(f"hypotheses/{key.replace('hypothesis/', 'weight/')}", record[key], step)
        for name, seconds in record["seconds"].items():
            self._writer.add_scalar(f"seconds/{name}", seconds, step)

    def images(self, images: Mapping[str, np.ndarray], step: int) -> None:
        """Write the figures of an episode, whose number is ``step``, as pixels (height, width, 3) of ``uint8``."""
        for name, image in images.items():
            self._writer.add_image(name, image, step, dataformats="HWC")

    def scalar(self, tag: str, value: float) -> None:
        """Write a scalar of the run as a whole."""
        self._writer.add_scalar(tag, value, 0)

    def close(self) -> None:
        self._writer.close()
