"""Generators with a seed, episodes of a plant, tensors in double precision, and a clock, which many tests need."""

import torch


def seeded(seed=0):
    """A new generator with the seed."""
    return torch.Generator().manual_seed(seed)


def double(*values):
    """The values as a tensor in double precision."""
    return torch.tensor(values, dtype=torch.float64)


def drawn(plant, count=1, seed=0):
    """Initial states and inputs of episodes of a plant."""
    generator = seeded(seed)
    return plant.draw_initial_state(count, generator), plant.draw_exogenous(count, generator)


class Time:
    """A clock that goes on only when somebody waits."""

    now = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds
