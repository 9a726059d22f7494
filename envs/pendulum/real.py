"""Gymnasium's ``Pendulum-v1`` itself, in the terms of the plant."""

import torch
from torch import Tensor
from torchrl.envs import GymWrapper

from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.loading import of_extra
from rt_torchrl.systems.real_system import Reading, RealSystem


def angle_and_speed(observation: Tensor) -> Tensor:
    """The state θ [rad] and dθ/dt [rad/s] from the observation (cos θ, sin θ, dθ/dt)."""
    cosine, sine, rate = observation.unbind(-1)
    return torch.stack([torch.atan2(sine, cosine), rate], -1)


def gymnasium_pendulum(plant: Pendulum, *, seed: int = 0, device: torch.device | str = "cpu") -> RealSystem:
    """The real system, which reports in single precision.

    Args:
        plant: the plant, with Gymnasium's time step.
        seed: seed of the initial states.
        device: device of the reported tensors.

    Raises:
        ValueError: if Gymnasium is not installed, or its time step is not that of the plant.
    """
    env = of_extra("gymnasium", "gym").make("Pendulum-v1", g=plant.gravity, max_episode_steps=plant.n_steps)
    dt = vars(env.unwrapped)["dt"]
    if dt != plant.dt:
        raise ValueError(f"dt={plant.dt} s of the plant must be that of Gymnasium's pendulum, {dt} s.")
    return RealSystem(GymWrapper(env), plant, state=Reading(of=angle_and_speed), seed=seed, device=device)
