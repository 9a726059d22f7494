"""The digital twin: the weights that vary when it replays and when a policy is planned on it."""

import copy

import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from torch import nn

from rt_torchrl import shipped_plants
from rt_torchrl.contract.methods import random_commands
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.steps.config import AssimilationConfig
from rt_torchrl.trajectories import twin as twin_module
from rt_torchrl.trajectories.engines import parallel
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import identification_cost
from rt_torchrl.trajectories.twin import DigitalTwin, constant


def twin_and_policy():
    plant = LinearQuadratic(horizon=1.0)
    generator = torch.Generator().manual_seed(0)
    twin = DigitalTwin(plant, LinearClosure(0.1 * torch.randn(2, 2, generator=generator)))
    return (
        twin,
        plant.make_policy(generator),
        (plant.draw_initial_state(3, generator), plant.draw_exogenous(3, generator)),
    )


def test_a_constant_module_follows_the_one_it_was_made_from():
    original = nn.Sequential(nn.Linear(2, 3), nn.BatchNorm1d(3)).double()
    shared, x = constant(original), torch.randn(5, 2, dtype=torch.float64)
    assert not any(w.requires_grad for w in shared.parameters()) and all(w.requires_grad for w in original.parameters())
    # As Levenberg-Marquardt, Adam and a checkpoint move weights: in place. The buffers move with a forward pass.
    original.load_state_dict({key: 2 * value for key, value in original.state_dict().items()})
    original(x)
    shared.eval(), original.eval()
    assert torch.equal(shared(x), original(x))


def test_planning_holds_the_closure_constant_and_changes_no_gradient_of_the_policy():
    twin, policy, episodes = twin_and_policy()
    twin.cost(policy, *episodes).backward()
    planned = [w.grad.clone() for w in policy.parameters()]
    assert all(w.grad is None and w.requires_grad for w in twin.closure.parameters())
    # Independent of the engines: the plant's step in a loop, with a closure of its own that is differentiated too.
    law, (state, exogenous), total = copy.deepcopy(twin.closure), episodes, 0.0
    weights = [*policy.parameters(), *law.parameters()]
    for k in range(twin.plant.n_steps):
        t, z = torch.tensor(k * twin.plant.dt), exogenous[:, k]
        action = policy(state)
        total = total + twin.plant.running_cost(t, state, action, z).mean() / twin.plant.n_steps
        state = twin.plant.step(t, state, action, z, law).state
    expected = torch.autograd.grad(total, weights)
    for found, exact in zip(planned, expected, strict=False):
        torch.testing.assert_close(found, exact)
    assert expected[-1].abs().max() > 0.0


class Scaled(LinearClosure):
    """A closure with a number that is no weight."""

    scale = 1.0

    def forward(self, features):
        return self.scale * super().forward(features)


