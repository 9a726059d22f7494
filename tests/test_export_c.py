"""C files: against the policy in torch, in closed form, in a C program, and with every value of arithmetic."""

import ctypes
import math
import re

import pytest
import torch
from c_build import COMPILER, library, needs_compiler, printed
from linear_quadratic import LinearGain, LinearQuadratic
from seeds_and_numbers import seeded
from torch import nn

from rt_torchrl import export_c, shipped_plants
from rt_torchrl.export import c_file
from rt_torchrl.export.c_file import c_array
from rt_torchrl.plants.policies import SaturatedMLP
from rt_torchrl.plants.signal import Signal
from rt_torchrl.programs.c_source import CSource, literal
from rt_torchrl.programs.rules import new_tracer

# The same operations in double precision; sums in another order and another libm: a few ulp per operation.
ROUNDING = 1e-12


def plant_of(n_observations, actions):
    """The oracle plant with other signals; only these matter here."""
    names = [Signal(symbol="e", name=f"error_{k}", unit="-") for k in range(n_observations)]
    return type("Other", (LinearQuadratic,), {"observations": tuple(names), "actions": tuple(actions)})()


def unbounded(n):
    return [Signal(symbol="a", name=f"action_{k}", unit="N") for k in range(n)]


def called(function, observation, n_actions):
    action = c_array([0.0] * n_actions)
    function(c_array(observation), action)
    return torch.tensor(action, dtype=torch.float64)


@needs_compiler
def test_a_program_in_c_that_includes_the_header(tmp_path):
    plant = shipped_plants()["flapping_wing"]()
    policy = SaturatedMLP(4, plant.actions, hidden=(6,), generator=seeded())
    export_c(policy, tmp_path / "wing.c", plant, function="fly")
    header = (tmp_path / "wing.h").read_text()
    for signal in (*plant.observations, *plant.actions):
        assert signal.name in header and f"[{signal.unit}]" in header
    assert re.search(r"action\[0\] +flapping_amplitude +\[deg\] +50 \.\.\. 88", header)
    assert "every 0.0005 s" in header
    # The action, computed by a program that a user would write.
    seen = torch.randn(4, generator=seeded(), dtype=torch.float64)
    observation = ", ".join(f"{value:.17g}" for value in seen.tolist())
    (tmp_path / "main.c").write_text(
        '#include "wing.h"\n#include <stdio.h>\n'
        f"int main(void) {{ const double e[FLY_OBSERVATIONS] = {{{observation}}}; double a[FLY_ACTIONS]; fly(e, a);\n"
        '    printf("%.17g, %.17g", a[0], a[1]); return 0; }\n'
    )
    found = printed(tmp_path, "main.c", "wing.c")
    assert [float(x) for x in found.split(",")] == pytest.approx(policy(seen).tolist(), rel=ROUNDING)


class Formula(nn.Module):
    """A policy of one formula of the observation e, a matrix and a vector of weights."""

    def __init__(self, formula):
        super().__init__()
        self.formula = formula
        self.W = nn.Parameter(torch.randn(4, 4, generator=seeded(), dtype=torch.float64))
        self.b = nn.Parameter(torch.randn(4, generator=seeded(), dtype=torch.float64))

    def forward(self, e):
        return self.formula(e, self.W, self.b)


