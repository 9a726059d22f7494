"""Exploration of step 1: noise on the command of the live policy."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plant import Plant


@dataclass(frozen=True, kw_only=True)
class ExplorationConfig:
    """The noise ξ(i)·N(0, Σ_a), with Σ_a diagonal and ξ falling linearly to zero.

    Args:
        spread: standard deviation of the noise on each action, as a share of half its range, in the first episode.
        episodes: number of episodes until ξ is zero; 0 explores in none.
    """

    spread: float = 0.2
    episodes: int = 5

    def __post_init__(self):
        if self.spread < 0:
            raise ValueError(f"spread={self.spread} of the exploration must not be negative.")
        if self.episodes < 0:
            raise ValueError(f"episodes={self.episodes} of the exploration must not be negative.")

    def strength(self, episode: int) -> float:
        """ξ of an episode, counted from 0."""
        return max(0.0, 1.0 - episode / self.episodes) if self.episodes else 0.0


class LivePolicy(nn.Module):
    """What acts on the real system: the live policy, plus noise, saturated to the ranges of the actions.

    Args:
        plant: gives the ranges.
        policy: the policy that is live; assign :attr:`policy` to change it.
        spread: see :class:`ExplorationConfig`.
        generator: source of the noise.
    """

    def __init__(self, plant: Plant, policy: nn.Module, *, spread: float, generator: torch.Generator):
        super().__init__()
        low, high = (
            torch.tensor([getattr(a, b) for a in plant.actions], dtype=torch.float64, device=generator.device)
            for b in ("low", "high")
        )
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.policy, self.strength = policy, 0.0
        self._scale = 0.5 * spread * (high - low)
        self._generator = generator

    @torch.no_grad()
    def forward(self, observation: Float[Tensor, "*batch n_o"]) -> Float[Tensor, "*batch n_a"]:
        command = self.policy(observation)
        if self.strength == 0.0:
            return command
        noise = torch.randn(command.shape, generator=self._generator, dtype=command.dtype, device=command.device)
        return (command + self.strength * self._scale * noise).clamp(self.low, self.high)
