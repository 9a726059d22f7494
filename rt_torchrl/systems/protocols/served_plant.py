"""A plant in operation behind a communication watchdog, as a simulated plant server runs it."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.systems.protocols.tags import MISSED, SAFE, SAMPLE, Tags
from rt_torchrl.trajectories.rollout import DivergenceError


class ServedPlant:
    """A plant in simulation that never stops: its exogenous inputs are drawn anew after each horizon.

    Interval k runs under the command that answers its sample, and under the safe action if none comes in the interval,
    or one that is not finite or out of its range. So a lost connection brings the safe action within one period: at the
    end of the interval that was answered last. The simulation computes an interval at its end, when it is known what
    came; a machine would hold the last command for the few milliseconds in which the next one may come. Before the
    first command the safe action acts.

    Args:
        plant: the plant, with its own closure.
        safe: safe action, one number for each actuator.
        seed: seed of the first state and of the inputs.

    Raises:
        ValueError: if the safe action does not fit the actuators.
    """

    def __init__(self, plant: Plant, safe: Sequence[float], *, seed: int = 0):
        self.plant, self.tags = plant, Tags.of(plant)
        self._low, self._high = bounds(plant.actions)
        self._safe = torch.tensor(tuple(safe), dtype=torch.float64)
        fits = self._safe.shape == self._low.shape and self._valid(self._safe)
        if not fits:
            ranges = [(action.name, action.low, action.high) for action in plant.actions]
            raise ValueError(f"safe={tuple(safe)} must be one number within the range of each action, {ranges}.")
        self._generator = torch.Generator().manual_seed(seed)
        self._state = plant.draw_initial_state(1, self._generator)
        self._inputs = plant.draw_exogenous(1, self._generator)
        self._applied = torch.zeros(1, len(plant.actions), dtype=torch.float64)
        self._acting = self._safe
        self.sample, self.missed, self.safe = 0, 0, True

    def _valid(self, command: Tensor) -> bool:
        return bool((command.isfinite() & (command >= self._low) & (command <= self._high)).all())

    def published(self) -> dict[str, float]:
        """All tags that a client reads, at the beginning of the interval."""
        plant, k = self.plant, self.sample % self.plant.n_steps
        parts = self._state[0, : len(plant.readings)], self._inputs[0, k], self._applied[0]
        names = (tag for tags in self.tags.entries.values() for tag in tags)
        values = dict(zip(names, torch.cat(parts).tolist(), strict=True))
        return {SAMPLE: float(self.sample), SAFE: float(self.safe), MISSED: float(self.missed)} | values

    @torch.no_grad()
    def advance(self, answered: float, command: Sequence[float]) -> None:
        """Run to the end of the interval.

        Args:
            answered: number of the sample that the command answers.
            command: command that the client has written last.

        Raises:
            DivergenceError: if the plant diverges.
        """
        asked = torch.tensor(tuple(command), dtype=torch.float64)
        if answered == self.sample and self._valid(asked):
            self._acting, self.safe = asked, False
        else:
            self.missed += 1
            self._acting, self.safe = self._safe, True
        plant, k = self.plant, self.sample % self.plant.n_steps
        t = torch.full((1,), k * plant.dt, dtype=torch.float64)
        inputs = self._inputs[:, k]
        self._state, self._applied = plant.step(t, self._state, self._acting[None], inputs, plant.closure)
        if not math.isfinite(self._state.sum()):
            raise DivergenceError(f"plant {plant.name!r} diverged at sample {self.sample}.")
        self.sample += 1
        if self.sample % plant.n_steps == 0:
            self._inputs = plant.draw_exogenous(1, self._generator)
