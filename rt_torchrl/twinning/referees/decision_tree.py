"""The paper's referee: a decision tree with two counters."""

from rt_torchrl.twinning.referees.referee import Event, Evidence, RefereeConfig, Role, TwoPolicies


class DecisionTree(TwoPolicies):
    """The paper's decision tree (figure decisionTree).

    The roles swap when the live policy has been worse on the twin for more than P_π episodes in a row. Otherwise the
    idle policy becomes a clone when it has stalled for more than P_w episodes in a row. Each counter restarts when its
    condition fails; the second counter also restarts while the live policy is worse.

    Note: the paper prints J_live/J_idle < T_J for "the live policy performs worse". Here the condition is >, because a
    smaller cost is better.

    Args:
        config: parameters of step 6.
        live: role that starts live.
    """

    counters = ("worse_count", "stall_count")

    def __init__(self, config: RefereeConfig, live: Role = "model_free"):
        super().__init__(config, live)
        self.worse_count = 0  # C_π

    def decide(self, evidence: Evidence) -> Event:
        if not self.worse(evidence.live_cost, self.config.tolerance * evidence.idle_cost):
            self.worse_count = 0
            return self.stalled(evidence.idle_weight_change)
        self.worse_count, self.stall_count = self.worse_count + 1, 0
        if self.worse_count > self.config.patience:
            self.worse_count = 0
            self.live = self.idle
            return "swap"
        return "keep"
