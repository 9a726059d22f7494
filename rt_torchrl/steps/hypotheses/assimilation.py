"""Step 4 for several hypotheses: each is fitted to the same records, and weighed by how well it replays them.

A fit goes over segments that begin with what sensors read. The hidden states of a hypothesis, which no sensor reads, go
on through all segments: they follow from what the sensors have read before.
"""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.fit.least_squares import SHORT
from rt_torchrl.fit.uncertainty import Uncertainty
from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant, Transition, replaying
from rt_torchrl.plants.signal import Signal
from rt_torchrl.plants.vector_field import ResidualRates
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.steps.config import AssimilationConfig, HypothesesConfig
from rt_torchrl.steps.hypotheses.ensemble import ALONE, TwinEnsemble
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin

FIRST, AGAIN = 3, 1
"""Greatest numbers of stages of the first fit, and of every further one."""
STEPS = 10
"""Greatest number of Levenberg-Marquardt steps in a stage."""
HELD = 0.1
"""Twice the cost, as a share of the misfit of a segment, of a weight of a neural residual that has changed by one.
Without this prior the weights that the records hardly show spoil the steps, and many weights follow noise."""
FAR = 10.0
"""Ratio of misfits beyond which a stage has gone astray, or the weights of the last episode have."""
RUN_UP = 0.5
"""Share of a record that begins in the middle of an operation, in which hidden states settle: nothing is compared."""
LONGEST_PAUSE = 8
"""Greatest number of episodes between two fits of a hopeless hypothesis."""


@dataclasses.dataclass
class Turns:
    """A hypothesis that explains nothing is fitted in ever fewer episodes, any other one in all.

    Args:
        waiting: number of episodes until the next fit; negative in an episode in which it is due.
        pause: number of episodes to wait after the next fit, if the hypothesis is hopeless then, too.
    """

    waiting: int = 0
    pause: int = 1

    def due(self) -> bool:
        """Whether a fit is due in this episode; called once in each."""
        self.waiting -= 1
        return self.waiting < 0

    def rest(self, *, hopeless: bool) -> None:
        """Wait twice as long as before until the next fit of a hopeless hypothesis, and not at all with another one."""
        if not hopeless:
            self.waiting, self.pause = 0, 1
        elif self.waiting < 0:
            self.waiting, self.pause = self.pause, min(2 * self.pause, LONGEST_PAUSE)


