"""One control interval as a differentiable map, what engines do with it, and the two plain engines of PyTorch."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils._pytree import tree_map

from rt_torchrl.plants.plant import Plant, cost_rate, held


class Drive(NamedTuple):
    """Times t [s], exogenous inputs z and recorded commands of the intervals, with the time as first dimension.

    Shapes: ``t`` is ``n 1``, ``exogenous`` ``n batch n_z``, ``command`` ``n batch n_a``; with a policy it has no
    width, or is what is added to the policy's commands.
    """

    t: Tensor
    exogenous: Tensor
    command: Tensor


class Interval(nn.Module):
    r""":math:`s_{k+1} = \Phi(s_k, x_k; w)` with w the weights of the closure and, if there is one, of the policy.

    Args:
        plant: the physics; holds no trained weights.
        closure: the true or the learned closure.
        policy: policy that computes the command from the observation; None takes the command from the drive. With a
            policy an episode that has ended early stays in its state; a record is replayed without regard to ends.
    """

    def __init__(self, plant: Plant, closure: nn.Module, policy: nn.Module | None):
        super().__init__()
        self.plant, self.closure, self.policy = plant, closure, policy

    def command(self, state: Tensor, drive: Drive) -> Tensor:
        """The command to the actuators at the start of the interval."""
        if self.policy is None:
            return drive.command
        command: Tensor = self.policy(self.plant.observe(drive.t, state, drive.exogenous))
        return command + drive.command if drive.command.shape[-1] else command

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """The state at the end of the interval."""
        return self.end(state, self.command(state, drive), drive)

    def end(self, state: Tensor, command: Tensor, drive: Drive) -> Tensor:
        """The state at the end of the interval under a command."""
        end = self.plant.step(drive.t, state, command, drive.exogenous, self.closure).state
        return end if self.policy is None else held(self.plant, state, end)


class CostInterval(nn.Module):
    r"""An interval whose state (s, J) also sums the cost.

    .. math:: J_{k+1} = J_k + L_a(t_k, s_k, a_k, z_k) + \big(\Phi_a(s_{k+1}) - \Phi_a(s_k)\big)/\Delta t

    The last term sums to the terminal cost of the last state, less that of the first one.

    Args:
        interval: the interval of the states s.
    """

    sums = 1
    """Number of the last states, which begin with zero."""

    def __init__(self, interval: Interval):
        super().__init__()
        self.interval = interval

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """State and cost, (s, J), at the end of the interval."""
        plant, s = self.interval.plant, state[..., :-1]
        applied = plant.actuate(s, self.interval.command(s, drive))
        end = self.interval(s, drive)
        change = (plant.terminal_cost(end) - plant.terminal_cost(s)) / plant.dt
        cost = state[..., -1] + cost_rate(plant, drive.t, s, applied, drive.exogenous) + change
        return torch.cat([end, cost.unsqueeze(-1)], -1)


def with_weights(interval: nn.Module, weights: dict[str, Tensor], state: Tensor, drive: Drive) -> Tensor:
    """The end of an interval with tensors in place of some of its weights, in every module that holds one.

    PyTorch's own search for weights that are shared leaves the tensors in a module that is held twice, such as the
    plant's own closure.
    """
    everywhere = dict(interval.named_parameters(remove_duplicate=False))
    replacements = {id(everywhere[name]): tensor for name, tensor in weights.items()}
    tensors = {
        f"{path}.{name}".lstrip("."): replacements[id(w)]
        for path, module in interval.named_modules()  # each module once
        for name, w in module.named_parameters(recurse=False, remove_duplicate=False)
        if id(w) in replacements
    }
    end: Tensor = torch.func.functional_call(interval, tensors, (state, drive), tie_weights=False)
    return end


def batched(jacobian: Callable[..., Any], in_dims: int | tuple[int | None, ...] = 0) -> Callable[..., Any]:
    """A Jacobian by ``torch.func.jacrev`` at many points at once, ``torch.func.vmap`` of it, without a graph.

    Where gradients are off, PyTorch 2.15 gives wrong numbers for :func:`torch.linalg.solve` in it.
    """

    def of_all(*arguments: Any) -> Any:
        with torch.enable_grad():
            jacobians = torch.func.vmap(jacobian, in_dims)(*arguments)
        return jacobians if torch.is_grad_enabled() else tree_map(Tensor.detach, jacobians)

    return of_all


def costate_products(end: Tensor, leaves: Sequence[Tensor], costate: Tensor) -> Sequence[Tensor]:
    """λᵀ∂Φ/∂x for each leaf x of an end state Φ, zero for those on which it does not depend."""
    if not end.requires_grad:
        return [torch.zeros_like(leaf) for leaf in leaves]
    return torch.autograd.grad(end, leaves, costate, allow_unused=True, materialize_grads=True)


def march(interval: Callable[[Tensor, Drive], Tensor], initial_state: Tensor, drive: Drive) -> Tensor:
    """States at the end of every interval, ``n batch n_s``, by a loop."""
    state, states = initial_state, []
    for k in range(drive.t.shape[0]):
        state = interval(state, Drive(drive.t[k], drive.exogenous[k], drive.command[k]))
        states.append(state)
    return torch.stack(states)


class GradientEngine:
    """Computes differentiable trajectories of a plant.

    The options name an engine by its class, in small letters and with underscores.
    """

    exact: ClassVar[bool] = True
    """Whether the engine differentiates the plant's own step. One that integrates the vector field takes no plant with
    another scheme (:attr:`Plant.own_scheme`) or with early ends."""

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable by weights, initial state and drive."""
        raise NotImplementedError

    def costs(self, interval: CostInterval, initial_state: Tensor, drive: Drive) -> Tensor | None:
        """Means of the running cost over all intervals, ``batch``, differentiable; None if they follow from the states.

        An engine computes them itself if this is quicker than to differentiate the costs of all states.
        """
        return None


