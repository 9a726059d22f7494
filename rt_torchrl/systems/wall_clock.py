"""A plant that is simulated in real time, for rehearsals of a controller before a machine has to rely on it."""

import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from rt_torchrl.plants.plant import Plant
from rt_torchrl.systems.calling_simulator import CallingSimulator, Controller
from rt_torchrl.trajectories.rollout import DivergenceError


class WallClock:
    """A simulation of a plant that goes on with a wall clock, whether or not its controller is ready.

    At the start of each control interval it reports to the controller, whose action acts in this interval. If an action
    comes after the end of its interval, it is late: the last action has acted in the interval instead, and the clock
    goes on from the moment when the late one came. :meth:`environment` is the simulation as a TorchRL environment.

    The attribute ``answers`` holds the wall-clock time that the controller took for each action of the last episode
    [s], and ``late`` the number of late ones.

    Args:
        plant: the plant, with its own closure.
        clock: wall clock [s].
        sleep: function that waits for some time [s].
    """

    def __init__(
        self,
        plant: Plant,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self.plant, self._clock, self._sleep = plant, clock, sleep
        self.answers: list[float] = []
        self.late = 0

    def environment(self, *, seed: int = 0) -> CallingSimulator:
        """The environment; it reports ``time`` [s], ``state``, ``exogenous`` and ``applied``, in the plant's units.

        Args:
            seed: seed of the first episode; each later one adds 1.
        """
        plant = self.plant
        sizes = {"state": len(plant.readings), "exogenous": len(plant.inputs), "applied": len(plant.actions)}
        return CallingSimulator(self.simulate, {"time": 1, **sizes}, plant.actions, seed=seed)

    @torch.no_grad()
    def simulate(self, seed: int, controller: Controller) -> None:
        """Simulate an episode of the draws that belong to a seed.

        Raises:
            DivergenceError: if the plant diverges.
        """
        plant, generator = self.plant, torch.Generator().manual_seed(seed)
        state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
        applied, last = torch.zeros(1, len(plant.actions), dtype=torch.float64), None
        self.answers, self.late = [], 0
        due = self._clock()
        for k in range(plant.n_steps):
            t, began = torch.tensor([k * plant.dt], dtype=torch.float64), self._clock()
            asked = torch.from_numpy(controller(self._report(t, state, exogenous[:, k], applied)))[None]
            self.answers.append(self._clock() - began)
            late = self.answers[-1] > plant.dt
            self.late += late
            acting = last if late and last is not None else asked
            state, applied = plant.step(t, state, acting, exogenous[:, k], plant.closure)
            if not state.isfinite().all():
                raise DivergenceError(f"plant {plant.name!r} diverged at t = {t.item() + plant.dt:g} s.")
            last = asked
            due = max(due + plant.dt, self._clock())
            self._sleep(max(0.0, due - self._clock()))
        end = torch.tensor([plant.horizon], dtype=torch.float64)
        controller(self._report(end, state, exogenous[:, -1], applied))

    def _report(self, t: Tensor, state: Tensor, exogenous: Tensor, applied: Tensor) -> dict[str, np.ndarray]:
        parts = {"state": state[0, : len(self.plant.readings)], "exogenous": exogenous[0], "applied": applied[0]}
        return {"time": t.numpy()} | {name: part.numpy() for name, part in parts.items()}