CHANGES = {
    "an attribute": lambda closure: setattr(closure, "scale", 2.0),
    "another weight": lambda closure: setattr(closure, "matrix", nn.Parameter(2.0 * closure.matrix.detach())),
    "a frozen weight": lambda closure: closure.requires_grad_(False),
    "a hook": lambda closure: closure.register_forward_hook(lambda module, features, found: 2.0 * found),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_twin_is_planned_on_with_the_closure_it_has_now(change):
    twin, policy, episodes = twin_and_policy()
    twin.closure = Scaled(twin.closure.matrix.detach())
    before = twin.cost(policy, *episodes)
    CHANGES[change](twin.closure)
    found = twin.cost(policy, *episodes)
    fresh = DigitalTwin(twin.plant, copy.deepcopy(twin.closure)).cost(policy, *episodes)
    assert torch.equal(found, fresh) and (change == "a frozen weight" or not torch.equal(found, before))


def test_a_policy_in_single_precision_is_refused_also_later():
    twin, policy, episodes = twin_and_policy()
    twin.cost(policy, *episodes)
    with pytest.raises(ValueError, match="torch.float32"):
        twin.cost(policy.float(), *episodes)


def test_each_policy_has_its_own_cost_with_the_weights_and_the_plant_of_now():
    twin, policy, episodes = twin_and_policy()
    other = copy.deepcopy(policy)
    with torch.no_grad():
        next(other.parameters()).add_(0.3)
    costs = [twin.cost(each, *episodes) for each in (policy, other, policy)]
    assert torch.equal(costs[0], costs[2]) and not torch.equal(costs[0], costs[1])
    with torch.no_grad():
        next(twin.closure.parameters()).add_(0.1)
    costs.append(twin.cost(policy, *episodes))
    twin.plant = LinearQuadratic(dt=0.5 * twin.plant.dt)
    costs.append(twin.cost(policy, *episodes))
    assert costs[4] == DigitalTwin(twin.plant, twin.closure).cost(policy, *episodes)
    assert len({cost.item() for cost in costs}) == 4


# Forward sensitivities and Levenberg-Marquardt against backpropagation and known minima


def recorded(plant, batch=3, seed=0):
    """A true trajectory under random commands, and a twin that starts from the wrong closure."""
    generator = torch.Generator().manual_seed(seed)
    command = random_commands(plant, (batch, plant.n_steps), generator)
    exogenous = plant.draw_exogenous(batch, generator)
    start = plant.draw_initial_state(batch, generator)
    with torch.no_grad():
        flown = Rollout(plant, plant.closure)(start, exogenous, command)
    return DigitalTwin(plant, plant.make_closure(generator)), flown, exogenous


@pytest.mark.parametrize("piece", [parallel.PIECE, 7], ids=["at once", "in pieces"])
@pytest.mark.parametrize("plant", [LinearQuadratic(), WindTurbine(horizon=30.0)], ids=lambda plant: plant.name)
def test_gradient_and_states_are_those_of_backpropagation(plant, piece, monkeypatch):
    monkeypatch.setattr(parallel, "PIECE", piece)  # no divisor of the intervals: the last piece overlaps
    twin, flown, exogenous = recorded(plant)
    found = Assimilation(twin, AssimilationConfig()).likelihood(flown).normal_equations()
    rollout = Rollout(plant, twin.closure, engine="autograd")
    cost = identification_cost(plant, rollout(flown.states[:, 0], exogenous, flown.actions), flown.states).mean()
    gradient = torch.cat([g.flatten() for g in torch.autograd.grad(cost, list(twin.closure.parameters()))])
    # The same derivatives, forward instead of backward: rounding over at most 60 steps.
    assert found.cost.item() == pytest.approx(cost.item(), rel=1e-12)
    assert ((found.gradient - gradient).norm() / gradient.norm()).item() < 1e-10


@pytest.mark.parametrize("kind", [LinearQuadratic, *shipped_plants().values()], ids=lambda kind: kind.name)
def test_they_are_machine_code_on_every_plant(kind, monkeypatch):
    """Without it an assimilation takes ten times as long. A frozen weight has no column, and may be freed again."""
    plant = kind(horizon=4 * kind().dt)
    twin, flown, exogenous = recorded(plant)
    monkeypatch.setattr(twin_module, "over_all", None)
    closure, given = twin.closure, (flown.states[:, 0], exogenous, flown.actions)
    _, whole = twin.sensitivities(*given)
    first = next(closure.parameters())
    first.requires_grad_(False)
    if any(w.requires_grad for w in closure.parameters()):
        torch.testing.assert_close(twin.sensitivities(*given)[1], whole[..., first.numel() :])
    first.requires_grad_(True)
    torch.testing.assert_close(twin.sensitivities(*given)[1], whole)


class Stiffness(nn.Module):
    """p = (0, c s_1) with one number c, of no dimension."""

    def __init__(self):
        super().__init__()
        self.c = nn.Parameter(torch.tensor(-0.2, dtype=torch.float64))

    def forward(self, features):
        return torch.stack([torch.zeros_like(features[..., 0]), self.c * features[..., 0]], -1)


@pytest.mark.parametrize("native", [True, False])
def test_a_weight_may_be_a_number_without_a_dimension(native, monkeypatch):
    plant = LinearQuadratic(horizon=1.0)
    twin, flown, exogenous = recorded(plant)
    given = flown.states[:, 0], exogenous, flown.actions
    own = DigitalTwin(plant, Stiffness())
    twin.closure.load_state_dict({"matrix": torch.tensor([[0.0, 0.0], [-0.2, 0.0]]).double()})
    if not native:
        monkeypatch.setattr(own.sensitivities._engine, "own_end_states", lambda *given: None)
    _, whole = twin.sensitivities(*given)  # by the four numbers of the matrix, of which the third is c
    torch.testing.assert_close(own.sensitivities(*given)[1], whole[..., 2:3])


def test_matrix_is_the_hessian_where_the_residual_vanishes():
    """At the true weights the Gauss-Newton matrix is the Hessian of J_p, here by differences of exact gradients."""
    plant = LinearQuadratic(horizon=2.0)
    twin, flown, exogenous = recorded(plant)
    twin.closure.load_state_dict(plant.closure.state_dict())
    assimilation, weight = Assimilation(twin, AssimilationConfig()), twin.closure.matrix
    found = assimilation.likelihood(flown).normal_equations()
    columns, step = [], 1e-5
    for k in range(weight.numel()):
        gradients = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                weight.view(-1)[k] += sign * step
                gradients.append(assimilation.likelihood(flown).normal_equations().gradient)
                weight.view(-1)[k] -= sign * step
        columns.append((gradients[0] - gradients[1]) / (2.0 * step))
    # step² of the central difference and the rounding 1e-16/1e-5, both about 1e-10 of the matrix.
    torch.testing.assert_close(found.matrix, torch.stack(columns, -1), rtol=1e-7, atol=1e-8)


def test_levenberg_marquardt_identifies_the_closure_to_rounding():
    plant = LinearQuadratic(noise=0.0)
    twin, flown, exogenous = recorded(plant)
    assimilation = Assimilation(twin, AssimilationConfig())
    LevenbergMarquardt(twin.closure).run(lambda: assimilation.likelihood(flown).normal_equations(), iterations=15)
    # The record is noise-free and J_p quadratic at its minimum: Newton's convergence ends in rounding.
    torch.testing.assert_close(twin.closure.matrix, plant.closure.matrix, rtol=0, atol=1e-8)


class Valley(torch.nn.Module):
    """Residuals w_1 − 1 and 10 (w_2 − w_1²): Rosenbrock's valley, in which gradient steps hardly move."""

    def __init__(self):
        super().__init__()
        self.w = torch.nn.Parameter(torch.tensor([-1.2, 1.0], dtype=torch.float64))

    def equations(self):
        w1, w2 = self.w.detach()
        residual = torch.stack([w1 - 1.0, 10.0 * (w2 - w1**2)])
        J = torch.stack(
            [torch.stack([torch.ones_like(w1), torch.zeros_like(w1)]), torch.stack([-20.0 * w1, w1 * 0 + 10.0])]
        )
        return NormalEquations(0.5 * residual @ residual, J.T @ residual, J.T @ J)


def test_a_step_never_raises_the_cost_and_the_valley_is_followed():
    valley = Valley()
    optimiser, last = LevenbergMarquardt(valley), float("inf")
    for _ in range(60):
        found = optimiser.run(valley.equations, 1)
        assert found.best <= min(found.start, last)
        last = found.best
    torch.testing.assert_close(valley.w.detach(), torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-6)


def test_a_trial_that_diverges_is_taken_back():
    valley, calls = Valley(), 0

    def equations():
        nonlocal calls
        calls += 1
        if calls > 1:
            raise FloatingPointError
        return valley.equations()

    before = valley.w.detach().clone()
    optimiser = LevenbergMarquardt(valley, damping=1.0)
    optimiser.run(equations, 3)
    assert torch.equal(valley.w.detach(), before)
    assert optimiser.damping == pytest.approx(2.0 * 4.0 * 8.0)


def test_a_cost_that_the_weights_cannot_lower_ends_the_run():
    valley, calls = Valley(), 0
    valley.w.data.fill_(1.0)

    def equations():
        nonlocal calls
        calls += 1
        found = valley.equations()
        # What noise leaves of the cost at its minimum, and a gradient that is rounding beside it.
        return NormalEquations(found.cost + 1.0, found.gradient + 1e-9, found.matrix)

    found = LevenbergMarquardt(valley).run(equations, 15)
    assert (calls, found.iterations, found.best) == (1, 0, 1.0)


def test_no_step_is_longer_than_asked_for():
    valley = Valley()
    optimiser = LevenbergMarquardt(valley, longest_step=0.05)
    for _ in range(20):
        before = valley.w.detach().clone()
        optimiser.run(valley.equations, 1)
        assert (valley.w.detach() - before).abs().max() <= 0.05 + 1e-12


class Parallel(torch.nn.Module):
    """Residuals w_1 + w_2 − 0.5 and 0.01 w_2 − 1: the sum is well known, w_2 alone hardly, and at its best 100."""

    def __init__(self):
        super().__init__()
        self.w = torch.nn.Parameter(torch.zeros(2, dtype=torch.float64))

    def equations(self):
        J = torch.tensor([[1.0, 1.0], [0.0, 0.01]], dtype=torch.float64)
        residual = J @ self.w.detach() - torch.tensor([0.5, 1.0], dtype=torch.float64)
        return NormalEquations(0.5 * residual @ residual, J.T @ residual, J.T @ J)


def test_a_weight_that_is_hardly_known_does_not_hold_up_the_others():
    """The whole step to (−99.5, 100), cut to a length of 1, would leave 99 % of the first residual."""
    parallel = Parallel()
    LevenbergMarquardt(parallel).run(parallel.equations, 1)
    assert (parallel.w.sum() - 0.5).abs() < 0.05
    assert 0.1 < parallel.w.abs().max() <= 1.0
