"""Write the log of a simulated real system for ``identify.py``, with jittered intervals, noisy sensors and a gap."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import numpy as np
import torch
import tyro
from torch import Tensor, nn

from rt_torchrl import ClassicalController, Plant, check_options, main_of, rk4_step
from rt_torchrl.envs.cryogenic_tank.controllers import PIValve
from rt_torchrl.envs.flapping_wing.controllers import TrimmedPD
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.fit.log import SensorLog, logged_states
from rt_torchrl.runs.command_line import plant_class
from rt_torchrl.runs.run_folder import load_tensors

CONTROLLERS: dict[str, type[ClassicalController]] = {
    "wind_turbine": JonkmanController,
    "flapping_wing": TrimmedPD,
    "cryogenic_tank": PIValve,
}
Law = Callable[[Tensor, Tensor, Tensor], Tensor]
"""A control law: a function from time [s], state and exogenous input to a command. It may have a memory."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Fly one episode of a plant and write the log that a data logger would write.

    Args:
        log: log file to write, CSV or Parquet.
        plant: name of a folder under envs, or FILE.py:NAME or package.module:NAME of your own plant.
        law: law of the actions: classical for the plant's classical controller, policy for a policy.
        weights: weights.pt of a training with the paper's policy; by default the policy has random first weights.
        role: role of the policy in the training.
        states: names of the states that are logged; by default all.
        seed: seed of the episode and of a policy's first weights.
        horizon: length of the episode [s]; by default the plant's.
        jitter: greatest difference of a control interval from dt, as a share of dt; by default 0.4, or 0 for a plant
            with a scheme of its own.
        noise: standard deviation of the states' sensors, as a share of what they read.
        gap: share of the log that is missing, from its middle on.
    """

    log: Annotated[Path, tyro.conf.Positional]
    plant: str
    law: Literal["classical", "policy"] = "classical"
    weights: Path | None = None
    role: Literal["model_based", "model_free"] = "model_based"
    states: tuple[str, ...] = ()
    seed: int = 0
    horizon: float | None = None
    jitter: float | None = None
    noise: float = 0.005
    gap: float = 0.02

    def __post_init__(self):
        check_options(self)
        known = [state.name for state in logged_states(plant_class(self.plant))]
        unknown = [name for name in self.states if name not in known]
        if unknown:
            raise ValueError(f"states={unknown} of {self.plant!r} do not exist; choose of {', '.join(known)}.")
        if self.seed < 0:
            raise ValueError(f"seed={self.seed} must not be negative.")
        if self.law == "classical" and self.plant not in CONTROLLERS:
            raise ValueError(f"law='classical': no classical controller of {self.plant!r} is known; use policy.")
        if not 0.0 <= self.gap < 0.5:
            raise ValueError(f"gap={self.gap} must lie in [0, 0.5), a share of the log.")
        known = [state.name for state in logged_states(make_plant(self))]
        unknown = [name for name in self.states if name not in known]
        if unknown:
            raise ValueError(f"states={self.states}: {self.plant!r} logs no {', '.join(unknown)}; choose of {known}.")


def main(config: Config) -> None:
    plant, generator = make_plant(config), torch.Generator().manual_seed(config.seed)
    law = law_of(config, plant, generator)
    default = 0.0 if plant.own_scheme else 0.4
    jitter = default if config.jitter is None else config.jitter
    log = with_gap(recorded(plant, law, generator, jitter=jitter, noise=config.noise), config.gap)
    log = log.without([s.name for s in logged_states(plant) if config.states and s.name not in config.states])
    log.write(config.log)
    print(f"{len(log.times)} rows of plant {plant.name!r} in {config.log}: {', '.join(log.columns)}")


def make_plant(config: Config) -> Plant:
    """The plant with the requested horizon."""
    kind = plant_class(config.plant)
    return kind() if config.horizon is None else kind(horizon=config.horizon)


def law_of(config: Config, plant: Plant, generator: torch.Generator) -> Law:
    """The law that acts on the real system."""
    if config.law == "classical":
        return ClassicalLaw(CONTROLLERS[config.plant](plant))
    policy = plant.make_policy(generator)
    if config.weights:
        try:
            policy.load_state_dict(load_tensors(config.weights)[config.role])
        except (KeyError, RuntimeError) as error:
            raise ValueError(f"weights of {config.role!r} in {config.weights} do not fit: {error}") from error
    return policy_law(plant, policy)


def with_gap(log: SensorLog, share: float) -> SensorLog:
    """The log without a share of its rows, from the middle on."""
    middle, end = 0.5 * log.times[-1], (0.5 + share) * log.times[-1]
    return log.chosen((log.times <= middle) | (log.times > end))


def policy_law(plant: Plant, policy: nn.Module) -> Law:
    """A policy of the plant's observation as a control law."""
    return lambda t, state, exogenous: policy(plant.observe(t, state, exogenous))


