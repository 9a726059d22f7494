"""Episodes and figures of a finished run, without a training."""

import dataclasses

import pytest
import torch
from test_documentation import leave_finished_run

from rt_torchrl import load_run
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return load_run(leave_finished_run(tmp_path_factory.mktemp("what_if") / "run"))


def test_an_episode_is_that_of_the_plant_stepped_by_hand(run):
    wind = torch.linspace(9.0, 13.0, 40, dtype=torch.float64)[:, None]
    policy = run.policy("model_based")
    for system, plant, closure in (("real", run.plant, run.plant.closure), ("twin", run.physics, run.closure)):
        flown = run.simulate(policy, wind, on=system, seed=3)
        state = flown.states[0]
        with torch.no_grad():
            for k in range(40):
                t = torch.tensor(k * plant.dt, dtype=torch.float64)
                step = plant.step(t, state, policy(plant.observe(t, state, wind[k])), wind[k], closure)
                torch.testing.assert_close(flown.states[k + 1], step.state, rtol=1e-9, atol=1e-9)
                state = step.state


def test_what_is_left_out_is_drawn_and_the_same_seed_is_the_same_episode(run):
    policy = run.policy(run.live)
    one, two, three = (run.simulate(policy, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one.states, two.states) and not torch.equal(one.exogenous, three.exogenous)
    start = torch.stack([one.states[0], three.states[0]])
    both = run.simulate(policy, torch.stack([one.exogenous, three.exogenous]), start)
    torch.testing.assert_close(both.states, torch.stack([one.states, three.states]), rtol=1e-9, atol=1e-9)


def test_a_classical_controller_flies_too(run):
    law = JonkmanController(run.plant)
    flown = run.simulate(law, seed=1)
    own = law.fly(flown.states[:1], flown.exogenous[None])
    assert torch.equal(flown.states, own.states[0])


def test_impossible_requests_are_refused(run):
    policy = run.policy("model_based")
    for arguments, message in (
        ({"on": "model"}, "on='model' must be real or twin"),
        ({"exogenous": torch.ones(5, 3)}, "a column for each input"),
        ({"exogenous": torch.ones(5)}, "a row for each control interval"),
        ({"initial_state": torch.ones(2)}, r"initial_state of shape \(2,\) must have the shape \(6,\)"),
        ({"exogenous": torch.ones(2, 5, 1), "initial_state": torch.ones(3, 6)}, "has 2 episodes, others 3"),
    ):
        with pytest.raises(ValueError, match=message):
            run.simulate(policy, **arguments)
    with pytest.raises(ValueError, match="figure 'state' does not exist in this run; choose one of actions"):
        run.figure("state")


def test_figures_show_the_episode_that_is_given(run):
    flown = run.simulate(run.policy("model_based"), torch.full((30, 1), 12.5), seed=5)
    ax = run.figure("states", flown).axes[0]
    drawn = {line.get_label(): line.get_ydata() for line in ax.lines}
    assert drawn["real"] == pytest.approx(flown.states[:, 0].numpy())
    assert {"states", "actions", "learning_curves", "power_and_speed"} <= set(run.figure_names())


def test_the_table_has_a_row_for_each_episode(run):
    assert run.table()["real_cost"].tolist() == pytest.approx([0.1, 0.09])


def test_without_results_the_message_names_the_file(run, tmp_path):
    with pytest.raises(ValueError, match=r"metrics.json cannot be read"):
        dataclasses.replace(run, folder=tmp_path).table()
