"""Programs in C: against torch, with every value that arithmetic can give, and in arrays that are one."""

import ctypes
import math

import pytest
import torch
from c_build import library, needs_compiler

from rt_torchrl.programs.c_source import CSource
from rt_torchrl.programs.rules import new_tracer

pytestmark = needs_compiler
EDGES = [math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-310, 0.5, 1.5, 2.5, -0.5, -1.5, 1e300, -3.0, 7.0, 49.0, 50.0]


def compiled(function, x, folder, weight=None):
    """The C function of a torch function of one vector; the result may be written where the argument is read."""
    tracer, given = new_tracer(), x.clone()
    tracer.input(given, "x")
    if weight is not None:
        tracer.weight(weight)
    with torch.no_grad(), tracer:
        out = function(given)
    values = tracer.outputs(out)
    source = CSource([] if weight is None else [("weight", weight.flatten().tolist())])
    inputs = {("x", k): f"x[{k}]" for k in range(x.numel())}
    source.add(
        "void f(const double *x, double *y)", tracer.program, inputs, [(f"y[{k}]", v) for k, v in enumerate(values)]
    )
    file = folder / "f.c"
    file.write_text(f"#include <math.h>\nvoid f(const double *x, double *y);\n{source.text()}")
    f = library(file).f

    def run(x):
        size = max(len(values), x.numel())
        array = (ctypes.c_double * size)(*x.flatten().tolist())
        f(array, array)
        return torch.tensor(list(array)[: len(values)], dtype=torch.float64).view(out.shape)

    return run


def every_pair():
    edges = torch.tensor(EDGES, dtype=torch.float64)
    return torch.cartesian_prod(edges, edges)


ELEMENTWISE = {
    "minimum": lambda x: torch.minimum(x[0], x[1]),
    "maximum": lambda x: torch.maximum(x[0], x[1]),
    "clamp between numbers": lambda x: x[0].clamp(-1.0, 2.0),
    "clamp between tensors": lambda x: x[0].clamp(min=x[1]),
    "where": lambda x: torch.where(x[0] > x[1], x[0], x[1]),
    "where of its negation": lambda x: torch.where(~(x[0] > x[1]), x[0], x[1]),
    "not equal": lambda x: (x[0] != x[1]).double(),
    "equal or not a number": lambda x: ((x[0] == x[1]) | x[0].isnan() ^ x[1].isnan()).double(),
    "relu": lambda x: torch.relu(x[0]),
    "sign": lambda x: torch.sign(x[0]),
    "rounding": lambda x: x[0].round(),
    "floor, ceiling and truncation": lambda x: x[0].floor() + x[0].ceil() + x[0].trunc(),
    "absolute value": lambda x: x[0].abs(),
    "quotient": lambda x: x[0] / x[1],
    "product with zero": lambda x: 0.0 * x[0],
}


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_every_pair_of_edges(name, tmp_path):
    def stacked(x):
        return ELEMENTWISE[name](x).reshape(1)

    function, found, expected = compiled(stacked, torch.ones(2, dtype=torch.float64), tmp_path), [], []
    for pair in every_pair():
        found.append(function(pair))
        expected.append(stacked(pair))
    torch.testing.assert_close(torch.cat(found), torch.cat(expected), rtol=0.0, atol=0.0, equal_nan=True)


def test_outside_of_a_table_a_look_up_is_not_a_number(tmp_path):
    table = torch.arange(100.0, dtype=torch.float64).view(50, 2).sqrt()
    function = compiled(lambda x: table[x.long()], torch.ones(1, dtype=torch.float64), tmp_path)
    for place in EDGES:
        found = function(torch.tensor([place], dtype=torch.float64))
        if math.isfinite(place) and -50 <= math.trunc(place) < 50:  # a negative place counts from the end, as in torch
            assert torch.equal(found, table[math.trunc(place)].unsqueeze(0))
        else:
            assert found.isnan().all()


def test_loops_over_long_rows(tmp_path):
    weight = torch.randn(30, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def function(x):
        return torch.sigmoid(x.view(1, 40) @ weight.T) ** 2 / 3.0 - torch.ones(30, dtype=torch.float64).cumsum(0)

    x = torch.linspace(-2.0, 2.0, 40, dtype=torch.float64)
    found = compiled(function, x, tmp_path, weight)(x)
    assert "for (int" in (tmp_path / "f.c").read_text()
    torch.testing.assert_close(found, function(x), rtol=1e-13, atol=1e-13)


def test_what_is_read_may_be_overwritten(tmp_path):
    x = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    assert compiled(lambda x: x.flip(0) * torch.tensor([1.0, 1.0, 2.0]).double(), x, tmp_path)(x).tolist() == [3, 2, 2]
