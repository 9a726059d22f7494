"""A referee that believes the twin while the real cost follows its predictions."""

import math

from rt_torchrl.twinning.referees.referee import Event, Evidence, RefereeConfig, Role, TwoPolicies

ROUNDING = 1e-9
"""Share of a cost below which its change says nothing."""


class TrustRatio(TwoPolicies):
    r"""A referee that trusts the twin while the real cost follows the twin's predictions from episode to episode.

    .. math:: \rho_i = \frac{J_i - J_{i-1}}{\hat J_i - \hat J_{i-1}}

    J are the real costs of the last two episodes. Ĵ are the costs of the same two episodes on the twin, flown with the
    same weights from the same states under the same inputs; luck then cancels, and an exact twin has ρ = 1. A ratio
    within the band says that the twin predicts at least the direction of a change. After more than ``patience``
    episodes in a row outside the band the model-free policy acts, whatever the twin predicts. One episode within the
    band restores the trust, and then the policy that is better on the twin acts at once. While that policy stays live,
    the idle policy becomes a clone when it has stalled, as in the decision tree. If the predicted cost does not change,
    an episode says nothing about the twin and the count stays.

    Args:
        config: parameters of step 6.
        live: role that starts live.

    Source: the consistency ratio of Poletti et al., *Reinforcement twinning for hybrid control of flapping-wing drones*
    (arXiv 2505.18201), with its band [0, 40] and its patience of 2.
    """

    counters = ("doubt_count", "stall_count")

    def __init__(self, config: RefereeConfig, live: Role = "model_free"):
        super().__init__(config, live)
        self.doubt_count = 0

    @property
    def trusted(self) -> bool:
        """Whether the twin is trusted."""
        return self.doubt_count <= self.config.patience

    def decide(self, evidence: Evidence) -> Event:
        self._weigh(evidence)
        better = self.idle if self.worse(evidence.live_cost, self.config.tolerance * evidence.idle_cost) else self.live
        acting: Role = better if self.trusted else "model_free"
        if acting != self.live:
            self.live, self.stall_count = acting, 0
            return "swap"
        return self.stalled(evidence.idle_weight_change) if acting == better else "keep"

    def _weigh(self, evidence: Evidence) -> None:
        """Count the episodes in a row whose ratio lies outside the band."""
        if len(evidence.real_costs) < 2:
            return
        (*_, before, now), (*_, predicted_before, predicted_now) = evidence.real_costs, evidence.predicted_costs()
        predicted = predicted_now - predicted_before
        if abs(predicted) <= ROUNDING * abs(predicted_before) < math.inf:
            return
        low, high = self.config.band
        # A twin that diverges with a policy that has flown predicts an infinite change, and so is not credible.
        credible = math.isfinite(predicted) and low <= (now - before) / predicted <= high
        self.doubt_count = 0 if credible else self.doubt_count + 1
