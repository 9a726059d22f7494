"""Generators with a seed, episodes of a plant and their steps, tensors in double precision, and a clock."""

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


@torch.no_grad()
def stepped(plant, closure, state, exogenous, act):
    """States, applied actions and J_a of episodes by the plant's own step in a loop, under ``act(k, t, state, z)``."""
    states, applied, cost = [state], [], 0.0
    for k, z in enumerate(exogenous.unbind(-2)):
        t, s = torch.tensor(k * plant.dt, dtype=torch.float64), states[-1]
        end, action = plant.step(t, s, act(k, t, s, z), z, closure)
        cost = cost + plant.running_cost(t, s, action, z) / exogenous.shape[-2]
        states.append(end)
        applied.append(action)
    return torch.stack(states, -2), torch.stack(applied, -2), cost


class Time:
    """A clock that goes on only when somebody waits."""

    now = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds
