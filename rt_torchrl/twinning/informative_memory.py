r"""A memory of earlier episodes that are kept for what they tell about the closure's weights.

Of the episodes that leave the short-term memory, those stay that together tell most: starting from the information of
the short-term memory, each next one has the greatest gain in

.. math:: \ln\det F, \qquad F = \sum_i\sum_kS_k^\top\frac{\partial^2L_p}{\partial s^2}S_k\,\Delta t.

The last episodes of a good controller are alike, and tell little that the first one has not told.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from rt_torchrl.fit.design import LEAST_INFORMATION, volume
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of
from rt_torchrl.twinning.assimilation import Assimilation
from rt_torchrl.twinning.short_term_memory import ShortTermMemory


class InformativeMemory:
    """Earlier records, chosen by information.

    Args:
        assimilation: step 4, whose twin says what a record tells.
        capacity: number of records; 0 keeps none.

    Raises:
        ValueError: if the capacity is negative, or step 4 draws its inputs, for which it needs a process of every
            record.
    """

    def __init__(self, assimilation: Assimilation, capacity: int):
        if capacity < 0:
            raise ValueError(f"informative={capacity} records must not be negative.")
        if capacity and assimilation.config.inputs != "record":
            raise ValueError(
                f"informative={capacity} records need --twinning.assimilation.inputs record; they are "
                f"{assimilation.config.inputs!r}."
            )
        self.assimilation, self.capacity = assimilation, capacity
        self.records: list[Trajectory] = []

    def before(self, short_term: ShortTermMemory, record: Trajectory) -> None:
        """Consider the record that leaves a full short-term memory when another one comes in."""
        if self.capacity and len(short_term) == short_term.maxlen:
            self.consider(short_term[0], [*list(short_term)[1:], record])

    def consider(self, record: Trajectory, latest: Sequence[Trajectory]) -> None:
        """Choose anew among the kept records and one that leaves the short-term memory.

        Args:
            record: the record.
            latest: records that stay in the short-term memory.
        """
        if not self.capacity:
            return
        candidates = [one for one in (*self.records, record) if len(one.actions) == len(record.actions)]
        if len(candidates) <= self.capacity:
            self.records = candidates
            return
        information = [self._information(one) for one in candidates]
        total = torch.stack([*information, *(self._information(one) for one in latest)]).diagonal(dim1=1, dim2=2)
        known = torch.diag(LEAST_INFORMATION * total.sum(0).clamp_min(1e-300))
        known = known + sum((self._information(one) for one in latest), start=torch.zeros_like(known))
        left = list(range(len(candidates)))
        chosen: list[int] = []
        while len(chosen) < self.capacity:
            best = max(left, key=lambda k: volume(known + information[k]))
            known = known + information[best]
            left.remove(best)
            chosen.append(best)
        self.records = [candidates[k] for k in sorted(chosen)]

    def _information(self, record: Trajectory) -> Tensor:
        """Information of the weights in a record; none in one on which the present twin diverges."""
        n = sum(w.numel() for w in self.assimilation.twin.closure.parameters() if w.requires_grad)
        try:
            return self.assimilation.normal_equations(batch_of([record])).matrix
        except DivergenceError:
            return record.states.new_zeros(n, n)

    def with_latest(self, latest: Sequence[Trajectory]) -> list[Trajectory]:
        """The kept records before the latest ones."""
        return [*self.records, *latest]

    def state_dict(self) -> dict[str, Any]:
        return {"records": [record._asdict() for record in self.records]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.records = [Trajectory(**record) for record in state["records"]]
