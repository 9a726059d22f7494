"""The plants in JAX, with which the benchmark compares the engines, are those of the library."""

import numpy as np
import pytest
import torch
from benchmarking.case import Case, scenario_of, system_of

from rt_torchrl import Rollout, control_cost

STEPS, REALISATIONS = 60, 3


@pytest.mark.parametrize("policy", ["affine", pytest.param("mlp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("closure", ["law", pytest.param("mlp", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "plant",
    ["wind_turbine", *(pytest.param(other, marks=pytest.mark.slow) for other in ("flapping_wing", "cryogenic_tank"))],
)
def test_jax_and_torch_agree(plant, closure, policy):
    pytest.importorskip("jax", reason="the plants in JAX need the extra bench")
    from benchmarking.jax_loops import JaxLoops

    system = system_of(Case(plant, closure, policy))
    scenario = scenario_of(system.case, STEPS, REALISATIONS)
    trajectory = Rollout(system.plant, system.closure, system.policy, engine="autograd")(*scenario)
    cost = control_cost(system.plant, trajectory).mean()
    expected = dict(
        zip(
            (name for name, _ in system.policy.named_parameters()),
            torch.autograd.grad(cost, system.weights()),
            strict=True,
        )
    )
    states = trajectory.states[:, 1:].detach().permute(1, 2, 0).numpy()
    size = np.abs(states).max((0, 2), keepdims=True)  # of each state
    whole = torch.cat([part.flatten() for part in expected.values()]).norm().item()
    assert whole > 0.0
    for method in ("scan", "sweep"):
        loops = JaxLoops(system, method)
        inputs = loops.inputs(scenario)
        if method == "scan":
            found_cost, ends = loops.forward(inputs)
            assert (np.abs(np.asarray(ends) - states) / size).max() < 1e-9
            assert float(found_cost) == pytest.approx(cost.item(), rel=1e-9)
        also_cost, gradient = loops.gradient(inputs)
        assert float(also_cost) == pytest.approx(cost.item(), rel=1e-9)
        assert set(gradient) == set(expected)
        gap = [np.asarray(gradient[name]).ravel() - part.flatten().numpy() for name, part in expected.items()]
        assert np.linalg.norm(np.concatenate(gap)) < 1e-9 * whole
