"""The public names of the library; ``__init__.py`` imports each at its first use, from the module named here."""

# Plants and their parts
from .plants.actuators import (
    DelayedActuator,
    LaggedActuator,
    PlayActuator,
    RateLimitedActuator,
    ResonantActuator,
    ScaledActuator,
    StickingActuator,
)
from .plants.closures import BoundedPerceptron, PositiveCoefficients
from .plants.vector_field import ScaledCoefficients
from .plants.extension import ExtendedClosure, Extension
from .plants.vector_field import NeuralResidual
from .plants.plant import Plant, Transition
from .plants.policies import SaturatedAffine, SaturatedMLP, SmoothClip
from .plants.sampling import require_stable_step, rk4_step
from .plants.sensors import BiasedSensor
from .plants.signal import Measurement, Named, Phase, Preview, Signal
from .plants.sensors import StackedObservations
from .contract import ContractReport, PlantContractError, check_plant
from .control.classical import ClassicalController
from .control.discon import DISCON

# Real systems
from .systems.adapters import CallingSimulator, EpisodeAbandoned, FMUEnvironment, FMUError
from .systems.config import OperatingLimitsConfig, OperationConfig, SafetyConfig
from .systems.environment import PlantEnv
from .systems.exploration import ExplorationConfig
from .systems.machine.connected_plant import ConnectedPlant, Link, LinkLostError, RefusedRequestError
from .systems.machine.modbus import ModbusLink, Register
from .systems.machine.opc_ua import OpcUaLink
from .systems.preflight import Wiring, WiringError, check_real_system
from .systems.real_system import Actuation, Reading, RealSystem
from .systems.safety import OperatingLimits, SafetyEvent, SafetyLayer, SafetyReport
from .evaluation.unseen import RealController

# Trajectories and the twin
from .trajectories.rollout import DivergenceError, Engine, Rollout
from .trajectories.state_feedback import StateFeedback
from .trajectories.trajectory import Scenario, Trajectory, control_cost, identification_cost
from .trajectories.twin import DigitalTwin
from .control.forecasts import Decaying, Forecast
from .control.predictive_control import PredictiveConfig, PredictiveControl, RecedingHorizon

# Identification
from .fit.least_squares import Estimate, Estimation, EstimationConfig
from .fit.log import LogConfig, read_log
from .fit.sensors import SensorRecord, sensor_record
from .fit.sensors import Sensor, sensors_of
from .fit.uncertainty import Uncertainty

# The algorithm and the configurations of its steps
from .steps.config import LearnerConfig
from .steps.learn import ActorCritic, Learner
from .steps.losses import LearningMethod
from .optimisers.descent import Descended, DescentConfig
from .algorithm import ReinforcementTwinning
from .steps.config import (
    PAPER,
    AssimilationConfig,
    ExogenousConfig,
    HypothesesConfig,
    PlannerConfig,
    RefereeConfig,
    TwinningConfig,
)
from .steps.hypotheses.ensemble import TwinEnsemble
from .steps.plan import Planner, RecedingHorizonPlanner, WholeEpisodes
from .steps.switch import DecisionTree, Evidence, Referee
from .steps.start import EarlierPolicies, FirstController, RecordedFlights, Start

# Trainings from the command line, and their results
from .loading import begin_loading
from .options import configuration
from .runs.compare import Comparison, compare_runs
from .runs.diagnosis import Reason, diagnose
from .runs.loaded_run import LoadedRun, load_run
from .runs.run import Run
from .runs.run_config import Preset, RunConfig, require_device
from .runs.command_line import main_of, shipped_plants
from .figures.snapshot import Snapshot
from .export.fmu import export_policy_fmu, export_twin_fmu
from .export.discon import export_discon
from .export import export_c, export_controller, export_onnx, export_twin

__version__: str

__all__ = [
    "DISCON",
    "PAPER",
    "ActorCritic",
    "Actuation",
    "AssimilationConfig",
    "BiasedSensor",
    "BoundedPerceptron",
    "CallingSimulator",
    "ClassicalController",
    "Comparison",
    "ConnectedPlant",
    "ContractReport",
    "Decaying",
    "DecisionTree",
    "DelayedActuator",
    "Descended",
    "DescentConfig",
    "DigitalTwin",
    "DivergenceError",
    "EarlierPolicies",
    "Engine",
    "EpisodeAbandoned",
    "Estimate",
    "Estimation",
    "EstimationConfig",
    "Evidence",
    "ExogenousConfig",
    "ExplorationConfig",
    "ExtendedClosure",
    "Extension",
    "FMUEnvironment",
    "FMUError",
    "FirstController",
    "Forecast",
    "HypothesesConfig",
    "LaggedActuator",
    "Learner",
    "LearnerConfig",
    "LearningMethod",
    "Link",
    "LinkLostError",
    "LoadedRun",
    "LogConfig",
    "Measurement",
    "ModbusLink",
    "Named",
    "NeuralResidual",
    "OpcUaLink",
    "OperatingLimits",
    "OperatingLimitsConfig",
    "OperationConfig",
    "Phase",
    "Planner",
    "PlannerConfig",
    "Plant",
    "PlantContractError",
    "PlantEnv",
    "PlayActuator",
    "PositiveCoefficients",
    "PredictiveConfig",
    "PredictiveControl",
    "Preset",
    "Preview",
    "RateLimitedActuator",
    "Reading",
    "RealController",
    "RealSystem",
    "Reason",
    "RecedingHorizon",
    "RecedingHorizonPlanner",
    "RecordedFlights",
    "Referee",
    "RefereeConfig",
    "RefusedRequestError",
    "Register",
    "ReinforcementTwinning",
    "ResonantActuator",
    "Rollout",
    "Run",
    "RunConfig",
    "SafetyConfig",
    "SafetyEvent",
    "SafetyLayer",
    "SafetyReport",
    "SaturatedAffine",
    "SaturatedMLP",
    "ScaledActuator",
    "ScaledCoefficients",
    "Scenario",
    "Sensor",
    "SensorRecord",
    "Signal",
    "SmoothClip",
    "Snapshot",
    "StackedObservations",
    "Start",
    "StateFeedback",
    "StickingActuator",
    "Trajectory",
    "Transition",
    "TwinEnsemble",
    "TwinningConfig",
    "Uncertainty",
    "WholeEpisodes",
    "Wiring",
    "WiringError",
    "begin_loading",
    "check_plant",
    "check_real_system",
    "compare_runs",
    "configuration",
    "control_cost",
    "diagnose",
    "export_c",
    "export_controller",
    "export_discon",
    "export_onnx",
    "export_policy_fmu",
    "export_twin",
    "export_twin_fmu",
    "identification_cost",
    "load_run",
    "main_of",
    "read_log",
    "require_device",
    "require_stable_step",
    "rk4_step",
    "sensor_record",
    "sensors_of",
    "shipped_plants",
]