class Reread(Extension):
    """A plant whose further inputs hold readings, and whether an interval begins with them.

    Over segments that begin with readings, the states are nearly linear in the weights. The hidden states go on from
    one segment to the next, so that all segments show the weights on which the hidden states depend.

    Args:
        base: the plant.
    """

    def __init__(self, base: Plant):
        super().__init__(replaying(base), [])
        self._met, self._read = len(base.inputs), len(base.readings)
        readings = [Signal(symbol=s.symbol, name=f"read_{s.name}", unit=s.unit) for s in base.readings]
        self.inputs = (*base.inputs, *readings, Signal(symbol="r", name="is_read", unit="-"))

    @property
    def own_scheme(self) -> bool:
        """Always: an interval that begins with readings is no integral of the vector field."""
        return True

    def step(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        command: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Transition:
        """One interval of the plant from the readings, or from its own states."""
        inputs, readings, flag = exogenous.split([self._met, self._read, 1], -1)
        states, hidden = state[..., : self._read], state[..., self._read :]
        start = torch.where(flag + torch.zeros_like(states) > 0.5, readings + torch.zeros_like(states), states)
        return self.base.step(t, torch.cat([start, hidden], -1), command, inputs, closure)


def reread(record: Trajectory, plant: Plant, segment: int) -> Trajectory:
    """A record as a :class:`Reread` plant replays it, with the readings at the start of every segment.

    Args:
        record: the record, as sensors read it.
        plant: the plant; its hidden states are at rest at the start.
        segment: number of control intervals of a segment.
    """
    read = record.states[:-1]
    flag = torch.zeros_like(read[:, :1])
    starts = torch.arange(0, len(read), segment, device=read.device)
    if record.seen is not None:  # from each start on, the next sample that was measured
        measured = record.seen[:-1].nonzero().flatten()
        place = torch.searchsorted(measured, starts)
        starts = measured[place[place < len(measured)]]
    flag[starts] = 1.0
    exogenous = torch.cat([record.exogenous, read, flag], -1)
    return settled(record)._replace(states=plant.at_rest(record.states), exogenous=exogenous)


def settled(record: Trajectory) -> Trajectory:
    """A record in which no sample is seen before hidden states have settled, which are not always at rest at its start.

    They are not where a later part of an episode begins, a window of a continuous operation, or a log.
    """
    if record.from_rest:
        return record
    seen = torch.ones_like(record.states[..., 0], dtype=torch.bool) if record.seen is None else record.seen.clone()
    seen[: int(RUN_UP * len(seen))] = False
    return record._replace(seen=seen)


class Fit:
    """The fit of one hypothesis over segments that begin with what was read (multiple shooting); the best weights stay.

    Over a whole record of a system that oscillates nearly every weight has local minima. Over segments it has few; the
    hidden states go on through all of them, with their derivatives.

    Args:
        twin: twin of the hypothesis, whose closure is updated in place.
        config: parameters of step 4.
        segment: number of control intervals of a segment.
    """

    def __init__(self, twin: DigitalTwin, config: AssimilationConfig, segment: int):
        self.twin, self.segment = twin, segment
        short = AssimilationConfig(iterations=STEPS, prior=config.prior, segment=0, initial="measured")
        self.short = Assimilation(twin.of(Reread(twin.plant)), short)
        measured = dataclasses.replace(config, inputs="record", segment=config.segment or 0)
        self.whole = Assimilation(twin, measured)
        """What tells the errors over records, which is not fitted."""
        self.least = math.inf
        self._held = not config.prior and any(isinstance(m, ResidualRates) for m in twin.closure.modules())

    def update(self, records: Sequence[Trajectory], length: int = 0) -> float:
        """Fit the records.

        Where the steps have not arrived, and much more is left over than the last time, the fit also begins anew from
        the first weights: those of the last episode may explode on these records, and no step leads back from there.

        Args:
            records: the records.
            length: number of control intervals of the segments over which errors are reported; 0 for whole records.

        Returns:
            The misfit of the best weights, which the closure has then.
        """
        first, self.whole.length = math.isinf(self.least), length
        least, arrived = self._run(records, FIRST if first else AGAIN)
        if not (first or arrived or least < FAR * self.least):
            present = copy.deepcopy(self.twin.closure.state_dict())
            self.twin.closure.load_state_dict(self.short.first)
            anew, _ = self._run(records, FIRST)
            if not anew < least:
                self.twin.closure.load_state_dict(present)
            least = min(anew, least)
        self.least = least
        return least

    def _run(self, records: Sequence[Trajectory], stages: int) -> tuple[float, bool]:
        """Go through stages until the steps have arrived.

        Returns:
            The misfit of the best weights, which the closure has then, and whether the steps have arrived.
        """
        plant, closure = self.twin.plant, self.twin.closure
        least, best = misfit(self.twin, records, self.segment), copy.deepcopy(closure.state_dict())
        shown = least if math.isfinite(least) else self.least
        if self._held and math.isfinite(shown):  # see HELD
            self.short.prior.stiffness = HELD * shown
        read_again, steps = [reread(record, plant, self.segment) for record in records], STEPS
        while stages and steps == STEPS:
            safe_point()
            stages -= 1
            with contextlib.suppress(FloatingPointError):  # a twin that diverges on the way only loses the stage
                steps = self.short.update(read_again).iterations
            present = misfit(self.twin, records, self.segment)
            if present < least:
                least, best = present, copy.deepcopy(closure.state_dict())
            elif not present < FAR * least:
                closure.load_state_dict(best)
        closure.load_state_dict(best)
        return least, steps < STEPS

    def cost(self, records: Sequence[Trajectory]) -> float:
        """J_p of whole records under their measured inputs; infinite if the twin diverges on them."""
        return self.whole.cost_of(self.whole.in_segments(batch_of(self.rested(records))))

    def rested(self, records: Sequence[Trajectory]) -> list[Trajectory]:
        """The records with hidden states of the hypothesis, of which a replay takes those at the start of segments.

        All begin where these have settled.
        """
        complete, n = [self.twin.completed(record) for record in records], len(records[0].actions)
        first = 0 if all(record.from_rest for record in records) else int(RUN_UP * n)
        return [record.part(first, n, self.twin.plant.dt) for record in complete]

    def state_dict(self) -> dict[str, Any]:
        closure = {"closure": self.twin.closure.state_dict(), "least": self.least}
        return closure | {"short": self.short.state_dict(), "whole": self.whole.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.least = state["least"]
        self.twin.closure.load_state_dict(state["closure"])
        self.short.load_state_dict(state["short"])
        self.whole.load_state_dict(state["whole"])


@torch.no_grad()
def misfit(twin: DigitalTwin, records: Sequence[Trajectory], segment: int) -> float:
    """Mean J_p with which a twin replays segments of the records; infinite if it diverges."""
    stacked = batch_of([settled(record) for record in records])
    try:
        if twin.plant.unread:  # hidden states follow from the readings of every interval
            hidden = torch.stack([twin.followed(record)[:, stacked.states.shape[-1] :] for record in records])
            stacked = stacked._replace(states=torch.cat([stacked.states, hidden], -1))
        pieces = stacked.segments(min(segment, stacked.actions.shape[1]), twin.plant.dt)
        flown = twin.replay(pieces.states[:, 0], pieces.exogenous, pieces.actions, start=pieces.start)
    except DivergenceError:
        return float("inf")
    return identification_cost(twin.plant, flown, pieces.states, pieces.seen).mean().item()


PRIOR = 0.01
"""Prior weight p_h of every addition, as a share of that of the twin alone: evidence comes before anything is added."""
SHARPNESS = 6.0
"""Exponent κ of the evidence, which stands for the number of independent samples in the records."""
LEAST = 0.1
"""Weight, as a share of the greatest one, below which a hypothesis is left out of the plan."""
HOPELESS = 1e-3
"""Weight, as a share of the greatest one, below which a hypothesis is fitted in fewer episodes."""


class EnsembleAssimilation(Assimilation):
    """Fits the twin as :class:`Assimilation` does, then every hypothesis, and weighs all of them.

    Hypotheses replay the measured inputs, because draws of the inputs hide small dynamics.

    Args:
        twin: the ensemble, whose closures and weights are updated in place. Where hypotheses have weight already, they
            are fitted from the first episode on.
        config: parameters of step 4.
        hypotheses: parameters of the hypotheses.
        always: whether the twin alone is fitted in every episode, because state feedback plans on it; otherwise it
            rests as any other hypothesis that explains nothing.
    """

    def __init__(
        self,
        twin: TwinEnsemble,
        config: AssimilationConfig,
        hypotheses: HypothesesConfig,
        *,
        always: bool = False,
    ):
        super().__init__(twin, config)
        self.ensemble, self.hypotheses = twin, hypotheses
        self.segment = max(2, twin.plant.n_steps // SHORT)
        self.fits = {name: Fit(suspect, config, self.segment) for name, suspect in twin.twins.items() if name != ALONE}
        self.always, self.turns = always, {name: Turns() for name in twin.twins}
        self.misfits: dict[str, float] = {}
        self.called = not hypotheses.call or set(twin.weights) != {ALONE}
        self._before: float | None = None

    def update(self, records: Sequence[Trajectory], draw: Callable[[], Trajectory] | None = None) -> Descended:
        """As :meth:`Assimilation.update`, and fit the hypotheses if they have been called.

        Returns:
            The result of the twin alone. Where it rests, that is its present cost, without a gradient.
        """
        believed = self.fits.get(self.ensemble.likeliest)
        self._before = None if believed is None else believed.cost(records)
        if self.turns[ALONE].due() or self.always or ALONE in self.ensemble.weights:
            descended = super().update(records, draw)
        else:
            self._records, cost = records, self.cost_of(self.in_segments(batch_of(records)))
            descended = Descended(cost, cost, math.nan, 0)
        if self.called:
            self._weigh()
        return descended

    def explain(self, difference: float) -> bool:
        """Fit the hypotheses from now on if a real episode cost other than the twin says, and no more if none helps.

        Args:
            difference: paired difference of the latest episode beyond what noise of the sensors explains.

        Returns:
            Whether they have been fitted.
        """
        wrong = difference > self.hypotheses.call or not self.hypotheses.call
        first = wrong and not self.called
        self.called = wrong or (self.called and set(self.ensemble.weights) != {ALONE})
        if first:
            self._weigh()
        return first

    def _weigh(self) -> None:
        """Fit the hypotheses to the records of the last update, and weigh them."""
        records = self._records
        self.misfits = {ALONE: misfit(self.ensemble.twins[ALONE], records, self.segment)}
        for name, fit in self.fits.items():
            if self.turns[name].due():
                self.misfits[name] = fit.update(records, self.length)
            else:
                self.misfits[name] = misfit(fit.twin, records, self.segment)
        shares = evidence(self.misfits)
        for name, turns in self.turns.items():
            turns.rest(hopeless=shares[name] < HOPELESS)
        kept = {name: share for name, share in shares.items() if share >= LEAST}
        self.ensemble.weights = {name: share / sum(kept.values()) for name, share in kept.items()}

    def report(self) -> dict[str, float | str]:
        """The weight and the misfit of every hypothesis, and what is said of the twin where a hypothesis is believed.

        ``J_p`` is then that of the likeliest hypothesis, whose name is ``believed``, over the records of the last
        update; ``J_p_before`` is that of the one that was the likeliest before, as it was then.
        """
        weights, believed = self.ensemble.weights, self.fits.get(self.ensemble.likeliest)
        metrics: dict[str, float | str] = {f"hypothesis/{name}": weights.get(name, 0.0) for name in self.ensemble.twins}
        metrics |= {f"misfit/{name}": value for name, value in self.misfits.items()}
        if self._before is not None:
            metrics["J_p_before"] = self._before
        if believed is not None and self._records:
            metrics |= {"J_p": believed.cost(self._records), "believed": self.ensemble.likeliest}
        return {**metrics, **super().report()}

    def rms_errors(self, records: Sequence[Trajectory]) -> dict[str, float]:
        """RMS errors of the likeliest hypothesis; see :meth:`Assimilation.rms_errors`."""
        fit = self.fits.get(self.ensemble.likeliest)
        return super().rms_errors(records) if fit is None else fit.whole.rms_errors(fit.rested(records))

    def uncertainty(self, records: Sequence[Trajectory]) -> Uncertainty | None:
        """Standard errors of the likeliest hypothesis; see :meth:`Assimilation.uncertainty`."""
        fit = self.fits.get(self.ensemble.likeliest)
        return super().uncertainty(records) if fit is None else fit.whole.uncertainty(fit.rested(records))

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {
            "fits": {name: fit.state_dict() for name, fit in self.fits.items()},
            "misfits": dict(self.misfits),
            "weights": dict(self.ensemble.weights),
            "called": self.called,
            "turns": {name: dataclasses.asdict(turns) for name, turns in self.turns.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        for name, fit in self.fits.items():
            fit.load_state_dict(state["fits"][name])
        self.misfits, self.ensemble.weights = dict(state["misfits"]), dict(state["weights"])
        self.called = state["called"]
        self.turns = {name: Turns(**saved) for name, saved in state["turns"].items()}


def evidence(misfits: dict[str, float]) -> dict[str, float]:
    r"""Weights :math:`w_h \propto p_h (\epsilon_{min}/\epsilon_h)^\kappa` as shares of the greatest one.

    ε is the J_p with which a hypothesis replays the records. The twin alone has all weight if none replays them.
    """
    least = min(misfits.values())
    if not least < float("inf"):
        return {name: float(name == ALONE) for name in misfits}
    tiny = 1e-300  # a misfit of zero is perfect, as is another one
    weights = {
        name: (1.0 if name == ALONE else PRIOR) * ((least + tiny) / (value + tiny)) ** SHARPNESS
        for name, value in misfits.items()
    }
    greatest = max(weights.values())
    return {name: weight / greatest for name, weight in weights.items()}
