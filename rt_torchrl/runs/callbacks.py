"""What may look at a training after every episode, and end it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

Callback = Callable[[Sequence[dict[str, Any]]], str | None]
"""Function of the entries of all episodes so far, as in ``metrics.json``; it returns why the training should end, or
None to go on."""


@dataclass(frozen=True, kw_only=True)
class EarlyStopping:
    """Ends a training whose live policy has not become better for a while.

    The cost that counts is the live policy's mean J_a over the virtual episodes on the twin. An arm without a twin
    reports none, and the cost of the real episode counts. Nothing is chosen by the unseen episodes.

    Args:
        patience: number of episodes in a row without a gain, at least 1.
        least_gain: least gain that counts, as a share of the least cost so far.

    Raises:
        ValueError: if an argument is out of its range.
    """

    patience: int
    least_gain: float = 0.01

    def __post_init__(self) -> None:
        if self.patience < 1:
            raise ValueError(f"patience={self.patience} must be at least 1 episode.")
        if not 0.0 <= self.least_gain < 1.0:
            raise ValueError(f"least_gain={self.least_gain} must lie in [0, 1), such as 0.01 for one per cent.")

    def __call__(self, episodes: Sequence[dict[str, Any]]) -> str | None:
        """Why the training should end, by the entries of its episodes; None to go on."""
        least, since = float("inf"), 0
        for episode in episodes:
            cost = self.cost(episode)
            gained = cost < (1.0 - self.least_gain) * least
            least, since = (cost, 0) if gained else (least, since + 1)
        if since < self.patience:
            return None
        return f"no gain of {100.0 * self.least_gain:g} % in the last {since} episodes"

    @staticmethod
    def cost(episode: dict[str, Any]) -> float:
        """The cost of an episode that counts."""
        found = episode.get(f"J_a_{episode['live']}", episode["real_cost"])
        return float("inf") if found is None else float(found)