FORMULAS = {
    "power and scale": lambda e, W, b: 0.5 * e**2 - 2 * e**3 + e.abs() ** 1.5,
    "weights that are computed": lambda e, W, b: e * torch.exp(W).sum(0) + torch.stack(b.unbind()[::-1]),
    "select and stack": lambda e, W, b: torch.stack(
        [e[..., 0] * e[..., 1], e[..., 3], b[0] * e[..., 2], e[..., 0]], -1
    ),
    "slice and concatenate": lambda e, W, b: torch.cat([e[..., 1:3], b[:1].expand(len(e), 1), e[..., :1].tanh()], -1),
    "choose by index": lambda e, W, b: e[..., [2, 0, 3, 3]] + e.flip(-1) + e.roll(1, -1),
    "unbind and chunk": lambda e, W, b: torch.cat([torch.hypot(*e.chunk(2, -1)), *e.split([1, 3], -1)[:1] * 2], -1),
    "broadcast product": lambda e, W, b: (e.unsqueeze(-2) * W).sum(-1) + b,
    "matrix times vector": lambda e, W, b: (W @ e.unsqueeze(-1)).squeeze(-1),
    "einsum": lambda e, W, b: torch.einsum("ij,...j,i->...i", W, e, b),
    "quadratic form": lambda e, W, b: ((e @ W) * e).sum(-1, keepdim=True) * b,
    "mean and norm": lambda e, W, b: (
        (e - e.mean(-1, keepdim=True)) / (1.0 + torch.linalg.norm(e, dim=-1, keepdim=True))
    ),
    "outer product of two that vary": lambda e, W, b: torch.bmm(e.unsqueeze(-1), e.tanh().unsqueeze(-2)).sum(-2),
    "clamps": lambda e, W, b: e.clamp(-0.5, 0.7) + e.clamp(min=0.1) - e.clamp(max=0.2) + e.clamp(b, b.abs() + 1.0),
    "where": lambda e, W, b: torch.where((e > 0.1) & ~(e > 0.5) | (e < b), e, -2.0 * e.sign()),
    "extrema": lambda e, W, b: torch.maximum(e, b) + torch.minimum(e, e.flip(-1)),
    "functions": lambda e, W, b: e.sin() + e.cos() + torch.atan2(e, b) + e.square().log1p() + (-e.abs()).exp(),
    "roots": lambda e, W, b: (1.0 + e**2).sqrt() - (2.0 + e**2).rsqrt() + (3.0 + e**2).reciprocal(),
    "a constant": lambda e, W, b: torch.zeros_like(e) + b,
    "a tensor of the formula": lambda e, W, b: e * torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64),
    "truth values as numbers": lambda e, W, b: (e > b).double() * e,
    "softmax": lambda e, W, b: torch.softmax(e, -1),
    "integers": lambda e, W, b: (e > 0).sum(-1, keepdim=True).double(),
    "rounding": lambda e, W, b: torch.div(e, 2.0, rounding_mode="floor") + e.round() + torch.remainder(e, 0.7),
    "look up": lambda e, W, b: torch.linspace(-1.0, 1.0, 50, dtype=torch.float64)[(e.tanh() * 10.0 + 20.0).long()],
    "long rows": lambda e, W, b: torch.tanh(e.repeat(1, 10) * W.repeat(1, 10)[:1]).view(-1, 10, 4).sum(1) @ W,
}


def named(values):
    """Actions, one for every element of every value and named after it, so that an error tells the element."""
    names = [f"{name.replace(' ', '_')}_{k}" for name, value in values.items() for k in range(value.shape[-1])]
    return [Signal(symbol="a", name=name, unit="-") for name in names]


@needs_compiler
def test_formulas(tmp_path):
    def every(e, W, b):
        return {name: formula(e, W, b) for name, formula in FORMULAS.items()}

    policy = Formula(lambda e, W, b: torch.cat(list(every(e, W, b).values()), -1))
    plant = plant_of(4, named(every(torch.zeros(1, 4, dtype=torch.float64), policy.W, policy.b)))
    assert export_c(policy, tmp_path / "formulas.c", plant) < ROUNDING
    assert library(tmp_path / "formulas.c").linear_quadratic_policy


ACTIVATIONS = [
    *(nn.ReLU(), nn.SiLU(), nn.GELU(), nn.GELU(approximate="tanh"), nn.ELU(0.7), nn.SELU(), nn.CELU(), nn.Softplus()),
    *(nn.LeakyReLU(0.2), nn.Sigmoid(), nn.Softsign(), nn.Hardtanh(-0.4, 0.6), nn.Hardswish(), nn.Mish(), nn.ReLU6()),
    *(nn.LogSigmoid(), nn.PReLU(dtype=torch.float64), nn.Dropout(), nn.Identity(), nn.Tanhshrink(), nn.Hardsigmoid()),
    *(nn.LayerNorm(5, dtype=torch.float64), nn.RMSNorm(5, dtype=torch.float64), nn.Threshold(0.1, 2.0)),
]


class Layers(nn.Module):
    """All activations of one linear layer, side by side."""

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(2, 5, dtype=torch.float64)
        self.activations = nn.ModuleList(ACTIVATIONS)

    def every(self, e):
        return {f"{type(module).__name__}_{k}": module(self.linear(e)) for k, module in enumerate(self.activations)}

    def forward(self, e):
        return torch.cat(list(self.every(e).values()), -1)


