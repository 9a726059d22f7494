"""How often, and under whom, a run flies a real system: in its episodes, and afterwards only where that is asked for.

The real system is the oracle plant behind a foreign interface, which counts its flights and keeps their costs itself.
"""

import dataclasses
import json
import signal

import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from small_runs import SMALL, small_run
from test_classical import PD
from test_real_system import Rig, connected
from torch.nn.utils import parameters_to_vector

from rt_torchrl.evaluation.real_episodes import RealEpisodes
from rt_torchrl.evaluation.unseen import RealController, TwinEpisodes
from rt_torchrl.plants.actuators import LaggedActuator
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.hypotheses.ensemble import TwinEnsemble

STEPS = 20


class Machine(Rig):
    """A rig that counts its resets, and keeps the actions of every flight and what the plant says that it costs."""

    def __init__(self, plant, **options):
        super().__init__(plant, **options)
        self.resets, self.flights, self.costs = 0, [], []

    def _reset(self, tensordict=None, **kwargs):
        self.resets += 1
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict):
        if self.count == 0:
            self.flights.append([])
            self.costs.append(0.0)
        s, z, plant = self.found["state"], self.found["exogenous"], self.inner.plant
        seen, told = self.found["observation"], super()._step(tensordict)
        t = torch.full((1,), (self.count - 1) * plant.dt).double()
        self.costs[-1] += plant.running_cost(t, s, self.found["applied"], z).item() / STEPS
        if self.count == STEPS:
            self.costs[-1] += plant.terminal_cost(self.found["state"]).item() / (STEPS * plant.dt)
        self.flights[-1].append((seen, self.found["applied"]))
        return told


def run_on(
    machine, folder, *, closure=None, baselines=None, first=None, callbacks=(), twinning=SMALL, untrained=2, **options
):
    own = {"compiled": False, "episodes": 2, "unseen": 3, "figures": False, "untrained": untrained}
    config = RunConfig(log_dir=folder, twinning=twinning, **own, **options)
    plant = machine.inner.plant
    given = {"baselines": baselines, "first": first, "callbacks": callbacks}
    return Run(config, plant, env=connected(plant, rig=machine, closure=closure), **given)


def machine():
    return Machine(LinearQuadratic(horizon=2.0))


def test_a_training_flies_its_episodes_and_nothing_else(tmp_path, capsys):
    """Neither the policies, trained or not, nor random ones, are judged on a system that is not ours unasked."""
    rig = machine()
    metrics = run_on(rig, tmp_path, unseen_every=1).train()
    assert (rig.resets, len(rig.flights)) == (2, 2)
    summary = metrics["summary"]
    assert "real_unseen" not in summary and summary["unseen"]["judged_on"] == "twin"
    paid = summary["cost_of_learning"]
    assert paid["episodes"] == 2 and paid["sum"] == pytest.approx(sum(rig.costs), rel=1e-9)
    said = capsys.readouterr().out
    assert "judged on 3 unseen ones on the twin" in said and "flights on the real system" not in said


def test_costs_on_the_twin_are_called_so_in_every_cell(tmp_path, capsys):
    """A J_p on episodes that only the twin has flown would be zero; there is none."""
    rig = machine()
    run = run_on(rig, tmp_path)
    unseen = run.train()["summary"]["unseen"]
    rows = [line for line in capsys.readouterr().out.splitlines() if line.lstrip().startswith("J_a ")]
    assert len(rows) == 2 and all("on the twin" in row for row in rows)
    assert unseen["J_p"]["mean"] is None and unseen["J_p_before"]["mean"] is None
    # The same flights in a loop of our own, under the law that the twin has found.
    twin, policy, plant = run.algorithm.twin, run.algorithm.policies["model_based"], rig.inner.plant
    s, costs = run.unseen.initial_state, 0.0
    for k in range(STEPS):
        t, z = torch.tensor(k * plant.dt), run.unseen.exogenous[:, k]
        a = plant.actuate(s, policy(plant.observe(t, s, z)))
        costs = costs + plant.running_cost(t, s, a, z) / STEPS
        s = plant.step(t, s, a, z, twin.closure).state
    costs = costs + plant.terminal_cost(s) / (STEPS * plant.dt)
    assert unseen["costs"]["model_based"] == pytest.approx(costs.tolist(), rel=1e-9)


class Asked(RealController):
    """A controller that is flown on the machine of the test."""

    rig = None

    def fly_real(self, count, *, seed):
        return RealEpisodes(connected(self.plant, rig=type(self).rig), count).fly(LinearGain([[-0.5, -0.5]]))


def test_flights_that_are_asked_for_are_announced_and_paid(tmp_path, capsys):
    rig = machine()
    Asked.rig = rig
    run = run_on(rig, tmp_path, real_unseen=2, start="controller", first=PD, baselines={"cascade": Asked})
    metrics = run.train()
    # The controller's episode, two episodes, and then the live policy, the first controller and the cascade.
    assert len(rig.flights) == 3 + 2 * 3
    summary, said = metrics["summary"], capsys.readouterr().out
    live = summary["live"]
    words = live.replace("_", "-")
    assert f"6 flights on the real system: 2 of the live policy ({words}), 2 of PD, 2 of cascade" in said
    paid = summary["cost_of_learning"]
    assert paid["episodes"] == 9 and paid["sum"] == pytest.approx(sum(rig.costs), rel=1e-9)
    assert paid["largest"] == pytest.approx(max(rig.costs), rel=1e-9)
    costs = summary["real_unseen"]["costs"]
    assert [*costs] == [live, "PD", "cascade"]
    assert [cost for each in costs.values() for cost in each] == pytest.approx(rig.costs[3:], rel=1e-9)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    policy = run.algorithm.policies[live]
    for observation, applied in rig.flights[3] + rig.flights[4]:
        torch.testing.assert_close(applied, policy(observation).detach(), rtol=1e-9, atol=1e-12)


