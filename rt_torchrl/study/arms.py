"""Arms on systems that the twin knows and on others: what they cost, what learning has paid, and when alarms rose."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from rt_torchrl.study.results import Entry, arm_entry
from rt_torchrl.study.training import Training

MATTERS = 0.1
"""Gap over the oracle from which an alarm is missed if it does not rise."""
SETTLED = 5
"""Number of first episodes in which no alarm is missed."""
NO_WORTH = 0.02
"""Share of a cost or of a sum of costs below which a part that is switched off changes nothing."""


@dataclass(frozen=True, kw_only=True)
class Arm:
    """An arm on one system.

    Args:
        entry: costs of the live policy on the unseen episodes, and after each real episode.
        paid: J_a of every real episode, with that of the start, for each seed; empty for a yardstick.
        alarms: whether the alarm was up after each real episode, for each seed; empty for an arm without a twin.
        wrong: whether each real episode cost over a tenth other than the twin says of it; empty without a twin.
    """

    entry: Entry
    paid: list[list[float]] = field(default_factory=list)
    alarms: list[list[bool]] = field(default_factory=list)
    wrong: list[list[bool]] = field(default_factory=list)

    @property
    def name(self) -> str:
        return self.entry.name

    def median(self) -> float:
        """Median over the seeds of the mean cost on the unseen episodes."""
        return float(np.median(self.entry.costs.mean(1)))

    def regret(self, oracle: float) -> Float[np.ndarray, "seeds episodes"]:
        """Sum of the real costs so far less that of as many episodes of the oracle, up to the shortest training.

        Args:
            oracle: mean J_a of the oracle.
        """
        count = min(map(len, self.paid))
        return np.cumsum(np.array([costs[:count] for costs in self.paid]) - oracle, 1)

    def sums(self) -> list[float]:
        """Sum of the real costs of each seed."""
        return [sum(costs) for costs in self.paid]


@dataclass(frozen=True)
class AlarmCount:
    """Alarms counted over episodes.

    Args:
        episodes: number of episodes in which an alarm could be false, or missed.
        wrong: number of those in which it was.
    """

    episodes: int
    wrong: int

    def __add__(self, other: "AlarmCount") -> "AlarmCount":
        return AlarmCount(self.episodes + other.episodes, self.wrong + other.wrong)

    def words(self) -> str:
        """The count with its share."""
        if not self.episodes:
            return "none could be"
        return f"{self.wrong} of {self.episodes} ({100.0 * self.wrong / self.episodes:.1f} %)"


def false_alarms(arm: Arm) -> AlarmCount:
    """Alarms on a system as its twin knows it, all of which are false."""
    raised = [up for seed in arm.alarms for up in seed]
    return AlarmCount(len(raised), sum(raised))


def missed_alarms(arm: Arm, oracle: float) -> AlarmCount:
    """Episodes after the first ones whose policy costs at least a tenth more than the oracle, without an alarm.

    Args:
        arm: arm on a system that its twin does not know.
        oracle: mean J_a of the oracle on the same unseen episodes.
    """
    return _unsaid(arm, oracle)


def missed_errors(arm: Arm, oracle: float) -> AlarmCount:
    """As :func:`missed_alarms`, of the episodes alone in which the twin is wrong about the policy, too.

    A plan may end in a poor minimum, about which the twin is right.
    """
    return _unsaid(arm, oracle, among=arm.wrong)


def _unsaid(arm: Arm, oracle: float, *, among: list[list[bool]] | None = None) -> AlarmCount:
    """Episodes after the first ones whose policy costs at least a tenth more than the oracle, without an alarm."""
    counted = [[True] * len(seed) for seed in arm.alarms] if among is None else among
    silent = [
        not up
        for each in zip(arm.entry.curves, arm.alarms, counted, strict=True)
        for cost, up, counts in list(zip(*each, strict=False))[SETTLED:]
        if counts and cost >= (1.0 + MATTERS) * oracle
    ]
    return AlarmCount(len(silent), sum(silent))


def trained_arm(name: str, trainings: Sequence[Training]) -> Arm:
    """An arm from its trainings, one for each seed."""
    found = [training.metrics()["episodes"] for training in trainings]
    paid = [[one[key] for one in seed for key in ("start_cost", "real_cost") if key in one] for seed in found]
    watched = all("alarm" in one for seed in found for one in seed)
    alarms = [[bool(one["alarm"]) for one in seed] for seed in found] if watched else []
    differences = [[one.get("paired_difference", 0.0) for one in seed] for seed in found] if watched else []
    wrong = [[abs(d) > MATTERS for d in seed] for seed in differences]
    entry = arm_entry(name, list(trainings))
    return Arm(entry=entry, paid=paid, alarms=alarms, wrong=wrong)


def classical_arms(training: Training) -> list[Arm]:
    """The classical controllers that a training has flown on its unseen episodes."""
    unseen = training.metrics()["summary"]["unseen"]
    return [
        Arm(
            entry=Entry(
                name=name,
                costs=np.array([unseen["costs"][name]], dtype=float),
                merit={quantity: float(value["mean"]) for quantity, value in found["merit"].items()},
            )
        )
        for name, found in unseen["baselines"].items()
    ]


@dataclass(frozen=True, kw_only=True)
class SystemResult:
    """All arms on one real system.

    Args:
        case: name of the plant, with its task.
        system: names of what the real system has beside its twin; empty for what the twin knows.
        oracle: the best policy of the class on the true system.
        arms: arms and classical controllers.
    """

    case: str
    system: str
    oracle: Entry
    arms: list[Arm]

    @property
    def title(self) -> str:
        return f"{self.case}, {self.system or 'as the twin'}"

    @property
    def least(self) -> float:
        """The least cost that was found: a descent of the oracle may end in a poor minimum."""
        judged = [arm.entry for arm in self.arms if arm.paid and arm.entry.costs.shape[1] == self.oracle.costs.shape[1]]
        return min([self.oracle.mean, *(float(entry.costs.mean(1).min()) for entry in judged)])

    def arm(self, name: str) -> Arm | None:
        """The arm of a name, if it was trained here."""
        return next((arm for arm in self.arms if arm.name == name), None)
