from .actor_critic import ActorCritic
from .config import LearnerConfig, LongTermMemoryConfig, TD3Config
from .ddpg import DDPG
from .learner import Learner, make_learner
from .td3 import TD3

__all__ = [
    "DDPG",
    "TD3",
    "ActorCritic",
    "Learner",
    "LearnerConfig",
    "LongTermMemoryConfig",
    "TD3Config",
    "make_learner",
]
