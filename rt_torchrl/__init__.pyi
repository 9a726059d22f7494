"""The public names of the library: ``__init__.py`` imports them from where this file says, each at its first use."""

# Plants and what may stand in them
from .plants.closures import BoundedPerceptron, PositiveCoefficients
from .plants.disturbance import require_request
from .plants.integrators import rk4_step
from .plants.plant import Plant, Transition, require_stable_step
from .plants.policies import SaturatedAffine, SaturatedMLP, SmoothClip
from .plants.signal import Signal
from .contract import PlantContractError, check_plant
from .baselines.classical import ClassicalController

# Real systems
from .systems.calling_simulator import CallingSimulator, EpisodeAbandoned
from .systems.environment import PlantEnv
from .systems.exploration import ExplorationConfig
from .systems.real_system import Actuation, Reading, RealSystem
from .systems.safety import SafetyConfig, SafetyEvent, SafetyLayer, SafetyReport
from .evaluation.real_episodes import RealController

# Trajectories and the twin
from .trajectories.trajectory import DivergenceError, Engine, Rollout, Trajectory, control_cost, identification_cost
from .trajectories.twin import DigitalTwin
from .identification.identification import Identification, IdentificationConfig
from .identification.sensor_log import read_log

# The algorithm and the configurations of its steps
from .optimisers.descent import DescentConfig
from .twinning.algorithm import ReinforcementTwinning, TwinningConfig
from .twinning.assimilation import AssimilationConfig
from .twinning.distillation import DistillationConfig
from .twinning.exogenous import ExogenousConfig
from .twinning.memory import LongTermMemoryConfig
from .twinning.model_based import ModelBasedConfig
from .twinning.model_free import ModelFreeConfig
from .twinning.short_horizon import ShortHorizonConfig
from .twinning.switching import SwitchConfig

# Trainings from the command line, and what they leave
from .runs.run import Run, main_of
from .runs.run_config import RunConfig
from .runs.shipped_plants import shipped_plants
from .figures.snapshot import Snapshot
from .export import export_c, export_onnx, export_program

__version__: str

__all__ = [
    "Actuation",
    "AssimilationConfig",
    "BoundedPerceptron",
    "CallingSimulator",
    "ClassicalController",
    "DescentConfig",
    "DigitalTwin",
    "DistillationConfig",
    "DivergenceError",
    "Engine",
    "EpisodeAbandoned",
    "ExogenousConfig",
    "ExplorationConfig",
    "Identification",
    "IdentificationConfig",
    "LongTermMemoryConfig",
    "ModelBasedConfig",
    "ModelFreeConfig",
    "Plant",
    "PlantContractError",
    "PlantEnv",
    "PositiveCoefficients",
    "Reading",
    "RealController",
    "RealSystem",
    "ReinforcementTwinning",
    "Rollout",
    "Run",
    "RunConfig",
    "SafetyConfig",
    "SafetyEvent",
    "SafetyLayer",
    "SafetyReport",
    "SaturatedAffine",
    "SaturatedMLP",
    "ShortHorizonConfig",
    "Signal",
    "SmoothClip",
    "Snapshot",
    "SwitchConfig",
    "Trajectory",
    "Transition",
    "TwinningConfig",
    "check_plant",
    "control_cost",
    "export_c",
    "export_onnx",
    "export_program",
    "identification_cost",
    "main_of",
    "read_log",
    "require_request",
    "require_stable_step",
    "rk4_step",
    "shipped_plants",
]
