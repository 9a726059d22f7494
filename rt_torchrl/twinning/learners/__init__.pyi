from .actor_critic import ActorCritic
from .choice import make_learner
from .config import IncrementalTD3Config, LearnerConfig, LongTermMemoryConfig, TD3Config
from .ddpg import DDPG
from .incremental_td3 import IncrementalTD3
from .learner import Learner
from .td3 import TD3

__all__ = [
    "DDPG",
    "TD3",
    "ActorCritic",
    "IncrementalTD3",
    "IncrementalTD3Config",
    "Learner",
    "LearnerConfig",
    "LongTermMemoryConfig",
    "TD3Config",
    "make_learner",
]
