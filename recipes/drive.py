"""Reinforcement twinning of gym-electric-motor's series DC motor, whose speed is to follow a reference."""

from functools import partial
from typing import Any, Literal

import rt_torchrl as rt

rt.begin_loading(__name__)

import torch

RESISTANCE, INDUCTANCE = 0.064, 5.419e-3  # R [Ω], L [H]
EXCITATION, INERTIA = 2.2e-3, 2e-3  # L' [H], J [kg m²]: the data sheet's
VOLTAGE, CURRENT, TRIP, FASTEST = 60.0, 150.0, 210.0, 300.0  # V, A for a short time, A that trips the drive, rad/s
SPEED = rt.Signal(symbol=r"\omega", name="speed", unit="rad/s")
ARMATURE = rt.Signal(symbol="i", name="current", unit="A")
CHOPPER = rt.Signal(symbol="u", name="voltage", unit="V", low=0.0, high=VOLTAGE)
REFERENCE = rt.Signal(symbol=r"\omega^*", name="reference", unit="rad/s")


class MotorAndLoad(rt.PositiveCoefficients):
    """What the data sheet does not know exactly: the motor's flux, and what turns with it and against it."""

    names = {"excitation": "H", "inertia": "kg m^2", "friction": "N m s", "fan": "N m s^2"}


def error(plant, t, state, exogenous):
    return exogenous[..., 0] - state[..., 0]


class Drive(rt.Plant):
    """A chopper, a series DC motor and a fan; the drive trips at too much current."""

    name = "drive"
    states, actions, inputs = (SPEED, ARMATURE), (CHOPPER,), (REFERENCE,)
    state_sizes = (10.0, 10.0)
    measurements = (
        rt.Measurement.of(SPEED, offset=150.0, scale=100.0),
        rt.Measurement.of(ARMATURE, offset=60.0, scale=50.0),
        rt.Measurement(symbol="e", name="error", unit="rad/s", read=error, scale=20.0),
    )
    end_cost = 100.0

    def __init__(self, *, dt: float = 1e-3, horizon: float = 0.3):
        super().__init__(dt=dt, horizon=horizon, closure=self.make_closure())

    def vector_field(self, t, state, action, exogenous, closure):
        speed, current = state.unbind(-1)
        excitation, inertia, friction, fan = closure(state).unbind(-1)
        torque = excitation * current**2 - friction * speed - fan * speed * speed.abs()
        voltage = action[..., 0] - RESISTANCE * current - excitation * speed * current
        return torch.stack([torque / inertia, voltage / INDUCTANCE], -1)

    def running_cost(self, t, state, applied, exogenous):
        off = (1.0 + (error(self, t, state, exogenous) / 10.0) ** 2).sqrt() - 1.0  # about |error|/10
        return off + 100.0 * torch.relu(state[..., 1] / CURRENT - 1.0) ** 2

    def ended(self, state):
        return state[..., 1].abs() > TRIP

    def draw_initial_state(self, batch, generator):
        return torch.zeros(batch, 2, dtype=torch.float64)

    def draw_exogenous(self, batch, generator):
        first, size = torch.rand(2, batch, 1, generator=generator, dtype=torch.float64)
        steps = 0.04 * 100.0**size * torch.randn(batch, self.n_steps, generator=generator, dtype=torch.float64)
        return (FASTEST * first + steps.cumsum(-1)).clamp(0.0, FASTEST).unsqueeze(-1)

    def make_closure(self, generator=None):
        return MotorAndLoad([EXCITATION, INERTIA, 0.02, 5e-5])

    def setpoints(self, states, applied, exogenous):
        return {"speed [rad/s]": (states[..., 0], exogenous[..., 0])}

    def merit(self, states, applied, exogenous):
        square = error(self, None, states[..., :-1, :], exogenous).square()
        return {"RMS error [rad/s]": square.mean(-1).sqrt(), "greatest current [A]": states[..., 1].amax(-1)}


class Cascade(rt.ClassicalController):
    """PI of the speed, whose torque asks for a current, and PI of the current around the back-EMF."""

    gain_units = {"speed_loop": "rad/s", "current_loop": "rad/s"}
    default_gains = (200.0, 900.0)
    memory_size = 2

    def law(self, state, memory, exogenous):
        (outer, inner), (speed, current) = self.gains.unbind(), state.split(1, -1)
        lack = INERTIA * (exogenous - speed)
        torque = outer * lack + memory[:, :1]
        reference = (torch.relu(torque) / EXCITATION).sqrt().clamp(max=CURRENT)
        off = INDUCTANCE * (reference - current)
        command = inner * off + EXCITATION * speed * current + memory[:, 1:]
        free = (command > 0.0) & (command < VOLTAGE)  # at an end of a range, the integrals stand still
        inside = free & (torque > 0.0) & (reference < CURRENT)
        integrals = torch.cat([inside * outer**2 * lack, free * inner**2 * off], -1)
        return command, memory + 0.25 * self.plant.dt * integrals


def real_system(plant: Drive, *, seed: int = 0):
    """gym-electric-motor's series DC motor with another load; the reference is a random walk."""
    from gym_electric_motor.envs import ContSpeedControlDcSeriesMotorEnv
    from gym_electric_motor.physical_systems import PolynomialStaticLoad
    from gym_electric_motor.reference_generators import WienerProcessReferenceGenerator
    from gymnasium.wrappers import FlattenObservation
    from torchrl.envs import GymWrapper

    machine = ContSpeedControlDcSeriesMotorEnv(
        tau=plant.dt,
        load=PolynomialStaticLoad({"b": 0.01, "c": 1e-4, "j_load": 5e-4}),
        reference_generator=WienerProcessReferenceGenerator(sigma_range=(1e-4, 1e-2)),
        visualization=(),
    )
    read = [machine.state_names.index(name) for name in ("omega", "i")]
    limits = machine.limits[read]  # it reports shares of these
    return rt.RealSystem(
        GymWrapper(FlattenObservation(machine)),
        plant,
        state=rt.Reading(of=lambda observed: observed[..., read], scale=limits),
        exogenous=rt.Reading(of=lambda observed: observed[..., -1:], scale=limits[0]),
        actuation=rt.Actuation(scale=VOLTAGE),
        seed=seed,
    )


@rt.configuration
class Config(rt.RunConfig):
    """Let the speed of gym-electric-motor's series DC motor follow a reference.

    Args:
        policy: plant (the plant's own affine law) or mlp.
    """

    policy: Literal["plant", "mlp"] = "mlp"
    hidden: tuple[int, ...] = (16, 16)
    episodes: int = 6
    real_unseen: int = 20

    def plant(self) -> Drive:
        return Drive()


def main(config: Config, **parts: Any) -> None:
    """Train; ``parts`` are further arguments of :class:`Run`, such as ``learner``."""
    plant = config.plant()
    env = partial(real_system, plant, seed=config.seed)
    rt.Run(config, plant, env=env, first=Cascade, baselines={"cascade": Cascade}, **parts).train()


if __name__ == "__main__":
    rt.main_of(Config, main)
