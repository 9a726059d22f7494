"""A referee that weighs what may be gained by a change against what it may cost."""

import math
from statistics import NormalDist

from rt_torchrl.twinning.referees.referee import Event, Evidence, RefereeConfig, Role, TwoPolicies

NORMAL = NormalDist()


class WeightOfEvidence(TwoPolicies):
    r"""A referee that believes the twin as long as real episodes do, and else weighs gains against losses.

    Where no real episode contradicts the twin, the policy that costs less on the twin acts: there is nothing to try.

    Where one does, the belief about the real costs is :math:`g = \log J_{idle} - \log J_{live} \sim \mathcal N(\log
    \hat J_{idle} - \log\hat J_{live} + m, s^2)`, with the costs Ĵ on the twin over common draws, and with m and s from
    the joint belief about both policies by the paired differences of real episodes. Of g follow what an episode with
    the idle policy gains and what it loses, in units of J_live,

    .. math:: G = \mathrm E(1 - e^g)_+, \qquad L = \mathrm E(e^g - 1)_+

    The idle policy takes over if G over the next ``trial_horizon`` episodes exceeds L in one. A policy of uncertain
    worth so gets a trial where little is at stake. After a trial the other policy comes back only if it is expected to
    cost less, G > L: otherwise the episodes whose gain was counted would never come. Two policies that act alike never
    change roles.

    The attribute ``on_trial`` is 1 while the live policy took over although it was expected to cost more, L > G.

    Args:
        config: parameters of step 6.
        live: role that starts live.
    """

    counters = ("stall_count", "on_trial")

    def __init__(self, config: RefereeConfig, live: Role = "model_free"):
        super().__init__(config, live)
        self.on_trial = 0

    @property
    def preferred(self) -> Role:
        return self.idle if self.on_trial else self.live

    def decide(self, evidence: Evidence) -> Event:
        if evidence.contradicted():
            gain, loss = stakes(evidence)
            swaps = (1.0 if self.on_trial else self.config.trial_horizon) * gain > loss
            self.on_trial = int(swaps and loss > gain)
        else:
            swaps, self.on_trial = self.worse(evidence.live_cost, evidence.idle_cost), 0
        if swaps:
            self.live, self.stall_count = self.idle, 0
            return "swap"
        return self.stalled(evidence.idle_weight_change)


def stakes(evidence: Evidence) -> tuple[float, float]:
    """Expected gain and loss of an episode with the idle policy in the place of the live one, in units of J_live."""
    if not math.isfinite(evidence.idle_cost):
        return 0.0, math.inf
    if not math.isfinite(evidence.live_cost):
        return math.inf, 0.0
    if not (evidence.live_cost > 0.0 and evidence.idle_cost > 0.0):  # others have no ratio that says how much dearer
        better = evidence.idle_cost < evidence.live_cost
        return float(better), float(not better)
    error = evidence.difference()
    mean, deviation = math.log(evidence.idle_cost / evidence.live_cost) + error.mean, error.deviation
    if not deviation > 0.0:
        return max(-math.expm1(mean), 0.0), max(math.expm1(mean), 0.0)
    mean_ratio = math.exp(mean + 0.5 * deviation**2)
    low, high = NORMAL.cdf(-mean / deviation), NORMAL.cdf(-(mean + deviation**2) / deviation)
    gain = low - mean_ratio * high
    return max(gain, 0.0), max(mean_ratio * (1.0 - high) - (1.0 - low), 0.0)
