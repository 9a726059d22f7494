"""Parameters of step 2. They stand apart from the learners, because a command line reads them without TorchRL."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from rt_torchrl.options import check_options, require_widths

LearnerName = Literal["ddpg", "td3", "sac", "crossq", "redq"]


@dataclass(frozen=True, kw_only=True)
class LongTermMemoryConfig:
    """Parameters of the long-term memory D_L.

    Args:
        capacity: number n_L of transitions that the memory keeps.
        prioritisation: exponent α* of the sampling probability; 0 samples uniformly.
        correction: exponent of the importance weights; 1 removes the bias of the prioritised sampling.
        offset: number tol that is added to every |δ|.
    """

    capacity: int = 100_000
    prioritisation: float = 0.6
    correction: float = 0.4
    offset: float = 1e-3

    def __post_init__(self) -> None:
        check_options(self)
        if self.capacity < 1:
            raise ValueError(f"capacity={self.capacity} of the long-term memory must be at least 1.")
        for argument in ("prioritisation", "correction"):
            if not 0.0 <= getattr(self, argument) <= 1.0:
                raise ValueError(f"{argument}={getattr(self, argument)} must lie in [0, 1].")
        if not self.offset > 0:
            raise ValueError(f"offset={self.offset} must be positive, or a transition could never be sampled.")


@dataclass(frozen=True, kw_only=True)
class LearnerConfig:
    """Parameters of step 2.

    Args:
        algorithm: model-free method, a loss of TorchRL: ``ddpg``, as in the paper; ``td3``, which takes the lower value
            of two critics, delays the policy and smooths the targets; or one that also prices the entropy of a policy
            with noise: ``sac``, ``crossq`` (normalised layers instead of targets) or ``redq`` (more critics).
        critic_iterations: number n_Q of critic iterations per episode.
        actor_iterations: number n_A of DDPG's policy iterations per episode; TD3 makes one for every second critic
            iteration instead, the others one for each.
        batch_size: number n_b of transitions in a batch; it is at most the number n_t of control intervals.
        discount: discount factor γ per control interval.
        return_steps: number of control intervals whose rewards a target sums before it bootstraps; 1 as in the paper.
            Where a control interval is short beside the dynamics, one action matters less than the critic's error; a
            sum over more intervals mends that.
        reward_scale: factor on the rewards that the critic learns from. A value is about the mean reward over 1 − γ;
            scaled to the order of ten, a perceptron reaches it within an episode. Reports are unscaled.
        target_rate: rate τ at which the targets follow.
        critic_rate: learning rate of the critic (Adam).
        actor_rate: learning rate of the policy (Adam).
        gradient_limit: greatest norm of the policy's gradient; infinity does not limit it.
        critic_hidden: widths of the critic's hidden layers.
        memory: parameters of the long-term memory D_L.
    """

    algorithm: LearnerName = "ddpg"
    critic_iterations: int = 500
    actor_iterations: int = 1000
    batch_size: int = 128
    discount: float = 0.98
    return_steps: int = 1
    reward_scale: float = 1.0
    target_rate: float = 0.01
    critic_rate: float = 1e-3
    actor_rate: float = 2e-3
    gradient_limit: float = 1.0
    critic_hidden: Sequence[int] = field(default=(64, 64))
    memory: LongTermMemoryConfig = field(default_factory=LongTermMemoryConfig)

    def __post_init__(self) -> None:
        check_options(self, infinite=("gradient_limit",))
        require_widths("critic_hidden", self.critic_hidden)
        for argument in ("critic_iterations", "actor_iterations"):
            if getattr(self, argument) < 0:
                raise ValueError(f"{argument}={getattr(self, argument)} must not be negative.")
        for argument in ("batch_size", "return_steps"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least 1.")
        if not 0.0 <= self.discount < 1.0:
            raise ValueError(f"discount={self.discount} must lie in [0, 1); the critic bootstraps through truncation.")
        for argument in ("reward_scale", "target_rate", "critic_rate", "actor_rate", "gradient_limit"):
            if not getattr(self, argument) > 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} must be positive.")
