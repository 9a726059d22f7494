"""The gradient check of a run's start."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from small_runs import small_run
from torch import nn

from rt_torchrl.evaluation.gradient_check import engine_gap
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs.dashboard import Dashboard
from rt_torchrl.trajectories.engines.interval import Autograd
from rt_torchrl.trajectories.rollout import ENGINES


class TwoParts(nn.Module):
    """A closure with a part that can be frozen."""

    def __init__(self, plant):
        super().__init__()
        self.held, self.trained = plant.make_closure(torch.Generator()), plant.make_closure(torch.Generator())

    def forward(self, features):
        return 0.5 * (self.held(features) + self.trained(features))


@pytest.mark.parametrize("held", ["held", "held and trained"])
def test_weights_that_are_frozen_are_left_out(held):
    plant = LinearQuadratic()
    closure, policy = TwoParts(plant), plant.make_policy(torch.Generator().manual_seed(0))
    for part in held.split(" and "):
        getattr(closure, part).requires_grad_(False)
    unseen = UnseenEpisodes(plant, 2)
    # Rounding of forty intervals.
    assert engine_gap(plant, closure, policy, unseen) < 1e-13
    # The continuous adjoint differs by the order of its step: 1e-4 for 0.1 s times the 1/120 of the local error.
    assert 0.0 < engine_gap(plant, closure, policy, unseen, "odeint_adjoint") < 1e-5
    policy.requires_grad_(False)
    closure.requires_grad_(False)
    with pytest.raises(ValueError, match="closure TwoParts and policy LinearGain have no weight that is trained"):
        engine_gap(plant, closure, policy, UnseenEpisodes(plant, 2))


class Half(Autograd):
    """An engine whose states are right, and whose gradient is wrong by the half."""

    def end_states(self, *arguments):
        states = super().end_states(*arguments)
        return 0.5 * (states + states.detach())

    def costs(self, *arguments):
        return None


@pytest.mark.parametrize("engine", ["native", "parallel"])
def test_an_engine_whose_gradient_is_another_one_trains_nothing(engine, tmp_path, monkeypatch):
    run = small_run(tmp_path, episodes=1, engine=engine)
    monkeypatch.setitem(ENGINES, engine, Half)
    said = (
        rf"engine='{engine}' gives another gradient of plant 'linear_quadratic' than 'autograd': .* by \d.*e-01 of its"
    )
    with pytest.raises(ValueError, match=said):
        run.train()
    assert not run.episodes


@pytest.mark.parametrize("engine, most", [("native", 1e-13), ("parallel", 1e-13), ("odeint_adjoint", 1e-4)])
def test_the_gap_of_the_engine_that_trains_has_its_name(engine, most, tmp_path, monkeypatch):
    seen, scalar = {}, Dashboard.scalar
    monkeypatch.setattr(
        Dashboard, "scalar", lambda self, tag, value: seen.update({tag: value}) or scalar(self, tag, value)
    )
    run = small_run(tmp_path, episodes=1, engine=engine)
    gap = run.train()["summary"]["engine_gap"]
    assert seen == {f"gradient/relative gap of {engine} to autograd, short horizon": gap} and gap < most


class Frozen(LinearQuadratic):
    """Nothing depends on weights: the cost is of the time alone."""

    def running_cost(self, t, state, applied, exogenous):
        return t + 0.0 * state.sum(-1)


def test_a_gradient_of_zero_is_the_same_for_all_engines():
    plant = Frozen()
    policy = plant.make_policy(torch.Generator().manual_seed(0))
    assert engine_gap(plant, plant.make_closure(torch.Generator()), policy, UnseenEpisodes(plant, 2)) == 0.0