class ClassicalLaw:
    """A classical controller with its memory as a control law for one episode."""

    def __init__(self, controller: ClassicalController):
        self._controller = controller
        self._memory: Tensor | None = None

    def __call__(self, t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
        memory = self._controller.first_memory(state) if self._memory is None else self._memory
        command, self._memory = self._controller.law(state, memory)
        return command.clamp(self._controller.low_action, self._controller.high_action)


@torch.no_grad()
def recorded(
    plant: Plant, law: Law, generator: torch.Generator, *, jitter: float = 0.0, noise: float = 0.0
) -> SensorLog:
    r"""One episode of the real system under a control loop whose intervals are not quite dt.

    .. math:: t_j = (j + \eta_j)\,\Delta t, \qquad \eta_j \sim U(-\tfrac12, \tfrac12)\cdot\mathrm{jitter}

    At t_j the loop observes and acts. Action and exogenous input are held until t_{j+1}, and one step integrates the
    plant over that interval. The loop acts on the true state; the log holds the state with the sensors' noise.

    A plant with a scheme of its own can only step by Δt, and so must be recorded without jitter.

    Args:
        plant: plant whose own closure is the true one.
        law: control law, see :data:`Law`.
        generator: source of initial state, exogenous input, jitter and noise, in this order.
        jitter: greatest difference between an interval and dt, as a share of dt; it lies in [0, 1).
        noise: standard deviation of the sensors of the states, as a share of the value that they read.

    Raises:
        ValueError: if an argument is out of its range, or there is jitter and the plant has a scheme of its own.
    """
    _require_recordable(plant, jitter, noise)
    n, own_scheme = plant.n_steps, plant.own_scheme
    state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    offsets = jitter * (torch.rand(n + 1, generator=generator, dtype=torch.float64, device=generator.device) - 0.5)
    offsets[0] = 0.0
    times = plant.dt * (torch.arange(n + 1, device=generator.device) + offsets)
    rows = []
    for k in range(n + 1):
        z = exogenous[:, min(k, n - 1)]
        command = law(times[k], state, z)
        applied = plant.actuate(state, command)
        rows.append(torch.cat([state, applied, z], -1))
        if k < n and own_scheme:
            state = plant.step(times[k], state, command, z, plant.closure).state
        elif k < n:
            scheme = partial(_held, plant, (times[k + 1] - times[k]).item())
            state = plant.step_by(scheme, times[k], state, command, z, plant.closure).state
    return _log(plant, times, torch.cat(rows), generator, noise)


def _require_recordable(plant: Plant, jitter: float, noise: float) -> None:
    if not 0.0 <= jitter < 1.0:
        raise ValueError(f"jitter={jitter} must lie in [0, 1), a share of the control interval.")
    if not 0.0 <= noise < 1.0:
        raise ValueError(f"noise={noise} of the sensors is a share of what they read; it must lie in [0, 1).")
    if jitter and plant.own_scheme:
        raise ValueError(
            f"jitter={jitter}: plant {plant.name!r} steps by a scheme of its own, which knows no interval but dt="
            f"{plant.dt:g} s; record it with jitter=0."
        )


def _held(
    plant: Plant, length: float, t: Tensor, state: Tensor, applied: Tensor, z: Tensor, closure: nn.Module
) -> Tensor:
    """The state after an interval of any length, over which action and input are held."""
    return rk4_step(lambda t, s: plant.vector_field(t, s, applied, z, closure), t, state, length)


def _log(plant: Plant, times: Tensor, rows: Tensor, generator: torch.Generator, noise: float) -> SensorLog:
    n_s = len(plant.states)
    errors = torch.randn(len(rows), n_s, generator=generator, dtype=torch.float64, device=generator.device)
    values = torch.cat([rows[:, :n_s] * (1.0 + noise * errors), rows[:, n_s:]], -1).cpu().numpy()
    own = {signal.name for signal in logged_states(plant)}
    signals = (*plant.states, *plant.actions, *plant.acting_inputs)
    chosen = {s.name: k for k, s in enumerate(signals) if k >= n_s or s.name in own}
    columns = {name: np.ascontiguousarray(signals[k].wrapped(values[:, k])) for name, k in chosen.items()}
    return SensorLog(times=times.cpu().numpy(), columns=columns)


if __name__ == "__main__":
    main_of(Config, main)
