"""Step 4: the closure is trained until the twin replays the record."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.descent import Descended, Descent, DescentConfig
from rt_torchrl.exogenous import ExogenousProcess
from rt_torchrl.gauss_newton import LevenbergMarquardt, NormalEquations
from rt_torchrl.memory import Record
from rt_torchrl.trajectory import identification_cost
from rt_torchrl.twin import DigitalTwin


@dataclass(frozen=True, kw_only=True)
class AssimilationConfig:
    """Parameters of step 4.

    Args:
        iterations: n_G, gradients per episode.
        stop_ratio: end the loop once J_p is below this share of its value at the start of the episode; 0 never does.
        inputs: ``realisations`` replays the record under N_z samples of the exogenous process, as in the paper;
            ``record`` under the exogenous input that was measured. Realisations keep a twin from fitting what is chance
            in the input, but weights that move the states less than that chance are lost in it.
        method: ``gradient`` takes the steps of ``descent``; ``levenberg_marquardt`` solves the normal equations from
            forward sensitivities, for closures of some ten weights, and makes no use of ``descent``.
        window: control intervals of the pieces that a record is replayed in, each from the state measured at its start
            (multiple shooting); 0, as in the paper, replays it whole. Over many periods of a motion whose period the
            weights change, the cost of a whole replay has a local minimum for every period that is missed. What is left
            at the end of a record is not replayed.
        descent: how the closure's weights descend J_p.
    """

    iterations: int = 15
    stop_ratio: float = 0.0
    window: int = 0
    inputs: Literal["realisations", "record"] = "realisations"
    method: Literal["gradient", "levenberg_marquardt"] = "gradient"
    descent: DescentConfig = field(default_factory=DescentConfig)

    def __post_init__(self):
        if self.iterations < 0:
            raise ValueError(f"iterations={self.iterations} of the assimilation (n_G) must not be negative.")
        if not 0.0 <= self.stop_ratio < 1.0:
            raise ValueError(f"stop_ratio={self.stop_ratio} must lie in [0, 1).")
        if self.window < 0:
            raise ValueError(f"window={self.window} of the assimilation must not be negative; 0 replays whole records.")


class Pieces(NamedTuple):
    """Records cut into ``count`` pieces each: start of each piece [s], and what was measured and done in it."""

    start: float | Float[Tensor, " batch"]
    measured: Float[Tensor, "batch samples n_s"]
    exogenous: Float[Tensor, "batch n n_z"]
    actions: Float[Tensor, "batch n n_a"]
    count: int


class Assimilation:
    r"""Minimises :math:`J_p = \mathbb E\int L_p(s, \check s)\,dt` over the closure's weights (paper, eq. J_p).

    The expectation is over the records in D_S and, for each, realisations of its exogenous process; all are driven by
    the *stored* actions.

    Args:
        twin: its closure is updated in place, and holds the best weights seen, w_p*, afterwards.
        config: see :class:`AssimilationConfig`.

    Raises:
        ValueError: if a window is longer than an episode.
    """

    def __init__(self, twin: DigitalTwin, config: AssimilationConfig):
        if config.window > twin.plant.n_steps:
            raise ValueError(
                f"window={config.window} of the assimilation exceeds the {twin.plant.n_steps} control intervals of an "
                f"episode of plant {twin.plant.name!r}; 0 replays whole records."
            )
        self.twin, self.config = twin, config
        self.descent = Descent(twin.closure, config.descent)
        self.second_order = LevenbergMarquardt(twin.closure)

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
        if self.config.inputs == "record":
            count, exogenous = 1, torch.stack([record.exogenous for record in records])
        else:
            exogenous = torch.cat([process.sample(count, generator) for process in processes])
        measured = torch.stack([record.states for record in records]).repeat_interleave(count, 0)
        actions = torch.stack([record.actions for record in records]).repeat_interleave(count, 0)
        pieces = self.cut(measured, exogenous, actions)

        if self.config.method == "levenberg_marquardt":
            return self.second_order.run(
                lambda: self._equations(pieces),
                self.config.iterations,
                stop_below=self.config.stop_ratio,
            )

        def cost() -> Tensor:
            replayed = self.twin.replay(pieces.measured[:, 0], pieces.exogenous, pieces.actions, start=pieces.start)
            return pieces.count * identification_cost(self.twin.plant, replayed, pieces.measured).mean()

        return self.descent.run(cost, self.config.iterations, stop_below=self.config.stop_ratio)

    def cut(
        self,
        measured: Float[Tensor, "batch samples n_s"],
        exogenous: Float[Tensor, "batch n n_z"],
        actions: Float[Tensor, "batch n n_a"],
    ) -> Pieces:
        """The records in pieces of ``window`` intervals; each whole if that is 0."""
        n, window = actions.shape[1], self.config.window or actions.shape[1]
        count = n // window
        if count == 1:
            return Pieces(0.0, measured[:, : window + 1], exogenous[:, :window], actions[:, :window], 1)
        inputs, held = (
            x[:, : count * window].unflatten(1, (count, window)).flatten(0, 1) for x in (exogenous, actions)
        )
        # The end of a piece is the start of the next: both have that sample.
        states = measured.unfold(1, window + 1, window).transpose(2, 3).flatten(0, 1)
        first = torch.arange(count, dtype=measured.dtype, device=measured.device).repeat(len(measured))
        return Pieces(self.twin.plant.dt * window * first, states, inputs, held, count)

    def _equations(self, pieces: Pieces) -> NormalEquations:
        found = self.normal_equations(pieces.exogenous, pieces.measured, pieces.actions, start=pieces.start)
        return NormalEquations(*(pieces.count * part for part in found))

    def normal_equations(
        self,
        exogenous: Float[Tensor, "batch n n_z"],
        measured: Float[Tensor, "batch samples n_s"],
        actions: Float[Tensor, "batch n n_a"],
        *,
        start: float | Float[Tensor, " batch"] = 0.0,
    ) -> NormalEquations:
        """J_p, its gradient and its Gauss-Newton matrix with respect to the closure's weights."""
        states, S = self.twin.sensitivities(measured[:, 0], exogenous, actions, start=start)
        plant, target = self.twin.plant, measured[:, 1:]
        pointwise = torch.func.vmap(torch.func.vmap(torch.func.grad(plant.discrepancy)))
        curvature = torch.func.vmap(torch.func.vmap(torch.func.hessian(plant.discrepancy)))
        share = plant.dt / len(measured)
        g, H = pointwise(states, target), curvature(states, target)
        return NormalEquations(
            share * plant.discrepancy(states, target).sum(),
            share * torch.einsum("bki,bkiw->w", g, S),
            share * torch.einsum("bkiv,bkij,bkjw->vw", S, H, S),
        )