@needs_compiler
def test_activations_and_normalisations(tmp_path):
    torch.manual_seed(0)  # torch's own initialisation of layers
    policy = Layers().eval()
    plant = plant_of(2, named(policy.every(torch.zeros(1, 2, dtype=torch.float64))))
    assert export_c(policy, tmp_path / "layers.c", plant) < ROUNDING
    assert library(tmp_path / "layers.c").linear_quadratic_policy


@pytest.mark.parametrize("number", [0.1, -1 / 3, 1e-300, 43_093.55, -0.0, math.inf, -math.inf, 5e-324, 1.7e308])
def test_literals_are_read_back_to_the_bit(number):
    text = literal(number).strip("()").replace("INFINITY", "inf")
    assert float(text).hex() == float(number).hex()
    assert text.endswith("inf") or "." in text or "e" in text  # a double, not an int


REFUSED = {
    "sort": (
        lambda e, W, b: e.sort(-1).values[..., :1],
        "policy Formula cannot be .* aten.sort.* pt2 and onnx",
    ),
    "single precision": (lambda e, W, b: e.float().double()[..., :1], "a conversion to torch.float32"),
    "a branch": (lambda e, W, b: e[..., :1] if e.sum() > 0 else -e[..., :1], "a branch of Python is taken"),
    "a number by NumPy": (lambda e, W, b: e[..., :1] * float(e.numpy()[0, 0]), r"\.numpy\(\) takes a number"),
    "random numbers": (lambda e, W, b: e[..., :1] + torch.randn(1, 1, dtype=torch.float64), "draws random numbers"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_c_form_is_refused(name, tmp_path):
    formula, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        export_c(Formula(formula), tmp_path / "policy.c", plant_of(4, unbounded(1)))
    assert not list(tmp_path.iterdir())


def test_a_machine_without_compiler_says_that_nothing_was_checked(tmp_path, monkeypatch):
    monkeypatch.setattr(c_file, "COMPILERS", ("no_such_compiler",))
    with pytest.warns(UserWarning, match="not checked: there is no C compiler"):
        assert export_c(LinearGain([[0.1, 0.2]]), tmp_path / "policy.c", LinearQuadratic()) is None
    assert (tmp_path / "policy.c").exists() and (tmp_path / "policy.h").exists()


@pytest.mark.parametrize(
    ("path", "function", "message"),
    [("policy.c", name, "function=.*must be a name in C") for name in ("2fast", "my-policy", "régulateur")]
    + [("policy.cpp", None, r"path=.*must end in \.c"), ("policy.c", "double", "could not be compiled")],
)
def test_names_that_c_does_not_take_are_refused(path, function, message, tmp_path):
    if function == "double" and COMPILER is None:
        pytest.skip("no C compiler here")
    with pytest.raises(ValueError, match=message):
        export_c(LinearGain([[0.1, 0.2]]), tmp_path / path, LinearQuadratic(), function=function)
    assert not list(tmp_path.iterdir())


# Programs in C: against torch, with every value that arithmetic can give, and in arrays that are one.


EDGES = [math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-310, 0.5, 1.5, 2.5, -0.5, -1.5, 1e300, -3.0, 7.0, 49.0, 50.0]


def compiled(function, x, folder):
    """The C function of a torch function of one vector; the result may be written where the argument is read."""
    tracer, given = new_tracer(), x.clone()
    tracer.input(given, "x")
    with torch.no_grad(), tracer:
        out = function(given)
    values = tracer.outputs(out)
    source = CSource()
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


@needs_compiler
def test_every_pair_of_edges(tmp_path):
    def stacked(x):
        return torch.stack([function(x) for function in ELEMENTWISE.values()])

    function = compiled(stacked, torch.ones(2, dtype=torch.float64), tmp_path)
    for pair in every_pair():
        torch.testing.assert_close(function(pair), stacked(pair), rtol=0.0, atol=0.0, equal_nan=True)


@needs_compiler
def test_outside_of_a_table_a_look_up_is_not_a_number(tmp_path):
    table = torch.arange(100.0, dtype=torch.float64).view(50, 2).sqrt()
    function = compiled(lambda x: table[x.long()], torch.ones(1, dtype=torch.float64), tmp_path)
    for place in EDGES:
        found = function(torch.tensor([place], dtype=torch.float64))
        if math.isfinite(place) and -50 <= math.trunc(place) < 50:  # a negative place counts from the end, as in torch
            assert torch.equal(found, table[math.trunc(place)].unsqueeze(0))
        else:
            assert found.isnan().all()
