"""Exploration of step 1, noise on the command of the live policy; and bumpless handover from one policy to the next."""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.interruption import safe_point
from rt_torchrl.options import Count, NotNegative, configuration
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.state_feedback import StateFeedback

OF_RANDOM_WEIGHTS = 0.2
"""Spread of the noise around random weights."""
HANDOVER = 20
"""Number n of control intervals in which an offset of a handover as wide as the range of the action fades."""


@configuration
class ExplorationConfig:
    r"""Parameters of the noise ξ(i)·N(0, Σ_a) in episode i; Σ_a is diagonal, and ξ falls linearly to zero.

    Noise that is new at each control interval hardly moves a plant whose dynamics are much slower, and the critic
    learns little from it. With a correlation time τ the noise is an Ornstein-Uhlenbeck process with the same standard
    deviation,

    .. math:: x_{k+1} = \rho x_k + \sqrt{1 - \rho^2}\,w_k, \qquad \rho = e^{-\Delta t/\tau}

    Args:
        spread: standard deviation of the noise on each action, as a share of half its range, in the first episode; by
            default 0.2, or none where a training begins with a controller, a log or an earlier one: a real system that
            a controller has held so far need not meet the noise that finds out what actions do at all, and a policy
            beside a limit may leave it by noise.
        episodes: number of episodes until ξ is zero; with 0 no episode explores.
        correlation_time: correlation time τ of the noise [s]; 0 makes the noise new at each control interval, as in
            the paper.

    Raises:
        ValueError: if an option is not a number of its type, is negative or not finite.
    """

    spread: NotNegative | None = None
    episodes: Count = 5
    correlation_time: NotNegative = 0.0

    @property
    def noise(self) -> float:
        """The spread, that of random weights where none is given."""
        return OF_RANDOM_WEIGHTS if self.spread is None else self.spread

    def imitating(self) -> "ExplorationConfig":
        """The noise in a training that does not begin with random weights: what is given, or none."""
        return self if self.spread is not None else dataclasses.replace(self, spread=0.0)

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
        self._scale = 0.5 * config.noise * (high - low)
        self._memory = math.exp(-plant.dt / config.correlation_time) if config.correlation_time else 0.0
        self.generator = generator

    def begin(self, policy: nn.Module, *, strength: float) -> None:
        """Start an episode with the policy that is live now and ξ = ``strength``; state feedback gets ready for it."""
        self.policy, self.strength, self._noise, self._intervals = policy, strength, None, 0
        if isinstance(policy, StateFeedback):
            policy.begin()

    def draw_noise(self, shape: torch.Size | tuple[int, ...]) -> Float[Tensor, "*batch n_a"]:
        """The noise of the next control interval; where ξ is zero, it is zero and nothing is drawn."""
        if self.strength == 0.0:
            return torch.zeros(shape, dtype=torch.float64, device=self.low.device)
        fresh = torch.randn(shape, generator=self.generator, dtype=torch.float64, device=self.low.device)
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
            command: Tensor = policy(observation)
            return command
        if state is None or exogenous is None:
            raise ValueError(f"{type(policy).__name__} acts from state and exogenous input; give both.")
        return policy.act(self._dt * self._intervals, state, exogenous)


class BumplessPolicy(LivePolicy):
    r"""The live policy of a system in operation, in which policies take over without a bump.

    A policy that takes over in interval h acts with an offset, which is the difference to the policy before it, and
    which fades component by component,

    .. math::
        a_k = \pi_{new}(e_k) + b_k, \qquad b_h = a_h^{old} - \pi_{new}(e_h), \qquad
        |b_{k+1}| = \max(0, |b_k| - r)

    The action of interval h is what the old policy would have sent. From then on the handover adds at most r to the
    action in an interval: its range over n intervals.

    Integrators and filters of a plant are among its states, so that they carry over. State feedback that takes over
    begins with its first memory.

    Args:
        plant: plant that gives the ranges of the actions and the control interval.
        policy: the policy that is live.
        config: parameters of the noise.
        generator: source of the noise.
    """

    def __init__(self, plant: Plant, policy: nn.Module, config: ExplorationConfig, *, generator: torch.Generator):
        super().__init__(plant, policy, config, generator=generator)
        self._share = (self.high - self.low) / HANDOVER
        self._former: nn.Module | None = None
        self._offset: Tensor | None = None

    def begin(self, policy: nn.Module, *, strength: float) -> None:
        """See :meth:`LivePolicy.begin`; after a reset of the system nothing is left of earlier policies."""
        super().begin(policy, strength=strength)
        self._former = self._offset = None

    def begin_window(self) -> None:
        """Begin a window of operation without a reset: the plant's clock begins anew, and all else goes on."""
        self._intervals = 0

    def hand_over(self, policy: nn.Module, *, strength: float) -> None:
        """Let a policy take over in the next interval.

        Args:
            policy: the new policy, ready to act; a module of its own, because the old one is asked once more.
            strength: strength ξ of the exploration from now on.
        """
        self._former = self._former or self.policy
        self.policy, self.strength = policy, strength

    def commanded(
        self, policy: nn.Module, observation: Tensor, state: Tensor | None, exogenous: Tensor | None
    ) -> Float[Tensor, "*batch n_a"]:
        """The command of the policy and what is left of the offset."""
        command = super().commanded(policy, observation, state, exogenous)
        if self._offset is not None:
            left = self._offset.sign() * (self._offset.abs() - self._share).clamp(min=0.0)
            self._offset = left if left.any() else None
        if self._former is not None:
            before = super().commanded(self._former, observation, state, exogenous)
            before = before if self._offset is None else before + self._offset
            offset = before.clamp(self.low, self.high) - command
            # A policy that asked for no number leaves nothing behind.
            self._former, self._offset = None, offset.nan_to_num(0.0, 0.0, 0.0)
        return command if self._offset is None else command + self._offset
