"""The latest real episodes, and the transitions between decisions that critics learn from."""

import math
from collections import deque
from typing import Any

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from rt_torchrl.plants.increments import Increments
from rt_torchrl.twinning.learners.innovations import Innovations, inputs_within

SEEN = ("observation", "state", "exogenous")
"""Entries of an episode that the critics see."""
LEAST_SPREAD = 1e-6
"""Least standard deviation of a feature as a share of its mean; one that varies less is constant."""
LEAST_COST = 1e-12
"""Least mean |reward| that can scale rewards."""
PLACES = 4
"""Number of transitions that begin within a decision, if it has as many control intervals."""


class EpisodeMemory:
    r"""Whole real episodes, from which transitions of decisions are made.

    A decision lasts m control intervals; its action is the mean of those applied. The transition after n decisions is

    .. math:: \Big(x_k, u_k, \sum_{j<nm}\gamma^jr_{k+j}, \gamma^{nm}, x_{k+nm}\Big)

    The features x are observation, state and exogenous input, scaled by their mean and standard deviation over the
    memory. The last nm intervals of an episode begin no transition, because critics bootstrap through its end.

    An episode that ends early has N intervals, after which each one costs L_e for ever. Its last intervals begin
    transitions, too: where k + nm ≥ N, the sum goes on to infinity, and the discount of what follows is zero. The
    action is then the mean of those applied before the end.

    Args:
        capacity: number of episodes that are kept.
        increments: scales of the actions.
        intervals: number m of control intervals of a decision.
        discount: discount factor γ per control interval.
        horizon: number of control intervals of an episode that does not end early.
        end_cost: cost L_e of an interval after an early end; None if no episode ends early.
    """

    def __init__(
        self,
        capacity: int,
        increments: Increments,
        *,
        intervals: int,
        discount: float,
        horizon: int,
        end_cost: float | None = None,
    ):
        self.increments, self.intervals, self.discount = increments, intervals, discount
        self.horizon, self.end_cost = horizon, end_cost
        self.episodes: deque[TensorDict] = deque(maxlen=capacity)

    def __len__(self) -> int:
        return len(self.episodes)

    def store(self, episode: TensorDictBase) -> None:
        """Keep an episode of n_t control intervals."""
        kept = episode.select(*SEEN, "action").clone()
        kept["reward"] = episode["next", "reward"].clone()
        if self.end_cost is not None:
            kept["over"] = episode["next", "terminated"].clone()
        self.episodes.append(kept)

    def over(self, episode: TensorDictBase) -> bool:
        """Whether an episode ended early."""
        return self.end_cost is not None and bool(episode["over"][-1].any())

    def cost(self) -> float:
        """The least mean |reward| of an episode up to its horizon, in units of which the critics see rewards."""
        return max(LEAST_COST, min(self._mean_cost(episode) for episode in self.episodes))

    def _mean_cost(self, episode: TensorDict) -> float:
        costs = episode["reward"].abs()
        if not self.over(episode):
            return costs.mean().item()
        rest = self.horizon - len(costs)
        return (costs.sum().item() + rest * abs(self.end_cost or 0.0)) / self.horizon

    def end_value(self) -> float:
        r"""The value of a state in which an episode has ended, :math:`-L_e/(1 - \gamma)`; 0 if none ends early."""
        return -(self.end_cost or 0.0) / (1.0 - self.discount)

    def statistics(self) -> tuple[Float[Tensor, " n_x"], Float[Tensor, " n_x"]]:
        """Mean and standard deviation of the features in all episodes; 1 for the latter of a constant."""
        seen = torch.cat([features(episode) for episode in self.episodes])
        mean, spread = seen.mean(0), seen.std(0)
        return mean, torch.where(spread > LEAST_SPREAD * (LEAST_SPREAD + mean.abs()), spread, 1.0)

    def transitions(self, decisions: int, *, recent: int, reward_scale: float) -> list[TensorDict]:
        """Transitions of each episode, oldest first, with the control intervals ``place`` at which they begin.

        Args:
            decisions: number n of decisions of a transition.
            recent: number of latest episodes with such transitions; those of the others are of one decision.
            reward_scale: factor on the rewards.

        Raises:
            ValueError: if a transition is longer than an episode.
        """
        first, scales = len(self.episodes) - recent, self.statistics()
        law = self.innovations(scales)
        return [
            self._transitions(episode, decisions if k >= first else 1, scales, law, reward_scale)
            for k, episode in enumerate(self.episodes)
        ]

    def innovations(self, scales: tuple[Tensor, Tensor]) -> Innovations:
        """The law by which features foretell the inputs within a decision, from all episodes."""
        places = [self.inner_places(episode, self.intervals) for episode in self.episodes]
        parts = list(zip(self.episodes, places, strict=True))
        starts = torch.cat([self._scaled_features(episode, at, scales) for episode, at in parts])
        return Innovations(starts, torch.cat([inputs_within(episode, at, self.intervals) for episode, at in parts]))

    def places(self, episode: TensorDictBase, intervals: int) -> Tensor:
        """Control intervals at which transitions begin that last so many intervals, or up to an early end.

        Raises:
            ValueError: if there are none.
        """
        if self.over(episode):
            return torch.arange(0, len(episode), self._stride, device=episode["reward"].device)
        if intervals >= len(episode):
            raise ValueError(
                f"{intervals} control intervals of a transition do not fit into an episode of {len(episode)}; lower "
                "return_steps or the discount, or use a longer horizon."
            )
        return self.inner_places(episode, intervals)

    def inner_places(self, episode: TensorDictBase, intervals: int) -> Tensor:
        """Those of them after which the episode goes on for so many intervals; there may be none."""
        last = max(0, len(episode) - intervals)
        return torch.arange(0, last, self._stride, device=episode["reward"].device)

    @property
    def _stride(self) -> int:
        return max(1, self.intervals // PLACES)

    def _transitions(
        self,
        episode: TensorDict,
        decisions: int,
        scales: tuple[Tensor, Tensor],
        law: Innovations,
        reward_scale: float,
    ) -> TensorDict:
        n = decisions * self.intervals
        at = self.places(episode, n)
        after = (at + n).clamp(max=len(episode) - 1)  # beyond an early end, what is seen then counts for nothing
        now, then = self.situation(episode, at, scales), self.situation(episode, after, scales)
        rewards = episode["reward"].squeeze(-1)
        if self.over(episode):
            rewards = torch.cat([rewards, rewards.new_full((n,), -(self.end_cost or 0.0))])
        sums, discount = self.closed(windows(rewards, self.discounts(n))[at], at + n >= len(episode), n)
        then["reward"], then["discount"] = reward_scale * sums.unsqueeze(-1), discount.unsqueeze(-1)
        now["action"] = self.taken(episode, at)
        now["innovation"] = law(now["features"], inputs_within(episode, at, self.intervals))
        return TensorDict(now | {"next": then, "place": at}, batch_size=len(at), device=at.device)

    def closed(
        self, sums: Float[Tensor, " b"], over: Bool[Tensor, " b"], n: int
    ) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
        """Sums of n rewards with the value of the end, and the discount of what follows.

        Args:
            sums: discounted sums of n rewards.
            over: whether the episode has ended by then; nothing follows, but each interval costs L_e for ever.
            n: number of control intervals.
        """
        ended, discount = over.to(sums.dtype), self.discount**n
        return sums + discount * self.end_value() * ended, discount * (1.0 - ended)

    def situation(self, episode: TensorDict, at: Tensor, scales: tuple[Tensor, Tensor]) -> dict[str, Any]:
        """What policy and critics need of some control intervals: observation, centre of the increments, features."""
        seen = {"observation": episode["observation"][at], "centre": self.increments.centre(episode["state"][at])}
        return seen | {"features": self._scaled_features(episode, at, scales)}

    def _scaled_features(
        self, episode: TensorDict, at: Tensor, scales: tuple[Tensor, Tensor]
    ) -> Float[Tensor, "n n_x"]:
        mean, spread = scales
        return (features(episode)[at] - mean) / spread

    def taken(self, episode: TensorDict, at: Tensor) -> Float[Tensor, "n n_a"]:
        """Increments of the decisions that begin at some control intervals."""
        m = self.intervals
        share = episode["reward"].new_full((m,), 1.0 / m)
        applied = episode["action"]
        if self.over(episode):  # the last decisions have fewer intervals
            applied = torch.cat([applied, torch.zeros_like(applied[:1]).expand(m, -1)])
        action = torch.stack([windows(part, share)[at] for part in applied.unbind(-1)], -1)
        action = action * m / (len(episode) - at).clamp(max=m).to(action.dtype).unsqueeze(-1)
        return self.increments.scaled(self.increments.centre(episode["state"][at]), action).clamp(-1.0, 1.0)

    def discounts(self, n: int) -> Float[Tensor, " {n}"]:
        """Discounts of n control intervals in a row."""
        return self.discount ** torch.arange(n, dtype=torch.float64, device=self.increments.low.device)

    def observations(self) -> Float[Tensor, "n n_o"]:
        """Observations of all episodes."""
        return torch.cat([episode["observation"] for episode in self.episodes])

    def state_dict(self) -> dict[str, Any]:
        return {"episodes": [episode.to_dict() for episode in self.episodes]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        device = self.increments.low.device
        saved = [TensorDict(each, batch_size=len(each["reward"]), device=device) for each in state["episodes"]]
        self.episodes.clear()
        self.episodes.extend(saved)


def features(episode: TensorDictBase) -> Float[Tensor, "n n_x"]:
    """What the critics see, before it is scaled: observation, state and exogenous input."""
    return torch.cat([episode[key] for key in SEEN], -1)


def windows(values: Float[Tensor, " n"], weights: Float[Tensor, " m"]) -> Float[Tensor, " n_windows"]:
    """Weighted sums of m values in a row, from every place on that has as many."""
    return torch.nn.functional.conv1d(values.view(1, 1, -1), weights.view(1, 1, -1)).view(-1)


def decision_intervals(discount: float, decisions: int) -> int:
    """The number m of control intervals of a decision, of which ``decisions`` last 1/(1 − γ); at least 1."""
    return max(1, math.floor(1.0 / ((1.0 - discount) * decisions) + 0.5))
