"""In which episodes a hypothesis is fitted."""

from typing import Any

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
