"""The learners that a configuration can name."""

import torch
from torch import nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.twinning.learners.config import LearnerConfig, LearnerName
from rt_torchrl.twinning.learners.ddpg import DDPG
from rt_torchrl.twinning.learners.learner import Learner
from rt_torchrl.twinning.learners.td3 import TD3

LEARNERS: dict[LearnerName, type[DDPG] | type[TD3]] = {"ddpg": DDPG, "td3": TD3}


def make_learner(plant: Plant, policy: nn.Module, config: LearnerConfig, *, generator: torch.Generator) -> Learner:
    """The learner that a configuration names; :class:`ActorCritic` describes the arguments."""
    return LEARNERS[config.algorithm](plant, policy, config, generator=generator)
