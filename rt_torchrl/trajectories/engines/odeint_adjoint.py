"""Engine ``odeint_adjoint``: the paper's continuous adjoint (eqs. lambda_p and lambda_a), solved by torchdiffeq."""

from typing import ClassVar

import torch
from torch import Tensor, nn

from rt_torchrl.trajectories.engines.interval import Drive, GradientEngine, Interval


class OdeintAdjoint(GradientEngine):
    r"""Chains :func:`torchdiffeq.odeint_adjoint` over the control intervals.

    The applied action and the exogenous input are constant components of the integrated state. The co-state of an
    action is then :math:`\int \lambda^\top \partial f/\partial a\,dt` over its interval, and ordinary backpropagation
    carries it on into the policy. The co-state is integrated backwards with the step of the forward solution, so that
    the gradient differs from the exact one of the discrete trajectory by the order of that step.

    Args:
        compiled: without effect: torchdiffeq goes back several times through one graph, which compiled code refuses.
    """

    own_scheme: ClassVar[bool] = False  # it integrates the vector field
    start_per_realisation: ClassVar[bool] = False  # torchdiffeq integrates the whole batch over one span

    def __init__(self, *, compiled: bool):
        pass

    def end_states(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable."""
        from torchdiffeq import odeint_adjoint  # here, because it takes a second to load and only this engine needs it

        field = _HeldField(interval, initial_state.shape[-1])
        weights = tuple(w for w in interval.closure.parameters() if w.requires_grad)
        interval_span = torch.tensor([0.0, interval.plant.dt], dtype=torch.float64, device=drive.t.device)

        def integrated(t: Tensor, state: Tensor, applied: Tensor, exogenous: Tensor, closure: nn.Module) -> Tensor:
            held = torch.cat([state, applied, exogenous], -1)
            # The span is in absolute time: the backward pass evaluates the field again, long after this call.
            span = t + interval_span
            end = odeint_adjoint(field, held, span, method="rk4", adjoint_params=weights)[-1]
            return end[..., : state.shape[-1]]

        state, states = initial_state, []
        for k in range(drive.t.shape[0]):
            now = Drive(drive.t[k], drive.exogenous[k], drive.command[k])
            command = interval.command(state, now)
            state = interval.plant.step_by(integrated, now.t, state, command, now.exogenous, interval.closure).state
            states.append(state)
        return torch.stack(states)


class _HeldField(nn.Module):
    """The vector field of the held state, d[s, a, z]/dt = [f(t, s, a, z), 0, 0]."""

    def __init__(self, interval: Interval, n_states: int):
        super().__init__()
        plant = interval.plant
        self.closure, self.sizes = interval.closure, (n_states, len(plant.actions), len(plant.inputs))
        self.vector_field = plant.vector_field

    def forward(self, t: Tensor, held: Tensor) -> Tensor:
        state, action, exogenous = held.split(self.sizes, -1)
        rate = self.vector_field(t, state, action, exogenous, self.closure)
        return torch.cat([rate, torch.zeros_like(action), torch.zeros_like(exogenous)], -1)
