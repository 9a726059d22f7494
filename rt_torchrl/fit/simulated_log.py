"""Logs of a simulated real system, with irregular instants and noisy sensors."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.fit.sensor_log import SensorLog, logged_states
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sampling import rk4_step

Law = Callable[[Float[Tensor, ""], Float[Tensor, "1 n_s"], Float[Tensor, "1 n_z"]], Float[Tensor, "1 n_a"]]
"""A control law: a function from time [s], state and exogenous input to a command. It may have a memory."""


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
            state = _held(plant, times[k], state, applied, z, (times[k + 1] - times[k]).item())
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


def _held(plant: Plant, t: Tensor, state: Tensor, applied: Tensor, z: Tensor, length: float) -> Tensor:
    """The state after an interval of any length, over which action and input are held."""
    end = rk4_step(lambda t, s: plant.vector_field(t, s, applied, z, plant.closure), t, state, length)
    return plant.latch(end, applied)


def _log(plant: Plant, times: Tensor, rows: Tensor, generator: torch.Generator, noise: float) -> SensorLog:
    n_s = len(plant.states)
    errors = torch.randn(len(rows), n_s, generator=generator, dtype=torch.float64, device=generator.device)
    values = torch.cat([rows[:, :n_s] * (1.0 + noise * errors), rows[:, n_s:]], -1).cpu().numpy()
    own = {signal.name for signal in logged_states(plant)}
    signals = (*plant.states, *plant.actions, *plant.inputs)
    chosen = {s.name: k for k, s in enumerate(signals) if k >= n_s or s.name in own}
    columns = {name: np.ascontiguousarray(signals[k].wrapped(values[:, k])) for name, k in chosen.items()}
    return SensorLog(times=times.cpu().numpy(), columns=columns)
