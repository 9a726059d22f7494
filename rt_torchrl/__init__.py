"""Reinforcement Twinning: a digital twin and two controllers, trained while the real system runs."""

from rt_torchrl.contract import ContractReport, PlantContractError, check_plant
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal
from rt_torchrl.runs.loaded_run import LoadedRun, load_run
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.real_system import Actuation, Reading, RealSystem
from rt_torchrl.trajectories.trajectory import DivergenceError, Rollout, Trajectory, control_cost, identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.algorithm import ReinforcementTwinning, TwinningConfig

__all__ = [
    "Actuation",
    "ContractReport",
    "DigitalTwin",
    "DivergenceError",
    "LoadedRun",
    "Plant",
    "PlantContractError",
    "PlantEnv",
    "Reading",
    "RealSystem",
    "ReinforcementTwinning",
    "Rollout",
    "Signal",
    "Trajectory",
    "TwinningConfig",
    "check_plant",
    "control_cost",
    "identification_cost",
    "load_run",
]
