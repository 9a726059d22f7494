"""Exploration of step 1: noise on the command of the live policy."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.interruption import safe_point
from rt_torchrl.options import check_options
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.state_feedback import StateFeedback


@dataclass(frozen=True, kw_only=True)
class ExplorationConfig:
    r"""Parameters of the noise ξ(i)·N(0, Σ_a) in episode i; Σ_a is diagonal, and ξ falls linearly to zero.

    Noise that is new at each control interval hardly moves a plant whose dynamics are much slower, and the critic
    learns little from it. With a correlation time τ the noise is an Ornstein-Uhlenbeck process with the same standard
    deviation,

    .. math:: x_{k+1} = \rho x_k + \sqrt{1 - \rho^2}\,w_k, \qquad \rho = e^{-\Delta t/\tau}

    Args:
        spread: standard deviation of the noise on each action, as a share of half its range, in the first episode.
        episodes: number of episodes until ξ is zero; with 0 no episode explores.
        correlation_time: correlation time τ of the noise [s]; 0 makes the noise new at each control interval, as in
            the paper.

    Raises:
        ValueError: if an option is not a number of its type, is negative or not finite.
    """

    spread: float = 0.2
    episodes: int = 5
    correlation_time: float = 0.0

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("spread", "episodes", "correlation_time"):
            if not getattr(self, argument) >= 0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the exploration must not be negative.")

    def strength(self, episode: int) -> float:
        """ξ of an episode, counted from 0."""
        return max(0.0, 1.0 - episode / self.episodes) if self.episodes else 0.0


class LivePolicy(nn.Module):
    """The live policy as it acts on the real system: with noise added, and saturated to the ranges of the actions.

    A policy takes the observation. :class:`StateFeedback` takes the time since :meth:`begin`, in calls of one control
    interval each, the measured state and the measured inputs.

    Args:
        plant: plant that gives the ranges of the actions and the control interval.
        policy: the policy that is live.
        config: parameters of the noise.
        generator: source of the noise.
    """

    low: Tensor
    high: Tensor

    def __init__(self, plant: Plant, policy: nn.Module, config: ExplorationConfig, *, generator: torch.Generator):
        super().__init__()
        low, high = bounds(plant.actions, device=generator.device)
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.policy, self.strength, self._dt, self._intervals = policy, 0.0, plant.dt, 0
        self._noise: Tensor | None = None
        self._scale = 0.5 * config.spread * (high - low)
        self._memory = math.exp(-plant.dt / config.correlation_time) if config.correlation_time else 0.0
        self._generator, self._plant = generator, (plant,)

    @property
    def plant(self) -> Plant:
        """Plant that gives the ranges of the actions and the control interval."""
        return self._plant[0]

    @property
    def generator(self) -> torch.Generator:
        """Source of the noise."""
        return self._generator

    def begin(self, policy: nn.Module, *, strength: float) -> None:
        """Start an episode with the policy that is live now and ξ = ``strength``; state feedback gets ready for it."""
        self.policy, self.strength, self._noise, self._intervals = policy, strength, None, 0
        if isinstance(policy, StateFeedback):
            policy.begin()

    def draw_noise(self, shape: torch.Size | tuple[int, ...]) -> Float[Tensor, "*batch n_a"]:
        """The noise of the next control interval; where ξ is zero, it is zero and nothing is drawn."""
        if self.strength == 0.0:
            return torch.zeros(shape, dtype=torch.float64, device=self.low.device)
        fresh = torch.randn(shape, generator=self._generator, dtype=torch.float64, device=self.low.device)
        if self._noise is None:
            self._noise = fresh
        else:
            self._noise = self._memory * self._noise + math.sqrt(1.0 - self._memory**2) * fresh
        return self.strength * self._scale * self._noise

    @torch.no_grad()
    def forward(
        self,
        observation: Float[Tensor, "*batch n_o"],
        state: Float[Tensor, "*batch n_s"] | None = None,
        exogenous: Float[Tensor, "*batch n_z"] | None = None,
    ) -> Float[Tensor, "*batch n_a"]:
        safe_point()
        command = self.commanded(self.policy, observation, state, exogenous)
        self._intervals += 1
        return (command + self.draw_noise(command.shape)).clamp(self.low, self.high)

    def commanded(
        self, policy: nn.Module, observation: Tensor, state: Tensor | None, exogenous: Tensor | None
    ) -> Float[Tensor, "*batch n_a"]:
        """The command of a policy in the present interval, without noise.

        Raises:
            ValueError: if state feedback is given no state or exogenous input.
        """
        if not isinstance(policy, StateFeedback):
            found: Tensor = policy(observation)
            return found
        if state is None or exogenous is None:
            raise ValueError(f"{type(policy).__name__} acts from state and exogenous input; give both.")
        return policy.act(self._dt * self._intervals, state, exogenous)
