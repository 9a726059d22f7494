"""What step 2 asks of a model-free method, and its parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from rt_torchrl.options import check_options, require_widths
from rt_torchrl.twinning.long_term_memory import LongTermMemoryConfig

LearnerName = Literal["ddpg", "td3"]


@runtime_checkable
class Learner(Protocol):
    """A model-free method: it sees every real episode and improves π_mf from what it has kept.

    See ``docs/learner.md`` for how to write one.
    """

    policy: nn.Module
    """π_mf, updated in place."""

    def store(self, episode: TensorDictBase) -> None:
        """Keep what it needs of a real episode, whichever policy flew it (step 1).

        Args:
            episode: ``observation``, ``action`` (as applied) and ``("next", ...)`` of n_t control intervals.
        """

    def update(self) -> TensorDict:
        """Improve the policy (step 2).

        Returns:
            Scalars for the report of the episode, by name; none is required.
        """

    def restart(self) -> None:
        """Forget what belongs to the weights that the policy had, because they have jumped: it became a clone."""

    def observations(self) -> Float[Tensor, "n n_o"]:
        """What the policies have seen on the real system, for a clone of another architecture."""

    def state_dict(self) -> dict[str, Any]:
        """All that the next update depends on, the policy's weights apart: tensors in plain containers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state_dict` of a learner of the same configuration."""


@dataclass(frozen=True, kw_only=True)
class TD3Config:
    """What TD3 has beside the parameters that it shares with DDPG.

    Args:
        delay: critic iterations for one of the policy and of the targets.
        smoothing: standard deviation of the noise on the target's actions, as a share of half their range.
        smoothing_limit: greatest noise on the target's actions, as a share of half their range.
    """

    delay: int = 2
    smoothing: float = 0.2
    smoothing_limit: float = 0.5

    def __post_init__(self) -> None:
        check_options(self)
        if self.delay < 1:
            raise ValueError(f"delay={self.delay} of TD3 must be at least 1 critic iteration.")
        for argument in ("smoothing", "smoothing_limit"):
            if not 0.0 <= getattr(self, argument) <= 2.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of TD3 must lie in [0, 2] halves of the range.")


@dataclass(frozen=True, kw_only=True)
class LearnerConfig:
    """Parameters of step 2.

    Args:
        algorithm: ``ddpg`` as in the paper, or ``td3``: two critics, of which the lower value counts, a delayed policy
            and smoothed targets.
        critic_iterations: n_Q.
        actor_iterations: n_A of DDPG. TD3 takes one for every ``td3.delay`` critic iterations instead.
        batch_size: n_b; at most n_t transitions are sampled.
        discount: γ per control interval.
        return_steps: control intervals whose rewards a target sums before it bootstraps; 1 as in the paper. A control
            interval that is short beside the dynamics makes one action matter little, and less than the critic's error.
        reward_scale: factor on the rewards the critic learns from, so that its values are of the order of ten, which
            a perceptron reaches within an episode; a value is the mean reward over 1 − γ. What is reported is unscaled.
        target_rate: τ of the target critic, and of TD3's target policy.
        critic_rate: learning rate of the critic (Adam).
        actor_rate: learning rate of the policy (Adam).
        gradient_limit: greatest norm of the policy's gradient, infinite for none.
        critic_hidden: widths of the critic's hidden layers.
        memory: D_L.
        td3: what TD3 has beside these.
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
    td3: TD3Config = field(default_factory=TD3Config)

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
