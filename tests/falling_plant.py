"""An oracle plant whose episodes end early: a rod that falls over unless a force holds it."""

import torch
from linear_quadratic import LinearQuadratic


class Falling(LinearQuadratic):
    """Upright is unstable; beyond one metre the rod lies on the ground, and each second there costs as much as ten."""

    name = "falling"
    A = ((0.0, 1.0), (2.0, 0.0))
    reach = 1.0
    end_cost = 10.0

    def ended(self, state):
        return state[..., 0].abs() > self.reach

    def terminal_cost(self, state):
        return 0.5 * state[..., 0] ** 2

    def draw_initial_state(self, batch, generator):
        return 0.3 * torch.tanh(super().draw_initial_state(batch, generator))
