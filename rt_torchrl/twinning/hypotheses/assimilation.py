"""Step 4 for several hypotheses: each is fitted to the same records, and weighed by how well it replays them."""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.plants.extensions.neural_residual import ResidualRates
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import Assimilation, AssimilationConfig
from rt_torchrl.twinning.exogenous import ExogenousProcess
from rt_torchrl.twinning.hypotheses.config import HypothesesConfig
from rt_torchrl.twinning.hypotheses.ensemble import ALONE, TwinEnsemble
from rt_torchrl.twinning.hypotheses.hidden_states import with_hidden_states
from rt_torchrl.twinning.hypotheses.reread import Reread, at_rest, reread

SEGMENTS = 60
"""Number of segments of an episode by default."""
FIRST = 3 * ("short", "whole")
"""Stages of the first fit: steps over segments, and over whole records."""
AGAIN = ("short",)
"""Stages of every further fit, in which whole records have hardly ever found more."""
STEPS = 10
"""Greatest number of Levenberg-Marquardt steps over segments in a stage."""
HOPELESS = 1e-3
"""Weight, as a share of the greatest one, below which a hypothesis is fitted in fewer episodes."""
LONGEST_PAUSE = 8
"""Greatest number of episodes between two fits of a hopeless hypothesis."""
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
        self.least, self.waiting, self.pause = math.inf, 0, 1
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

    def due(self) -> bool:
        """Whether the fit is due, which a hopeless hypothesis is in ever fewer episodes."""
        self.waiting -= 1
        return self.waiting < 0

    def rest(self, *, hopeless: bool) -> None:
        """Wait twice as long as before until the next fit of a hopeless hypothesis, and not at all with another one."""
        if not hopeless:
            self.waiting, self.pause = 0, 1
        elif self.waiting < 0:
            self.waiting, self.pause = self.pause, min(2 * self.pause, LONGEST_PAUSE)

    def state_dict(self) -> dict[str, Any]:
        stages = {name: stage.state_dict() for name, stage in self.stages.items()}
        counters = {"least": self.least, "waiting": self.waiting, "pause": self.pause}
        return counters | {"closure": self.twin.closure.state_dict(), **stages}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.least, self.waiting, self.pause = state["least"], state["waiting"], state["pause"]
        self.twin.closure.load_state_dict(state["closure"])
        for name, stage in self.stages.items():
            stage.load_state_dict(state[name])


