"""A referee that weighs what may be gained by a change against what it may cost."""

import math
from statistics import NormalDist

from rt_torchrl.twinning.referees.referee import Event, Evidence, RefereeConfig, Role, TwoPolicies

NORMAL = NormalDist()


class WeightOfEvidence(TwoPolicies):
    r"""A referee that compares beliefs about the real costs of both policies.

    The belief about a policy is :math:`\log J \sim \mathcal N(\log\hat J + m, s^2)`, with the cost Ĵ on the twin over
    common draws, and m and s from the paired differences of real episodes. Of the difference
    :math:`g = \log J_{idle} - \log J_{live}` follow what an episode gains and what it loses, in units of J_live,

    .. math:: G = \mathrm E(1 - e^g)_+, \qquad L = \mathrm E(e^g - 1)_+

    The idle policy takes over if G over the next ``trial_horizon`` episodes exceeds L in one, after which its own
    episode is evidence. A policy of uncertain worth so gets a trial where little is at stake. Patience is not needed:
    one episode with a hopeless policy is enough where the other is ten times better.

    The attribute ``on_trial`` is 1 while the policy that took over is not the preferred one: it is expected to cost
    more than the other, L > G, or where no real episode contradicts the twin, it costs more on the twin. What is
    expected holds :math:`e^{s^2/2}`, which speaks for whatever has flown more often, and a twin that has been right
    knows better.

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
        gain, loss = stakes(evidence, self.live, self.idle)
        swaps = self.config.trial_horizon * gain > loss
        self.on_trial = int(swaps and dearer(evidence, gain, loss))
        if swaps:
            self.live, self.stall_count = self.idle, 0
            return "swap"
        return self.stalled(evidence.idle_weight_change)


def dearer(evidence: Evidence, gain: float, loss: float) -> bool:
    """Whether the idle policy is the dearer one: by what is expected, or by a twin that no real episode contradicts."""
    return loss > gain if evidence.contradicted() else evidence.idle_cost > evidence.live_cost


def stakes(evidence: Evidence, live: Role, idle: Role) -> tuple[float, float]:
    """Expected gain and loss of an episode with the idle policy in the place of the live one, in units of J_live."""
    if not math.isfinite(evidence.idle_cost):
        return 0.0, math.inf
    if not math.isfinite(evidence.live_cost):
        return math.inf, 0.0
    if not evidence.live_cost * evidence.idle_cost > 0.0:  # costs of two signs have no ratio
        better = evidence.idle_cost < evidence.live_cost
        return float(better), float(not better)
    beliefs = evidence.beliefs()
    mean = math.log(evidence.idle_cost / evidence.live_cost) + beliefs[idle].mean - beliefs[live].mean
    deviation = math.hypot(beliefs[idle].deviation, beliefs[live].deviation)
    mean_ratio = math.exp(mean + 0.5 * deviation**2)
    low, high = NORMAL.cdf(-mean / deviation), NORMAL.cdf(-(mean + deviation**2) / deviation)
    gain = low - mean_ratio * high
    return max(gain, 0.0), max(mean_ratio * (1.0 - high) - (1.0 - low), 0.0)
