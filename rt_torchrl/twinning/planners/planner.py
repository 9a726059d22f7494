"""The protocol of a planner, which improves π_mb in step 5, and its parameters."""

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

from torch import nn

from rt_torchrl.control.predictive_control import PredictiveConfig
from rt_torchrl.optimisers.descent import Descended, DescentConfig
from rt_torchrl.options import check_options, require_widths
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.planners.constraints_config import ConstraintsConfig


@runtime_checkable
class Planner(Protocol):
    """A planner, which improves π_mb on the twin.

    ``docs/planner.md`` shows how to write one.
    """

    policy: nn.Module
    """Policy π_mb, updated in place."""

    def plan(self, episodes: Scenario) -> Descended:
        """Improve the policy on these virtual episodes; the algorithm then judges it on others.

        Returns:
            Mean J_a on ``episodes`` before and after, the norm of the first gradient, and the number of iterations.

        Raises:
            DivergenceError: if the twin diverges with the present policy.
        """

    def refuse(self) -> None:
        """React to a plan that was worse on other episodes; the policy has its earlier weights again."""

    def restart(self) -> None:
        """Forget everything that belongs to the policy's earlier weights, because the policy's weights have jumped."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next plan depends on, except the policy's weights: tensors in plain containers."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the :meth:`state_dict` of a planner with the same configuration."""


