"""The contract of traced code: right, or refused with the line and the remedy; nothing is silently wrong."""

import re
import warnings
from collections import OrderedDict

import changes
import pytest
import snippets
import torch
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import drawn, seeded
from torch import nn
from traced_function import Recurrent, Rows, Snippet, compared, gap, signals, traced

from rt_torchrl import DigitalTwin, PlantEnv
from rt_torchrl.programs.contract import ImpureError
from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.systems.collectors import EpisodeCollector, collector_of
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.trajectories.engines import code
from rt_torchrl.trajectories.engines.interval import Autograd
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.rollout import ENGINES, Rollout

EQUAL, REFUSED, IMPURE, MIXED = (snippets.TABLE[name] for name in ("equal", "refused", "impure", "mixed"))
REMEDIES = r"; (use|make|write|take|multiply|eliminate|they belong|machine code has|compute) |raises"


@pytest.mark.parametrize("case", EQUAL)
def test_equals_eager(case):
    # Rounding, summed in another order: a Newton iteration amplifies it most.
    for found, exact in compared(EQUAL[case][0], *signals(11, 3)):
        assert gap(found, exact) < 1e-10


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_the_line_of_the_code_and_the_remedy(case):
    snippet, word = REFUSED[case]
    with pytest.raises(UntraceableError, match=re.escape(word)) as refusal:
        traced(snippet, *signals(11, 3))
    assert re.search(r"snippets\.(py|txt):\d+: .", str(refusal.value)) or case == "deepcopy", refusal.value
    assert re.search(REMEDIES, str(refusal.value))


@pytest.mark.parametrize("case", IMPURE)
def test_no_function_of_its_arguments_is_refused_with_the_remedy(case):
    (snippet, word), remedy = IMPURE[case], "Policy, closure and plant must|Rows are systems of their own"
    with pytest.raises(ImpureError, match=f"{word}.*({remedy})"):
        Native().end_states(snippet, *signals(11, 3))


@pytest.mark.parametrize("case", MIXED)
@pytest.mark.parametrize("batch", [1, 11])
def test_realisations_that_depend_on_each_other_are_refused(case, batch):
    with pytest.raises(UntraceableError, match="differs from what torch computes"):
        traced(MIXED[case][0], *signals(batch, 1))


@pytest.mark.slow
def test_wide_perceptrons_need_no_wide_stack():
    """Each of the arrays of hidden units and of gradients by weights, 4 MiB, lies beyond the stack of a thread."""
    network = nn.Sequential(nn.Linear(3, 256), nn.Tanh(), nn.Linear(256, 256), nn.Tanh(), nn.Linear(256, 3))
    snippet = Snippet(lambda m, s, d: sum(m.net(s * k) for k in (1.0, 2.0, 3.0)), net=network)
    for found, exact in compared(snippet, *signals(3, 2)):
        assert gap(found, exact) < 1e-12


@pytest.mark.parametrize("where", ["state", "weight"])
@pytest.mark.parametrize("wanted", [True, False])
@pytest.mark.filterwarnings("error")
def test_what_is_no_number_refuses_no_code(where, wanted):
    """A twin that explodes once does not leave its engine for the rest of a training."""
    network, (state, drive) = nn.Linear(3, 3).double(), signals(4, 2)
    interval = Snippet(lambda m, s, d: m.w0 * torch.tanh(m.net(s) * d.t.unsqueeze(-1) * d.exogenous), net=network)
    spoiled = state.detach() if where == "state" else network.bias.data
    before = spoiled.clone()
    spoiled.fill_(torch.nan)
    for number in (torch.nan, 0.0):
        with torch.set_grad_enabled(wanted):
            begin = torch.full_like(state, number) if where == "state" else state
            found = Native().end_states(interval, begin, drive)
            exact = Autograd().end_states(interval, begin, drive)
        torch.testing.assert_close(found, exact, equal_nan=True)
        spoiled.copy_(before)
    assert code.code_of(interval, state, drive) is not None


def counted(monkeypatch):
    """The texts of recurrences that are made, of which none is known yet."""
    made, text = [], code.march_text
    monkeypatch.setattr(code, "march_text", lambda *given: made.append(given) or text(*given))
    monkeypatch.setattr(code, "_codes", OrderedDict())
    return made


BUFFERS = {
    "in place": lambda x: x.mul_(2.0),
    "behind torch's back": lambda x: x.data.mul_(2.0),
    "in its memory": lambda x: x.numpy().__setitem__(0, 3.0),
    "other memory": lambda x: setattr(x, "data", x.data * 2.0),
}


@pytest.mark.parametrize("change", BUFFERS)
def test_a_buffer_is_an_input(change, monkeypatch):
    """Its new numbers are read, and need no other program."""
    made = counted(monkeypatch)
    snippet = Snippet(lambda m, s, d: (s * m.gain).clamp(max=m.limit))
    snippet.register_buffer("gain", torch.ones(3, dtype=torch.float64))
    snippet.register_buffer("limit", torch.tensor(torch.inf, dtype=torch.float64))
    state, drive = signals(4, 5)
    for _ in range(3):
        found = Native().end_states(snippet, state, drive)
        torch.testing.assert_close(found, Autograd().end_states(snippet, state, drive))
        BUFFERS[change](snippet.gain)
    assert len(made) == 1


