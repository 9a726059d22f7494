"""Write the log of a simulated real system for ``identify.py``, with jittered intervals, noisy sensors and a gap."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import rt_torchrl as rt

rt.begin_loading(__name__)

import numpy as np
import torch
import tyro
from pydantic import Field
from torch import Tensor, nn

from rt_torchrl.envs.cryogenic_tank.controllers import PIValve
from rt_torchrl.envs.flapping_wing.controllers import TrimmedPD
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.fit.log import SensorLog, logged_states
from rt_torchrl.runs.command_line import plant_class

CONTROLLERS: dict[str, Callable[[rt.Plant], rt.ClassicalController]] = {
    "wind_turbine": JonkmanController,
    "flapping_wing": TrimmedPD,
    "cryogenic_tank": PIValve,
}
JITTER = 0.4
"""Greatest difference of a control interval from dt, as a share of dt; a plant with a scheme of its own has none."""
Law = Callable[[Tensor, Tensor, Tensor], Tensor]
"""A control law: a function from time [s], state and exogenous input to a command. It may have a memory."""


@rt.configuration
class Config:
    """Fly one episode of a plant and write the log that a data logger would write.

    The classical controller of turbine, drone and tank acts, also where FILE.py:NAME gives the
    plant; on any other plant a policy with random first weights does.

    Args:
        log: log file to write, CSV or Parquet.
        plant: name of a folder under envs, or FILE.py:NAME of your own plant.
        states: names of the states that are logged; by default all.
        seed: seed of the episode and of a policy's first weights.
        horizon: length of the episode [s]; by default the plant's.
        noise: standard deviation of the states' sensors, as a share of what they read.
        gap: share of the log that is missing, from its middle on.
    """

    log: Annotated[Path, tyro.conf.Positional]
    plant: str
    states: tuple[str, ...] = ()
    seed: int = 0
    horizon: float | None = None
    noise: Annotated[float, Field(ge=0, lt=1)] = 0.005
    gap: Annotated[float, Field(ge=0, lt=0.5)] = 0.02

    def __post_init__(self):
        names = [state.name for state in logged_states(plant_class(self.plant))]
        unknown = [name for name in self.states if name not in names]
        if unknown:
            raise ValueError(f"states={unknown} of {self.plant!r} do not exist; choose of {', '.join(names)}.")


def main(config: Config) -> None:
    plant = plant_class(config.plant)(**({} if config.horizon is None else {"horizon": config.horizon}))
    generator = torch.Generator().manual_seed(config.seed)
    controller = CONTROLLERS.get(plant.name)
    law = controller(plant).act if controller else policy_law(plant, plant.make_policy(generator))
    log = recorded(plant, law, generator, jitter=JITTER, noise=config.noise)
    share = log.times / log.times[-1]
    log = log.chosen((share <= 0.5) | (share > 0.5 + config.gap))
    log = log.without([s.name for s in logged_states(plant) if config.states and s.name not in config.states])
    log.write(config.log)
    print(f"{len(log.times)} rows of plant {plant.name!r} in {config.log}: {', '.join(log.columns)}")


def policy_law(plant: rt.Plant, policy: nn.Module) -> Law:
    """A policy of the plant's observation as a control law."""
    return lambda t, state, exogenous: policy(plant.observe(t, state, exogenous))


@torch.no_grad()
def recorded(
    plant: rt.Plant, law: Law, generator: torch.Generator, *, jitter: float = 0.0, noise: float = 0.0
) -> SensorLog:
    r"""One episode of the real system under a control loop whose intervals are not quite dt.

    .. math:: t_j = (j + \eta_j)\,\Delta t, \qquad \eta_j \sim U(-\tfrac12, \tfrac12)\cdot\mathrm{jitter}

    At t_j the loop observes and acts. Action and exogenous input are held until t_{j+1}, and one step integrates the
    plant over that interval. The loop acts on the true state; the log holds the state with the sensors' noise.

    A plant with a scheme of its own can only step by Δt, and so is recorded without jitter.

    Args:
        plant: plant whose own closure is the true one.
        law: control law, see :data:`Law`.
        generator: source of initial state, exogenous input, jitter and noise, in this order.
        jitter: greatest difference between an interval and dt, as a share of dt; it lies in [0, 1).
        noise: standard deviation of the sensors of the states, as a share of the value that they read.
    """
    n, n_s = plant.n_steps, len(plant.states)
    state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    offsets = (0.0 if plant.own_scheme else jitter) * (
        torch.rand(n + 1, generator=generator, dtype=torch.float64) - 0.5
    )
    offsets[0] = 0.0
    times, rows = plant.dt * (torch.arange(n + 1) + offsets), []
    for k in range(n + 1):
        z = exogenous[:, min(k, n - 1)]
        command = law(times[k], state, z)
        rows.append(torch.cat([state, plant.actuate(state, command), z], -1))
        if k < n:
            scheme = plant.advance if plant.own_scheme else partial(_held, plant, (times[k + 1] - times[k]).item())
            state = plant.step_by(scheme, times[k], state, command, z, plant.closure).state
    values = torch.cat(rows)
    values[:, :n_s] *= 1.0 + noise * torch.randn(n + 1, n_s, generator=generator, dtype=torch.float64)
    of_states = dict(zip(plant.states, values.T.numpy(), strict=False))
    driving = dict(zip((*plant.actions, *plant.acting_inputs), values[:, n_s:].T.numpy(), strict=False))
    chosen = {signal: of_states[signal] for signal in logged_states(plant)} | driving
    columns = {signal.name: np.ascontiguousarray(signal.wrapped(column)) for signal, column in chosen.items()}
    return SensorLog(times=times.numpy(), columns=columns)


def _held(
    plant: rt.Plant, length: float, t: Tensor, state: Tensor, applied: Tensor, z: Tensor, closure: nn.Module
) -> Tensor:
    """The state after an interval of any length, over which action and input are held."""
    return rt.rk4_step(lambda t, s: plant.vector_field(t, s, applied, z, closure), t, state, length)


if __name__ == "__main__":
    rt.main_of(Config, main)
