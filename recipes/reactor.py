"""Reinforcement twinning of pcgym's stirred-tank reactor, whose set point and inlet change."""

from functools import partial
from typing import Any

import rt_torchrl as rt

rt.begin_loading(__name__)

import torch

FLOW, HEAT, FEED = 1.0 / 60.0, 5e4 / 239.0, 1.0  # q/V [1/s], −ΔH/(ρ c) [K L/mol], C_f [mol/L]
CONCENTRATION = rt.Signal(symbol="C", name="concentration", unit="mol/L", low=0.0)
TEMPERATURE = rt.Signal(symbol="T", name="temperature", unit="K")
JACKET = rt.Signal(symbol="T_c", name="jacket_temperature", unit="K", low=290.0, high=306.0)
WANTED = rt.Signal(symbol="C_s", name="set_point", unit="mol/L", low=0.0)
INLET = rt.Signal(symbol="T_i", name="inlet_temperature", unit="K")


class Kinetics(rt.PositiveCoefficients):
    """What the data sheet knows roughly: Arrhenius' law and the jacket."""

    names = {"rate": "1/s", "activation": "K", "jacket": "1/s"}
    meanings = {"rate": "reaction rate at 325 K", "activation": "E/R", "jacket": "UA/(ρ c V)"}


class Reactor(rt.Plant):
    """An exothermic reaction in a stirred tank that a jacket cools."""

    name = "reactor"
    states, actions, inputs = (CONCENTRATION, TEMPERATURE), (JACKET,), (WANTED, INLET)
    state_sizes = (0.05, 3.0)
    measurements = (
        rt.Measurement.of(CONCENTRATION, offset=0.85, scale=0.05),
        rt.Measurement.of(TEMPERATURE, offset=325.0, scale=3.0),
        rt.Measurement.of(WANTED, offset=0.85, scale=0.05),
        rt.Measurement.of(INLET, offset=350.0, scale=3.0),
    )

    def __init__(self, *, dt: float = 10.0, horizon: float = 900.0):
        super().__init__(dt=dt, horizon=horizon, closure=self.make_closure())

    def vector_field(self, t, state, action, exogenous, closure):
        (concentration, temperature), inlet = state.unbind(-1), exogenous[..., 1]
        rate, activation, jacket = closure(state).unbind(-1)
        reaction = rate * torch.exp(activation * (1.0 / 325.0 - 1.0 / temperature)) * concentration
        warming = HEAT * reaction + jacket * (action[..., 0] - temperature)
        return torch.stack([FLOW * (FEED - concentration) - reaction, FLOW * (inlet - temperature) + warming], -1)

    def running_cost(self, t, state, applied, exogenous):
        return 1e3 * (state[..., 0] - exogenous[..., 0]) ** 2  # as pcgym's reward

    def draw_initial_state(self, batch, generator):
        uniform = torch.rand(batch, 2, generator=generator, dtype=torch.float64)
        return torch.tensor([0.75, 322.0]) + torch.tensor([0.15, 8.0]) * uniform

    def draw_exogenous(self, batch, generator):
        levels = torch.rand(2, batch, 3, generator=generator, dtype=torch.float64)
        steps = levels.repeat_interleave(-(-self.n_steps // 3), -1)[..., : self.n_steps]
        return torch.stack([0.78 + 0.14 * steps[0], 348.0 + 4.0 * steps[1]], -1)

    def make_closure(self, generator=None):
        return Kinetics([0.002, 7e3, 0.03])  # the data sheet

    def setpoints(self, states, applied, exogenous):
        return {"concentration [mol/L]": (states[..., 0], exogenous[..., 0])}


class PI(rt.ClassicalController):
    """Jacket temperature by the concentration's error and its integral, which stands still at an end of the range."""

    gain_units = {"proportional": "K L/mol", "integral": "K L/(mol s)"}
    default_gains = (300.0, 1.0)
    memory_size = 1

    def law(self, state, memory, exogenous):
        proportional, integral = self.gains.unbind()
        error = state[:, :1] - exogenous[:, :1]
        command = 298.0 + proportional * error + integral * memory
        stuck = (command - 298.0).abs() > 8.0
        return command, torch.where(stuck, memory, memory + self.plant.dt * error)


def real_system(plant: Reactor, *, seed: int = 0) -> "rt.RealSystem":
    """pcgym's reactor with the plant's draws of starts, set points and inlets, which are parameters to pcgym."""
    import numpy as np
    import pcgym
    from torchrl.envs import GymWrapper

    class Episodes(pcgym.make_env):
        def reset(self, seed=None, **options):
            draws = torch.Generator().manual_seed(seed)
            start, course = plant.draw_initial_state(1, draws)[0], plant.draw_exogenous(1, draws)[0]
            course = np.vstack([course, course[-1:]])
            self.env_params["x0"] = np.append(start, course[0, 0])
            # pcgym reports a set point an interval after its own reward takes it. Cost, twin and controllers here know
            # the reported one alone, so that it merely changes an interval later than drawn.
            self.SP, self.disturbances = {"Ca": course[:, 0]}, {"Ti": course[:, 1]}
            return super().reset(seed=seed, **options)

    n = plant.n_steps + 1
    ranges = {
        "a_space": {"low": np.float32([JACKET.low]), "high": np.float32([JACKET.high])},
        "o_space": {"low": np.float32([0.0, 250.0, 0.0]), "high": np.float32([1.0, 500.0, 1.0])},
        "disturbance_bounds": {"low": np.float32([300.0]), "high": np.float32([400.0])},
    }
    defaults = {"x0": np.zeros(3), "SP": {"Ca": [0.0]}, "disturbances": {"Ti": [350.0]}}
    options = {"model": "cstr", "N": n, "tsim": n * plant.dt / 60.0, "normalise_a": False, "normalise_o": False}
    state, exogenous = rt.Reading(of=lambda obs: obs[..., :2]), rt.Reading(of=lambda obs: obs[..., 2:])
    machine = GymWrapper(Episodes(options | ranges | defaults))
    return rt.RealSystem(machine, plant, state=state, exogenous=exogenous, seed=seed)


@rt.configuration
class Config(rt.RunConfig):
    """Hold the concentration in pcgym's reactor."""

    episodes: int = 6
    real_unseen: int = 20

    def plant(self) -> Reactor:
        return Reactor()


def main(config: Config, **parts: Any) -> None:
    """Train; ``parts`` are further arguments of :class:`Run`, such as ``learner``."""
    plant = config.plant()
    env = partial(real_system, plant, seed=config.seed)
    rt.Run(config, plant, env=env, first=PI, baselines={"PI": PI}, **parts).train()


if __name__ == "__main__":
    rt.main_of(Config, main)
