"""A quadrotor flies to a point in gusts; two_plants.md beside this file has the equations and results."""

import numpy as np
import torch

import rt_torchrl as rt

MASS, INERTIA, ARM, GRAVITY = 0.5, 0.004, 0.15, 9.81  # kg, kg m², m, m/s²
TARGET, HOVER = (2.0, 2.0), 0.5 * MASS * GRAVITY  # x and z [m], thrust of a rotor [N]


class RotorsAndDrag(rt.PositiveCoefficients):
    """What nobody knows of the quadrotor."""

    names = {"left_rotor": "-", "right_rotor": "-", "drag": "N s^2/m^2"}
    meanings = {"left_rotor": "thrust over its data sheet's", "right_rotor": "thrust over its data sheet's"}
    true_coefficients = (0.85, 0.95, 0.06)


class Quadrotor(rt.Plant):
    """A quadrotor in a vertical plane, in gusts."""

    name = "quadrotor"
    states = (
        rt.Signal(symbol="x", name="position", unit="m"),
        rt.Signal(symbol="z", name="height", unit="m"),
        rt.Signal(symbol=r"\theta", name="pitch", unit="rad"),
        rt.Signal(symbol="v_x", name="speed", unit="m/s"),
        rt.Signal(symbol="v_z", name="climb", unit="m/s"),
        rt.Signal(symbol="q", name="pitch_rate", unit="rad/s"),
    )
    state_sizes = (1.0, 1.0, 0.5, 1.0, 1.0, 3.0)  # differences that count alike when the twin is fitted
    actions = (
        rt.Signal(symbol="F_l", name="left_thrust", unit="N", low=0.0, high=6.0),
        rt.Signal(symbol="F_r", name="right_thrust", unit="N", low=0.0, high=6.0),
    )
    inputs = (rt.Signal(symbol="w", name="gust", unit="m/s"),)
    measurements = (
        rt.Measurement.of(states[0], offset=TARGET[0], scale=2.0),
        rt.Measurement.of(states[1], offset=TARGET[1], scale=2.0),
        rt.Measurement.of(states[2], scale=0.5),
        rt.Measurement.of(states[3], scale=2.0),
        rt.Measurement.of(states[4], scale=2.0),
        rt.Measurement.of(states[5], scale=5.0),
    )

    def __init__(self, *, dt=0.01, horizon=5.0):
        super().__init__(dt=dt, horizon=horizon, closure=RotorsAndDrag.true())

    def vector_field(self, t, state, action, exogenous, closure):
        _, _, pitch, speed, climb, rate = state.unbind(-1)
        left, right, drag = closure(state).unbind(-1)
        left, right = left * action[..., 0], right * action[..., 1]
        headway = speed - exogenous[..., 0]
        airspeed = (headway**2 + climb**2 + 1e-4).sqrt()  # the slope of √ at zero would be infinite
        across = (-(left + right) * torch.sin(pitch) - drag * airspeed * headway) / MASS
        up = ((left + right) * torch.cos(pitch) - drag * airspeed * climb) / MASS - GRAVITY
        return torch.stack([speed, climb, rate, across, up, ARM * (right - left) / INERTIA], -1)

    def running_cost(self, t, state, applied, exogenous):
        away = (state[..., 0] - TARGET[0]) ** 2 + (state[..., 1] - TARGET[1]) ** 2
        effort = ((applied - HOVER) ** 2).sum(-1)
        return away + 0.1 * state[..., 2] ** 2 + 0.05 * state[..., 5] ** 2 + 0.05 * effort

    def draw_initial_state(self, batch, generator):
        spread = torch.tensor([0.5, 0.5, 0.1, 0.2, 0.2, 0.1], dtype=torch.float64)
        return spread * (2.0 * torch.rand(batch, 6, generator=generator, dtype=torch.float64) - 1.0)

    def draw_exogenous(self, batch, generator):
        t = self.dt * torch.arange(self.n_steps, dtype=torch.float64)
        wind, gust, when = torch.rand(3, batch, 1, generator=generator, dtype=torch.float64)
        series = 4.0 * wind - 2.0 + 3.0 * gust * torch.exp(-(((t - 1.0 - 3.0 * when) / 0.4) ** 2))
        return series.unsqueeze(-1)

    def make_closure(self, generator):
        return RotorsAndDrag(torch.tensor([1.0, 1.0, 0.02]))  # the data sheet, and a guess

    def setpoints(self, states, applied, exogenous):
        x, z = states[..., 0], states[..., 1]
        return {"position [m]": (x, torch.full_like(x, TARGET[0])), "height [m]": (z, torch.full_like(z, TARGET[1]))}

    def merit(self, states, applied, exogenous):
        away = ((states[..., :2] - states.new_tensor(TARGET)) ** 2).sum(-1).sqrt()
        return {"final distance [m]": away[..., -1]}


class LQR(rt.ClassicalController):
    """The linear-quadratic regulator of the data sheet; the library limits its command to the actions' ranges."""

    def __init__(self, plant, gains=None, **options):
        from scipy.linalg import solve_continuous_are

        super().__init__(plant, gains, **options)
        a, b = np.zeros((6, 6)), np.zeros((6, 2))  # linearised about hover
        a[0, 3] = a[1, 4] = a[2, 5] = 1.0
        a[3, 2] = -GRAVITY
        b[4], b[5] = 1.0 / MASS, (-ARM / INERTIA, ARM / INERTIA)
        weights, effort = np.diag([1.0, 1.0, 0.1, 1e-3, 1e-3, 0.05]), 0.05 * np.eye(2)
        gain = np.linalg.solve(effort, b.T @ solve_continuous_are(a, b, weights, effort))
        self.register_buffer("gain", torch.tensor(gain))
        self.register_buffer("target", torch.tensor([*TARGET, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))

    def law(self, state, memory, exogenous):
        return HOVER - (state - self.target) @ self.gain.T, memory


TWINNING = rt.TwinningConfig(
    assimilation=rt.AssimilationConfig(method="levenberg_marquardt", inputs="record"),  # three weights, gusts measured
    planner=rt.PlannerConfig(iterations=40, realisations=20, descent=rt.DescentConfig(optimiser="lbfgs", rate=1.0)),
)


@rt.configuration
class Config(rt.RunConfig):
    """Fly a quadrotor to a point in gusts."""

    episodes: int = 6
    start: str = "controller"
    twinning: rt.TwinningConfig = TWINNING

    def plant(self):
        return Quadrotor()


def main(config):
    """Check the plant, then train."""
    plant = config.plant()
    print(rt.check_plant(plant))
    rt.Run(config, plant, first=LQR, baselines={"LQR": LQR}).train()


if __name__ == "__main__":
    rt.main_of(Config, main)
