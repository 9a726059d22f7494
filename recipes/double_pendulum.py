"""Reinforcement twinning of MuJoCo's cart, which has to keep two rods upright, one on top of the other."""

from functools import partial
from typing import Any

import rt_torchrl as rt

rt.begin_loading(__name__)

import torch

CART, ROD, INERTIA, GRAVITY = 10.472, 4.1987, 0.15497, 9.81  # M [kg], m [kg] and I [kg m²] of each rod, g [m/s²]
LENGTH, CENTRE = 0.6, 0.3  # length l of each rod, and distance c of its centre of gravity from its lower end [m]
BOTH, UPPER = ROD * (LENGTH + CENTRE), ROD * CENTRE  # first moments of both rods and of the upper rod [kg m]
TOTAL, TURNED = CART + 2.0 * ROD, INERTIA + ROD * CENTRE**2  # mass [kg], inertia about a rod's lower end [kg m²]
SWUNG = TURNED + ROD * LENGTH**2  # inertia about the cart's joint, with the upper rod at the end of the lower one


class DriveAndFriction(rt.PositiveCoefficients):
    """What nobody knows of the cart."""

    names = {"drive": "N", "rail_friction": "N s/m", "joint_friction": "N m s/rad"}
    meanings = {"drive": "greatest force on the cart"}


class DoublePendulum(rt.Plant):
    """A cart on a rail and two rods with joints; the upper angle is that between the rods, as MuJoCo counts."""

    name = "double_pendulum"
    states = (
        rt.Signal(symbol="x", name="position", unit="m"),
        rt.Signal(symbol=r"\theta_1", name="lower_angle", unit="rad"),
        rt.Signal(symbol=r"\theta_2", name="upper_angle", unit="rad"),
        rt.Signal(symbol=r"\dot x", name="speed", unit="m/s"),
        rt.Signal(symbol=r"\dot\theta_1", name="lower_rate", unit="rad/s"),
        rt.Signal(symbol=r"\dot\theta_2", name="upper_rate", unit="rad/s"),
    )
    state_sizes = (0.1, 0.1, 0.1, 0.5, 0.5, 0.5)
    actions = (rt.Signal(symbol="u", name="command", unit="-", low=-1.0, high=1.0),)
    measurements = tuple(rt.Measurement.of(s, scale=size) for s, size in zip(states, state_sizes, strict=True))
    end_cost = 9.36  # what an upright pendulum earns in Gymnasium, and a fallen one does not

    def __init__(self, *, dt: float = 0.05, horizon: float = 10.0):
        super().__init__(dt=dt, horizon=horizon, closure=self.make_closure())

    def vector_field(self, t, state, action, exogenous, closure):
        lower, bend, speed, lower_rate, bend_rate = state[..., 1:].unbind(-1)
        drive, rail, joint = closure(state).unbind(-1)
        upper, upper_rate = lower + bend, lower_rate + bend_rate  # against the vertical
        a, b, c, ones = BOTH * lower.cos(), UPPER * upper.cos(), UPPER * LENGTH * bend.cos(), torch.ones_like(bend)
        inertias = torch.stack([TOTAL * ones, a, b, a, SWUNG * ones, c, b, c, TURNED * ones], -1).unflatten(-1, (3, 3))
        coupling = UPPER * LENGTH * bend.sin()
        swing = BOTH * lower.sin() * lower_rate**2 + UPPER * upper.sin() * upper_rate**2
        forces = (
            drive * action[..., 0] - rail * speed + swing,
            BOTH * GRAVITY * lower.sin() + coupling * upper_rate**2 - joint * (lower_rate - bend_rate),
            UPPER * GRAVITY * upper.sin() - coupling * lower_rate**2 - joint * bend_rate,
        )
        speed_up, lower_up, upper_up = torch.linalg.solve(inertias, torch.stack(forces, -1)).unbind(-1)
        return torch.stack([speed, lower_rate, bend_rate, speed_up, lower_up, upper_up - lower_up], -1)

    def tip(self, state):
        """Position and height of the upper end [m]."""
        x, lower, bend = state[..., :3].unbind(-1)
        return x + LENGTH * (lower.sin() + (lower + bend).sin()), LENGTH * (lower.cos() + (lower + bend).cos())

    def running_cost(self, t, state, applied, exogenous):
        (across, height), (lower_rate, bend_rate) = self.tip(state), state[..., 4:].unbind(-1)
        penalty = 0.01 * across**2 + (height - 2.0) ** 2 + 1e-3 * lower_rate**2 + 5e-3 * bend_rate**2
        return penalty - (2.0 * LENGTH - 2.0) ** 2  # what Gymnasium's reward is less than that of the upright pendulum

    def ended(self, state):
        return self.tip(state)[1] <= 1.0

    def draw_initial_state(self, batch, generator):
        positions = 2.0 * torch.rand(batch, 3, generator=generator, dtype=torch.float64) - 1.0
        return 0.1 * torch.cat([positions, torch.randn(batch, 3, generator=generator, dtype=torch.float64)], -1)

    def draw_exogenous(self, batch, generator):
        return torch.zeros(batch, self.n_steps, 0, dtype=torch.float64)

    def make_closure(self, generator=None):
        return DriveAndFriction([300.0, 0.2, 0.5])  # the data sheet's drive, and guesses


