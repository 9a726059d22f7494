"""NaN, infinity and signed zeros in machine code, over every kind of lanes, as torch has them."""

import math

import llvmlite.binding as llvm
import pytest
import torch
from torch import nn
from traced_function import Snippet, compared, gap, marched, signals

from rt_torchrl.programs import machine_code
from rt_torchrl.programs.machine_code import Lanes, lanes_of_this_machine, march_text
from rt_torchrl.programs.rules import new_tracer
from rt_torchrl.trajectories.engines import native
from rt_torchrl.trajectories.engines.code import Inputs, IntervalCode, Point, for_each_group
from rt_torchrl.trajectories.engines.interval import Drive

LANES = [Lanes(8, "e"), Lanes(4, "d"), Lanes(2, "b"), Lanes(2, "")]
SPECIAL = torch.tensor(
    [0.0, -0.0, 1.0, -1.0, 0.5, 2.0, -2.5, 3.0, 1e-300, -1e200, 1e16, 0.7, math.inf, -math.inf, math.nan, math.pi],
    dtype=torch.float64,
)
TABLE = torch.tensor([1.0, -2.0, 4.0, 0.0], dtype=torch.float64)
UNARY = {
    **{f: getattr(torch, f) for f in "exp log sin tanh sqrt abs floor round sign neg relu sigmoid isnan erf".split()},
    **{f: getattr(torch, f) for f in "log1p expm1 atan rsqrt reciprocal square trunc isinf isfinite erfc".split()},
    "zero times": lambda x: 0.0 * x,
    "minus itself": lambda x: x - x,
    "by itself": lambda x: x / x,
    "plus zero": lambda x: x + 0.0,
    "zero minus": lambda x: 0.0 - x,
    "minus zero": lambda x: x - 0.0,
    "clamp": lambda x: x.clamp(-1.0, 1.0),
    "clamp from below": lambda x: x.clamp(min=0.5),
    "clamp by NaN": lambda x: x.clamp(max=math.nan),
    "where": lambda x: torch.where(x > 0.0, x.sqrt(), x.log()),
    "look-up": lambda x: TABLE[torch.bucketize(x, TABLE.sort().values).clamp(0, 3)],
    "square root by power": lambda x: x**0.5,
    "cube": lambda x: x**3,
    "inverse square": lambda x: x**-2,
    "fractional power": lambda x: x**1.7,
    "remainder": lambda x: torch.remainder(x, 0.7),
    "remainder of a negative": lambda x: torch.remainder(x, -0.7),
    "nan_to_num": lambda x: torch.nan_to_num(x, 1.0, 2.0, 3.0),
    "halves": lambda x: x / 4.0,
    "tiny divisor": lambda x: x / 5e-324,
}
BINARY = {f: getattr(torch, f) for f in "add sub mul div minimum maximum atan2 hypot remainder fmod pow".split()}
BINARY |= {f: getattr(torch, f) for f in "gt lt ge le eq ne logaddexp".split()}


def assert_same(f, lanes=None):
    """Equal values over all pairs of special numbers."""
    x, y = (v.flatten() for v in torch.meshgrid(SPECIAL, SPECIAL, indexing="ij"))
    snippet = Snippet(lambda m, s, d: torch.stack([f(s[..., 0], s[..., 1]), s[..., 1]], -1), share=1.0)
    snippet.forward = lambda state, drive: snippet.f(snippet, state, drive)
    _, drive = signals(len(x), 1)
    state, lanes = torch.stack([x, y], -1), lanes or lanes_of_this_machine()
    n = lanes.number
    first = Drive(drive.t[0].expand(n), *(z[0, :n] for z in drive[1:]))
    programs = IntervalCode(snippet, Point(torch.linspace(0.3, 0.8, 2 * n).double().view(n, 2), first), lanes)
    with torch.no_grad():
        task = native._Task(programs, Inputs(snippet), state, drive)
        found = native._EndStates.apply(task, state, *drive, *task.inputs.learned)[0, :, 0]
        exact = marched(snippet, state, *drive)[0, :, 0]
    torch.testing.assert_close(found, exact, rtol=1e-12, atol=1e-300, equal_nan=True)


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_special_values_of_operators(name):
    one, two = UNARY.get(name), BINARY.get(name)
    assert_same((lambda x, y: one(x).double()) if one else (lambda x, y: two(x, y).double()))


def all_functions(m, s, d):
    x = m.net(s).tanh() + 0.3
    y = x.exp().log1p() + x.sin() * x.cos() + x.abs().pow(1.3) + torch.atan2(x, s[..., :1]) + x.erf()
    y = y + torch.hypot(x, y) + torch.remainder(x, 0.7) + x.clamp(-0.5, 0.5)
    return y[..., :3] * m.w0 + x.sum(-1, keepdim=True)


@pytest.mark.parametrize("width", [3, 40])
@pytest.mark.parametrize("lanes", LANES, ids=str)
def test_every_kind_of_lanes(lanes, width):
    features = llvm.get_host_cpu_features()
    if not features.get({"e": "avx512dq", "d": "avx2"}.get(lanes.variant, "sse2"), False):
        pytest.skip("this processor lacks these lanes")
    torch.manual_seed(0)
    for found, exact in compared(Snippet(all_functions, net=nn.Linear(3, width)), *signals(11, 3), lanes=lanes):
        assert gap(found, exact) < 1e-12


def test_a_text_that_is_too_long_for_optimisation_gives_the_same(monkeypatch, tmp_path):
    torch.manual_seed(0)
    case, lanes = (Snippet(all_functions, net=nn.Linear(3, 40)), *signals(11, 3)), lanes_of_this_machine()
    optimised = compared(*case, lanes=lanes)
    monkeypatch.setattr(machine_code, "LONG", 0)
    monkeypatch.setattr(machine_code, "cache_folder", lambda: tmp_path)
    for (found, exact), (other, _) in zip(compared(*case, lanes=lanes), optimised, strict=True):
        assert gap(found, exact) < 1e-12 and gap(found, other) < 1e-15
    assert list(tmp_path.iterdir())


def test_the_text_compiles_for_other_processors():
    tracer = new_tracer()
    state = torch.rand(1, 3, dtype=torch.float64)
    tracer.input(state, "s")
    snippet = nn.Sequential(nn.Linear(3, 40), nn.Tanh(), nn.Linear(40, 3)).double().requires_grad_(False)
    with torch.no_grad(), tracer:
        end = snippet(state) + state.sin()
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    text = march_text(tracer.program, tracer.cells(end).flatten().tolist(), {"x": 1, "s": 3}, Lanes(2, ""))
    for triple in ("aarch64-unknown-linux-gnu", "arm64-apple-macosx", "x86_64-pc-windows-msvc"):
        machine = llvm.Target.from_triple(triple).create_target_machine(opt=2)
        module = llvm.parse_assembly(text)
        module.triple = triple
        module.verify()
        assert len(machine.emit_object(module)) > 1000


# Groups of lanes: their work is shared among threads, once each, and a failure of any of them is raised


@pytest.mark.parametrize("failing", [0, 16])
def test_a_failure_is_raised(failing):
    def work(group):
        if group.first == failing:
            raise ArithmeticError(f"group {group.first}")

    with pytest.raises(ArithmeticError, match=f"group {failing}"):
        for_each_group(21, 8, work)
