"""C files: against the policy in torch, in closed form, in a C program, and with every value of arithmetic."""

import copy
import ctypes
import math
import re
from functools import partial

import pytest
import torch
from c_build import library, needs_compiler, printed
from linear_quadratic import LinearGain, LinearQuadratic
from seeds_and_numbers import seeded
from snippets import TABLE
from test_export import Law
from traced_function import signals

from rt_torchrl import SaturatedMLP, export_c, shipped_plants
from rt_torchrl.export import c_file
from rt_torchrl.programs.c_source import CSource, literal
from rt_torchrl.programs.rules import new_tracer
from rt_torchrl.trajectories.engines.interval import Drive

# The same operations in double precision; sums in another order and another libm: a few ulp per operation.
ROUNDING = 1e-12


PROGRAM = """
#include "wing.h"
#include <stdio.h>
int main(void) {
    const double e[4] = {%.17g, %.17g, %.17g, %.17g};
    double a[2];
    fly(e, a);
    printf("%%.17g, %%.17g", a[0], a[1]);
    return 0;
}
"""


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
    (tmp_path / "main.c").write_text(PROGRAM % tuple(seen.tolist()))
    found = printed(tmp_path, "main.c", "wing.c")
    assert [float(x) for x in found.split(",")] == pytest.approx(policy(seen).tolist(), rel=ROUNDING)


@pytest.mark.parametrize("number", [0.1, -1 / 3, 1e-300, 43_093.55, -0.0, math.inf, -math.inf, 5e-324, 1.7e308])
def test_literals_are_read_back_to_the_bit(number):
    text = literal(number).strip("()").replace("INFINITY", "inf")
    assert float(text).hex() == float(number).hex()
    assert text.endswith("inf") or "." in text or "e" in text  # a double, not an int


def test_what_has_no_c_form_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"policy Law cannot be .* aten.sort.* ONNX takes more"):
        export_c(Law(lambda law, e: e.sort(-1).values[..., :1]), tmp_path / "policy.c", LinearQuadratic())
    assert not list(tmp_path.iterdir())


def test_a_machine_without_compiler_says_that_nothing_was_checked(tmp_path, monkeypatch):
    monkeypatch.setattr(c_file, "COMPILERS", ("no_such_compiler",))
    with pytest.warns(UserWarning, match="not checked: there is no C compiler"):
        assert export_c(LinearGain([[0.1, 0.2]]), tmp_path / "policy.c", LinearQuadratic()) is None
    assert (tmp_path / "policy.c").exists() and (tmp_path / "policy.h").exists()


@needs_compiler
@pytest.mark.parametrize(
    ("path", "function", "message"),
    [
        ("policy.c", "my-policy", "function=.*must be a name in C"),
        ("policy.c", "régulateur", "function=.*must be a name in C"),
        ("policy.cpp", None, r"path=.*must end in \.c"),
        ("policy.c", "double", "could not be compiled"),
    ],
)
def test_names_that_c_does_not_take_are_refused(path, function, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        export_c(LinearGain([[0.1, 0.2]]), tmp_path / path, LinearQuadratic(), function=function)
    assert not list(tmp_path.iterdir())


# Programs in C: against torch, with every value that arithmetic can give, and in arrays that are one.


EDGES = [math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-310, 0.5, 1.5, 2.5, -0.5, -1.5, 1e300, -3.0, 7.0, 49.0, 50.0]


def compiled(functions, x, folder):
    """The C functions of torch functions of one vector; a result may be written where the argument is read."""
    source, shapes = CSource(), []
    heads = [f"void f{k}(const double *x, double *y)" for k in range(len(functions))]
    for head, function in zip(heads, functions, strict=True):
        tracer, given = new_tracer(), x.clone()
        tracer.input(given, "x")
        with torch.no_grad(), tracer:
            out = function(given)
        places = [(f"y[{k}]", value) for k, value in enumerate(tracer.outputs(out))]
        source.add(head, tracer.program, {("x", k): f"x[{k}]" for k in range(x.numel())}, places)
        shapes.append(out.shape)
    file = folder / "f.c"
    file.write_text("#include <math.h>\n" + "".join(f"{head};\n" for head in heads) + source.text())
    loaded = library(file)

    def run(k, x):
        array = (ctypes.c_double * max(shapes[k].numel(), x.numel()))(*x.flatten().tolist())
        getattr(loaded, f"f{k}")(array, array)
        return torch.tensor(list(array)[: shapes[k].numel()], dtype=torch.float64).view(shapes[k])

    return [partial(run, k) for k in range(len(functions))]


ATTENTION = {"scaled dot product", "TransformerEncoderLayer eval", "mha weights off"}
"""Their operator can draw random numbers, which C has none of."""


@needs_compiler
def test_pieces_of_user_code(tmp_path):
    """All that machine code computes, of known weights."""
    state, drive = signals(1, 1)
    now = Drive(*(part[0] for part in drive))
    known = [copy.deepcopy(snippet) for name, (snippet, _) in TABLE["equal"].items() if name not in ATTENTION]
    functions = [partial(snippet.requires_grad_(False), drive=now) for snippet in known]
    for found, exact in zip(compiled(functions, state, tmp_path), functions, strict=True):
        torch.testing.assert_close(found(state), exact(state), rtol=ROUNDING, atol=ROUNDING, equal_nan=True)


@needs_compiler
def test_every_pair_of_edges(tmp_path):
    def stacked(x):
        a, b = x
        extremes = torch.minimum(a, b), torch.maximum(a, b), a.clamp(-1.0, 2.0), a.clamp(min=b)
        chosen = torch.where(a > b, a, b), torch.where(~(a > b), a, b), torch.relu(a), torch.sign(a), a.abs()
        compared = a != b, (a == b) | a.isnan() ^ b.isnan(), a >= b, a <= b
        rounded = a.round(), a.floor() + a.ceil() + a.trunc()
        return torch.stack([*extremes, *chosen, *(x.double() for x in compared), *rounded, a / b, 0.0 * a])

    (function,) = compiled([stacked], torch.ones(2, dtype=torch.float64), tmp_path)
    edges = torch.tensor(EDGES, dtype=torch.float64)
    for pair in torch.cartesian_prod(edges, edges):
        torch.testing.assert_close(function(pair), stacked(pair), rtol=0.0, atol=0.0, equal_nan=True)


@needs_compiler
def test_outside_of_a_table_a_look_up_is_not_a_number(tmp_path):
    table = torch.arange(100.0, dtype=torch.float64).view(50, 2).sqrt()
    (function,) = compiled([lambda x: table[x.long()]], torch.ones(1, dtype=torch.float64), tmp_path)
    for place in EDGES:
        found = function(torch.tensor([place], dtype=torch.float64))
        if math.isfinite(place) and -50 <= math.trunc(place) < 50:  # a negative place counts from the end, as in torch
            assert torch.equal(found, table[math.trunc(place)].unsqueeze(0))
        else:
            assert found.isnan().all()
