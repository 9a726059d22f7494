"""Hyper-parameters of the whole algorithm."""

from dataclasses import dataclass, field
from typing import Literal

from rt_torchrl.options import check_options
from rt_torchrl.systems.exploration import ExplorationConfig
from rt_torchrl.twinning.assimilation import AssimilationConfig
from rt_torchrl.twinning.distillation import DistillationConfig
from rt_torchrl.twinning.exogenous import ExogenousConfig
from rt_torchrl.twinning.learners import LearnerConfig
from rt_torchrl.twinning.planners import PlannerConfig
from rt_torchrl.twinning.referees import RefereeConfig

Arm = Literal["twinning", "model_free", "model_based"]


@dataclass(frozen=True, kw_only=True)
class TwinningConfig:
    """Hyper-parameters of the algorithm, by step.

    Args:
        arm: ``twinning``, or one of its halves alone: ``model_free`` makes steps 1 and 2, ``model_based`` 1 and 3 to 5.
        realisations: N_z, samples of the exogenous process per record in steps 4 and 5.
        records: n_S, real episodes that steps 3 to 5 look back on.
        virtual_episodes: N, over which step 5 judges a plan and step 6 compares the policies.
        exploration: step 1.
        learner: step 2.
        exogenous: step 3.
        assimilation: step 4.
        planner: step 5.
        referee: step 6.
        distillation: how step 6 clones between policies of different architectures.
    """

    arm: Arm = "twinning"
    realisations: int = 5
    records: int = 1
    virtual_episodes: int = 20
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    exogenous: ExogenousConfig = field(default_factory=ExogenousConfig)
    assimilation: AssimilationConfig = field(default_factory=AssimilationConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    referee: RefereeConfig = field(default_factory=RefereeConfig)
    distillation: DistillationConfig = field(default_factory=DistillationConfig)

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("realisations", "records", "virtual_episodes"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} must be at least 1.")
