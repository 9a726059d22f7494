"""The short-term memory D_S: the real episodes that the twin is trained on."""

from collections import deque
from typing import Any

from rt_torchrl.trajectories.trajectory import Trajectory


class ShortTermMemory(deque[Trajectory]):
    """The records of the last ``capacity`` real episodes, oldest first."""

    def __init__(self, capacity: int):
        if capacity < 1:
            raise ValueError(f"capacity={capacity} of the short-term memory (n_S) must be at least 1.")
        super().__init__(maxlen=capacity)

    def whole(self, n_steps: int, *, latest: int = 0) -> bool:
        """Whether the latest records, or all with 0, are those of whole episodes of ``n_steps`` control intervals."""
        return all(len(record.actions) == n_steps for record in list(self)[-latest:])

    def state_dict(self) -> dict[str, Any]:
        return {"records": [record._asdict() for record in self]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.clear()
        self.extend(Trajectory(**record) for record in state["records"])