class LQR(rt.ClassicalController):
    """The linear-quadratic regulator for the data sheet and the curvature of the cost at the upright pendulum."""

    effort = 0.3  # weight of the squared command: of twelve, the best of this data sheet on the exact model

    def __init__(self, plant, gains=None, **options):
        from scipy.linalg import solve_discrete_are
        from scipy.signal import cont2discrete

        super().__init__(plant, gains, **options)
        s, u = torch.zeros(6, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
        rates = partial(plant.vector_field, 0.0, exogenous=None, closure=plant.make_closure())
        a, b = (slope.detach().numpy() for slope in torch.autograd.functional.jacobian(rates, (s, u)))
        curvature = torch.autograd.functional.hessian(lambda s: plant.running_cost(0.0, s, u, None), s).numpy()
        a, b, *_ = cont2discrete((a, b, a, b), plant.dt)
        p = solve_discrete_are(a, b, 0.5 * curvature, [[self.effort]])
        self.register_buffer("gain", torch.from_numpy(b.T @ p @ a / (self.effort + b.T @ p @ b)))

    def law(self, state, memory, exogenous):
        return -state @ self.gain.T, memory


def state_of(observed):
    """Position, angles and rates from what Gymnasium observes: sines and cosines of the angles, and a force at last."""
    x, sine, upper_sine, cosine, upper_cosine, *rates, _ = observed.unbind(-1)
    return torch.stack([x, torch.atan2(sine, cosine), torch.atan2(upper_sine, upper_cosine), *rates], -1)


def real_system(plant: DoublePendulum, *, seed: int = 0) -> "rt.RealSystem":
    """MuJoCo's double pendulum in Gymnasium."""
    import gymnasium
    from torchrl.envs import GymWrapper

    machine = gymnasium.make("InvertedDoublePendulum-v5", max_episode_steps=plant.n_steps)
    return rt.RealSystem(GymWrapper(machine), plant, state=rt.Reading(of=state_of), seed=seed)


@rt.configuration
class Config(rt.RunConfig):
    """Keep MuJoCo's double pendulum upright."""

    episodes: int = 6
    real_unseen: int = 20

    def plant(self) -> DoublePendulum:
        return DoublePendulum()


def main(config: Config, **parts: Any) -> None:
    """Train; ``parts`` are further arguments of :class:`Run`, such as ``learner``."""
    plant = config.plant()
    env = partial(real_system, plant, seed=config.seed)
    rt.Run(config, plant, env=env, first=LQR, baselines={"LQR": LQR}, **parts).train()


if __name__ == "__main__":
    rt.main_of(Config, main)
