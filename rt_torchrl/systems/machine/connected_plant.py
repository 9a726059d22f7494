"""A plant at the other end of a link, as an environment that keeps the plant's pace."""

import math
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDict, TensorDictBase

from rt_torchrl.plants.signal import Signal
from rt_torchrl.systems.environment import ForeignSystem
from rt_torchrl.systems.operation import Pace

FRESH = 0.5
"""Share of the period for which the client waits for a new sample after it was due."""
LOOKS = 20
"""Number of looks for a new sample in a period."""
EARLIER = 0.01
"""Share of the period by which the next look comes earlier where the sample was there at once; it keeps the phase."""
TOLERATED = 4
"""Number of late answers in a row after which a connection counts as lost."""
PATIENCE = 60.0
"""Time for which a reset waits for the plant to answer [s]."""
AGAIN = 0.05
"""Time between two attempts to connect [s]."""
LONGEST = 1e-4, 60.0
"""Least and greatest time for which a control loop may wait for an answer [s]."""


class LinkLostError(OSError):
    """The plant does not answer: the connection is lost, or an answer did not come in time."""


class LateAnswerError(LinkLostError):
    """An answer did not come in time; the connection may still be there."""


class RefusedRequestError(ValueError):
    """The plant answers, and refuses: a tag is unknown, may not be written, or does not take the value.

    Another attempt would be refused as well; tags, types or rights must be mended.
    """


@runtime_checkable
class Link(Protocol):
    """A connection to a plant's control system. A tag is a named number there.

    All methods but ``connect`` answer within a fraction of the control period, or raise. A tag that the control system
    marks as not good is NaN.

    Attributes:
        quality: a text for each tag of the last reading that is not good.
    """

    quality: Mapping[str, str]

    def connect(self) -> None:
        """Connect, or connect again.

        Raises:
            LinkLostError: if the plant does not answer.
            RefusedRequestError: if a tag is unknown there, or cannot take a number.
        """

    def read(self) -> dict[str, float]:
        """All tags that are read, by name, in one request.

        Raises:
            LinkLostError: if the plant does not answer in time.
            RefusedRequestError: if it refuses.
        """

    def write(self, values: Mapping[str, float]) -> None:
        """Write tags, in one request.

        Raises:
            LinkLostError: if the plant does not answer in time.
            RefusedRequestError: if it refuses a value.
        """

    def close(self) -> None:
        """Close the connection, if there is one."""


class ConnectedPlant(ForeignSystem):
    """An environment around a :class:`Link`: it writes commands, waits for the next sample, and reads.

    The plant's clock is the master: where a tag counts samples, the client follows it, and a reading that is no newer
    than the last one is not passed on as a new one. Where a reading does not come in time, because the connection is
    lost or the plant has stopped, the entries are NaN until the plant answers again. A safety layer in front of this
    environment then marks them, and asks for its fallback. The entries are NaN as well after an interval whose command
    did not get through, because nobody knows what acted in it; a tag that the plant marks as not good is NaN alone. A
    request that the plant refuses is an error. The entry ``skipped`` is the number of samples between this reading and
    the last one that nobody read; where it is not zero, a transition is longer than one interval.

    The plant must have a watchdog of its own, which brings its safe action when commands stay out. A thread connects
    again, so that the pace is kept.

    The attribute ``losses`` counts lost connections; ``reasons`` says why tags of the last reading are NaN.

    Args:
        link: connection to the plant.
        entries: tags behind each entry of the environment, in the order of its components.
        commands: tags of the commands, one for each action.
        actions: signals of the actions; their ranges become those of the environment's action.
        period: control period of the plant [s].
        sample: tag that counts the samples; None if the plant has none, and then the client's own clock counts.
        answered: tag that takes the number of the sample that a command answers; None if the plant has none.

    Raises:
        ValueError: if there are no entries, or not one command for each action, or a time is not positive, or a number
            is to be answered that nobody counts; in a reset, if the plant does not answer.
        RefusedRequestError: in a reset or a step, if the plant refuses a request.
    """

    def __init__(
        self,
        link: Link,
        entries: Mapping[str, Sequence[str]],
        commands: Sequence[str],
        actions: Sequence[Signal],
        *,
        period: float,
        sample: str | None = None,
        answered: str | None = None,
    ):
        if not entries or not actions or len(commands) != len(actions):
            raise ValueError(
                f"entries={list(entries)} must not be empty, and commands={list(commands)} must be one tag for each of "
                f"the actions {[action.name for action in actions]}."
            )
        if answered is not None and sample is None:
            raise ValueError(f"answered={answered!r} takes the number of a sample; name the tag that counts, sample.")
        super().__init__({key: len(tags) for key, tags in entries.items()} | {"skipped": 1}, actions)
        self.link, self.pace = link, Pace(period)
        self._entries_of = {key: tuple(tags) for key, tags in entries.items()}
        self._commands, self._sample_tag, self._answered = tuple(commands), sample, answered
        self.reads_applied = "applied" in entries
        """Whether the entry ``applied`` is what the plant has applied, also at a reset."""
        self.losses = self._in_a_row = self._gap = 0
        self._sample, self._connected, self._closing = -math.inf, False, False
        self.reasons: dict[str, str] = {}
        self._lost = "no new sample"  # why the last request failed
        self._connecting: Future[None] | None = None  # attempts to connect again, beside the control loop

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        """Connect, if there is no connection, and wait for a sample."""
        until = self.pace.clock() + PATIENCE
        while self.pace.clock() < until:
            try:
                if not self._up() and self._connecting is None:
                    self.link.connect()
                    self._connected = True
                self.pace.begin()
                reading = self._fresh() if self._connected else None
                if reading is not None:
                    self._gap = 0  # no transition ends with the first reading
                    return self._entries(reading)
            except LinkLostError as lost:
                self._connected, self._lost = False, str(lost)
            self.pace.sleep(min(AGAIN, self.pace.period))
        raise ValueError(f"the plant has not answered for {PATIENCE:g} s: {self._lost}")

    def _up(self) -> bool:
        """Whether there is a connection; what has ended the attempts to connect again is raised here."""
        if self._connecting is not None and self._connecting.done():
            connecting, self._connecting = self._connecting, None
            connecting.result()
            self._connected = True
        return self._connected

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        values = dict(zip(self._commands, tensordict["action"].reshape(-1).tolist(), strict=True))
        if self._answered is not None:
            values[self._answered] = self._sample
        through = self._up()
        try:
            if through:
                self.link.write(values)
        except LinkLostError as error:
            through = False
            self._lose(error)
        self.pace.wait()
        reading = self._fresh() if self._connected else None
        if not through:
            reading, self.reasons = None, {"commands": f"not written: {self._lost}"}
        return self._stepped(self._entries(reading))

    def _fresh(self) -> dict[str, float] | None:
        """A reading newer than the last one; None if none comes in time."""
        until, looks = self.pace.clock() + FRESH * self.pace.period, 0
        try:
            while True:
                reading = self.link.read()
                if self._sample_tag is None:
                    self._in_a_row = 0
                    return reading
                sample = reading[self._sample_tag]
                if math.isfinite(sample) and sample != self._sample:
                    break
                looks += 1
                if self.pace.clock() >= until:
                    why = self.link.quality.get(self._sample_tag, "it was read before")
                    self.reasons = {"all tags": f"{self._sample_tag} = {sample:.0f} is no new sample: {why}"}
                    return None
                self.pace.sleep(self.pace.period / LOOKS)
        except LinkLostError as error:
            self._lose(error)
            self.reasons = {"all tags": self._lost}
            return None
        # Keep the phase of the plant's clock: be there when the sample comes, and not long after it.
        self.pace.shift(-EARLIER * self.pace.period if looks == 0 else None)
        gap = sample - self._sample - 1.0
        self._gap = int(gap) if 0.0 < gap < math.inf else 0
        self._sample, self._in_a_row = sample, 0
        return reading

    def _entries(self, reading: dict[str, float] | None) -> TensorDict:
        if reading is not None:
            self.reasons = dict(self.link.quality)
        numbers = {
            key: [math.nan if reading is None else reading[tag] for tag in tags]
            for key, tags in self._entries_of.items()
        }
        numbers["skipped"], self._gap = [float(self._gap)], 0
        entries = {key: torch.tensor(values, dtype=torch.float64) for key, values in numbers.items()}
        return TensorDict(entries, batch_size=self.batch_size)

    def _lose(self, error: LinkLostError) -> None:
        """Note a late answer, or a lost connection, and then connect again beside the control loop."""
        self._lost = str(error)
        if isinstance(error, LateAnswerError):
            self._in_a_row += 1
            if self._in_a_row < TOLERATED:
                return
        self._in_a_row = 0
        self.losses += 1
        self._connected, self._connecting = False, Future()
        threading.Thread(target=self._connect, args=(self._connecting,), daemon=True).start()

    def _connect(self, done: "Future[None]") -> None:
        """Try until there is a connection, or the plant refuses, or the link fails otherwise."""
        try:
            while not self._closing:
                try:
                    self.link.connect()
                    break
                except LinkLostError as error:
                    self._lost = str(error)
                    time.sleep(AGAIN)
            done.set_result(None)
        except Exception as error:  # the control loop raises it
            done.set_exception(error)

    def close(self, **kwargs: Any) -> None:
        """Close the connection; the plant's own watchdog then brings its safe action."""
        self._closing = True
        if self._connecting is not None:
            self._connecting.exception()  # waits
        self.link.close()
        self._connected, self._connecting = False, None
        super().close(**kwargs)
