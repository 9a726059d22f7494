"""The protocol of a referee, which says in step 6 whether a policy is worse and who acts next, and its parameters."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from rt_torchrl.options import check_options
from rt_torchrl.twinning.evidence.paired_differences import LOCAL, Belief

Role = Literal["model_free", "model_based"]
Event = Literal["keep", "swap", "clone"]
RefereeName = Literal["decision_tree", "weight_of_evidence"]
UNKNOWN = Belief(0.0, math.sqrt(2.0) * LOCAL)
"""Belief about the difference of two policies of which nothing is known; the error that all policies share cancels."""
ROLES: tuple[Role, Role] = ("model_based", "model_free")


@dataclass(frozen=True, kw_only=True)
class RefereeConfig:
    """Parameters of step 6.

    Args:
        rule: rule of the referee: ``decision_tree``, as in the paper, or ``weight_of_evidence``, which believes the
            twin as long as real episodes do, and else weighs what a change may gain against what it may cost.
        patience: number P_π of episodes in a row that a reason to swap must outlast.
        clone_patience: number P_w of episodes in a row that the idle policy may stall; if it stalls longer, it becomes
            a clone.
        tolerance: ratio T_J of the live policy's mean cost to the idle policy's above which the live policy is worse.
        stall: relative weight change T_w below which the idle policy has stalled.
        trial_horizon: number of episodes over which a better policy pays for the trial in which it may be a worse one.
    """

    rule: RefereeName = "decision_tree"
    patience: int = 2
    clone_patience: int = 3
    tolerance: float = 1.0
    stall: float = 0.5
    trial_horizon: float = 5.0

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("patience", "clone_patience"):
            if getattr(self, argument) < 0:
                raise ValueError(f"{argument}={getattr(self, argument)} must not be negative.")
        for argument in ("tolerance", "stall"):
            if not getattr(self, argument) > 0:
                raise ValueError(f"{argument}={getattr(self, argument)} must be positive.")
        if not self.trial_horizon > 0:
            raise ValueError(f"trial_horizon={self.trial_horizon} must be positive.")


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Evidence about the two policies after an episode.

    Args:
        live_cost: mean J_a of the live policy over the virtual episodes.
        idle_cost: mean J_a of the idle policy over the same virtual episodes; infinite if the twin diverges with it.
        idle_weight_change: relative change ‖w^i − w^{i−1}‖/‖w^i‖ of the idle policy's weights over this episode.
        real_costs: J_a of the latest real episodes, oldest first.
        predicted_costs: function that returns the costs of the same episodes on the present twin, flown with the same
            weights from the same states under the same inputs. It flies each episode, so it is called only if needed.
        difference: function that returns the belief about d_idle − d_live, where d is log J_real − log J_twin of a
            policy. It is the joint belief about both: two policies that act alike differ by nothing, however little is
            known of either.
        contradicted: function that returns whether one of the latest real episodes contradicts the twin beyond chance.

    Raises:
        ValueError: if a cost or the weight change is not a number.
    """

    live_cost: float
    idle_cost: float
    idle_weight_change: float
    real_costs: tuple[float, ...] = ()
    predicted_costs: Callable[[], tuple[float, ...]] = tuple
    difference: Callable[[], Belief] = lambda: UNKNOWN
    contradicted: Callable[[], bool] = lambda: True

    def __post_init__(self) -> None:
        for argument in ("live_cost", "idle_cost", "idle_weight_change"):
            if math.isnan(getattr(self, argument)):
                raise ValueError(f"{argument} of step 6 is NaN; look at the virtual episodes it was computed from.")


@runtime_checkable
class Referee(Protocol):
    """A referee, which compares policies and names the one that acts on the real system.

    ``docs/referee.md`` shows how to write one.
    """

    live: Role
    """Role that acts in the next real episode."""

    @property
    def idle(self) -> Role:
        """Role that does not act."""

    def worse(self, cost: float, than: float) -> bool:
        """Whether a policy is worse than another one: a plan, a judged update or a clone than what it would replace.

        Args:
            cost: mean J_a of the policy over virtual episodes, or what it is expected to cost on the real system, with
                the price of leaving bounds; infinite or NaN if the twin diverges with it.
            than: the same of the other policy, over the same virtual episodes.
        """

    def decide(self, evidence: Evidence) -> Event:
        """Judge the policies after an episode, and swap their roles if that is the decision.

        Returns:
            ``swap`` if the roles have swapped, ``clone`` if the live policy is to be cloned into the idle one, ``keep``
            otherwise.
        """

    def state_dict(self) -> dict[str, Any]:
        """The live role and everything else that the next decision depends on, as plain values."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a :meth:`state_dict`."""


class TwoPolicies:
    """The common part of referees: the roles, the comparison of costs, and the clone of an idle policy that stalls.

    Args:
        config: parameters of step 6.
        live: role that starts live; the paper starts with the model-free policy.
    """

    counters: tuple[str, ...] = ("stall_count",)

    def __init__(self, config: RefereeConfig, live: Role = "model_free"):
        self.config = config
        self.live: Role = live
        self.stall_count = 0  # C_w

    @property
    def idle(self) -> Role:
        return "model_based" if self.live == "model_free" else "model_free"

    @property
    def preferred(self) -> Role:
        """Role that is expected to cost less: the live one, unless it is on trial."""
        return self.live

    def worse(self, cost: float, than: float) -> bool:
        return not math.isfinite(cost) or cost > than

    def stalled(self, idle_weight_change: float) -> Event:
        """Count stalled episodes: ``clone`` if there are more in a row than ``clone_patience``, else ``keep``."""
        self.stall_count = self.stall_count + 1 if idle_weight_change < self.config.stall else 0
        if self.stall_count > self.config.clone_patience:
            self.stall_count = 0
            return "clone"
        return "keep"

    def state_dict(self) -> dict[str, Any]:
        return {"live": self.live} | {name: getattr(self, name) for name in self.counters}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.live = state["live"]
        for name in self.counters:
            setattr(self, name, state.get(name, 0))  # a state of an earlier version lacks a later counter