class EnsembleAssimilation(Assimilation):
    """Fits the twin as :class:`Assimilation` does, then every hypothesis, and weighs all of them.

    Hypotheses replay the measured inputs, because draws of the inputs hide small dynamics.

    Args:
        twin: the ensemble, whose closures and weights are updated in place.
        config: parameters of step 4.
        hypotheses: parameters of the hypotheses.
    """

    def __init__(self, twin: TwinEnsemble, config: AssimilationConfig, hypotheses: HypothesesConfig):
        super().__init__(twin, config)
        self.ensemble, self.hypotheses = twin, hypotheses
        self.segment = hypotheses.segment or max(2, twin.plant.n_steps // SEGMENTS)
        twin.risk = hypotheses.risk
        self.fits = {name: Fit(one, config, self.segment) for name, one in twin.twins.items() if name != ALONE}
        self.misfits: dict[str, float] = {}
        self.called = not hypotheses.call
        self._records: Sequence[Trajectory] = ()
        self._before: float | None = None

    def update(
        self,
        records: Sequence[Trajectory],
        processes: Sequence[ExogenousProcess],
        count: int,
        generator: torch.Generator,
    ) -> Descended:
        """As :meth:`Assimilation.update`, whose result is that of the twin alone, and fit the hypotheses if called."""
        self._before = self._believed_cost(records) if self.ensemble.hypothesis else None
        found = super().update(records, processes, count, generator)
        self._records = records
        if self.called:
            self._weigh(generator)
        return found

    def explain(self, difference: float, generator: torch.Generator) -> bool:
        """Fit the hypotheses from now on if a real episode cost other than the twin says, and no more if none helps.

        Args:
            difference: paired difference of the latest episode beyond what exploration explains.
            generator: source of random numbers.

        Returns:
            Whether they have been fitted.
        """
        wrong = difference > self.hypotheses.call or not self.hypotheses.call
        first = wrong and not self.called
        self.called = wrong or (self.called and set(self.ensemble.weights) != {ALONE})
        if first:
            self._weigh(generator)
        return first

    def _weigh(self, generator: torch.Generator) -> None:
        """Fit the hypotheses to the records of the last update, and weigh them."""
        records = self._records
        alone = misfit(self.ensemble.twins[ALONE], records, self.segment)
        misfits = {name: self._misfit(fit, records, generator) for name, fit in self.fits.items()}
        self.misfits = {ALONE: alone} | misfits
        shares = evidence(self.misfits, self.hypotheses)
        for name, fit in self.fits.items():
            fit.rest(hopeless=shares[name] < HOPELESS)
        self.ensemble.weights = {name: share for name, share in shares.items() if share >= self.hypotheses.least}

    def _misfit(self, fit: "Fit", records: Sequence[Trajectory], generator: torch.Generator) -> float:
        return fit.update(records, generator) if fit.due() else misfit(fit.twin, records, self.segment)

    def _believed_cost(self, records: Sequence[Trajectory]) -> float:
        """J_p of the likeliest hypothesis, which is not the twin alone, over whole records."""
        return self.fits[self.ensemble.likeliest].cost(records)

    def report(self) -> dict[str, float | str]:
        """The weight and the misfit of every hypothesis, and what is said of the twin where a hypothesis is believed.

        ``J_p`` is then that of the likeliest hypothesis, whose name is ``believed``, over the records of the last
        update; ``J_p_before`` is that of the one that was the likeliest before, as it was then.
        """
        found: dict[str, float | str] = {}
        for name in self.ensemble.twins:
            found[f"hypothesis/{name}"] = self.ensemble.weights.get(name, 0.0)
        found |= {f"misfit/{name}": value for name, value in self.misfits.items()}
        if self._before is not None:
            found["J_p_before"] = self._before
        if self.ensemble.hypothesis is not None and self._records:
            found |= {"J_p": self._believed_cost(self._records), "believed": self.ensemble.hypothesis}
        return found

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {
            "fits": {name: fit.state_dict() for name, fit in self.fits.items()},
            "misfits": dict(self.misfits),
            "weights": self.ensemble.weights,
            "called": self.called,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        for name, fit in self.fits.items():
            fit.load_state_dict(state["fits"][name])
        self.misfits, self.ensemble.weights = dict(state["misfits"]), state["weights"]
        self.called = state["called"]


@torch.no_grad()
def misfit(twin: DigitalTwin, records: Sequence[Trajectory], segment: int) -> float:
    """Mean J_p with which a twin replays segments of the records; infinite if it diverges."""
    try:
        stacked = batch_of([with_hidden_states(twin, record) for record in records])
        measured, actions, exogenous, start = stacked.segments(min(segment, stacked.actions.shape[1]), twin.plant.dt)
        flown = twin.replay(measured[:, 0], exogenous, actions, start=start)
    except DivergenceError:
        return float("inf")
    return identification_cost(twin.plant, flown, measured).mean().item()


def evidence(misfits: dict[str, float], config: HypothesesConfig) -> dict[str, float]:
    """Weights of all hypotheses as shares of the greatest one; the twin alone has all if none replays the records."""
    least = min(misfits.values())
    if not least < float("inf"):
        return {name: float(name == ALONE) for name in misfits}
    tiny = 1e-300  # a misfit of zero is perfect, as is another one
    weights = {
        name: (1.0 if name == ALONE else config.prior) * ((least + tiny) / (value + tiny)) ** config.sharpness
        for name, value in misfits.items()
    }
    greatest = max(weights.values())
    return {name: weight / greatest for name, weight in weights.items()}
