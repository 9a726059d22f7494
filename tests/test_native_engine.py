"""Engine native against backpropagation, over batches, lengths, threads, memory, and weights of every kind."""

import warnings
from contextlib import nullcontext

import pytest
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import seeded
from test_gradients import Case, assert_equal
from torch import nn

from rt_torchrl.trajectories.engines.interval import Autograd
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
