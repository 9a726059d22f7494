"""Reinforcement Twinning: a digital twin and two controllers, trained while the real system runs."""

from rt_torchrl.algorithm import ReinforcementTwinning, TwinningConfig
from rt_torchrl.contract import PlantContractError, check_plant
from rt_torchrl.environment import PlantEnv
from rt_torchrl.plant import Plant
from rt_torchrl.real_system import Actuation, Reading, RealSystem
from rt_torchrl.signal import Signal
from rt_torchrl.trajectory import DivergenceError, Rollout, Trajectory, control_cost, identification_cost
from rt_torchrl.twin import DigitalTwin

__all__ = [
    "Actuation",
    "DigitalTwin",
    "DivergenceError",
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
]
