"""User code as machine code: equal to eager torch in states and gradients, or refused with the line of the code."""

import re
import warnings
from collections import OrderedDict

import operator_snippets
import pytest
import snippets
import torch
from torch import nn
from traced_function import Snippet, compared, gap, signals, traced

from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.trajectories.engines import code
from rt_torchrl.trajectories.engines.autograd import Autograd
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.engines.parallel import Parallel

CASES = snippets.CASES | operator_snippets.OPERATORS
REFUSED = {
    "dropout in training": "random",
    "func.jvp inside": "_has_same_storage_numel",
    "float32 inside": "float32",
    "complex inside": "complex",
    "lgamma": "lgamma",
    "sort": "sort",
    "argmax one-hot": "argmax",
    "random": "random",
    "branch on a state": "branch",
    "branch on t": "branch",
    ".item()": "number",
    ".numpy()": "numpy",
    "torch.cond": "cond",
    "out=": "out",
    "int view": "another type",
    "equal": "branch",
    "round decimals": "decimals",
    "bitwise int": "bits",
    "copysign": "signbit",
    "addmm alpha": "alpha",
    "hardtanh etc": "hardshrink_backward",
    "logcumsumexp": "logcumsumexp",
    "cumprod": "gather",
    "det": "_linalg_det",
    "matrix_exp": "linalg_matrix_exp",
    "cdist": "_cdist",
    "external leaf": "no parameter",
    "np.asarray": "__array__",
    "tolist": "tolist",
    "conv1d": "convolution",
    "bilinear": "_trilinear",
    "spectral param": "_weight_norm",
    "complex abs": "another type",
    "erfinv": "erf_inv",
    "checkpoint": "no parameter",
    "quantile/median": "median",
    "topk": "topk",
    "pad replicate": "replication_pad1d_backward",
    "interp grid": "upsample_linear1d_backward",
    "solve 7x7": "7 unknowns, more than 6",
    "number of a buffer": "number",
    "branch on a buffer": "branch",
    "sparse buffer": "sparse",
}
"""Code that is refused, with a word of the message."""
MIXED = ("batch mean", "batch size", "meshgrid")
"""Code in which a realisation depends on the others; it differs from torch, which the comparison finds."""


@pytest.mark.parametrize("case", [case for case in CASES if case not in REFUSED and case not in MIXED])
def test_equals_eager(case):
    # Rounding, summed in another order: a Newton iteration amplifies it most.
    for found, exact in compared(CASES[case], *signals(11, 3)):
        assert gap(found, exact) < 1e-10


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_the_line_of_the_code(case):
    with pytest.raises(UntraceableError, match=re.escape(REFUSED[case])) as refusal:
        traced(CASES[case], *signals(11, 3))
    assert re.search(r"snippets\.py:\d+: .", str(refusal.value)), refusal.value


@pytest.mark.parametrize("case", MIXED)
@pytest.mark.parametrize("batch", [1, 11])
def test_realisations_that_depend_on_each_other_are_refused(case, batch):
    with pytest.raises(UntraceableError, match="differs from what torch computes"):
        traced(CASES[case], *signals(batch, 1))


@pytest.mark.slow
def test_wide_perceptrons_need_no_wide_stack():
    """Each of the arrays of hidden units and of gradients by weights, 4 MiB, lies beyond the stack of a thread."""
    network = nn.Sequential(nn.Linear(3, 256), nn.Tanh(), nn.Linear(256, 256), nn.Tanh(), nn.Linear(256, 3))
    snippet = Snippet(lambda m, s, d: sum(m.modules_[0](s * k) for k in (1.0, 2.0, 3.0)), network)
    for found, exact in compared(snippet, *signals(3, 2)):
        assert gap(found, exact) < 1e-12


def test_refusals_hold_no_tensors():
    """The traceback of a refusal would keep everything that was traced."""
    case, (state, drive) = CASES["sort"], signals(2, 2)
    with pytest.warns(UserWarning, match="sort"):
        assert code.code_of(case, state, drive) is None
    assert code.code_of(case, state, drive) is None  # without another warning
    kept = (found for found, _ in code._kept.values())
    (refusal,) = (found for found in kept if isinstance(found, UntraceableError) and "sort" in str(found))
    assert refusal.__traceback__ is None


