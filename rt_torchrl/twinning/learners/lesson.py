"""The transitions of one update of incremental TD3, and the draws of its batches."""

from typing import TYPE_CHECKING, cast

import torch
from jaxtyping import Float, Int
from tensordict import TensorDict
from torch import Tensor

from rt_torchrl.trajectories.rollout import DivergenceError

if TYPE_CHECKING:
    from rt_torchrl.twinning.learners.incremental_td3 import IncrementalTD3


class Lesson:
    """Transitions of all real episodes, oldest first, and then those of the twin.

    ``data`` holds their weight in the loss, 1 or the trust in the twin, and ``virtual``, which tags those of the twin.
    With slopes it also holds ``slope``, and ``slope_weight``, the trust where the twin gives a slope and else zero.
    ``refused`` says what a twin that diverges does not teach, and why.

    Args:
        learner: learner that is to be updated.
        reward_scale: factor on the rewards.

    Raises:
        ValueError: if the twin is trusted and there is none.
    """

    def __init__(self, learner: "IncrementalTD3", reward_scale: float):
        own, memory = learner.config.incremental, learner.memory
        self.generator, self.size, self.refused = learner.generator, learner.batch_size, list[str]()
        episodes: list[TensorDict] = memory.transitions(
            learner.decisions, recent=own.return_episodes, reward_scale=reward_scale
        )
        for part in episodes:
            part["weight"] = torch.ones_like(part["next", "reward"])
            part["virtual"] = torch.zeros_like(part["weight"], dtype=torch.bool)
        self._real, self._latest = sum(map(len, episodes)), sum(map(len, episodes[-own.actor_episodes :]))
        self._slopes = learner.trust > 0.0 and own.slopes
        if learner.trust > 0.0:
            self._teach(learner, episodes, reward_scale)
        self.data = cast(TensorDict, torch.cat(episodes))
        self._n_a = len(learner.increments.low)

    def _teach(self, learner: "IncrementalTD3", parts: list[TensorDict], reward_scale: float) -> None:
        own, teacher, memory = learner.config.incremental, learner.teacher(), learner.memory
        if own.virtual:
            try:
                found = teacher.transitions(
                    own.virtual, learner.decisions, reward_scale=reward_scale, generator=learner.generator
                )
                if found is not None:
                    found["weight"] = torch.full_like(found["next", "reward"], learner.trust)
                    found["virtual"] = torch.ones_like(found["weight"], dtype=torch.bool)
                    parts.append(found)
            except DivergenceError as error:
                self.refused.append(f"no virtual transitions: {error}")
        if not own.slopes:
            return
        for part in parts:
            part["slope"], part["slope_weight"] = torch.zeros_like(part["action"]), torch.zeros_like(part["weight"])
        first = max(0, len(memory) - own.actor_episodes)
        for part, episode in zip(parts[first : len(memory)], list(memory.episodes)[first:], strict=True):
            try:
                slope = teacher.decision_slopes(episode, part["place"], reward_scale)
            except DivergenceError as error:
                self.refused.append(f"no slopes: {error}")
                continue
            if slope.isfinite().all():
                part["slope"], part["slope_weight"] = slope, torch.full_like(part["weight"], learner.trust)
            else:
                self.refused.append("no slopes: the twin's adjoint grows beyond all numbers along a real episode")

    def draw(self) -> Int[Tensor, " n"]:
        """Places of a batch for the critics, half of them virtual if there are virtual transitions."""
        if len(self.data) == self._real:
            return self._between(0, self._real, self.size)
        half = self.size // 2
        real = self._between(0, self._real, self.size - half)
        return torch.cat([real, self._between(self._real, len(self.data), half)])

    def draw_latest(self) -> Int[Tensor, " n"]:
        """Places of a batch for the policy, in the latest real episodes."""
        return self._between(self._real - self._latest, self._real, self.size)

    def latest(self) -> TensorDict:
        """Transitions of the latest real episodes."""
        return self.data[self._real - self._latest : self._real]

    def directions(self) -> Float[Tensor, "n n_a"] | None:
        """Directions of the actions along which slopes are compared, forwards or backwards; None without slopes."""
        if not self._slopes:
            return None
        shape, device = (self.size, self._n_a), self.generator.device
        sign = torch.randint(0, 2, shape, generator=self.generator, device=device)
        return 2.0 * sign.double() - 1.0

    def _between(self, first: int, last: int, count: int) -> Int[Tensor, " n"]:
        return torch.randint(first, last, (count,), generator=self.generator, device=self.generator.device)
