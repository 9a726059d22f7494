"""Parameters of step 2. They stand apart from the learners, because a command line reads them without TorchRL."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from rt_torchrl.options import check_options, require_widths

LearnerName = Literal["ddpg", "td3", "incremental_td3"]


@dataclass(frozen=True, kw_only=True)
class LongTermMemoryConfig:
    """Parameters of D_L, which incremental TD3 has not.

    Args:
        capacity: number n_L of transitions that the memory keeps; incremental TD3 keeps whole episodes instead.
        prioritisation: exponent α* of the sampling probability; 0 samples uniformly, as incremental TD3 always does.
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
class TD3Config:
    """Parameters of TD3 that DDPG does not have.

    Args:
        delay: number of critic iterations for each iteration of the policy and of the targets.
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
class IncrementalTD3Config:
    """Parameters of incremental TD3 that the other learners do not have.

    Args:
        critics: number of critics, at least two, of whose targets the mean counts.
        delay: number of critic iterations for each iteration of the policy and of the targets.
        decisions: number of decisions in the time 1/(1 − γ); a decision lasts as many control intervals as fit.
        actor_episodes: number of latest real episodes in whose states the policy is improved.
        return_episodes: number of latest real episodes whose targets sum ``return_steps`` rewards; those of older ones,
            which other policies flew, sum the rewards of a single decision.
        episodes: number of latest real episodes that are kept, in the place of the other learners' long-term memory.
        actor_rate: learning rate of the policy (Adam), which takes the place of that of the other learners.
        cooling: number of updates after which the policy's learning rate is half as large, as 1/(1 + updates/cooling);
            infinity keeps it. A restart begins anew.
        trust_region: greatest RMS change of the actions in one update in the states of ``actor_episodes``, as a share
            of half their range.
        settled: ratio of the mean |δ| of a hundred critic iterations to that of the hundred before from which on the
            critics have settled; the policy waits for this at first and whenever its weights have jumped.
        recovery: ratio of the cost of a real episode to the least median of three in a row so far above which the
            policy goes back to the weights from before the update; infinity never does.
        trust: trust in the twin at first, from 0 to 1; 0 learns nothing from it.
        measured: whether trust is measured from the first examination of the twin on: the probability, by the paired
            differences of real episodes, that the twin says within 10 % what the policy costs.
        slopes: whether a twin that is trusted teaches the slopes of values by actions.
        virtual: number of transitions that a twin that is trusted adds to an update, where they fill half of every
            batch; 0 for none.
    """

    critics: int = 2
    delay: int = 2
    decisions: int = 20
    actor_episodes: int = 2
    return_episodes: int = 3
    episodes: int = 20
    actor_rate: float = 1e-3
    cooling: float = 5.0
    trust_region: float = 0.5
    settled: float = 0.9
    recovery: float = 1.5
    trust: float = 0.0
    measured: bool = True
    slopes: bool = True
    virtual: int = 1000

    def __post_init__(self) -> None:
        check_options(self, infinite=("cooling", "trust_region", "recovery"))
        least = {"critics": 2, "delay": 1, "decisions": 1, "actor_episodes": 1, "episodes": 1}
        for argument, lowest in (least | {"return_episodes": 0, "virtual": 0}).items():
            if getattr(self, argument) < lowest:
                raise ValueError(f"{argument}={getattr(self, argument)} of incremental TD3 must be at least {lowest}.")
        for argument in ("actor_rate", "cooling", "trust_region", "settled"):
            if not getattr(self, argument) > 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of incremental TD3 must be positive.")
        if not self.recovery > 1.0:
            raise ValueError(f"recovery={self.recovery} of incremental TD3 must be above 1; infinity never recovers.")
        if not 0.0 <= self.trust <= 1.0:
            raise ValueError(f"trust={self.trust} in the twin must lie in [0, 1].")


@dataclass(frozen=True, kw_only=True)
class LearnerConfig:
    """Parameters of step 2.

    Args:
        algorithm: model-free method: ``ddpg``, as in the paper, or ``td3``, which takes the lower value of two critics,
            delays the policy and smooths the targets, or ``incremental_td3``, whose critics see the full state and
            what an action changes.
        critic_iterations: number n_Q of critic iterations per episode.
        actor_iterations: number n_A of DDPG's policy iterations per episode; TD3 makes one for every ``td3.delay``
            critic iterations instead.
        batch_size: number n_b of transitions in a batch; it is at most the number n_t of control intervals.
        discount: discount factor γ per control interval.
        return_steps: number of control intervals whose rewards a target sums before it bootstraps; 1 as in the paper.
            Where a control interval is short beside the dynamics, one action matters less than the critic's error; a
            sum over more intervals mends that.
        reward_scale: factor on the rewards that the critic learns from. A value is about the mean reward over 1 − γ;
            scaled to the order of ten, a perceptron reaches it within an episode. Reports are unscaled. Incremental TD3
            does not read it, because it counts rewards in the mean cost of the cheapest episode.
        target_rate: rate τ at which the target critic, and TD3's target policy, follow; those of incremental TD3 follow
            faster where few iterations would not carry values through the horizon.
        critic_rate: learning rate of the critic (Adam).
        actor_rate: learning rate of the policy (Adam).
        gradient_limit: greatest norm of the policy's gradient; infinity does not limit it.
        critic_hidden: widths of the critic's hidden layers.
        memory: parameters of the long-term memory D_L of DDPG and TD3. Incremental TD3 reads none of them, and keeps
            ``incremental.episodes`` whole episodes instead.
        td3: parameters of TD3 that DDPG does not have.
        incremental: parameters of incremental TD3 that the other learners do not have.
        update: way to compute an update: ``explicit`` for gradients by formula, several times as fast, or ``torchrl``
            for TorchRL's losses and autograd. Both give the same weights up to rounding. Critics or losses of your own
            always use TorchRL's way.
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
    incremental: IncrementalTD3Config = field(default_factory=IncrementalTD3Config)
    update: Literal["explicit", "torchrl"] = "explicit"

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
