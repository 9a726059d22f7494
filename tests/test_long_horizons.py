"""Memory of the gradient of a neural ODE of 64 states over a long horizon, in a process of its own."""

import json
import os
import subprocess
import sys

import pytest
import torch
from torch import nn

from rt_torchrl import Plant, Rollout, Signal

STATES = 64


class NeuralODE(Plant):
    """ds/dt = g(s) − s + a, with a perceptron for g."""

    name = "neural_ode"
    states = tuple(Signal(symbol=f"s_{{{i}}}", name=f"state_{i}", unit="-") for i in range(STATES))
    actions = (Signal(symbol="a", name="action", unit="-", low=-1.0, high=1.0),)
    inputs = ()
    observations = (Signal(symbol="e", name="error", unit="-", low=-1.0, high=1.0),)

    def __init__(self, n_steps):
        super().__init__(dt=0.01, horizon=0.01 * n_steps, closure=self.make_closure(torch.Generator().manual_seed(0)))

    def vector_field(self, t, state, action, exogenous, closure):
        return closure(state) - state + action

    def observe(self, t, state, exogenous):
        return state[..., :1]

    def running_cost(self, t, state, applied, exogenous):
        return (state**2).sum(-1)

    discrepancy_scales = (0.5**0.5,) * STATES

    def draw_initial_state(self, batch, generator):
        return torch.randn(batch, STATES, generator=generator, dtype=torch.float64)

    def draw_exogenous(self, batch, generator):
        return torch.zeros(batch, self.n_steps, 0, dtype=torch.float64)

    def make_closure(self, generator):
        network = nn.Sequential(nn.Linear(STATES, STATES), nn.Tanh(), nn.Linear(STATES, STATES)).double()
        for weight in network.parameters():
            nn.init.normal_(weight, std=STATES**-0.5, generator=generator)
        return network


def main(n_steps):
    """Cost and gradient of one episode, with respect to all weights; peak memory of the process [GiB]."""
    plant, generator = NeuralODE(n_steps), torch.Generator().manual_seed(1)
    rollout = Rollout(plant, plant.closure, plant.make_policy(generator), engine="native")
    state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    cost = rollout.costs(state, exogenous).mean()
    weights = list(plant.closure.parameters())
    gradient = torch.cat([g.flatten() for g in torch.autograd.grad(cost, weights)])
    direction, start = torch.randn(len(gradient), generator=generator).double(), nn.utils.parameters_to_vector(weights)
    step, costs = 1e-6, []
    for sign in (1.0, -1.0):
        nn.utils.vector_to_parameters((start + sign * step * direction).detach(), weights)
        with torch.no_grad():
            costs.append(rollout.costs(state, exogenous).mean().item())
    import resource  # which Windows lacks

    unit = 2**30 if sys.platform == "darwin" else 2**20
    return {
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit,
        "slope": (gradient @ direction).item(),
        "difference": (costs[0] - costs[1]) / (2 * step),
    }


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the standard library reads no peak memory there")
def test_a_neural_ode_of_64_states_over_100_000_steps_fits_in_4_gib():
    paths = os.pathsep.join(sys.path)
    command = [sys.executable, __file__, "100000"]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["peak"] < 4.0
    assert found["slope"] == pytest.approx(found["difference"], rel=1e-5)


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]))))
