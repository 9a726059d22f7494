"""The tags of a served plant."""

from dataclasses import dataclass

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

SAMPLE, SAFE, MISSED, ANSWERED = "sample", "safe", "missed", "answered"
"""Tags beside signals: number of the sample; whether the safe action acts; number of intervals without a valid command
so far; and, written by the client, the number of the sample that its commands answer."""


@dataclass(frozen=True)
class Tags:
    """The names of the tags of a plant: its signals, with their kind in front, and those that guard the connection.

    ====================  ==========================================================================================
    tag                   meaning
    ====================  ==========================================================================================
    ``sample``            number of the sample; it counts up at the beginning of every control interval
    ``safe``              1 while the plant's own watchdog holds the safe action, because no valid command came
    ``missed``            number of control intervals without a valid command so far
    ``state.NAME``        a state as its sensor reads it, at the beginning of the interval
    ``input.NAME``        a measured exogenous input of the interval
    ``applied.NAME``      the action that was applied in the interval before
    ``answered``          written by the client: the number of the sample that its commands answer
    ``command.NAME``      written by the client: the command to an actuator
    ====================  ==========================================================================================

    Attributes:
        states, inputs, actions: signals of the plant.
    """

    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    actions: tuple[Signal, ...]

    @classmethod
    def of(cls, plant: Plant) -> "Tags":
        """The tags of a plant."""
        return cls(plant.readings, plant.inputs, plant.actions)

    @property
    def entries(self) -> dict[str, tuple[str, ...]]:
        """The tags behind each vector that a client reads."""
        kinds = {"state": self.states, "exogenous": self.inputs, "applied": self.actions}
        prefix = {"state": "state", "exogenous": "input", "applied": "applied"}
        return {key: tuple(f"{prefix[key]}.{one.name}" for one in signals) for key, signals in kinds.items()}

    @property
    def commands(self) -> tuple[str, ...]:
        """The tags of the commands."""
        return tuple(f"command.{signal.name}" for signal in self.actions)

    @property
    def read(self) -> tuple[str, ...]:
        """All tags that a client reads."""
        return (SAMPLE, SAFE, MISSED, *(tag for tags in self.entries.values() for tag in tags))

    @property
    def written(self) -> tuple[str, ...]:
        """All tags that a client writes; the commands before the number that makes them valid."""
        return (*self.commands, ANSWERED)
