"""User code as an interval, run as machine code and as eager torch; tables of such code; modules with a memory."""

import re
from pathlib import Path
from typing import NamedTuple

import torch
from torch import nn

from rt_torchrl.programs.machine_code import lanes_of_this_machine
from rt_torchrl.trajectories.engines import native
from rt_torchrl.trajectories.engines.code import Inputs, IntervalCode, point_of
from rt_torchrl.trajectories.engines.interval import Drive


class Row(NamedTuple):
    """A row of a table: its parts, the word of a refusal or None, the file and the row's first line."""

    parts: list[str]
    word: str | None
    file: str
    line: int


def sections(name):
    """The rows of a table in ``data``, by section and first part; an indented line goes on with the row above it."""
    path, found, section = Path(__file__).parent / "data" / name, {}, {}
    for match in re.finditer(
        r"^\[(.+)\]$|^([^#\s].*(?:\n    .*)*)", text := path.read_text(encoding="utf-8"), re.MULTILINE
    ):
        if match[1]:
            section = found.setdefault(match[1], {})
        else:
            *parts, last = re.sub(r"\n    +", " ", match[2]).split(" :: ")
            refused = last.startswith("-> ")
            parts, word = (parts, last.removeprefix("-> ")) if refused else ([*parts, last], None)
            section[parts[0]] = Row(parts, word, str(path), text[: match.start()].count("\n") + 1)
    return found


class Snippet(nn.Module):
    """s + 0.1 f(self, s, drive), with a weight ``w0`` of one number, and submodules and weights of its own by name."""

    def __init__(self, f, *, share=0.1, **parts):
        super().__init__()
        self.f, self.share = f, share
        self.w0 = nn.Parameter(torch.tensor([0.3], dtype=torch.float64))
        for name, part in parts.items():
            setattr(self, name, part.double() if isinstance(part, nn.Module) else nn.Parameter(part.clone()))

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
    pairs = [(found.detach(), exact.detach())]
    for a, b, x in zip(by_found, by_exact, given, strict=True):
        pairs.append(tuple(torch.zeros_like(x) if y is None else y for y in (a, b)))
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


class Recurrent(nn.Module):
    """Keeps its hidden state on itself, and begins anew with another number of rows."""

    def __init__(self, outputs=1):
        super().__init__()
        self.cell, self.out, self.hidden = nn.GRUCell(2, 4).double(), nn.Linear(4, outputs).double(), None

    def forward(self, observation):
        rows = observation.reshape(-1, observation.shape[-1])
        if self.hidden is None or len(self.hidden) != len(rows):
            self.hidden = rows.new_zeros(len(rows), 4)
        self.hidden = self.cell(rows, self.hidden)
        return self.out(self.hidden).reshape(*observation.shape[:-1], -1)


class Rows(nn.Module):
    """A network of layers that take rows alone."""

    def __init__(self, *layers):
        super().__init__()
        self.layers = nn.Sequential(*layers).double()

    def forward(self, observation):
        return self.layers(observation.reshape(-1, observation.shape[-1])).reshape(*observation.shape[:-1], -1)


class Bounded(nn.Module):
    """A policy whose command is between −1 and 1 and whose weights are known."""

    def __init__(self, inner):
        super().__init__()
        self.inner = inner
        with torch.no_grad():
            for weight in self.parameters():
                weight.fill_(0.3)

    def forward(self, observation):
        return torch.tanh(self.inner(observation))
