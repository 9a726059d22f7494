"""The digital twin: the weights that vary when it replays and when a policy is planned on it."""

import copy

import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from torch import nn

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


def test_a_twin_is_planned_on_with_the_weights_it_has_now():
    twin, policy, episodes = twin_and_policy()
    before = twin.cost(policy, *episodes)
    with torch.no_grad():
        for weight in twin.closure.parameters():
            weight.add_(0.1)
    assert twin.cost(policy, *episodes) != before


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


def test_a_twin_is_planned_on_with_the_plant_it_has_now():
    twin, policy, episodes = twin_and_policy()
    before = twin.cost(policy, *episodes)
    twin.plant = LinearQuadratic(dt=0.5 * twin.plant.dt)
    found = twin.cost(policy, *episodes)
    assert torch.equal(found, DigitalTwin(twin.plant, twin.closure).cost(policy, *episodes)) and found != before


def test_a_policy_in_single_precision_is_refused_also_later():
    twin, policy, episodes = twin_and_policy()
    twin.cost(policy, *episodes)
    with pytest.raises(ValueError, match="torch.float32"):
        twin.cost(policy.float(), *episodes)


def test_each_policy_has_its_own_cost():
    twin, policy, episodes = twin_and_policy()
    other = copy.deepcopy(policy)
    with torch.no_grad():
        next(other.parameters()).add_(0.3)
    costs = [twin.cost(each, *episodes) for each in (policy, other, policy)]
    assert torch.equal(costs[0], costs[2]) and not torch.equal(costs[0], costs[1])