class Autograd(GradientEngine):
    """Backpropagation through every operation of every step; memory and time grow with the number of steps."""

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        return march(interval, initial_state, drive)


class OdeintAdjoint(GradientEngine):
    r"""Chains :func:`torchdiffeq.odeint_adjoint` over the control intervals: the paper's continuous adjoint.

    The applied action, the exogenous input and the time at the start of an interval are constant components of the
    integrated state, so that each realisation may have a start of its own. The co-state of an action is then
    :math:`\int \lambda^\top \partial f/\partial a\,dt` over its interval, and ordinary backpropagation carries it on
    into the policy. The co-state is integrated backwards with the step of the forward solution, so that the gradient
    differs from the exact one of the discrete trajectory by the order of that step.
    """

    exact: ClassVar[bool] = False

    def end_states(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
        from torchdiffeq import odeint_adjoint  # here, because it takes a second to load and only this engine needs it

        assert isinstance(interval, Interval)  # a vector field alone can be integrated
        plant, n_s = interval.plant, initial_state.shape[-1]
        field = _HeldField(interval, n_s)
        weights = tuple(w for w in interval.closure.parameters() if w.requires_grad)
        span = torch.tensor([0.0, plant.dt], dtype=torch.float64, device=drive.t.device)

        def integrated(t: Tensor, state: Tensor, applied: Tensor, exogenous: Tensor, closure: nn.Module) -> Tensor:
            began = t.expand(state.shape[:-1]).unsqueeze(-1)
            held = torch.cat([state, applied, exogenous, began], -1)
            return odeint_adjoint(field, held, span, method="rk4", adjoint_params=weights)[-1, ..., :n_s]

        def step(state: Tensor, now: Drive) -> Tensor:
            command = interval.command(state, now)
            return plant.step_by(integrated, now.t, state, command, now.exogenous, interval.closure).state

        return march(step, initial_state, drive)


class _HeldField(nn.Module):
    """The vector field of the held state, d[s, a, z, t_0]/dt = [f(t_0 + t, s, a, z), 0, 0, 0]."""

    def __init__(self, interval: Interval, n_states: int):
        super().__init__()
        plant = interval.plant
        self.closure, self.sizes = interval.closure, (n_states, len(plant.actions), len(plant.inputs), 1)
        self.vector_field = plant.vector_field

    def forward(self, t: Tensor, held: Tensor) -> Tensor:
        state, action, exogenous, began = held.split(self.sizes, -1)
        rate = self.vector_field(t + began.squeeze(-1), state, action, exogenous, self.closure)
        return torch.cat([rate, torch.zeros_like(held[..., rate.shape[-1] :])], -1)
