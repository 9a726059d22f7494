"""Step 6: which policy is live, and whether the idle one is replaced by a clone."""

import math
from dataclasses import dataclass
from typing import Literal

from rt_torchrl.options import check_options

Role = Literal["model_free", "model_based"]
Event = Literal["keep", "swap", "clone"]


@dataclass(frozen=True, kw_only=True)
class SwitchConfig:
    """Thresholds of the decision tree (paper, figure decisionTree).

    Args:
        patience: P_π; the roles swap when the live policy has been worse more often than this, in a row.
        clone_patience: P_w; the idle policy becomes a clone when it has stalled more often than this, in a row.
        tolerance: T_J; the live policy is worse if its mean cost exceeds this times that of the idle one.
        stall: T_w; the idle policy has stalled if its relative weight change is below this.
    """

    patience: int = 2
    clone_patience: int = 3
    tolerance: float = 1.0
    stall: float = 0.5

    def __post_init__(self):
        check_options(self)
        for argument in ("patience", "clone_patience"):
            if getattr(self, argument) < 0:
                raise ValueError(f"{argument}={getattr(self, argument)} must not be negative.")
        for argument in ("tolerance", "stall"):
            if not getattr(self, argument) > 0:
                raise ValueError(f"{argument}={getattr(self, argument)} must be positive.")


class PolicySwitch:
    """The decision tree and its two counters.

    Note: the paper prints J_live/J_idle < T_J for "the live policy performs worse"; here >, because costs are better
    when they are smaller.

    Args:
        config: see :class:`SwitchConfig`.
        live: role that starts live; the paper starts with the model-free policy.
    """

    def __init__(self, config: SwitchConfig, live: Role = "model_free"):
        self.config, self.live = config, live
        self.worse_count = 0  # C_π
        self.stall_count = 0  # C_w

    @property
    def idle(self) -> Role:
        return "model_based" if self.live == "model_free" else "model_free"

    def decide(self, live_cost: float, idle_cost: float, idle_weight_change: float) -> Event:
        r"""One pass through the tree.

        Args:
            live_cost: mean J_a of the live policy over the virtual episodes.
            idle_cost: the same of the idle policy, on the same draws.
            idle_weight_change: ‖w^i − w^{i−1}‖/‖w^i‖ of the idle policy over this episode.

        Returns:
            ``swap`` if the roles have swapped, ``clone`` if the live weights are to be copied into the idle policy.
            Each counter restarts when its condition fails, the second one also while the live policy is worse.

        Raises:
            ValueError: if a cost or the weight change is not a number.
        """
        for argument, value in (("live_cost", live_cost), ("idle_cost", idle_cost), ("change", idle_weight_change)):
            if math.isnan(value):
                raise ValueError(f"{argument} of step 6 is NaN; look at the virtual episodes it was computed from.")
        if live_cost > self.config.tolerance * idle_cost:
            self.worse_count, self.stall_count = self.worse_count + 1, 0
            if self.worse_count > self.config.patience:
                self.worse_count = 0
                self.live = self.idle
                return "swap"
            return "keep"
        self.worse_count = 0
        self.stall_count = self.stall_count + 1 if idle_weight_change < self.config.stall else 0
        if self.stall_count > self.config.clone_patience:
            self.stall_count = 0
            return "clone"
        return "keep"
