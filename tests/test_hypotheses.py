"""Several twins side by side: what each finds, how they are weighed, and what is planned on them."""

import copy
import dataclasses
import math

import pytest
import torch
from c_build import library, needs_compiler
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic, Slewing, discretised
from seeds_and_numbers import double, drawn, stepped
from small_runs import SMALL, small_run
from test_export_recipe import recipe

import rt_torchrl as rt
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.export.c_file import c_array
from rt_torchrl.plants.closures import named_weights
from rt_torchrl.runs.results import twin_entries
from rt_torchrl.runs.table import results_table
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.steps.hypotheses.assimilation import (
    LEAST,
    EnsembleAssimilation,
    Fit,
    Reread,
    evidence,
    misfit,
    reread,
)
from rt_torchrl.steps.hypotheses.ensemble import ALONE, TwinEnsemble, make_twin
from rt_torchrl.trajectories.trajectory import batch_of

LAG = 0.6
ASSIMILATION = rt.AssimilationConfig(iterations=8, method="levenberg_marquardt", inputs="record")


class Suspecting(LinearQuadratic):
    def suspects(self):
        return {"late": rt.DelayedActuator(self, "force", 0.2), "lags": rt.LaggedActuator(self, "force", 0.2)}


def recorded(plant, steps=100):
    """A record of a plant under random commands, which hold for some intervals, as its sensors read it."""
    generator = torch.Generator().manual_seed(5)
    state = plant.draw_initial_state(1, generator)
    exogenous = torch.zeros(1, steps, 1, dtype=torch.float64)
    held = 4.0 * torch.rand(1, steps // 10, 1, generator=generator, dtype=torch.float64) - 2.0
    flown = rt.Rollout(plant, plant.closure)(state, exogenous, held.repeat_interleave(10, 1))
    read = flown.states[0, :, : len(plant.readings)]
    return rt.Trajectory(read, flown.actions[0], exogenous[0]), flown.states[0]


def ensemble(plant, call=0.0, *, always=False, **options):
    closure = LinearClosure([[0.0, 0.0], [0.0, 0.0]])
    config = rt.HypothesesConfig(call=call, **options)
    twin = make_twin(plant, closure, config)
    return twin, EnsembleAssimilation(twin, ASSIMILATION, config, always=always)


def fitted(real, plant, **options):
    twin, assimilation = ensemble(plant, **options)
    record, _ = recorded(real)
    assimilation.update([record])
    return twin, assimilation


PLANT = Suspecting(horizon=10.0)


def test_hypotheses_with_a_scheme_of_their_own_have_gradients_beside_the_continuous_adjoint():
    """The engine odeint_adjoint cannot follow their schemes; that of the twin alone errs by the order of the step."""
    plant, policy = Suspecting(horizon=2.0), LinearGain([[0.3, 0.4]])
    scenario = drawn(plant, 2, 2)
    gradients = {}
    for engine in ("native", "odeint_adjoint"):
        closure = LinearClosure([[0.0, 0.0], [-0.2, 0.1]])
        twin = make_twin(plant, closure, rt.HypothesesConfig(), engine=engine)
        for name in twin.twins:
            twin.weights = {name: 1.0}
            gradients[engine, name] = torch.autograd.grad(twin.cost(policy, *scenario), policy.gain)[0]
    for name, tolerance in {ALONE: 1e-3, "late": 1e-12, "lags": 1e-12}.items():
        torch.testing.assert_close(gradients["odeint_adjoint", name], gradients["native", name], rtol=tolerance, atol=0)


def test_hidden_states_follow_from_what_was_read():
    real = rt.LaggedActuator(PLANT, "force", LAG)
    record, states = recorded(real)
    twin = rt.DigitalTwin(real, real.closure)
    torch.testing.assert_close(twin.followed(record), states, rtol=1e-12, atol=1e-12)
    wild = record._replace(exogenous=record.exogenous + 1e308, actions=record.actions * 1e308)
    with pytest.raises(rt.DivergenceError, match="is not finite"):
        twin.followed(wild)
    assert misfit(twin, [wild], 5) == float("inf") > misfit(twin, [record], 5)  # which costs a hypothesis its weight


@pytest.mark.parametrize("lag", [None, 0.25])
def test_recorded_actions_act_as_they_are_on_what_is_behind_the_actuators(lag):
    """A log whose force jumps is replayed without the rate limit, which commands pass; a lag follows the jumps."""
    A, B, _, _ = discretised()
    base = Slewing()
    plant = base if lag is None else rt.LaggedActuator(base, "force", lag)
    forces, s, x = [1.5] * 10 + [-2.0] * 10, double(0.4, -0.1).numpy(), 0.0
    states = [[*s, 0.0, *([] if lag is None else [x])]]
    for a in forces:
        off, decay = x - a, 0.0 if lag is None else math.exp(-base.dt / lag)
        mean = a if lag is None else a + off * (1.0 - decay) * lag / base.dt
        s, x = A @ s + B[:, 0] * mean, a + off * decay
        states.append([*s, a, *([] if lag is None else [x])])
    expected, actions = double(*states), double(*forces)[:, None]
    record = rt.Trajectory(expected[:, :3], actions, torch.zeros(20, 1).double())
    twin, again = rt.DigitalTwin(plant, plant.closure), reread(record, plant, 20)
    start, given = expected[None, 0], (record.exogenous[None], record.actions[None])
    flown = twin.replay(start, *given)
    assert torch.equal(flown.actions[0], actions)
    limited = rt.Rollout(plant, plant.closure)(start, *given)
    assert limited.actions[0, :2, 0].tolist() == pytest.approx([0.1, 0.2])
    found = [
        flown.states[0],
        torch.cat([start, twin.sensitivities(start, *given)[0][0]]),
        twin.followed(record),
        twin.of(Reread(plant)).replay(start, again.exogenous[None], again.actions[None]).states[0],
    ]
    for states in found:  # one Runge-Kutta step in an interval
        torch.testing.assert_close(states, expected, rtol=0, atol=1e-5)


def test_a_plant_is_read_again_where_a_segment_begins_and_keeps_its_hidden_states():
    """The oracle replays every segment from readings and hidden states, which the same closure gives."""
    real = rt.LaggedActuator(PLANT, "force", LAG)
    record, _ = recorded(real)
    twin = rt.DigitalTwin(real, rt.ExtendedClosure(LinearClosure([[0.0, 0.0], [0.0, 0.0]]), real.closure.own))
    reading, again = twin.of(Reread(real)), reread(record, real, 20)
    flown = reading.replay(again.states[None, 0], again.exogenous[None], again.actions[None]).states[0]
    for first in range(0, 100, 20):
        start = torch.cat([record.states[first], flown[first, 2:]])[None]
        part = twin.replay(start, record.exogenous[None, first : first + 20], record.actions[None, first : first + 20])
        torch.testing.assert_close(flown[first + 1 : first + 21], part.states[0, 1:], rtol=1e-12, atol=1e-12)
    # A lag of the actuator does not depend on what is read.
    torch.testing.assert_close(flown[:, 2], twin.followed(record)[:, 2], rtol=1e-12, atol=1e-12)


def test_the_hypothesis_that_is_right_finds_its_parameter_and_takes_over():
    twin, assimilation = fitted(rt.LaggedActuator(PLANT, "force", LAG), PLANT)
    assert twin.weights == {"lags": 1.0} and twin.likeliest == "lags"
    assert twin.twins["lags"].closure.named_coefficients()["force_lag"].item() == pytest.approx(LAG, rel=1e-3)
    torch.testing.assert_close(twin.twins["lags"].closure.base.matrix, PLANT.closure.matrix, rtol=0.0, atol=2e-3)
    report = assimilation.report()
    assert report["hypothesis/lags"] == 1.0 and report["misfit/lags"] < 1e-3 * report[f"misfit/{ALONE}"]
    assert twin.hypothesis == "lags"


def whole_cost(twin, record):
    """J_p of a whole record, summed here over its samples."""
    start = twin.plant.at_rest(record.states[:1])
    flown = rt.Rollout(twin.plant, twin.closure)(start, record.exogenous[None], record.actions[None])
    read = flown.states[0, 1:, : record.states.shape[-1]]
    return (PLANT.dt * PLANT.discrepancy(read, record.states[1:])).sum().item()


def test_an_episode_reports_the_twin_that_is_believed():
    """J_p before is that of the closure that was believed before the fit, on the record that it has not seen."""
    real = rt.LaggedActuator(PLANT, "force", LAG)
    (record, _), shorter = recorded(real), recorded(real, steps=50)[0]
    twin, assimilation = ensemble(PLANT)
    found = assimilation.update([shorter])
    first, lagged = assimilation.report(), twin.twins["lags"]
    assert first["believed"] == "lags" and "J_p_before" not in first  # which is that of the twin alone
    assert first["J_p"] == pytest.approx(whole_cost(lagged, shorter)) and first["J_p"] < 1e-3 * found.best
    with torch.no_grad():
        for weight in lagged.closure.own.parameters():
            weight.add_(0.5)
    expected = whole_cost(lagged, record)
    alone = assimilation.update([record])
    second = assimilation.report()
    assert second["J_p_before"] == pytest.approx(expected) and expected != pytest.approx(alone.start, rel=0.1)
    assert second["J_p"] == pytest.approx(whole_cost(lagged, record)) and second["J_p"] < 1e-3 * expected
    entries = twin_entries(twin)
    assert entries["believed"] == "lags" and entries["closure"] == named_weights(lagged.closure.base)
    assert entries["closure"] != named_weights(twin.closure)


def test_hidden_states_go_on_through_the_segments_of_an_unstable_twin():
    """The hypothesis that is right replays any segments exactly, in a training, its figures and on unseen episodes."""
    real = rt.LaggedActuator(PLANT, "force", LAG)
    (record, states), twin = recorded(real), rt.DigitalTwin(real, real.closure)
    fit, unseen = Fit(twin, ASSIMILATION, 2), UnseenEpisodes(real, 2)
    for fit.whole.length in (0, 7, 25):
        assert fit.cost([record]) < 1e-20 and max(fit.whole.rms_errors(fit.rested([record])).values()) < 1e-10
        torch.testing.assert_close(twin.replayed(record, fit.whole.length), record.states)
        flown = batch_of([record._replace(states=states)])
        assert unseen.identification_costs(real, real.closure, flown, fit.whole.length).item() < 1e-20
    assert fit.cost([record.part(0, 7, PLANT.dt)]) < 1e-20  # of an episode that ended before a segment does


def test_a_biased_sensor_is_at_rest_by_what_was_found():
    """The twin's first interval costs what the real system's does, although the suspect began without a bias."""
    real, suspect = (rt.BiasedSensor(PLANT, "position", bias, scale=0.1) for bias in (0.3, 0.0))
    twin = TwinEnsemble(PLANT, PLANT.closure, {"bias": suspect}, {"bias": copy.deepcopy(real.closure)})
    twin.weights, (states, inputs) = {"bias": 1.0}, drawn(real, 3)
    policy = LinearGain([[1.0, 0.5]])
    expected = rt.control_cost(real, rt.Rollout(real, real.closure, policy)(states, inputs))
    torch.testing.assert_close(twin.episode_costs(policy, states[:, :2], inputs), expected)


@pytest.mark.parametrize("begin", [lambda record: record, lambda record: record._replace(start=0.0)])
def test_hidden_states_need_not_be_at_rest_where_a_record_does_not_begin_an_episode(begin):
    """A part of an episode, or a window of a continuous operation, whose clock begins anew: half of it counts."""
    real = rt.LaggedActuator(PLANT, "force", LAG)
    record = begin(recorded(real)[0].part(20, 100, PLANT.dt))
    lagged, wrong = real.closure, copy.deepcopy(real.closure)
    twin = rt.DigitalTwin(real, wrong)
    fit = Fit(twin, ASSIMILATION, 5)
    with torch.no_grad():
        wrong.base.matrix.mul_(0.5)
    fit.update([record])
    torch.testing.assert_close(wrong.base.matrix, lagged.base.matrix, rtol=0.01, atol=2e-3)
    assert fit.cost([record]) < 1e-6


def test_the_cost_is_the_weighted_mean_and_its_gradient_too():
    twin, _ = ensemble(PLANT)
    twin.weights = {ALONE: 0.25, "late": 0.75}
    policy, episodes = LinearGain([[1.0, 1.0]]), drawn(PLANT, 4)
    parts = [twin.twins[name] for name in (ALONE, "late")]
    alone, late = (one.cost(policy, one.plant.at_rest(episodes[0]), episodes[1]) for one in parts)
    found, mean = twin.cost(policy, *episodes), 0.25 * alone + 0.75 * late
    torch.testing.assert_close(found, mean)
    torch.testing.assert_close(*(torch.autograd.grad(cost, policy.gain)[0] for cost in (found, mean)))


def kept(misfits):
    return {name for name, share in evidence(misfits).items() if share >= LEAST}


def test_weights_ask_for_evidence():
    shares = evidence({ALONE: 1.0, "lags": 0.95})
    assert shares == {ALONE: 1.0, "lags": pytest.approx(0.01 / 0.95**6)}
    assert kept({ALONE: 1.0, "lags": 0.7}) == {ALONE}
    assert kept({ALONE: 1.0, "lags": 0.65}) == {ALONE, "lags"}
    assert kept({ALONE: 1.0, "lags": 0.1, "late": 0.11, "both": 1.0}) == {"lags", "late"}
    assert kept({ALONE: float("inf"), "lags": float("inf")}) == {ALONE}
    assert kept({ALONE: 0.0, "lags": 0.0}) == {ALONE}
    assert kept({ALONE: 1.0, "lags": float("inf")}) == {ALONE}


def test_hypotheses_wait_until_a_real_episode_costs_other_than_the_twin_says(monkeypatch):
    twin, assimilation = ensemble(PLANT, call=0.05)
    lagging, _ = recorded(rt.LaggedActuator(PLANT, "force", LAG))
    assimilation.update([lagging])
    assert not assimilation.explain(0.04)
    weights = {name: share for name, share in assimilation.report().items() if not name.startswith("rms/")}
    assert twin.weights == {ALONE: 1.0} and weights == {f"hypothesis/{n}": n == ALONE for n in twin.twins}
    assert assimilation.explain(0.06) and twin.weights == {"lags": 1.0}
    # The one that explains the records stays, and is fitted to each new one.
    assert not assimilation.explain(0.0) and assimilation.called
    twin.weights = {ALONE: 1.0}
    assert not assimilation.explain(0.0) and not assimilation.called


@pytest.mark.parametrize("always", [False, True])
def test_the_twin_alone_rests_where_it_explains_nothing(monkeypatch, always):
    """But for state feedback, which plans on it, and where a hypothesis fails and it is planned on again."""
    twin, assimilation = ensemble(PLANT, always=always)
    (record, _), fitted_in, own = recorded(PLANT), [], Assimilation.update

    def update(self, *arguments):
        fitted_in.append(done)
        return own(self, *arguments)

    monkeypatch.setattr(Assimilation, "update", update)
    for fit in assimilation.fits.values():
        monkeypatch.setattr(fit, "update", lambda *_: 1.0)
    replayed = "rt_torchrl.steps.hypotheses.assimilation.misfit"
    monkeypatch.setattr(replayed, lambda one, *_, **__: 100.0 if one is twin.twins[ALONE] else 1.0)
    for done in range(14):
        if done == 13:
            twin.retreat()
        found = assimilation.update([record])
        rested = done not in fitted_in
        assert math.isnan(found.gradient) == rested and math.isfinite(found.best)
        assert not rested or found.best == pytest.approx(assimilation.cost_of(batch_of([record])))
    assert fitted_in == (list(range(14)) if always else [0, 2, 5, 10, 13])


def test_hypotheses_are_chosen_by_name():
    twin, _ = ensemble(PLANT, which=("late",))
    assert list(twin.twins) == [ALONE, "late"]
    assert type(make_twin(PLANT, PLANT.closure, rt.HypothesesConfig(which=("none",)))) is rt.DigitalTwin
    assert type(make_twin(LinearQuadratic(), PLANT.closure, rt.HypothesesConfig())) is rt.DigitalTwin


# What is said of a twin with hypotheses is said of the likeliest one: simulations, results, exports and prices.


SHORT_LAG = 0.35


@rt.configuration
class Config(rt.RunConfig):
    """A system whose actuator lags, and a twin that suspects lag and dead time."""

    def plant(self):
        return rt.LaggedActuator(Suspecting(horizon=4.0), "force", SHORT_LAG)

    def believed(self):
        return Suspecting(horizon=4.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A training of one episode, in which the right hypothesis takes over."""
    folder = tmp_path_factory.mktemp("believed")
    assimilation = dataclasses.replace(SMALL.assimilation, method="levenberg_marquardt", inputs="record")
    hypotheses = rt.HypothesesConfig(call=0.0, which=("lags",))
    twinning = dataclasses.replace(SMALL, hypotheses=hypotheses, assimilation=assimilation)
    small_run(folder, 1, Config().plant(), config=Config, twinning=twinning).train()
    return rt.load_run(folder, Config)


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
    cost = run.twin.cost(policy, *batch).detach()
    torch.testing.assert_close(rt.control_cost(believed.plant, simulated).mean(), cost)
    alone = rt.DigitalTwin(run.physics, run.closure).control(policy, *batch).states[0]
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
    for name, twin in (("lags", believed), (ALONE, rt.DigitalTwin(run.physics, run.closure))):
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
    export, load_run = recipe("export"), rt.load_run
    monkeypatch.setattr(export.rt, "load_run", lambda folder, given: load_run(folder, Config))
    export.main(export.Config(run=run.folder, what=("twin",), output=tmp_path, name="it"))
    assert "the twin with lags, which explains the records best" in capsys.readouterr().out


@needs_compiler
def test_unread_states_are_started_in_c(tmp_path):
    """An actuator at rest stands at zero; a sensor's bias shows from the first interval on."""
    plant = rt.BiasedSensor(rt.LaggedActuator(LinearQuadratic(), "force", SHORT_LAG), "position", 0.5, scale=1.0)
    closure = plant.extended(LinearClosure([[0.05, 0.0], [-0.4, 0.2]]))
    assert rt.export_twin(closure, tmp_path / "it.c", plant, name="it") < 1e-9
    assert "void it_rest(const double *read, double *state);" in (tmp_path / "it.h").read_text()
    states = c_array([0.7, -0.4, 9.0, 9.0])
    library(tmp_path / "it.c").it_rest(states, states)
    assert list(states) == pytest.approx([0.7, -0.4, 0.0, 0.5], abs=1e-12)
    rt.export_twin(LinearClosure([[0.0, 0.0], [0.0, 0.0]]), tmp_path / "plain.c", LinearQuadratic(), name="plain")
    assert "_rest" not in (tmp_path / "plain.h").read_text()


def test_state_feedback_is_priced_on_the_twins_that_policies_are_priced_on():
    """The price is the weighted sum of flights under each hypothesis; test_hypotheses.py has that of a policy."""
    plant = Suspecting(horizon=1.0)
    twin, _ = ensemble(plant)
    twin.weights = {ALONE: 0.25, "late": 0.75}
    start, z = drawn(plant, 2)
    controller = rt.PredictiveControl(plant, twin.closure, rt.PredictiveConfig(horizon=0.5, forecast="held"))
    alone, late = (
        rt.control_cost(one.plant, controller.fly(one.plant.at_rest(start), z, one.closure, plant=one.plant))
        for one in (twin.twins[ALONE], twin.twins["late"])
    )
    assert not torch.allclose(alone, late)
    torch.testing.assert_close(twin.episode_costs(controller, start, z), 0.25 * alone + 0.75 * late)


def test_the_state_is_kept():
    """What goes on from it makes the same of the next record, in as many rounds."""
    twin, assimilation = ensemble(PLANT, call=0.05)
    record, _ = recorded(rt.LaggedActuator(PLANT, "force", LAG))
    assimilation.update([record])
    assert assimilation.explain(0.06)
    other, resumed = ensemble(PLANT, call=0.05)
    other.load_hypotheses(twin.state_dict()["hypotheses"])
    other.closure.load_state_dict(twin.closure.state_dict())
    resumed.load_state_dict(assimilation.state_dict())
    # The hopeless one waits; the other one is fitted, and in fewer rounds than the first time.
    assert resumed.called and resumed.turns["late"].waiting == 1 and resumed.fits["lags"].least < 1e-6
    for one in (assimilation, resumed):
        one.update([record])
    assert other.weights == twin.weights == {"lags": 1.0} and resumed.misfits == assimilation.misfits
    assert resumed.turns == assimilation.turns and resumed.turns["late"].waiting == 0
    for name, one in twin.twins.items():
        for mine, its in zip(other.twins[name].closure.parameters(), one.closure.parameters(), strict=True):
            assert torch.equal(mine, its)
