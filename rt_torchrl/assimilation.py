"""Step 4: the closure is trained until the twin replays the record."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from rt_torchrl.descent import Descended, Descent, DescentConfig
from rt_torchrl.exogenous import ExogenousProcess
from rt_torchrl.memory import Record
from rt_torchrl.trajectory import identification_cost
from rt_torchrl.twin import DigitalTwin


@dataclass(frozen=True, kw_only=True)
class AssimilationConfig:
    """Parameters of step 4.

    Args:
        iterations: n_G, gradients per episode.
        stop_ratio: end the loop once J_p is below this share of its value at the start of the episode; 0 never does.
        descent: how the closure's weights descend J_p.
    """

    iterations: int = 15
    stop_ratio: float = 0.0
    descent: DescentConfig = field(default_factory=DescentConfig)

    def __post_init__(self):
        if self.iterations < 0:
            raise ValueError(f"iterations={self.iterations} of the assimilation (n_G) must not be negative.")
        if not 0.0 <= self.stop_ratio < 1.0:
            raise ValueError(f"stop_ratio={self.stop_ratio} must lie in [0, 1).")


class Assimilation:
    r"""Minimises :math:`J_p = \mathbb E\int L_p(s, \check s)\,dt` over the closure's weights (paper, eq. J_p).

    The expectation is over the records in D_S and, for each, realisations of its exogenous process; all are driven by
    the *stored* actions.

    Args:
        twin: its closure is updated in place, and holds the best weights seen, w_p*, afterwards.
        config: see :class:`AssimilationConfig`.
    """

    def __init__(self, twin: DigitalTwin, config: AssimilationConfig):
        self.twin, self.config = twin, config
        self.descent = Descent(twin.closure, config.descent)

    def update(
        self, records: Sequence[Record], processes: Sequence[ExogenousProcess], count: int, generator: torch.Generator
    ) -> Descended:
        """One episode's gradient steps.

        Args:
            records: D_S.
            processes: the exogenous process of each record.
            count: N_z, realisations of each.
            generator: source of the realisations.
        """
        exogenous = torch.cat([process.sample(count, generator) for process in processes])
        measured = torch.stack([record.states for record in records]).repeat_interleave(count, 0)
        actions = torch.stack([record.actions for record in records]).repeat_interleave(count, 0)

        def cost() -> Tensor:
            replayed = self.twin.replay(measured[:, 0], exogenous, actions)
            return identification_cost(self.twin.plant, replayed, measured).mean()

        return self.descent.run(cost, self.config.iterations, stop_below=self.config.stop_ratio)
