"""The fit of one hypothesis to records, and what it leaves over."""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch

from rt_torchrl.interruption import safe_point
from rt_torchrl.plants.vector_field import ResidualRates
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import Assimilation, AssimilationConfig
from rt_torchrl.twinning.hypotheses.hidden_states import with_hidden_states
from rt_torchrl.twinning.hypotheses.reread import Reread, at_rest, reread
from rt_torchrl.twinning.hypotheses.turns import Turns

FIRST = 3 * ("short", "whole")
"""Stages of the first fit: steps over segments, and over whole records."""
AGAIN = ("short",)
"""Stages of every further fit, in which whole records have hardly ever found more."""
STEPS = 10
"""Greatest number of Levenberg-Marquardt steps over segments in a stage."""
HELD = 0.1
"""Twice the cost, as a share of the misfit of a segment, of a weight of a neural residual that has changed by one."""
FAR = 10.0
"""Ratio of misfits beyond which a stage has gone astray, or the weights of the last episode have."""


class Fit:
    """The fit of one hypothesis: steps over segments, at first in turns with whole records; the best weights stay.

    Over a whole record of a system that oscillates nearly every weight has local minima. Over segments that begin with
    what was read (multiple shooting) it has few; the hidden states go on through all segments, with their derivatives.
    Where some steps over segments have not arrived, the methods take turns, and each frees the other.

    Args:
        twin: twin of the hypothesis, whose closure is updated in place.
        config: parameters of step 4, for the whole records.
        segment: number of control intervals of a segment.
    """

    def __init__(self, twin: DigitalTwin, config: AssimilationConfig, segment: int):
        self.twin, self.segment = twin, segment
        measured = dataclasses.replace(config, inputs="record")
        short = dataclasses.replace(
            measured,
            method="levenberg_marquardt",
            initial="measured",
            segment=0,
            stop_ratio=0.0,
            iterations=STEPS,
        )
        self.stages = {
            "short": Assimilation(twin.of(Reread(twin.plant)), short),
            "whole": Assimilation(twin, measured),
        }
        self.least, self.turns = math.inf, Turns()
        self._first = copy.deepcopy(twin.closure.state_dict())
        self._held = not config.prior and any(isinstance(m, ResidualRates) for m in twin.closure.modules())

    def update(self, records: Sequence[Trajectory], generator: torch.Generator) -> float:
        """Fit the records: by both stages in turn the first time, by steps over segments from then on.

        Where these have not arrived, and much more is left over than the last time, the fit also begins anew from the
        first weights: those of the last episode may explode on these records, and no step leads back from there.

        Returns:
            The misfit of the best weights, which the closure has then.
        """
        first = math.isinf(self.least)
        least, arrived = self._run(records, FIRST if first else AGAIN, generator)
        if not (first or arrived or least < FAR * self.least):
            least = self._anew(records, least, generator)
        self.least = least
        return least

    def _anew(self, records: Sequence[Trajectory], least: float, generator: torch.Generator) -> float:
        """Fit from the first weights; the present ones stay unless their misfit is greater."""
        closure = self.twin.closure
        present = copy.deepcopy(closure.state_dict())
        closure.load_state_dict(self._first)
        found, _ = self._run(records, FIRST, generator)
        if not found < least:
            closure.load_state_dict(present)
        return min(found, least)

    def _run(
        self, records: Sequence[Trajectory], stages: Sequence[str], generator: torch.Generator
    ) -> tuple[float, bool]:
        """Go through stages until steps over segments have arrived.

        Returns:
            The misfit of the best weights, which the closure has then, and whether the steps have arrived.
        """
        plant, closure = self.twin.plant, self.twin.closure
        least, best = misfit(self.twin, records, self.segment), copy.deepcopy(closure.state_dict())
        self._hold(least)
        taken = {"short": [reread(record, plant, self.segment) for record in records]}
        taken["whole"] = [at_rest(record, plant) for record in records]
        arrived = False
        for name in stages:
            safe_point()
            steps = STEPS
            # A twin that diverges on the way only loses the stage.
            with contextlib.suppress(FloatingPointError):
                steps = self.stages[name].update(taken[name], (), 1, generator).iterations
            found = misfit(self.twin, records, self.segment)
            if found < least:
                least, best = found, copy.deepcopy(closure.state_dict())
            elif not found < FAR * least:
                closure.load_state_dict(best)
            arrived = name == "short" and steps < STEPS
            if arrived:
                break
        closure.load_state_dict(best)
        return least, arrived

    def _hold(self, least: float) -> None:
        """Hold the weights of a neural residual by a prior whose unit is the present misfit; see ``HELD``.

        Without it the weights that the records hardly show spoil the steps, and many weights follow noise.
        """
        for stage in self.stages.values() if self._held and math.isfinite(least) else ():
            stage.prior.stiffness = HELD * least

    def cost(self, records: Sequence[Trajectory]) -> float:
        """J_p of whole records under their measured inputs; infinite if the twin diverges on them."""
        return self.stages["whole"].cost_of(batch_of([at_rest(record, self.twin.plant) for record in records]))

    def state_dict(self) -> dict[str, Any]:
        stages = {name: stage.state_dict() for name, stage in self.stages.items()}
        counters = {"least": self.least, **self.turns.state_dict()}
        return counters | {"closure": self.twin.closure.state_dict(), "first": self._first, **stages}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.least = state["least"]
        self.turns.load_state_dict(state)
        self.twin.closure.load_state_dict(state["closure"])
        self._first = state.get("first", self._first)  # earlier versions did not save it
        for name, stage in self.stages.items():
            stage.load_state_dict(state[name])


@torch.no_grad()
def misfit(twin: DigitalTwin, records: Sequence[Trajectory], segment: int) -> float:
    """Mean J_p with which a twin replays segments of the records; infinite if it diverges."""
    try:
        stacked = batch_of([with_hidden_states(twin, record) for record in records])
        pieces = stacked.segments(min(segment, stacked.actions.shape[1]), twin.plant.dt)
        flown = twin.replay(pieces.states[:, 0], pieces.exogenous, pieces.actions, start=pieces.start)
    except DivergenceError:
        return float("inf")
    return identification_cost(twin.plant, flown, pieces.states, pieces.seen).mean().item()
