"""One control interval as a differentiable map, and the protocol of the engines that chain it to trajectories."""

from typing import ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant, cost_rate, final_cost, held


class Drive(NamedTuple):
    """Times t [s], exogenous inputs z and recorded commands of the intervals, with the time as first dimension.

    Shapes: ``t`` is ``n 1``, ``exogenous`` ``n batch n_z``, ``command`` ``n batch n_a`` (zero-width with a policy).
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
        return self.policy(self.plant.observe(drive.t, state, drive.exogenous))

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
        change = (final_cost(plant, end) - final_cost(plant, s)) / plant.dt
        cost = state[..., -1] + cost_rate(plant, drive.t, s, applied, drive.exogenous) + change
        return torch.cat([end, cost.unsqueeze(-1)], -1)


def with_weights(interval: nn.Module, weights: dict[str, Tensor], state: Tensor, drive: Drive) -> Tensor:
    """The end of an interval with tensors in place of some of its weights, in every module that holds one.

    PyTorch's own search for weights that are shared leaves the tensors in a module that is held twice, such as the
    plant's own closure.
    """
    everywhere = dict(interval.named_parameters(remove_duplicate=False))
    given = {id(everywhere[name]): tensor for name, tensor in weights.items()}
    held = {
        f"{path}.{name}".lstrip("."): given[id(w)]
        for path, module in interval.named_modules()  # each module once
        for name, w in module.named_parameters(recurse=False, remove_duplicate=False)
        if id(w) in given
    }
    end: Tensor = torch.func.functional_call(interval, held, (state, drive), tie_weights=False)
    return end


class GradientEngine(Protocol):
    """Computes differentiable trajectories of a plant, compiled or eager.

    The options name an engine by its class, in small letters and with underscores.
    """

    own_scheme: ClassVar[bool]
    """Whether the engine takes plants that step by a scheme of their own, see :attr:`Plant.own_scheme`."""
    start_per_realisation: ClassVar[bool]
    """Whether every realisation can have a start time of its own."""

    def __init__(self, *, compiled: bool): ...

    def end_states(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor:
        """States at the end of every interval, ``n batch n_s``, differentiable by weights, initial state and drive."""
        ...

    def costs(self, interval: Interval, initial_state: Tensor, drive: Drive) -> Tensor | None:
        """Means of the running cost over all intervals, ``batch``, differentiable; None if they follow from the states.

        An engine computes them itself if this is quicker than to differentiate the costs of all states.
        """
        return None
