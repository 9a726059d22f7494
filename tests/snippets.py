"""Pieces of user code as intervals, from ``data/snippets.txt``; those of several lines stand here."""

import copy
import math
import pickle
import random
import time

import numpy as np
import torch
from torch import nn
from torch.nn import functional as FF
from torch.nn.utils import parametrizations
from traced_function import Snippet, sections

D = {"dtype": torch.float64}
torch.manual_seed(0)
A33, A3, EYE, HALF = torch.randn(3, 3, **D), torch.randn(3, **D), torch.eye(3, **D), torch.tensor([0.5], **D)
LOW, ext, knots = torch.zeros((), **D), torch.ones(3, requires_grad=True, **D), torch.linspace(-3, 3, 20, **D)
BUFFERS = {
    "knots": knots,
    "table": knots.outer(knots.sin()),
    "matrix": torch.tensor([[0.0, 2.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 3.0]], **D),
    "sparse": torch.eye(3, **D).to_sparse(),
    "ints": torch.tensor([2, 0, 1]),
    "flags": torch.tensor([True, False, True]),
    "single": torch.tensor([1.0, 2.0, 3.0], dtype=torch.float32),
}
READ_BY_EXPRESSIONS = copy, math, pickle, random, time, np, FF, parametrizations


def newton(m, s, d):
    x = s.clone()
    for _ in range(5):
        x = x - (x**3 + x - s * m.w0) / (3 * x**2 + 1)
    return x


def until(m, s, d):
    x = s.clone()
    while (x - s * m.w0).abs().max() > 0.3:
        x = 0.5 * (x + s * m.w0)
    return x


def in_place(m, s, d):
    y = torch.zeros_like(s)
    y[..., 0] = s[..., 1] * m.w0
    y[..., 1:] = torch.sin(s[..., 1:])
    y += 0.5 * s
    return y


def in_place_with_places(m, s, d):
    y = s.clone()
    y[..., [0, 2]] = s[..., [1, 0]] * m.w0
    y[..., 1] += 2
    y.mul_(s)
    y[..., 0:2].clamp_(-0.5, 0.5)
    return y


def by_mask(m, s, d):
    y = s.clone()
    y[y > 0] = 0.0
    return y * m.w0


def set_data(m, s, d):
    y = s.clone()
    y.data = s.detach() * 2
    return y * m.w0


def interpolated(values, s):
    i = torch.searchsorted(knots, s).clamp(1, 19)
    x0, x1 = knots[i - 1], knots[i]
    return values[i - 1] + (values[i] - values[i - 1]) * (s - x0) / (x1 - x0)


