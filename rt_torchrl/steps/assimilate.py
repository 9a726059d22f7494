"""Step 4: the twin is fitted to the latest records, and compared with what real episodes cost."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.report import Step, findings, merged
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.twinning.assimilation import Assimilation


class Assimilate(Step):
    """Step 4: descend J_p over the latest records, and explain what real episodes cost other than the twin says.

    Reads ``record`` and ``large_scale``, of which the memory D_S and the processes hold more. Writes ``J_p_before`` and
    ``J_p``, the cost of the twin on the records before and after.

    Args:
        assimilation: the fit of the twin.
        belief: what takes the twin's word for a policy, or not.
        short_term: memory D_S of the latest records.
        realisations: number N_z of draws of the inputs for each record.
        generator: source of the draws.
    """

    in_keys = ["record", "large_scale"]
    out_keys = ["J_p_before", "J_p"]

    def __init__(
        self,
        assimilation: Assimilation,
        belief: Belief,
        short_term: Sequence[Trajectory],
        realisations: int,
        generator: torch.Generator,
    ):
        super().__init__(assimilation=assimilation, belief=belief)
        self.assimilation, self.belief, self.short_term = assimilation, belief, short_term
        self.realisations, self.generator = realisations, generator
        self.closure_before: dict[str, Any] | None = None
        """State of the closure before the last fit, to which a twin that diverges goes back; None after that."""

    def forward(self, episode: TensorDictBase) -> TensorDictBase:
        report = self.fit(list(self.short_term))
        found = self.belief.examine()
        if self.assimilation.explain(self.belief.unexplained, self.generator):
            found = merged(findings(**self.assimilation.report()), self.belief.examine())
        return merged(merged(episode, report), found)

    def fit(self, records: Sequence[Trajectory]) -> TensorDictBase:
        """Fit the twin to records; the report of the fit."""
        latest, processes = self.belief.virtual.paired(records)
        self.closure_before = copy.deepcopy(self.belief.virtual.twin.closure.state_dict())
        found = self.assimilation.update(latest, processes, self.realisations, self.generator)
        fit = findings(J_p_before=found.start, J_p=found.best, closure_gradient=found.gradient, closure_refused=0.0)
        return merged(fit, findings(**self.assimilation.report()))
