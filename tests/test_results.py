"""The results in numbers: values that JSON cannot write, and the choice of the better policy."""

import dataclasses
import json
from unittest.mock import Mock

import torch
from linear_quadratic import LinearGain, LinearQuadratic
from small_runs import SMALL, small_run

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.atomic_file import finite
from rt_torchrl.evaluation.real_episodes import RealEpisodes
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.runs import results
from rt_torchrl.runs.results_table import results_table
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.steps.imitation import of_each_role
from rt_torchrl.systems.real_system import RealSystem


def refused(name):
    raise AssertionError(f"{name} is not JSON")


def test_metrics_are_json_where_nothing_was_iterated(tmp_path, capsys):
    nothing = {part: dataclasses.replace(getattr(SMALL, part), iterations=0) for part in ("assimilation", "planner")}
    twinning = dataclasses.replace(SMALL, **nothing)
    options = {"compiled": False, "unseen": 3, "figures": False, "untrained": 0, "episodes": 1}
    metrics = Run(RunConfig(log_dir=tmp_path, twinning=twinning, **options), LinearQuadratic(horizon=2.0)).train()
    assert json.loads((tmp_path / "metrics.json").read_text(), parse_constant=refused) == metrics
    assert metrics["episodes"][0]["J_p"] is None and metrics["episodes"][0]["real_cost"] > 0.0
    assert "J_a model-based" in capsys.readouterr().out


def test_infinite_costs_are_dashes_in_the_table(tmp_path):
    metrics = small_run(tmp_path, episodes=1, figures=False).train()
    unseen = metrics["summary"]["unseen"]
    unseen["J_a_model_free"] = {"mean": float("inf"), "confidence_interval": [1.0, float("inf")]}
    metrics["summary"]["J_a_ratio_model_free"] = float("inf")
    row = next(line for line in results_table(finite(metrics)).splitlines() if "J_a model-free" in line)
    assert row.split()[-4:] == ["-", "[1,", "-]", "-"]


def judged(seed):
    """Two unseen episodes, whose mean costs depend on the draw."""
    return UnseenEpisodes(LinearQuadratic(horizon=1.0, noise=0.5), 2, seed=seed)


def test_the_better_policy_is_chosen_on_other_episodes_than_it_is_reported_on():
    policies = {"model_based": LinearGain([[0.0, 0.5]]), "model_free": LinearGain([[0.8, 0.5]])}
    algorithm = Mock(spec=ReinforcementTwinning, policies=policies)
    differs = 0
    for seed in range(4):
        unseen = judged(seed)
        other = unseen.validation()
        assert not torch.equal(other.initial_state, unseen.initial_state) and len(other.initial_state) == 2
        # Chosen alike for every seed of the unseen episodes, which play no part in it.
        assert results.better_of(algorithm, unseen) == (cheapest(policies, judged(2_000_000)), "validation episodes")
        differs += cheapest(policies, unseen) != cheapest(policies, other)
    assert differs > 0


def cheapest(policies, episodes):
    """Without the library's rollout: the plant's step in a loop."""
    plant, costs = episodes.plant, {}
    for role, policy in policies.items():
        s, total = episodes.initial_state, 0.0
        for k in range(plant.n_steps):
            t, z = torch.tensor(k * plant.dt), episodes.exogenous[:, k]
            a = plant.actuate(s, policy(s))
            total = total + plant.running_cost(t, s, a, z).mean()
            s = plant.step(t, s, a, z, plant.closure).state
        costs[role] = total
    return min(costs, key=costs.get)


def test_validation_follows_the_wear_of_the_system():
    unseen = judged(0)
    unseen.closure = torch.nn.Identity()
    assert unseen.validation().closure is unseen.closure


def test_on_a_real_system_the_better_policy_is_the_live_one():
    referee = Mock(spec=["live"], live="model_free")
    system = Mock(spec=RealSystem, plant=LinearQuadratic(horizon=2.0))
    algorithm = Mock(spec=ReinforcementTwinning, referee=referee)
    assert results.better_of(algorithm, RealEpisodes(system, 2)) == ("model_free", "twin")
    system.rollout.assert_not_called()


def test_clones_are_flown_once_and_other_policies_each():
    """Policies that start with the same weights, or that end as clones, share their flights, with the same numbers."""
    first, second, other = LinearGain([-0.8, -1.1]), LinearGain([-0.8, -1.1]), LinearGain([-0.8, -1.2])
    unseen, flown = UnseenEpisodes(LinearQuadratic(horizon=2.0), 3), []

    def costs(policy):
        flown.append(policy)
        return unseen.control_costs(policy)

    shared = of_each_role({"model_based": first, "model_free": second}, costs)
    assert flown == [first] and torch.equal(shared["model_free"], unseen.control_costs(second))
    flown.clear()
    each = of_each_role({"model_based": first, "model_free": other}, costs)
    assert flown == [first, other] and torch.equal(each["model_free"], unseen.control_costs(other))
    assert not torch.equal(each["model_free"], each["model_based"])