def test_a_controller_that_only_the_real_system_can_fly_asks_for_flights(tmp_path):
    rig = machine()
    with pytest.raises(ValueError, match=r"baselines \['cascade'\] .* on the real system, .* real_unseen"):
        run_on(rig, tmp_path, baselines={"cascade": Asked})
    assert not rig.flights


def test_a_policy_that_was_never_trained_does_not_fly_when_flights_are_asked_for(tmp_path, capsys):
    """The model-free arm acts; without iterations its weights are still the random ones."""
    learner = dataclasses.replace(SMALL.learner, critic_iterations=0, actor_iterations=0)
    rig = machine()
    run = run_on(rig, tmp_path, real_unseen=2, twinning=dataclasses.replace(SMALL, arm="model_free", learner=learner))
    metrics = run.train()
    live = metrics["summary"]["live"]
    weights = [parameters_to_vector(each[live].parameters()) for each in (run.initial_policies, run.algorithm.policies)]
    assert torch.equal(*weights)
    assert len(rig.flights) == 2 and "real_unseen" not in metrics["summary"]
    assert "random initial weights" in capsys.readouterr().out


def test_what_was_paid_for_judging_stays_paid_when_a_run_goes_on(tmp_path):
    rig = machine()
    run_on(rig, tmp_path, real_unseen=2).train()
    paid = run_on(rig, tmp_path, resume=True).train()["summary"]["cost_of_learning"]
    assert len(rig.flights) == 2 + 2 == paid["episodes"]
    assert paid["sum"] == pytest.approx(sum(rig.costs), rel=1e-9)


def test_flights_on_a_system_that_is_none_are_refused(tmp_path):
    with pytest.raises(ValueError, match="real_unseen=2 .* needs a real system"):
        small_run(tmp_path, real_unseen=2)
    with pytest.raises(ValueError, match="real_unseen=1 must be 0, or at least 2"):
        RunConfig(real_unseen=1)


def test_after_an_interrupt_nothing_flies(tmp_path):
    """Who has pressed Ctrl-C may have done so because of what the system did."""
    rig = machine()
    Asked.rig = rig
    pressed = [lambda episodes: signal.raise_signal(signal.SIGINT)]
    metrics = run_on(rig, tmp_path, real_unseen=2, baselines={"cascade": Asked}, callbacks=pressed).train()
    assert len(metrics["episodes"]) == 1 == len(rig.flights) and "real_unseen" not in metrics["summary"]


def test_a_system_with_a_known_closure_is_simulated_and_the_table_says_so(tmp_path, capsys):
    """As the served turbine: a real system, of which the recipe knows the true closure."""
    rig = machine()
    unseen = run_on(rig, tmp_path, closure=rig.inner.plant.closure).train()["summary"]["unseen"]
    assert len(rig.flights) == 2 and unseen["judged_on"] == "simulation of the real system"
    assert unseen["J_p"]["mean"] is not None
    assert "in simulation, with the closure that the real system was given" in capsys.readouterr().out


def test_a_flight_in_which_the_twin_diverges_costs_no_number_and_the_others_do():
    plant = LinearQuadratic(horizon=2.0)
    episodes = TwinEpisodes(DigitalTwin(plant, LinearClosure(1e6 * torch.eye(2))), plant, 3)
    episodes.initial_state[1], episodes.exogenous[1] = 0.0, 0.0
    policy = LinearGain([[0.5, 0.5]])
    costs = episodes.control_costs(policy)
    assert costs.isfinite().tolist() == [False, True, False] and costs[1] == 0.0
    assert torch.equal(episodes.judge(episodes.fly(policy)).control_costs.isfinite(), costs.isfinite())


def test_flights_are_those_of_the_hypothesis_that_is_believed():
    plant, lagged = LinearQuadratic(horizon=2.0), LaggedActuator(LinearQuadratic(horizon=2.0), "force", 0.4)
    laws = LinearClosure(plant.true_closure), lagged.closure
    twin = TwinEnsemble(plant, laws[0], {"lag": lagged}, {"lag": laws[1]})
    policy, episodes = LinearGain([[0.5, 0.5]]), TwinEpisodes(twin, plant, 3)
    for weights, physics in ({"as the twin": 1.0}, plant), ({"lag": 1.0}, lagged):
        twin.weights = weights
        s, expected = physics.at_rest(episodes.initial_state), 0.0
        for k in range(STEPS):
            t, z = torch.tensor(k * plant.dt), episodes.exogenous[:, k]
            command = policy(physics.observe(t, s, z))
            expected = expected + physics.running_cost(t, s, physics.actuate(s, command), z) / STEPS
            s = physics.step(t, s, command, z, physics.closure).state
        torch.testing.assert_close(episodes.control_costs(policy), expected.detach(), rtol=1e-9, atol=0.0)
