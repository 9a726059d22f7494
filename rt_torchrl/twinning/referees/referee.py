"""What step 6 asks of a referee: one question, whether a policy is worse, and who acts next."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from rt_torchrl.options import check_options

Role = Literal["model_free", "model_based"]
Event = Literal["keep", "swap", "clone"]
RefereeName = Literal["decision_tree", "trust_ratio"]
ROLES: tuple[Role, Role] = ("model_based", "model_free")


@dataclass(frozen=True, kw_only=True)
class RefereeConfig:
    """Parameters of step 6.

    Args:
        rule: ``decision_tree`` as in the paper, or ``trust_ratio``: the twin's word counts only while the real cost
            follows it.
        patience: P_π; episodes in a row that a reason to swap must outlast.
        clone_patience: P_w; the idle policy becomes a clone when it has stalled more often than this, in a row.
        tolerance: T_J; the live policy is worse if its mean cost exceeds this times that of the idle one.
        stall: T_w; the idle policy has stalled if its relative weight change is below this.
        band: least and greatest ratio of the real cost's change to the predicted one at which the twin is trusted.
    """

    rule: RefereeName = "decision_tree"
    patience: int = 2
    clone_patience: int = 3
    tolerance: float = 1.0
    stall: float = 0.5
    band: tuple[float, float] = (0.0, 40.0)

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("patience", "clone_patience"):
            if getattr(self, argument) < 0:
                raise ValueError(f"{argument}={getattr(self, argument)} must not be negative.")
        for argument in ("tolerance", "stall"):
            if not getattr(self, argument) > 0:
                raise ValueError(f"{argument}={getattr(self, argument)} must be positive.")
        if not self.band[0] < self.band[1]:
            raise ValueError(f"band={self.band} of the trust ratio must have its least value first.")


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What an episode has shown of the two policies.

    Args:
        live_cost: mean J_a of the live policy over the virtual episodes.
        idle_cost: the same of the idle policy, on the same draws; infinite if the twin diverges under it.
        idle_weight_change: ‖w^i − w^{i−1}‖/‖w^i‖ of the idle policy over this episode.
        real_costs: J_a of the latest real episodes, oldest first.
        predicted_costs: gives what the twin, as it is now, says that the same episodes cost: flown by the same weights
            from the same states under the same inputs. It costs a flight for each, and is asked for only where needed.

    Raises:
        ValueError: if a cost or the weight change is not a number.
    """

    live_cost: float
    idle_cost: float
    idle_weight_change: float
    real_costs: tuple[float, ...] = ()
    predicted_costs: Callable[[], tuple[float, ...]] = tuple

    def __post_init__(self) -> None:
        for argument in ("live_cost", "idle_cost", "idle_weight_change"):
            if math.isnan(getattr(self, argument)):
                raise ValueError(f"{argument} of step 6 is NaN; look at the virtual episodes it was computed from.")


@runtime_checkable
class Referee(Protocol):
    """Compares policies and names who acts on the real system.

    See ``docs/referee.md`` for how to write one.
    """

    live: Role
    """Who acts in the next real episode."""

    @property
    def idle(self) -> Role:
        """The other one."""

    def worse(self, cost: float, than: float) -> bool:
        """Whether a policy is worse than the one it would replace: the one question about plans, clones and swaps.

        Args:
            cost: mean J_a of the newcomer over virtual episodes; infinite or NaN if the twin diverges under it.
            than: the same of the policy that it would replace, on the same draws.
        """

    def decide(self, evidence: Evidence) -> Event:
        """Judge an episode.

        Returns:
            ``swap`` if the roles have swapped, ``clone`` if the live policy is to be cloned into the idle one.
        """

    def state_dict(self) -> dict[str, Any]:
        """Who is live, and all that the next decision depends on: plain values."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state_dict`."""


class TwoPolicies:
    """What referees share: who is live, the question, and when a stalled idle policy becomes a clone.

    Args:
        config: see :class:`RefereeConfig`.
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

    def worse(self, cost: float, than: float) -> bool:
        return not math.isfinite(cost) or cost > than

    def stalled(self, idle_weight_change: float) -> Event:
        """``clone`` once the idle policy has changed too little for longer than the patience, and ``keep`` before."""
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
            setattr(self, name, state[name])
