"""The recurrence s_{k+1} = Φ(s_k, x_k) itself, as a Python loop or as one compiled scan."""

import torch
from torch import Tensor, nn

from rt_torchrl.trajectories.engines.compilation import plain
from rt_torchrl.trajectories.engines.interval import Drive


def march(interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
    """States at the end of every interval, ``n batch n_s``, by a loop."""
    state, states = initial_state, []
    for k in range(drive.t.shape[0]):
        state = interval(state, Drive(drive.t[k], drive.exogenous[k], drive.command[k]))
        states.append(state)
    return torch.stack(states)


def march_by_scan(interval: nn.Module, initial_state: Tensor, drive: Drive) -> Tensor:
    """The states of :func:`march` by one ``scan``, for the compiler."""
    from hoptorch.scan import scan  # here, because it takes seconds to load and only the compiler needs it

    def body(state: Tensor, x: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        # The scan wants a carry that keeps its strides and an output that does not alias it.
        state = interval(state, Drive(*x)).contiguous()
        return state, state.clone()

    return scan(body, plain(initial_state), tuple(drive))[1]