@pytest.mark.parametrize("where", ["state", "weight"])
@pytest.mark.parametrize("wanted", [True, False])
@pytest.mark.filterwarnings("error")
def test_what_is_no_number_refuses_no_code(where, wanted):
    """A twin that explodes once does not leave its engine for the rest of a training."""
    network, (state, drive) = nn.Linear(3, 3).double(), signals(4, 2)
    interval = Snippet(lambda m, s, d: m.w0 * torch.tanh(m.modules_[0](s) * d.t.unsqueeze(-1) * d.exogenous), network)
    spoiled = state.detach() if where == "state" else network.bias.data
    before = spoiled.clone()
    spoiled.fill_(torch.nan)
    for number in (torch.nan, 0.0):
        with torch.set_grad_enabled(wanted):
            begin = torch.full_like(state, number) if where == "state" else state
            found = Native(compiled=False).end_states(interval, begin, drive)
            exact = Autograd(compiled=False).end_states(interval, begin, drive)
        torch.testing.assert_close(found, exact, equal_nan=True)
        spoiled.copy_(before)
    assert code.code_of(interval, state, drive) is not None


def test_code_may_compute_with_known_numbers_as_it_likes():
    def counted(m, s, d):
        sizes = torch.tensor([3.0, 1.0, 2.0]).sort().values
        return s * sizes.double() * m.w0 if sizes.tolist()[0] < 2 and sizes.numpy()[1] == 2 else -s

    for found, exact in compared(Snippet(counted), *signals(11, 3)):
        assert gap(found, exact) < 1e-12


def counted(monkeypatch):
    """The texts of recurrences that are made, of which none is known yet."""
    made, text = [], code.march_text
    monkeypatch.setattr(code, "march_text", lambda *given: made.append(given) or text(*given))
    monkeypatch.setattr(code, "_kept", OrderedDict())
    return made


CHANGES = {
    "in place": lambda x: x.mul_(2.0),
    "behind torch's back": lambda x: x.data.mul_(2.0),
    "in its memory": lambda x: x.numpy().__setitem__(0, 3.0),
    "other memory": lambda x: setattr(x, "data", x.data * 2.0),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_buffer_is_an_input(change, monkeypatch):
    """Its new numbers are read, and need no other program."""
    made = counted(monkeypatch)
    snippet = Snippet(lambda m, s, d: s * m.gain)
    snippet.register_buffer("gain", torch.ones(3, dtype=torch.float64))
    state, drive = signals(4, 5)
    for _ in range(3):
        found = Native(compiled=False).end_states(snippet, state, drive)
        torch.testing.assert_close(found, Autograd(compiled=False).end_states(snippet, state, drive))
        CHANGES[change](snippet.gain)
    assert len(made) == 1


def roots(m, s, d):
    return torch.where(s > m.level, (s - m.level).sqrt(), 0.0) * m.w0


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_gradient_that_is_no_number_is_not_traced_again_and_again(share, monkeypatch):
    """The gradient of a branch that is not taken is NaN. Where torch has one, it is compared."""
    made, snippet = counted(monkeypatch), Snippet(roots)
    snippet.level = 0.0
    state, drive = signals(16, 4)
    state = state.abs() * torch.where(torch.arange(16) % 2 < 2 * share, 1.0, -1.0).unsqueeze(-1)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for _ in range(6):
            ends = Native(compiled=False).end_states(snippet, state.requires_grad_(), drive)
            exact = Autograd(compiled=False).end_states(snippet, state, drive)
            torch.testing.assert_close(ends, exact)
    assert len(made) == (1 if share else code.TRIES)
    assert [str(each.message) for each in said if "no finite gradient" in str(each.message)] == [] or not share
    assert sum("no finite gradient" in str(each.message) for each in said) == (0 if share else 1)


def test_the_engine_parallel_refuses_attention_in_words():
    snippet, (state, drive) = operator_snippets.OPERATORS["scaled dot product"], signals(4, 3)
    found = Native(compiled=False).end_states(snippet, state, drive)
    torch.testing.assert_close(found, Autograd(compiled=False).end_states(snippet, state, drive))
    with pytest.raises(ValueError, match=r"engine='parallel' needs .* Use engine='native' or 'autograd'"):
        Parallel(compiled=False).end_states(snippet, state, drive)