# What is read and changes


def cost(plant, engine, rollouts):
    """The cost of a flight, by a rollout that lasts."""
    scenario, policy = drawn(plant, 2), plant.make_policy(seeded())
    flown = rollouts.setdefault(engine, Rollout(plant, plant.closure, policy, engine=engine))
    return flown.costs(*scenario).mean().item()


@pytest.mark.parametrize("kind", changes.KINDS)
def test_a_change_is_followed_or_the_thing_is_refused_by_name(kind, monkeypatch):
    make, change, refusal = changes.KINDS[kind]
    plant, lasting = make(), {}
    with changes.as_before(monkeypatch), warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for scale in (0.1, 10.0):
            change(scale, plant)
            exact = cost(plant, "autograd", {})
            for rollouts in (lasting, {}):
                assert cost(plant, "native", rollouts) == pytest.approx(exact, rel=1e-9)
    refusals = [str(each.message) for each in said if "takes the place of 'native'" in str(each.message)]
    assert exact > 1.0  # the factor is in the cost
    if refusal:
        remedies = ("make it an attribute or a buffer", "import it at the top")
        assert any(refusal in text and any(map(text.count, remedies)) for text in refusals), refusals
    else:
        assert not refusals


# What is no function of its arguments is refused in words, by every engine and on every path that flies it


class Centred(nn.Linear):
    """A policy that looks at the mean of all rows."""

    def forward(self, observation):
        return super().forward(observation - observation.mean())


AGAIN = "gives something else when it is called again with the same arguments"
POLICIES = {
    "recurrent": (Recurrent, rf"policy \(Recurrent\) {AGAIN}.*a state of the plant"),
    "dropout": (
        lambda: Rows(nn.Linear(2, 8), nn.Dropout(), nn.Linear(8, 1)),
        rf"policy.layers.1 \(Dropout\) {AGAIN}.*\.eval\(\)",
    ),
    "batch normalisation": (
        lambda: Rows(nn.BatchNorm1d(2), nn.Linear(2, 1)),
        rf"policy.layers.0 \(BatchNorm1d\) {AGAIN}.*\.eval\(\)",
    ),
    "mean over the batch": (lambda: Centred(2, 1).double(), "depends on the other realisations"),
}
PLANT = LinearQuadratic(horizon=1.0)


@pytest.mark.parametrize("kind", POLICIES)
@pytest.mark.parametrize("engine", ENGINES)
def test_a_policy_that_is_no_function_is_refused(engine, kind):
    make, message = POLICIES[kind]
    twin = DigitalTwin(PLANT, PLANT.make_closure(torch.Generator()), engine=engine)
    for batch in (1, 3) if kind != "mean over the batch" else (3,):
        policy = make()
        for ask in (twin.cost, twin.control):
            with pytest.raises(ImpureError, match=message):
                ask(policy, *drawn(PLANT, batch))


@pytest.mark.parametrize("by_steps", [False, True])
@pytest.mark.parametrize("kind", ["recurrent", "dropout"])
def test_it_does_not_fly_the_simulated_plant_either(kind, by_steps):
    make, message = POLICIES[kind]
    env = PlantEnv(PLANT, seed=0)
    actor = LivePolicy(PLANT, make(), ExplorationConfig(), generator=torch.Generator().manual_seed(0))
    collector = EpisodeCollector(env, actor, PLANT) if by_steps else collector_of(env, actor, PLANT)
    with pytest.raises(ImpureError, match=message):
        collector.rollout()


@pytest.mark.parametrize("kind", ["dropout", "batch normalisation"])
@pytest.mark.parametrize("engine", ["native", "autograd"])
def test_a_policy_in_evaluation_flies_until_it_trains_again(engine, kind):
    make, message = POLICIES[kind]
    policy = make().eval()
    fly = Rollout(PLANT, PLANT.closure, policy, engine=engine)
    exact = Rollout(PLANT, PLANT.closure, policy, engine="autograd")
    torch.testing.assert_close(fly(*drawn(PLANT, 3)).states, exact(*drawn(PLANT, 3)).states)
    policy.train()
    with pytest.raises(ImpureError, match=message):
        fly(*drawn(PLANT, 3))


class Noisy(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) * (1.0 + torch.rand(()))


class Shaken(LinearQuadratic):
    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action, exogenous, closure) + 0.1 * torch.randn_like(state)


@pytest.mark.parametrize("engine", ["native", "autograd"])
def test_a_plant_or_cost_that_is_no_function_is_refused(engine):
    message = f"a method of plant 'linear_quadratic' {AGAIN}"
    shaken, noisy = Shaken(horizon=1.0), Noisy(horizon=1.0)
    with pytest.raises(ImpureError, match=message):
        Rollout(shaken, shaken.closure, engine=engine)(*drawn(PLANT, 3), torch.zeros(3, 10, 1).double())
    with pytest.raises(ImpureError, match=message):
        Rollout(noisy, noisy.closure, noisy.make_policy(torch.Generator()), engine=engine).costs(*drawn(PLANT, 3))
