"""User code as an interval, run as machine code and as eager torch."""

import torch
from torch import nn

from rt_torchrl.programs.machine_code import lanes_of_this_machine
from rt_torchrl.trajectories.engines import native
from rt_torchrl.trajectories.engines.code import Inputs, IntervalCode, point_of
from rt_torchrl.trajectories.engines.interval import Drive


class Snippet(nn.Module):
    """s + 0.1 f(self, s, drive), with a weight ``w0`` of one number, submodules and weights of its own."""

    def __init__(self, f, *modules, share=0.1, **weights):
        super().__init__()
        self.f, self.share = f, share
        self.modules_ = nn.ModuleList(m.double() for m in modules)
        self.w0 = nn.Parameter(torch.tensor([0.3], dtype=torch.float64))
        for name, weight in weights.items():
            self.register_parameter(name, nn.Parameter(weight.clone()))

    def forward(self, state, drive):
        return state + self.share * self.f(self, state, drive)


def signals(batch, n, states=3, *, seed=0, scale=1.0):
    """Random initial states and a drive of one input and no command."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: scale * torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    t = torch.linspace(0, 1, n, dtype=torch.float64).unsqueeze(-1)
    return draw(batch, states), Drive(t, draw(n, batch, 1), draw(n, batch, 0))


def traced(interval, initial_state, drive, lanes=None):
    """Machine code of an interval; raises UntraceableError where native falls back."""
    lanes = lanes or lanes_of_this_machine()
    programs = IntervalCode(interval, point_of(initial_state, drive, lanes.number), lanes)
    programs.prepare_sweep(interval, driven=True)
    return programs


def marched(interval, state, t, exogenous, command):
    """The states at the end of every interval, by eager torch."""
    states = []
    for k in range(len(t)):
        state = interval(state, Drive(t[k], exogenous[k], command[k]))
        states.append(state)
    return torch.stack(states)


def compared(interval, initial_state, drive, *, lanes=None, seed=5):
    """States and gradients by all leaves: of machine code and of eager torch."""
    programs = traced(interval, initial_state, drive, lanes)
    leaves = [x.clone().requires_grad_() for x in (initial_state, *drive)]
    task = native._Task(programs, Inputs(interval), leaves[0], Drive(*leaves[1:]))
    found = native._EndStates.apply(task, *leaves, *task.inputs.learned)
    exact = marched(interval, *leaves)
    costate = torch.randn(exact.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    given = [*leaves, *task.inputs.learned]
    by_found = torch.autograd.grad(found, given, costate, allow_unused=True)
    by_exact = torch.autograd.grad(exact, given, costate, allow_unused=True) if exact.requires_grad else by_found
    zero = [torch.zeros_like(x) for x in given]
    pairs = [(found.detach(), exact.detach())]
    for a, b, z in zip(by_found, by_exact, zero, strict=True):
        pairs.append((z if a is None else a, z if b is None else b))
    return pairs


def gap(found, exact):
    """Greatest difference relative to the greatest number; NaN and infinity must be in the same places."""
    assert torch.equal(found.isnan(), exact.isnan()), (found, exact)
    infinite = exact.isinf()
    assert torch.equal(found.isinf(), infinite) and torch.equal(found[infinite], exact[infinite]), (found, exact)
    usual = exact.isfinite()
    if not usual.any():
        return 0.0
    scale = max(exact[usual].abs().max().item(), 1e-300)
    return (found[usual] - exact[usual]).abs().max().item() / scale
