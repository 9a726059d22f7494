"""Engine native against backpropagation, over batches, lengths, threads, memory, and weights of every kind."""

import math
import warnings
from contextlib import nullcontext

import llvmlite.binding as llvm
import pytest
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import seeded
from test_gradients import Case, assert_equal
from torch import nn
from traced_function import Snippet, compared, gap, marched, signals

from rt_torchrl.programs import machine_code
from rt_torchrl.programs.machine_code import Lanes, lanes_of_this_machine, march_text
from rt_torchrl.programs.rules import new_tracer
from rt_torchrl.trajectories.engines import native
from rt_torchrl.trajectories.engines.code import Inputs, IntervalCode, Point, for_each_group
from rt_torchrl.trajectories.engines.interval import Autograd, Drive
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.rollout import Rollout, drive_of


@pytest.fixture(autouse=True)
def _no_substitute():
    """No engine takes the place of native unseen."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="engine 'autograd'")
        yield


def case_of(driver="policy", batch=3, n=4, closure="own"):
    return Case(LinearQuadratic(horizon=0.1 * n), closure, driver, batch)


def assert_native(case, bound=1e-10):
    assert_equal(case.gradients("native"), case.gradients("autograd"), bound)


@pytest.mark.parametrize(
    ("driver", "batch", "n"),
    [("policy", batch, 2) for batch in (1, 2, 7, 8, 9, 17)]
    + [(driver, 3, n) for driver in ("commands", "policy") for n in (1, 2, 300)],
)
def test_every_batch_and_length(driver, batch, n):
    assert_native(case_of(driver, batch, n), 1e-13 if n == 2 else 1e-12)


def test_signals_in_any_memory_layout():
    """One row for all realisations, and the time first."""
    case = case_of("commands", 11, 6)
    case.exogenous = case.exogenous[:1, :1].expand(11, 6, -1)
    case.command = case.command.transpose(0, 1).contiguous().transpose(0, 1)
    assert_native(case)


class Stiffening(LinearQuadratic):
    """The oscillator with a spring that changes over time."""

    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action, exogenous, closure) + torch.sin(t).unsqueeze(-1) * state


def test_the_gradient_by_the_time_in_any_memory_layout():
    """One time for all realisations, every second of more; and one for each, the realisations first."""
    case = Case(Stiffening(horizon=0.6), "own", "policy", 3)
    interval, weights = case.rollout("native").interval, torch.arange(1.0, 19.0).double().view(6, 3, 1)
    for start in (3.0, torch.tensor([3.0, 5.0, 8.0]).double()):
        drive = drive_of(case.plant, case.exogenous, None, start=start)
        t = drive.t.t().contiguous().t() if drive.t.shape[1] > 1 else drive.t.repeat_interleave(2, 0)[::2]
        assert not t.is_contiguous()
        t.requires_grad_()
        found, exact = (
            torch.autograd.grad(
                (weights * engine.end_states(interval, case.initial_state, drive._replace(t=t))).sum(), t
            )
            for engine in (Native(), Autograd())
        )
        assert exact[0].all()
        assert_equal({"t": found[0]}, {"t": exact[0]})


def test_threads_give_the_same():
    case, threads = case_of(batch=21, n=900), torch.get_num_threads()
    whole = case.gradients("native")
    try:
        for number in (1, 2):
            torch.set_num_threads(number)
            assert_equal(case.gradients("native"), whole, 1e-13)
    finally:
        torch.set_num_threads(threads)


def test_a_weight_that_changes_before_the_backward_pass_is_noticed_or_does_not_matter():
    """Costs have computed their gradients before; states have not."""
    case, weights = case_of(), []
    given, weights = (case.initial_state, case.exogenous), [*case.closure.parameters(), *case.policy.parameters()]
    exact = torch.autograd.grad(case.rollout("native").costs(*given).sum(), weights)
    costs, states = case.rollout("native").costs(*given), case.rollout("native")(*given).states
    with torch.no_grad():
        for weight in weights:
            weight += 1.0
    for found, gradient in zip(torch.autograd.grad(costs.sum(), weights), exact, strict=True):
        assert torch.equal(found, gradient)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        states.sum().backward()


def test_frozen_weights():
    case = case_of()
    case.gradients("native")
    for module in (case.closure, case.policy):
        module.requires_grad_(False)
        assert_native(case)


def test_weights_in_any_memory_layout():
    case = case_of()
    for matrix in (torch.randn(2, 2).double().t(), torch.randn(4, 4).double()[::2, 1::2]):
        case.closure.matrix = nn.Parameter(matrix)
        assert not case.closure.matrix.is_contiguous()
        assert_native(case)


def test_shared_weights():
    case = case_of(closure="perceptron")
    first, *_, last = (m for m in case.closure.modules() if isinstance(m, nn.Linear))
    case.gradients("native")
    last.bias = nn.Parameter(first.bias.detach()[:2].clone())
    case.policy.gain = nn.Parameter(torch.randn(1, 2).double())
    case.gradients("native")
    last.bias = nn.Parameter(case.policy.gain.detach()[0].clone())
    assert_native(case)
    case.policy.gain = case.closure.extra = nn.Parameter(torch.randn(1, 2).double())
    assert_native(case)


@pytest.mark.parametrize("driver", ["commands", "policy"])
def test_the_own_closure_of_a_plant_keeps_its_weights(driver):
    """The interval holds it twice."""
    case = case_of(driver, closure="true")
    before = case.plant.closure.matrix
    assert_native(case)
    assert case.plant.closure.matrix is before and isinstance(before, nn.Parameter) and before.requires_grad


def test_single_precision_is_left_to_torch():
    case = case_of()
    rollout = case.rollout("native")
    case.closure.float()
    with pytest.warns(UserWarning, match="matrix is in torch.float32; trajectories need torch.float64"):
        rollout(case.initial_state, case.exogenous)


class Drained(LinearQuadratic):
    """A plant with a Python branch on its state."""

    def vector_field(self, t, state, action, exogenous, closure):
        rates = super().vector_field(t, state, action, exogenous, closure)
        return 3.0 * rates if state[..., 0].sum() > 0.0 else rates


def test_a_python_branch_has_the_gradient_of_the_branch_that_was_taken():
    """Rows of all times at once, as the engine parallel evaluates them, would take one branch for all of them."""
    plant, gradients = Drained(horizon=10.0, noise=0.0), []
    start, inputs = torch.tensor([[1.0, 0.0]]).double(), torch.zeros(1, 100, 1).double()
    for engine in ("native", "autograd"):
        closure = plant.make_closure(seeded(0))
        roll = Rollout(plant, closure, engine=engine)
        with pytest.warns(UserWarning, match="'autograd' takes the place") if engine == "native" else nullcontext():
            flown = roll(start, inputs, torch.zeros(1, 100, 1).double())
        gradients.append(torch.autograd.grad((flown.states**2).mean(), closure.matrix)[0])
    assert flown.states[..., 0].min() < 0.0 < flown.states[..., 0].max()  # both branches are taken
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=0.0)


# NaN, infinity and signed zeros in machine code, over every kind of lanes, as torch has them.


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


class NotBackwards(nn.Module):
    """A closure whose recurrence becomes a program, and whose gradient does not."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(2, dtype=torch.float64))

    def forward(self, features):
        return nn.functional.hardshrink(features * self.weight, 0.1)


def test_where_the_gradient_is_no_program_torch_computes_it():
    case = case_of()
    case.closure = NotBackwards()
    with pytest.warns(UserWarning, match="hardshrink_backward"):
        found = case.gradients("native")
    assert_equal(found, case.gradients("autograd"))