@dataclass(frozen=True, kw_only=True)
class ShortHorizonConfig:
    """Parameters of the planning over short windows.

    Args:
        window: number of control intervals in a window; 0 plans over whole episodes instead, as in the paper.
        discount: discount factor γ per control interval.
        mixing: weight λ of the rest of the window in the critic's targets; the critic itself has the weight 1 − λ.
        critic_iterations: gradients of the critic for each window.
        critic_hidden: widths of the critic's hidden layers.
        target_rate: share of the distance to the critic that the target critic moves after each window.
        policy_rate: learning rate of the policy (Adam).
        critic_rate: learning rate of the critic (Adam).
    """

    window: int = 0
    discount: float = 0.98
    mixing: float = 0.95
    critic_iterations: int = 8
    critic_hidden: tuple[int, ...] = (64, 64)
    target_rate: float = 0.2
    policy_rate: float = 5e-3
    critic_rate: float = 2e-3

    def __post_init__(self) -> None:
        check_options(self)
        require_widths("critic_hidden", self.critic_hidden)
        for argument, least in (("window", 0), ("critic_iterations", 1)):
            if getattr(self, argument) < least:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must be at least {least}.")
        if not 0.0 <= self.discount < 1.0:
            raise ValueError(f"discount={self.discount} of the short horizon must lie in [0, 1).")
        for argument in ("mixing", "target_rate"):
            if not 0.0 < getattr(self, argument) <= 1.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must lie in (0, 1].")
        for argument in ("policy_rate", "critic_rate"):
            if not getattr(self, argument) > 0.0:
                raise ValueError(f"{argument}={getattr(self, argument)} of the short horizon must be positive.")


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Parameters of step 5.

    Args:
        method: method of the model-based policy: whole_episodes descends the cost of whole virtual episodes,
            short_horizon that of short windows plus a learned tail cost, and receding_horizon is model predictive
            control, which has no weights of its own and plans while it acts. By default short_horizon if its window is
            positive, and else whole_episodes.
        iterations: number n_mb of gradients per episode or, with a short horizon, of sweeps through the virtual
            episodes.
        realisations: number N_z of virtual episodes that a plan is made on; None takes ``realisations`` of the
            algorithm. Twenty virtual episodes take about as long as one, and where the initial states differ much, a
            plan made on one of them says little about the others.
        rounds: number of plans that follow each other in step 5, each on virtual episodes that are drawn anew. A policy
            with hundreds of weights fits itself to those of a single plan of many gradients, and one of them under
            which the gradient explodes ends that plan.
        approach: number of gradients of Adam with small steps that lead to two more plans, one from the present weights
            and one from those before the imitation of a controller; each stays if it costs less on other virtual
            episodes; 0 for none. A descent from the imitation of a controller may end in a minimum beside that
            controller.
        approach_at: number of the episode whose step 5 makes these plans. The twin should be right by then.
        anew: number of plans, of which all but the first are also made from the weights with which the first began; the
            better one on other virtual episodes stays. What is planned on the inputs of a single episode may lie in a
            minimum that is poor in others. 0 and 1 plan from the present weights alone.
        scouts: number of random policies that fly the virtual episodes in the fourth episode, the eighth, the sixteenth
            and so on (:class:`~rt_torchrl.twinning.scouts.Scouts`). One more plan begins with the best of them, and
            stays if it costs 5 % less on other virtual episodes; 0 for none. Neither short windows nor model predictive
            control have any.
        episode_gradient_limit: limit κ of the gradient of each virtual episode, see :func:`limited_mean`, in a second
            descent over whole episodes where the first one gains nothing beside a mean gradient that is longer, and
            of plans from earlier weights (:class:`~rt_torchrl.twinning.way_back.WayBack`) where neither gains anything;
            infinite for none, as in the paper. A short horizon has none either.
        experience: number of latest real episodes whose exogenous inputs steps 5 and 6 draw from; 1 as in the paper.
        extremes: number of random initial states among which the extremes of each state are found, from which a plan
            and an imitation must not fail; 0 for none. Twenty virtual episodes do not show what a policy does in one
            of hundreds.
        constraints: bounds on states that plans over whole episodes keep.
        descent: parameters of the policy's descent over whole episodes.
        short_horizon: parameters of planning over short windows, for tasks where gradients of whole episodes are of no
            use.
        receding_horizon: parameters of model predictive control.
    """

    method: Literal["whole_episodes", "short_horizon", "receding_horizon"] | None = None
    iterations: int = 10
    realisations: int | None = None
    rounds: int = 1
    approach: int = 0
    approach_at: int = 3
    anew: int = 0
    scouts: int = 0
    episode_gradient_limit: float = 10.0
    experience: int = 100
    extremes: int = 1000
    constraints: ConstraintsConfig = field(default_factory=ConstraintsConfig)
    descent: DescentConfig = field(default_factory=DescentConfig)
    short_horizon: ShortHorizonConfig = field(default_factory=ShortHorizonConfig)
    receding_horizon: PredictiveConfig = field(default_factory=PredictiveConfig)

    @property
    def whole(self) -> bool:
        """Whether plans descend over whole episodes."""
        return not self.short_horizon.window and self.method != "receding_horizon"

    def __post_init__(self) -> None:
        check_options(self, infinite=("episode_gradient_limit",))
        if self.method is not None and (self.method == "short_horizon") != (self.short_horizon.window > 0):
            raise ValueError(
                f"method={self.method!r} of the planning does not go with short_horizon.window="
                f"{self.short_horizon.window}; a positive window belongs to short_horizon alone."
            )
        if self.constraints.states and not self.whole:
            raise ValueError(
                f"constraints.states of {', '.join(self.constraints.states)} need plans over whole episodes: leave "
                "planner.method and short_horizon.window as they are, or leave the constraints out."
            )
        if self.rounds < 1 or (self.rounds > 1 and self.method == "receding_horizon"):
            raise ValueError(
                f"rounds={self.rounds} of the planning must be at least 1, and 1 with method receding_horizon, which "
                "plans while it acts."
            )
        if self.approach < 0 or self.approach_at < 1:
            raise ValueError(
                f"approach={self.approach} of the planning must not be negative, and approach_at={self.approach_at} "
                "must be at least 1."
            )
        if self.approach and not self.whole:
            raise ValueError(
                f"approach={self.approach} of the planning belongs to descents over whole episodes; leave it out, or "
                "short_horizon.window and method=receding_horizon."
            )
        self._check_numbers()

    def _check_numbers(self) -> None:
        if self.iterations < 0:
            raise ValueError(f"iterations={self.iterations} of the planning (n_mb) must not be negative.")
        if self.realisations is not None and self.realisations < 1:
            raise ValueError(f"realisations={self.realisations} of the planning (N_z) must be at least 1.")
        if not self.episode_gradient_limit >= 1.0:
            raise ValueError(
                f"episode_gradient_limit={self.episode_gradient_limit} of the planning must be at least 1; infinite is "
                "no limit."
            )
        if self.anew < 0 or (self.anew > 1 and not self.whole):
            raise ValueError(
                f"anew={self.anew} of the planning must not be negative, and at most 1 with short_horizon.window and "
                "with method=receding_horizon: it belongs to descents over whole episodes."
            )
        if self.scouts < 0:
            raise ValueError(f"scouts={self.scouts} of the planning must not be negative; 0 sends none.")
        if self.extremes < 0:
            raise ValueError(f"extremes={self.extremes} of the planning must not be negative; 0 looks at none.")
        if self.experience < 1:
            raise ValueError(f"experience={self.experience} of the planning must be at least 1 episode.")
