"""What is said of a twin with hypotheses is said of the likeliest one: simulations, results, exports and prices."""

import dataclasses

import pytest
import torch
from c_build import library, needs_compiler
from linear_quadratic import LinearClosure, LinearQuadratic
from seeds_and_numbers import drawn, stepped
from small_runs import SMALL, small_run
from test_export_recipe import recipe
from test_hypotheses import Suspecting, ensemble

from rt_torchrl import BiasedSensor, DigitalTwin, RunConfig, configuration, control_cost, export_twin, load_run
from rt_torchrl.control.predictive_control import PredictiveConfig, PredictiveControl
from rt_torchrl.export.c_file import c_array
from rt_torchrl.plants.actuators import LaggedActuator
from rt_torchrl.runs.results import results_table
from rt_torchrl.steps.config import HypothesesConfig
from rt_torchrl.steps.hypotheses.ensemble import ALONE

LAG = 0.35


@configuration
class Config(RunConfig):
    """A system whose actuator lags, and a twin that suspects lag and dead time."""

    def plant(self):
        return LaggedActuator(Suspecting(horizon=4.0), "force", LAG)

    def believed(self):
        return Suspecting(horizon=4.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A training of one episode, in which the right hypothesis takes over."""
    folder = tmp_path_factory.mktemp("believed")
    assimilation = dataclasses.replace(SMALL.assimilation, method="levenberg_marquardt", inputs="record")
    hypotheses = HypothesesConfig(call=0.0, which=("lags",))
    twinning = dataclasses.replace(SMALL, hypotheses=hypotheses, assimilation=assimilation)
    small_run(folder, 1, Config().plant(), config=Config, twinning=twinning).train()
    return load_run(folder, Config)


def test_the_twin_that_is_flown_is_the_likeliest_hypothesis(run):
    believed, policy = run.twin.believed, run.policy(run.live)
    assert run.twin.hypothesis == "lags" and believed.plant.states != run.physics.states
    start, z = torch.tensor([0.5, -0.2]).double(), torch.full((40, 1), 0.3, dtype=torch.float64)
    flown = run.simulate(policy, z, start, on="twin")
    rest = believed.plant.at_rest(start)
    act = lambda k, t, s, w: policy(believed.plant.observe(t, s, w))  # noqa: E731
    expected, *_ = stepped(believed.plant, believed.closure, rest, z, act)
    torch.testing.assert_close(flown.states, expected, rtol=1e-9, atol=1e-9)
    assert torch.equal(run.simulate(policy, z, expected[0], on="twin").states, flown.states)
    batch = start.expand(1, 2), z[None]
    simulated = run.simulate(policy, batch[1], batch[0], on="twin")
    torch.testing.assert_close(control_cost(believed.plant, simulated).mean(), run.twin.cost(policy, *batch).detach())
    alone = DigitalTwin(run.physics, run.closure).control(policy, *batch).states[0]
    assert (alone - flown.states[:, :2]).abs().max() > 1e-3


def test_the_summary_is_that_of_the_likeliest_and_names_it(run):
    summary, last, believed = run.metrics["summary"], run.metrics["episodes"][-1], run.twin.believed
    law = believed.closure.base
    assert summary["believed"] == "lags" and run.twin.believed_law is law
    assert not torch.equal(law.matrix, run.closure.matrix)
    found = torch.tensor(list(summary["closure"]["found"].values()), dtype=torch.float64)
    torch.testing.assert_close(found.reshape(2, 2), law.matrix.detach())
    # The real system is the hypothesis, which replays what it has not seen; the twin alone cannot.
    unseen_J_p = summary["unseen"]["J_p"]["mean"]
    flown = run.simulate(run.policy(run.live), seed=5)
    misfits = {}
    for name, twin in (("lags", believed), (ALONE, DigitalTwin(run.physics, run.closure))):
        start = twin.plant.at_rest(flown.states[0, :2])
        states, *_ = stepped(twin.plant, twin.closure, start, flown.exogenous, lambda k, t, s, w: flown.actions[k])
        misfits[name] = twin.plant.dt * run.physics.discrepancy(states[1:, :2], flown.states[1:, :2]).sum().item()
    assert misfits["lags"] < 0.1 * misfits[ALONE] and unseen_J_p < 0.1 * misfits[ALONE]
    # So has its RMS error, which is told in units.
    rms = {key.removeprefix("rms/"): last[key] for key in last if key.startswith("rms/")}
    assert summary["twin"] == {"segment": 0, "rms": rms} | summary["twin"] and rms
    table = results_table(run.metrics)
    assert "beside the twin: lags" in table and "; J_p and closure weights are its own" in table


@needs_compiler
def test_the_recipe_exports_the_likeliest_and_says_so(run, tmp_path, capsys, monkeypatch):
    export = recipe("export")
    monkeypatch.setattr(export.rt, "load_run", lambda folder, given: load_run(folder, Config))
    export.main(export.Config(run=run.folder, what=("twin",), output=tmp_path, name="it"))
    assert "the twin with lags, which explains the records best" in capsys.readouterr().out


@needs_compiler
def test_unread_states_are_started_in_c(tmp_path):
    """An actuator at rest stands at zero; a sensor's bias shows from the first interval on."""
    plant = BiasedSensor(LaggedActuator(LinearQuadratic(), "force", LAG), "position", 0.5, scale=1.0)
    closure = plant.extended(LinearClosure([[0.05, 0.0], [-0.4, 0.2]]))
    assert export_twin(closure, tmp_path / "it.c", plant, name="it") < 1e-9
    assert "void it_rest(const double *read, double *state);" in (tmp_path / "it.h").read_text()
    states = c_array([0.7, -0.4, 9.0, 9.0])
    library(tmp_path / "it.c").it_rest(states, states)
    assert list(states) == pytest.approx([0.7, -0.4, 0.0, 0.5], abs=1e-12)
    export_twin(LinearClosure([[0.0, 0.0], [0.0, 0.0]]), tmp_path / "plain.c", LinearQuadratic(), name="plain")
    assert "_rest" not in (tmp_path / "plain.h").read_text()


def test_state_feedback_is_priced_on_the_twins_that_policies_are_priced_on():
    """The price is the weighted sum of flights under each hypothesis; test_hypotheses.py has that of a policy."""
    plant = Suspecting(horizon=1.0)
    twin, _ = ensemble(plant)
    twin.weights = {ALONE: 0.25, "late": 0.75}
    start, z = drawn(plant, 2)
    controller = PredictiveControl(plant, twin.closure, PredictiveConfig(horizon=0.5, forecast="held"))
    alone, late = (
        control_cost(one.plant, controller.fly(one.plant.at_rest(start), z, one.closure, plant=one.plant))
        for one in (twin.twins[ALONE], twin.twins["late"])
    )
    assert not torch.allclose(alone, late)
    torch.testing.assert_close(twin.episode_costs(controller, start, z), 0.25 * alone + 0.75 * late)
