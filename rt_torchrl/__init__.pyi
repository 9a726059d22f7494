"""The public names of the library; ``__init__.py`` imports each at its first use, from the module named here."""

# Plants and their parts
from .plants.actuators import DelayedActuator, LaggedActuator, ResonantActuator, ScaledActuator
from .plants.closures import BoundedPerceptron, PositiveCoefficients
from .plants.vector_field import LaggedCoefficients, ScaledCoefficients
from .plants.extension import ExtendedClosure, Extension
from .plants.vector_field import NeuralResidual
from .plants.plant import Plant, Transition
from .plants.policies import SaturatedAffine, SaturatedMLP, SmoothClip
from .plants.sampling import require_request, require_stable_step, rk4_step
from .plants.sensors import BiasedSensor, UnreadInput
from .plants.signal import Measurement, Named, Phase, Preview, Signal
from .plants.sensors import StackedObservations
from .contract import ContractReport, PlantContractError, check_plant
from .control.classical import ClassicalController

# Real systems
from .systems.calling_simulator import CallingSimulator, EpisodeAbandoned
from .systems.environment import PlantEnv
from .systems.exploration import ExplorationConfig
from .systems.faulty_system import FaultySystem, Injection
from .systems.operating_limits import OperatingLimits
from .systems.operating_limits_config import OperatingLimitsConfig
from .systems.operation.config import OperationConfig
from .systems.protocols.connected_plant import ConnectedPlant
from .systems.protocols.link import Link, LinkLostError, RefusedRequestError
from .systems.protocols.modbus import ModbusLink
from .systems.protocols.opc_ua import OpcUaLink
from .systems.protocols.relay import Relay
from .systems.protocols.served_system import served_system
from .systems.protocols.server_process import ServerProcess
from .systems.reading import Actuation, Reading
from .systems.real_system import RealSystem
from .systems.safety import SafetyConfig, SafetyLayer
from .systems.safety_report import SafetyEvent, SafetyReport
from .evaluation.unseen import RealController

# Trajectories and the twin
from .steps.config import LearnerConfig, LongTermMemoryConfig
from .steps.learn import ActorCritic, Learner, LearningMethod
from .trajectories.rollout import DivergenceError, Engine, Rollout
from .trajectories.state_feedback import StateFeedback
from .trajectories.trajectory import Scenario, Trajectory, control_cost, identification_cost
from .trajectories.twin import DigitalTwin
from .evaluation.clairvoyant import Clairvoyant, clairvoyant
from .control.forecasts import Decaying, Forecast, Held, Foreseen, Scattered
from .control.predictive_control import PredictiveConfig, PredictiveControl, RecedingHorizon
from .evaluation.limits import LimitConfig
from .fit.least_squares import Estimate, Estimation, EstimationConfig
from .fit.log import LogConfig, read_log
from .fit.sensors import SensorRecord, sensor_record
from .fit.sensors import Sensor, sensors_of
from .fit.uncertainty import Uncertainty

# The algorithm and the configurations of its steps
from .optimisers.descent import Descended, DescentConfig
from .algorithm import ReinforcementTwinning
from .steps.config import (
    PAPER,
    AssimilationConfig,
    ConstraintsConfig,
    ExogenousConfig,
    HypothesesConfig,
    PlannerConfig,
    RefereeConfig,
    ShortHorizonConfig,
    TwinningConfig,
)
from .steps.hypotheses.ensemble import TwinEnsemble
from .steps.plan import Planner, RecedingHorizonPlanner, WholeEpisodes
from .steps.short_horizon import ShortHorizon
from .steps.switch import DecisionTree, Evidence, ExpectedCost, Referee
from .steps.start import EarlierPolicies, FirstController, RecordedFlights, Start

# Trainings from the command line, and their results
from .interruption import require_finished
from .loading import begin_loading
from .options import check_options
from .runs.callbacks import EarlyStopping
from .runs.command_line import main_of
from .runs.compare import Comparison, compare_runs
from .runs.loaded_run import LoadedRun, load_run
from .runs.machine import require_device
from .runs.run import Run
from .runs.run_config import Preset, RunConfig
from .runs.shipped_plants import shipped_plants
from .figures.snapshot import Snapshot
from .export.exported_policy import ExportedPolicy, load_policy
from .systems.fmu_environment import FMUEnvironment, FMUError
from .export.fmu import export_policy_fmu, export_twin_fmu
from .export import export_c, export_controller, export_onnx, export_program, export_twin

__version__: str

__all__ = [
    "PAPER",
    "ActorCritic",
    "Actuation",
    "AssimilationConfig",
    "BiasedSensor",
    "BoundedPerceptron",
    "CallingSimulator",
    "Clairvoyant",
    "ClassicalController",
    "Comparison",
    "ConnectedPlant",
    "ConstraintsConfig",
    "ContractReport",
    "Decaying",
    "DecisionTree",
    "DelayedActuator",
    "Descended",
    "DescentConfig",
    "DigitalTwin",
    "DivergenceError",
    "EarlierPolicies",
    "EarlyStopping",
    "Engine",
    "EpisodeAbandoned",
    "Estimate",
    "Estimation",
    "EstimationConfig",
    "Evidence",
    "ExogenousConfig",
    "ExpectedCost",
    "ExplorationConfig",
    "ExportedPolicy",
    "ExtendedClosure",
    "Extension",
    "FMUEnvironment",
    "FMUError",
    "FaultySystem",
    "FirstController",
    "Forecast",
    "Foreseen",
    "Held",
    "HypothesesConfig",
    "Injection",
    "LaggedActuator",
    "LaggedCoefficients",
    "Learner",
    "LearnerConfig",
    "LearningMethod",
    "LimitConfig",
    "Link",
    "LinkLostError",
    "LoadedRun",
    "LogConfig",
    "LongTermMemoryConfig",
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
    "PositiveCoefficients",
    "PredictiveConfig",
    "PredictiveControl",
    "Preset",
    "Preview",
    "Reading",
    "RealController",
    "RealSystem",
    "RecedingHorizon",
    "RecedingHorizonPlanner",
    "RecordedFlights",
    "Referee",
    "RefereeConfig",
    "RefusedRequestError",
    "ReinforcementTwinning",
    "Relay",
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
    "Scattered",
    "Scenario",
    "Sensor",
    "SensorRecord",
    "ServerProcess",
    "ShortHorizon",
    "ShortHorizonConfig",
    "Signal",
    "SmoothClip",
    "Snapshot",
    "StackedObservations",
    "Start",
    "StateFeedback",
    "Trajectory",
    "Transition",
    "TwinEnsemble",
    "TwinningConfig",
    "Uncertainty",
    "UnreadInput",
    "WholeEpisodes",
    "begin_loading",
    "check_options",
    "check_plant",
    "clairvoyant",
    "compare_runs",
    "control_cost",
    "export_c",
    "export_controller",
    "export_onnx",
    "export_policy_fmu",
    "export_program",
    "export_twin",
    "export_twin_fmu",
    "identification_cost",
    "load_policy",
    "load_run",
    "main_of",
    "read_log",
    "require_device",
    "require_finished",
    "require_request",
    "require_stable_step",
    "rk4_step",
    "sensor_record",
    "sensors_of",
    "served_system",
    "shipped_plants",
]
