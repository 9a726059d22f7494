"""Several twins side by side: what each finds, how they are weighed, and what is planned on them."""

import math

import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from seeds_and_numbers import drawn

from rt_torchrl import DigitalTwin, ExtendedClosure
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.actuators import DelayedActuator, LaggedActuator
from rt_torchrl.plants.closures import named_weights
from rt_torchrl.runs.results import twin_entries
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.steps.config import AssimilationConfig, HypothesesConfig
from rt_torchrl.steps.hypotheses.assimilation import (
    LEAST,
    EnsembleAssimilation,
    Fit,
    Reread,
    evidence,
    misfit,
    reread,
)
from rt_torchrl.steps.hypotheses.ensemble import ALONE, make_twin
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of

LAG = 0.6
ASSIMILATION = AssimilationConfig(iterations=8, method="levenberg_marquardt", inputs="record")


class Suspecting(LinearQuadratic):
    def suspects(self):
        return {"late": DelayedActuator(self, "force", 0.2), "lags": LaggedActuator(self, "force", 0.2)}


def recorded(plant, steps=100):
    """A record of a plant under random commands, which hold for some intervals, as its sensors read it."""
    generator = torch.Generator().manual_seed(5)
    state = plant.draw_initial_state(1, generator)
    exogenous = torch.zeros(1, steps, 1, dtype=torch.float64)
    held = 4.0 * torch.rand(1, steps // 10, 1, generator=generator, dtype=torch.float64) - 2.0
    flown = Rollout(plant, plant.closure)(state, exogenous, held.repeat_interleave(10, 1))
    read = flown.states[0, :, : len(plant.readings)]
    return Trajectory(read, flown.actions[0], exogenous[0]), flown.states[0]


def ensemble(plant, call=0.0, *, always=False, **options):
    closure = LinearClosure([[0.0, 0.0], [0.0, 0.0]])
    config = HypothesesConfig(call=call, **options)
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
        twin = make_twin(plant, closure, HypothesesConfig(), engine=engine)
        for name in twin.twins:
            twin.weights = {name: 1.0}
            gradients[engine, name] = torch.autograd.grad(twin.cost(policy, *scenario), policy.gain)[0]
    for name, tolerance in {ALONE: 1e-3, "late": 1e-12, "lags": 1e-12}.items():
        torch.testing.assert_close(gradients["odeint_adjoint", name], gradients["native", name], rtol=tolerance, atol=0)


def test_hidden_states_follow_from_what_was_read():
    real = LaggedActuator(PLANT, "force", LAG)
    record, states = recorded(real)
    twin = DigitalTwin(real, real.closure)
    torch.testing.assert_close(twin.followed(record), states, rtol=1e-12, atol=1e-12)
    wild = record._replace(exogenous=record.exogenous + 1e308, actions=record.actions * 1e308)
    with pytest.raises(DivergenceError, match="is not finite"):
        twin.followed(wild)
    assert misfit(twin, [wild], 5) == float("inf") > misfit(twin, [record], 5)  # which costs a hypothesis its weight


def test_a_plant_is_read_again_where_a_segment_begins_and_keeps_its_hidden_states():
    """The oracle replays every segment from readings and hidden states, which the same closure gives."""
    real = LaggedActuator(PLANT, "force", LAG)
    record, _ = recorded(real)
    twin = DigitalTwin(real, ExtendedClosure(LinearClosure([[0.0, 0.0], [0.0, 0.0]]), real.closure.own))
    reading, again = twin.of(Reread(real)), reread(record, real, 20)
    flown = reading.replay(again.states[None, 0], again.exogenous[None], again.actions[None]).states[0]
    for first in range(0, 100, 20):
        start = torch.cat([record.states[first], flown[first, 2:]])[None]
        part = twin.replay(start, record.exogenous[None, first : first + 20], record.actions[None, first : first + 20])
        torch.testing.assert_close(flown[first + 1 : first + 21], part.states[0, 1:], rtol=1e-12, atol=1e-12)
    # A lag of the actuator does not depend on what is read.
    torch.testing.assert_close(flown[:, 2], twin.followed(record)[:, 2], rtol=1e-12, atol=1e-12)


def test_the_hypothesis_that_is_right_finds_its_parameter_and_takes_over():
    twin, assimilation = fitted(LaggedActuator(PLANT, "force", LAG), PLANT)
    assert twin.weights == {"lags": 1.0} and twin.likeliest == "lags"
    assert twin.twins["lags"].closure.named_coefficients()["force_lag"].item() == pytest.approx(LAG, rel=1e-3)
    torch.testing.assert_close(twin.twins["lags"].closure.base.matrix, PLANT.closure.matrix, rtol=0.0, atol=2e-3)
    report = assimilation.report()
    assert report["hypothesis/lags"] == 1.0 and report["misfit/lags"] < 1e-3 * report[f"misfit/{ALONE}"]
    assert twin.hypothesis == "lags"


def whole_cost(twin, record):
    """J_p of a whole record, summed here over its samples."""
    start = twin.plant.at_rest(record.states[:1])
    flown = Rollout(twin.plant, twin.closure)(start, record.exogenous[None], record.actions[None])
    read = flown.states[0, 1:, : record.states.shape[-1]]
    return (PLANT.dt * PLANT.discrepancy(read, record.states[1:])).sum().item()


def test_an_episode_reports_the_twin_that_is_believed():
    """J_p before is that of the closure that was believed before the fit, on the record that it has not seen."""
    real = LaggedActuator(PLANT, "force", LAG)
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
    real = LaggedActuator(PLANT, "force", LAG)
    (record, states), twin = recorded(real), DigitalTwin(real, real.closure)
    fit, unseen = Fit(twin, ASSIMILATION, 2), UnseenEpisodes(real, 2)
    for fit.whole.length in (0, 7, 25):
        assert fit.cost([record]) < 1e-20 and max(fit.whole.rms_errors(fit.rested([record])).values()) < 1e-10
        torch.testing.assert_close(twin.replayed(record, fit.whole.length), record.states)
        flown = batch_of([record._replace(states=states)])
        assert unseen.identification_costs(real, real.closure, flown, fit.whole.length).item() < 1e-20
    assert fit.cost([record.part(0, 7, PLANT.dt)]) < 1e-20  # of an episode that ended before a segment does


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
    lagging, _ = recorded(LaggedActuator(PLANT, "force", LAG))
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
    monkeypatch.setattr(replayed, lambda one, *_: 100.0 if one is twin.twins[ALONE] else 1.0)
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
    assert type(make_twin(PLANT, PLANT.closure, HypothesesConfig(which=("none",)))) is DigitalTwin
    assert type(make_twin(LinearQuadratic(), PLANT.closure, HypothesesConfig())) is DigitalTwin