def assigned(m, s, d):
    rows = torch.arange(len(s)).unsqueeze(-1)
    return m.values.expand(len(s), 4).index_put((rows, (s > 0).long() + torch.arange(3) // 2), s)[..., :3] * m.w0


def known_numbers(m, s, d):
    sizes = torch.tensor([3.0, 1.0, 2.0]).sort().values
    return s * sizes.double() * m.w0 if sizes.tolist()[0] < 2 and sizes.numpy()[1] == 2 else -s


def long_row(known):
    """A row that is long enough for a loop, of which the first element is a known number."""

    def row_of(m, s, d):
        rest = torch.cat([s * k for k in range(1, 10)], -1)
        row = torch.cat([torch.full_like(s[..., :1], known), rest], -1)
        return ((row / 4.0) * m.w0 + (row * 4.0).sin()).unflatten(-1, (7, 4)).sum(-2)[..., :3]

    return row_of


def diffusion(m, s, d):
    x = s.repeat(1, 20)
    y = FF.pad(x, (1, 1))
    return (y[..., 2:] - 2 * x + y[..., :-2]).unflatten(-1, (20, 3)).sum(-2) * m.w0


def pivoted(m, s, d):
    """A matrix with zeros on its diagonal, which needs pivots."""
    x = FF.pad(s, (0, 3), value=0.7)
    A = torch.diag_embed(x).roll(2, -1) + 0.1 * m.A * x.unsqueeze(-1)
    return torch.linalg.solve(A, x)[..., :3] * m.w0


def slope(m, s, d):
    x = s.detach().requires_grad_()
    with torch.enable_grad():
        return torch.autograd.grad((torch.sin(x) * m.w0).sum(), x, create_graph=True)[0]


class Swish(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x * torch.sigmoid(x)

    @staticmethod
    def backward(ctx, g):
        (x,) = ctx.saved_tensors
        y = torch.sigmoid(x)
        return g * (y + x * y * (1 - y))


class Half(torch.autograd.Function):
    """Rounds, and passes the gradient on."""

    @staticmethod
    def forward(ctx, x):
        return x.round()

    @staticmethod
    def backward(ctx, g):
        return g


def hook_on_a_tensor(m, s, d):
    y = s * m.w0
    if y.requires_grad:
        y.register_hook(lambda g: g * 2)
    return y


def hooked(forward):
    layer = nn.Linear(3, 3)
    if forward:
        layer.register_forward_hook(lambda module, given, found: found.tanh())
    else:
        layer.register_full_backward_hook(lambda module, given, found: None)
    return layer


class Symmetric(nn.Module):
    def forward(self, x):
        return x.triu() + x.triu(1).mT


def parametrised():
    layer = nn.Linear(3, 3)
    nn.utils.parametrize.register_parametrization(layer, "weight", Symmetric())
    return layer


def tied():
    a, b = nn.Linear(3, 3), nn.Linear(3, 3)
    b.weight = a.weight
    return nn.Sequential(a, nn.Tanh(), b)


def frozen():
    layer = nn.Linear(3, 3)
    layer.weight.requires_grad_(False)
    return layer


def snippet_of(row):
    """The snippet of a row of the table."""
    _, expression, *parts = row.parts
    named = {name: eval(part, globals()) for name, part in (part.split(" = ", 1) for part in parts)}
    code = compile("\n" * (row.line - 1) + f"lambda m, s, d: {expression}", row.file, "eval")
    snippet = Snippet(eval(code, globals()), **named)
    for buffer, value in BUFFERS.items():
        if f"m.{buffer}" in expression:
            snippet.register_buffer(buffer, value.clone(), persistent=buffer != "sparse")
    snippet.plain = torch.tensor(2.0, **D)
    return snippet


TABLE = {
    section: {name: (snippet_of(row), row.word) for name, row in rows.items()}
    for section, rows in sections("snippets.txt").items()
}
"""Snippets with a word of their refusal, by section and name."""
ACTIVATIONS = [
    *(nn.ReLU(), nn.LeakyReLU(), nn.ELU(), nn.SELU(), nn.CELU(), nn.GELU(), nn.GELU(approximate="tanh"), nn.SiLU()),
    *(nn.Softplus(), nn.Mish(), nn.Hardtanh(), nn.Hardswish(), nn.Softsign(), nn.Tanhshrink(), nn.PReLU(), nn.ReLU6()),
    *(nn.Softshrink(0.1), nn.Hardshrink(0.1), nn.LogSigmoid(), nn.Threshold(0.1, 0.0), nn.Softmin(-1)),
    *(nn.LogSoftmax(-1), nn.Hardsigmoid()),
]
for kind in ACTIVATIONS:
    word = {"Softshrink(0.1)": "softshrink", "Hardshrink(0.1)": "hardshrink"}.get(f"{kind}")
    section = "refused" if word else "other numbers" if isinstance(kind, nn.Hardsigmoid) else "equal"
    wide = {"net": nn.Linear(3, 40), "kind": copy.deepcopy(kind), "A": torch.randn(40, 3, **D)}
    TABLE[section][f"{kind}"] = Snippet(lambda m, s, d: m.net(s) * m.w0, net=kind), word
    TABLE[section][f"wide {kind}"] = Snippet(lambda m, s, d: m.kind(m.net(s)) @ m.A, **wide), word
