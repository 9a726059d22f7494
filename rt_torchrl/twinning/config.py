"""Hyper-parameters of the whole algorithm."""

from dataclasses import dataclass, field

from rt_torchrl.options import check_options
from rt_torchrl.steps.config import Arm, ExogenousConfig, LearnerConfig, PlannerConfig, RefereeConfig
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.systems.operating_limits_config import OperatingLimitsConfig
from rt_torchrl.twinning.assimilation import AssimilationConfig
from rt_torchrl.twinning.hypotheses.config import HypothesesConfig


@dataclass(frozen=True, kw_only=True)
class TwinningConfig:
    """Hyper-parameters of the algorithm, by step.

    Args:
        arm: part of the algorithm that runs: ``twinning`` for all six steps, ``model_free`` for steps 1 and 2 alone, or
            else ``model_based`` for steps 1, 3, 4 and 5 alone.
        realisations: number N_z of samples of the exogenous process, for each record in step 4 and in all in step 5.
        records: number n_S of latest real episodes that step 4 trains the twin on; steps 5 and 6 draw exogenous inputs
            from at least as many.
        virtual_episodes: number N of virtual episodes on which step 5 judges a plan and step 6 compares the policies.
        least_sound: least share of a real episode without a fault, in a row, that is learned from; with a lower share
            the episode is flown again.
        limits: limits of the real system, which a safety layer holds for every policy, and which the twin must predict
            to be kept before a policy may act.
        exploration: parameters of step 1.
        learner: parameters of step 2.
        exogenous: parameters of step 3.
        assimilation: parameters of step 4.
        hypotheses: parameters of the hypotheses about what the real system has beside its twin.
        planner: parameters of step 5.
        referee: parameters of step 6.
    """

    arm: Arm = "twinning"
    realisations: int = 5
    records: int = 1
    virtual_episodes: int = 20
    least_sound: float = 0.5
    limits: OperatingLimitsConfig = field(default_factory=OperatingLimitsConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    exogenous: ExogenousConfig = field(default_factory=ExogenousConfig)
    assimilation: AssimilationConfig = field(default_factory=AssimilationConfig)
    hypotheses: HypothesesConfig = field(default_factory=HypothesesConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    referee: RefereeConfig = field(default_factory=RefereeConfig)

    @property
    def experience(self) -> int:
        """Number of latest real episodes whose exogenous inputs are kept: enough for step 4, and for steps 5 and 6."""
        return max(self.records, self.planner.experience)

    @property
    def bounded_states(self) -> dict[str, tuple[float, float]]:
        """Bounds on states by name, of the limits and of the constraints of plans, which come first."""
        return {**self.limits.states, **self.planner.constraints.states}

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("realisations", "records", "virtual_episodes"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least 1.")
        if not 0.0 < self.least_sound <= 1.0:
            raise ValueError(f"least_sound={self.least_sound} must lie in (0, 1], a share of an episode.")
