"""A heater keeps a room warm during four winter days; two_plants.md beside this file has equations and results."""

import math

import torch

import rt_torchrl as rt

DAY, HOUR = 86400.0, 3600.0  # s
AIR, WALLS, WINDOW = 1.5e6, 1.2e7, 4.0  # J/K, J/K, m²
COMFORT, POWER = 21.0, 3000.0  # °C, W


class Losses(rt.PositiveCoefficients):
    """What nobody knows of the room: three conductances, and the share of the sun that comes in."""

    names = {"window_loss": "W/K", "inner_wall": "W/K", "outer_wall": "W/K", "solar_gain": "-"}
    true_coefficients = (35.0, 180.0, 40.0, 0.55)


ROOM = rt.Signal(symbol="T_r", name="room_temperature", unit="degC")
WALL = rt.Signal(symbol="T_m", name="wall_temperature", unit="degC")
OUTSIDE = rt.Signal(symbol="T_o", name="outside_temperature", unit="degC")
SUN = rt.Signal(symbol="I", name="sun", unit="W/m^2", low=0.0)


class HeatedRoom(rt.Plant):
    """A room with its walls, a heater, and the weather."""

    name = "heated_room"
    states = (ROOM, WALL)
    actions = (rt.Signal(symbol="P", name="heater_power", unit="W", low=0.0, high=POWER),)
    inputs = (OUTSIDE, SUN)
    measurements = (
        rt.Measurement.of(ROOM, offset=COMFORT, scale=2.0),
        rt.Measurement.of(WALL, offset=COMFORT, scale=2.0),
        rt.Measurement.of(OUTSIDE, offset=5.0, scale=5.0),
        rt.Measurement.of(SUN, offset=100.0, scale=200.0),
        rt.Measurement(symbol=r"\cos", name="day_cosine", unit="-", read=rt.Phase("cosine", DAY)),
        rt.Measurement(symbol=r"\sin", name="day_sine", unit="-", read=rt.Phase("sine", DAY)),
    )

    def __init__(self, *, dt=600.0, horizon=4 * DAY):
        super().__init__(dt=dt, horizon=horizon, closure=Losses.true())

    def vector_field(self, t, state, action, exogenous, closure):
        (room, wall), (outside, sun) = state.unbind(-1), exogenous.unbind(-1)
        window, inner, outer, gain = closure(state).unbind(-1)
        to_room = action[..., 0] + gain * WINDOW * sun + window * (outside - room) + inner * (wall - room)
        to_wall = inner * (room - wall) + outer * (outside - wall)
        return torch.stack([to_room / AIR, to_wall / WALLS], -1)

    def occupied(self, t):
        """1 by day and 0 by night, with smooth steps at 7 h and 22 h."""
        noon = torch.cos(2.0 * math.pi * (t / HOUR - 14.5) / 24.0)
        return torch.sigmoid(6.0 * (noon - math.cos(2.0 * math.pi * 7.5 / 24.0)))

    def running_cost(self, t, state, applied, exogenous):
        cold, hot = (torch.nn.functional.softplus(4.0 * off) / 4.0 for off in self.outside_of_comfort(state))
        return self.occupied(t) * (cold**2 + hot**2) + applied[..., 0] / POWER

    def outside_of_comfort(self, state):
        return COMFORT - state[..., 0], state[..., 0] - COMFORT - 3.0

    def draw_initial_state(self, batch, generator):
        return 17.0 + 4.0 * torch.rand(batch, 2, generator=generator, dtype=torch.float64)

    def draw_exogenous(self, batch, generator):
        hour = self.dt / HOUR * torch.arange(self.n_steps, dtype=torch.float64)
        mean, change = torch.rand(2, batch, 1, generator=generator, dtype=torch.float64)
        weather = 12.0 * mean - 4.0 + (4.0 * change - 2.0) * hour / 96.0
        outside = weather + 4.0 * torch.cos(math.pi * (hour - 15.0) / 12.0)
        days = torch.rand(batch, 1 + int(hour[-1] // 24), generator=generator, dtype=torch.float64)
        sun = 500.0 * days[:, (hour // 24).long()] * torch.relu(torch.cos(math.pi * (hour - 12.5) / 12.0))
        return torch.stack([outside, sun], -1)

    def make_closure(self, generator):
        return Losses(torch.tensor([60.0, 100.0, 80.0, 0.3]))

    def setpoints(self, states, applied, exogenous):
        return {"room temperature [degC]": (states[..., 0], torch.full_like(states[..., 0], COMFORT))}

    def merit(self, states, applied, exogenous):
        t = self.dt * torch.arange(applied.shape[-2], dtype=states.dtype)
        cold = self.occupied(t) * torch.relu(self.outside_of_comfort(states[..., :-1, :])[0])
        return {"energy [kWh/day]": 24e-3 * applied[..., 0].mean(-1), "cold by day [K h/day]": 24.0 * cold.mean(-1)}


class Thermostat(rt.ClassicalController):
    """Switches the heater on below a band of temperatures, and off above; it remembers whether the heater is on."""

    gain_units = {"middle": "degC", "half_width": "K"}
    default_gains = (21.3, 0.3)
    memory_size = 1

    def law(self, state, memory, exogenous):
        middle, width = self.gains.unbind()
        room = state[:, :1]
        on = torch.where(room < middle - width, 1.0, torch.where(room > middle + width, 0.0, memory))
        return POWER * on, on


class PI(rt.ClassicalController):
    """Power by the temperature's error and its integral, which stands still while the power is at an end."""

    gain_units = {"proportional": "W/K", "integral": "W/(K s)"}
    default_gains = (1500.0, 0.1)
    memory_size = 1

    def law(self, state, memory, exogenous):
        proportional, integral = self.gains.unbind()
        error = COMFORT + 0.3 - state[:, :1]
        command = proportional * error + integral * memory
        stuck = ((command > POWER) & (error > 0.0)) | ((command < 0.0) & (error < 0.0))  # no windup
        return command, torch.where(stuck, memory, memory + self.plant.dt * error)


TWINNING = rt.TwinningConfig(
    assimilation=rt.AssimilationConfig(method="levenberg_marquardt", inputs="record"),  # four weights, weather measured
    planner=rt.PlannerConfig(iterations=40, realisations=20, descent=rt.DescentConfig(optimiser="lbfgs", rate=1.0)),
)


@rt.configuration
class Config(rt.RunConfig):
    """Heat a room during four winter days."""

    policy: str = "mlp"
    hidden: tuple[int, ...] = (16, 16)
    episodes: int = 5
    start: str = "controller"
    twinning: rt.TwinningConfig = TWINNING

    def plant(self):
        return HeatedRoom()


def main(config):
    """Check the plant, then train."""
    plant = config.plant()
    print(rt.check_plant(plant))
    rt.Run(config, plant, first=Thermostat, baselines={"thermostat": Thermostat, "PI": PI}).train()


if __name__ == "__main__":
    rt.main_of(Config, main)
