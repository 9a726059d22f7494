"""The fit of one hypothesis to records, over segments that begin with what sensors read, and what it leaves over.

The hidden states of a hypothesis, which no sensor reads, go on through all segments: they follow from what the sensors
have read before.
"""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.interruption import safe_point
from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant, Transition
from rt_torchrl.plants.signal import Signal
from rt_torchrl.plants.vector_field import ResidualRates
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.steps.config import AssimilationConfig
from rt_torchrl.trajectories.engines.interval import Drive, Interval
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.rollout import DivergenceError, drive_of, require_finite
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin

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
LONGEST_PAUSE = 8
"""Greatest number of episodes between two fits of a hopeless hypothesis."""


class Turns:
    """A hypothesis that explains nothing is fitted in ever fewer episodes, any other one in all.

    Attributes:
        waiting: number of episodes until the next fit; negative in an episode in which it is due.
        pause: number of episodes to wait after the next fit, if the hypothesis is hopeless then, too.
    """

    def __init__(self) -> None:
        self.waiting, self.pause = 0, 1

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

    def state_dict(self) -> dict[str, int]:
        return {"waiting": self.waiting, "pause": self.pause}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.waiting, self.pause = state["waiting"], state["pause"]


class Reread(Extension):
    """A plant whose further inputs hold readings, and whether an interval begins with them.

    Over segments that begin with readings, the states are nearly linear in the weights. The hidden states go on from
    one segment to the next, so that all segments show the weights on which the hidden states depend.

    Args:
        base: the plant.
    """

    def __init__(self, base: Plant):
        super().__init__(base, [])
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
        met, read, flag = exogenous.split([self._met, self._read, 1], -1)
        own, hidden = state[..., : self._read], state[..., self._read :]
        known = torch.where(flag + torch.zeros_like(own) > 0.5, read + torch.zeros_like(own), own)
        return self.base.step(t, torch.cat([known, hidden], -1), command, met, closure)


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
    return at_rest(record, plant)._replace(exogenous=torch.cat([record.exogenous, read, flag], -1))


def at_rest(record: Trajectory, plant: Plant) -> Trajectory:
    """A record with the hidden states of a plant at rest, of which a replay takes those of the start."""
    return record._replace(states=plant.at_rest(record.states))


class ReadInterval(Interval):
    """One control interval that begins with the states that sensors read; the drive's command holds (a, s)."""

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """The state at the end of the interval."""
        action, read = drive.command.split((len(self.plant.actions), len(self.plant.readings)), -1)
        known = torch.cat([read, state[..., read.shape[-1] :]], -1)
        return self.plant.step(drive.t, known, action, drive.exogenous, self.closure).state


_intervals: "WeakKeyDictionary[DigitalTwin, ReadInterval]" = WeakKeyDictionary()
"""The interval of each twin. The engine compares what is new to it with all that it knows, which takes milliseconds."""


@torch.no_grad()
def with_hidden_states(twin: DigitalTwin, record: Trajectory) -> Trajectory:
    """The record with the hidden states of a twin's plant, which follow from the readings of every interval.

    The hidden states are at rest at the start. Errors of the twin do not build up in them, because every interval
    begins with what was read.

    Raises:
        DivergenceError: if the hidden states diverge all the same.
    """
    plant, read = twin.plant, record.states
    start = plant.at_rest(read[:1])
    if start.shape[-1] == read.shape[-1]:
        return record
    drive = drive_of(plant, record.exogenous[None], torch.cat([record.actions, read[:-1]], -1)[None])
    interval = _intervals.get(twin)
    if interval is None or interval.plant is not plant or interval.closure is not twin.closure:
        interval = _intervals[twin] = ReadInterval(plant, twin.closure, None)
    ends = Native(compiled=False).end_states(interval, start, drive)[:, 0]
    require_finite(plant, ends.unsqueeze(1), start, [twin.closure])
    states = torch.cat([start, ends])
    return record._replace(states=torch.cat([read, states[:, read.shape[-1] :]], -1))


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
        measured = dataclasses.replace(config, inputs="record", segment=config.segment or 0)
        short = dataclasses.replace(
            measured,
            method="levenberg_marquardt",
            initial="measured",
            segment=0,
            stop_below=0.0,
            iterations=STEPS,
        )
        self.short = Assimilation(twin.of(Reread(twin.plant)), short)
        self.whole = Assimilation(twin, measured)
        self.least, self.turns = math.inf, Turns()
        self._first = copy.deepcopy(twin.closure.state_dict())
        self._held = not config.prior and any(isinstance(m, ResidualRates) for m in twin.closure.modules())

    def update(self, records: Sequence[Trajectory], generator: torch.Generator, length: int = 0) -> float:
        """Fit the records: by both stages in turn the first time, by steps over segments from then on.

        Where these have not arrived, and much more is left over than the last time, the fit also begins anew from the
        first weights: those of the last episode may explode on these records, and no step leads back from there.

        Args:
            records: the records.
            generator: source of random numbers.
            length: number of control intervals of the segments in the place of whole records, which a twin of an
                unstable system leaves; 0 for whole records.

        Returns:
            The misfit of the best weights, which the closure has then.
        """
        first, self.whole.length = math.isinf(self.least), length
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
        taken = {
            "short": (self.short, [reread(record, plant, self.segment) for record in records]),
            "whole": (self.whole, self.rested(records)),
        }
        arrived = False
        for name in stages:
            safe_point()
            steps = STEPS
            # A twin that diverges on the way only loses the stage.
            with contextlib.suppress(FloatingPointError):
                stage, given = taken[name]
                steps = stage.update(given, (), 1, generator).iterations
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
        if self._held and math.isfinite(least):
            self.short.prior.stiffness = self.whole.prior.stiffness = HELD * least

    def cost(self, records: Sequence[Trajectory]) -> float:
        """J_p of whole records under their measured inputs; infinite if the twin diverges on them."""
        return self.whole.cost_of(self.whole.in_segments(batch_of(self.rested(records))))

    def rested(self, records: Sequence[Trajectory]) -> list[Trajectory]:
        """The records with the hidden states of the hypothesis at rest."""
        return [at_rest(record, self.twin.plant) for record in records]

    def state_dict(self) -> dict[str, Any]:
        counters = {"least": self.least, **self.turns.state_dict()}
        stages = {"short": self.short.state_dict(), "whole": self.whole.state_dict()}
        return counters | {"closure": self.twin.closure.state_dict(), "first": self._first, **stages}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.least, self._first = state["least"], state["first"]
        self.turns.load_state_dict(state)
        self.twin.closure.load_state_dict(state["closure"])
        self.short.load_state_dict(state["short"])
        self.whole.load_state_dict(state["whole"])


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
