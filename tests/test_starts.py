"""A training begins with an earlier run, with a log, or with model predictive control; with its own weights at once."""

import dataclasses
import json

import pytest
import small_runs
import test_early_ends
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from small_runs import SMALL, small_run
from test_classical import PD
from test_export_recipe import recipe
from test_hypotheses import ASSIMILATION as NEWTON
from test_hypotheses import LAG, Suspecting

import rt_torchrl as rt
from rt_torchrl.steps.start import RecordedFlights, transitions_of
from rt_torchrl.steps.switch import clones
from rt_torchrl.trajectories.trajectory import between_ends

pytestmark = pytest.mark.training

recorded = recipe("record_log").recorded

GAINS = (0.6, 0.5)
TWINNING = dataclasses.replace(
    SMALL,
    assimilation=rt.AssimilationConfig(iterations=20, inputs="record", method="lbfgs"),
    planner=rt.PlannerConfig(receding_horizon=rt.PredictiveConfig(horizon=1.0)),
)


class Config(rt.RunConfig):
    """The oracle plant."""

    def plant(self):
        return LinearQuadratic(horizon=2.0, noise=0.1)

    def make_closure(self, plant, generator):
        return LinearClosure(torch.zeros(1, 2, 2)) if self.closure == "mlp" else super().make_closure(plant, generator)


def training(folder, plant=None, episodes=2, twinning=TWINNING, **options):
    options = {"unseen": 2, "twinning": twinning} | options
    return small_run(folder, episodes, plant or Config().plant(), config=Config, parts={"first": PD}, **options)


@pytest.fixture(scope="module")
def earlier(tmp_path_factory):
    folder = tmp_path_factory.mktemp("earlier") / "run"
    training(folder, start="controller").train()
    return folder


def live_of(folder):
    return json.loads((folder / "metrics.json").read_text())["summary"]["live"]


def test_weights_of_a_run_are_taken_as_they_are(earlier, tmp_path):
    run, known = training(tmp_path, start=str(earlier)), rt.load_run(earlier)
    found = run.algorithm
    assert not len(found.start()) and found.referee.live == live_of(earlier)
    assert all(clones(policy, known.policy(role)) for role, policy in found.policies.items())
    assert torch.equal(found.twin.closure.matrix, known.closure.matrix) and not found.short_term


def test_another_kind_of_policy_imitates_the_one_that_was_live(earlier, tmp_path):
    run, known = training(tmp_path, start=str(earlier), policy="mlp", hidden=(4,)), rt.load_run(earlier)
    found, teacher = run.algorithm, known.policy(live_of(earlier))
    report = found.start()
    assert report["start_cost"] > 0.0 and report["start_error_model_free"] < 0.1
    seen = found.short_term[0]
    torch.testing.assert_close(seen.actions, teacher(seen.states[:-1]).clamp(-2.0, 2.0).detach())
    assert all(isinstance(policy, rt.SaturatedMLP) for policy in found.policies.values())


def test_a_half_that_was_not_trained_begins_as_the_other(tmp_path):
    arm = dataclasses.replace(TWINNING, arm="model_free")
    training(tmp_path / "half", start="controller", twinning=arm).train()
    found = training(tmp_path / "whole", start=str(tmp_path / "half")).algorithm
    found.start()
    assert clones(found.policies["model_based"], rt.load_run(tmp_path / "half").policy("model_free"))


@pytest.fixture(scope="module")
def believing(tmp_path_factory):
    """A run that believes a lag of the force, and options of runs that begin with it."""
    folder, known = tmp_path_factory.mktemp("believing") / "run", Suspecting(horizon=4.0)
    config = rt.HypothesesConfig(call=0.0, which=("lags",))
    twinning = dataclasses.replace(SMALL, arm="model_based", assimilation=NEWTON, hypotheses=config)
    options = {"episodes": 1, "unseen": 2, "figures": False, "twinning": twinning}
    rt.Run(small_runs.believing(known)(log_dir=folder, **options), rt.LaggedActuator(known, "force", LAG)).train()
    return folder, options | {"start": str(folder)}


def test_hypotheses_of_a_run_go_on(believing, tmp_path):
    folder, options = believing
    found = rt.Run(rt.RunConfig(log_dir=tmp_path, **options), Suspecting(horizon=4.0)).algorithm
    its, ours = rt.load_run(folder, rt.RunConfig, plant=Suspecting(horizon=4.0)).twin, found.twin
    assert its.hypothesis == ours.hypothesis == "lags" and found.assimilation.called
    (its, ours) = (twin.twins["lags"].closure.state_dict() for twin in (its, ours))
    assert all(torch.equal(weight, its[name]) for name, weight in ours.items())


def test_what_a_run_believes_must_be_among_the_hypotheses_of_the_next_one(believing, tmp_path):
    options = believing[1] | {"log_dir": tmp_path}
    which = [dataclasses.replace(SMALL, hypotheses=rt.HypothesesConfig(which=(name,))) for name in ("late", "none")]
    late, alone = (rt.RunConfig(**options | {"twinning": twinning}) for twinning in which)
    with pytest.raises(ValueError, match=r"believes 'lags', but hypotheses 'lags' .*which of that run, or none"):
        rt.Run(late, Suspecting(horizon=4.0))
    assert not isinstance(rt.Run(alone, Suspecting(horizon=4.0)).algorithm.twin, rt.TwinEnsemble)


class Cubic(LinearClosure):
    """Another law with weights of the same shapes."""

    def forward(self, features):
        return super().forward(features**3)


def test_a_run_that_does_not_fit_is_refused_before_any_work(earlier, tmp_path):
    speed = (*LinearQuadratic.observations[:1], rt.Signal(symbol="v", name="speed", unit="-"))
    for changed, options, message in (
        ({"name": "other"}, {}, "whose plant is linear_quadratic; here it is other"),
        ({"observations": speed}, {}, "whose observation is .*velocity_error"),
        ({}, {"closure": "mlp"}, r"whose closure does not fit that of this run"),
        ({"make_closure": lambda self, generator: Cubic(self.true_closure)}, {}, "is LinearClosure; here it is Cubic"),
    ):
        plant = type("Other", (LinearQuadratic,), changed)(horizon=2.0, noise=0.1)
        with pytest.raises(ValueError, match=message):
            training(tmp_path / "new", plant, start=str(earlier), **options)
        assert not (tmp_path / "new").exists()


def log_of(path, horizon, gap=False):
    plant = LinearQuadratic(horizon=horizon, noise=0.1)
    log = recorded(plant, PD(plant, GAINS).act, torch.Generator().manual_seed(1))
    keep = abs(log.times - 0.5 * horizon) > 0.25 if gap else log.times >= 0.0
    log.chosen(keep).write(path)
    return log


@pytest.mark.parametrize(("horizon", "gap"), [(8.0, False), (1.5, False), (3.0, True)])
def test_a_log_teaches_twin_and_policies(tmp_path, horizon, gap):
    path = tmp_path / "log.csv"
    log_of(path, horizon, gap)
    run = training(tmp_path / "run", start=str(path))
    found, before = run.algorithm, torch.dist(run.initial_closure.matrix, run.algorithm.twin.plant.closure.matrix)
    report, whole = found.start(), horizon > 2.0 and not gap
    for policy in found.policies.values():
        torch.testing.assert_close(policy.gain.detach(), torch.tensor([GAINS]).double(), rtol=0.02, atol=0.02)
    assert torch.dist(found.twin.closure.matrix, found.twin.plant.closure.matrix) < 0.5 * before
    assert "start_cost" not in report and found.referee.live == "model_based"  # nobody has paid for it
    assert (len(found.virtual.processes), not found.short_term) == ((4, False) if whole else (0, True))
    assert len(found.learner.observations()) == {8.0: 80, 1.5: 15, 3.0: 24}[horizon]


def test_a_run_from_a_log_is_resumed_without_the_log(tmp_path):
    path = tmp_path / "log.csv"
    log_of(path, 4.0)
    options = {"start": str(path)}
    first = training(tmp_path / "run", episodes=1, **options).train()["episodes"]
    path.unlink()
    both = training(tmp_path / "run", episodes=2, resume=True, **options).train()["episodes"]
    assert "start_error_model_free" in first[0] and "start_error_model_free" not in both[1] and len(both) == 2
    assert rt.load_run(tmp_path / "run").config.start == str(path)


class Falling(LinearQuadratic):
    """It falls to the side where it starts: a PD law of small gains does not hold it, and hardly any force does."""

    A = ((0.0, 1.0), (1.0, 0.0))

    def draw_initial_state(self, batch, generator):
        return 0.2 * super().draw_initial_state(batch, generator).abs()


def test_model_predictive_control_flies_first(tmp_path):
    """Within the actions' ranges, where it is a linear law, which a gain imitates."""
    plant = Falling(horizon=2.0, noise=0.0)
    report, controlled = (training(tmp_path / s, plant, start=s).algorithm.start() for s in ("mpc", "controller"))
    assert report["start_cost"] < 0.9 * controlled["start_cost"] and report["start_error_model_free"] < 0.02
    assert report["start_cost_ratio_model_free"] < 1.02


def test_a_log_is_cut_where_an_episode_of_it_has_ended():
    """What lies on the ground is no flight; what comes after it is another one."""
    plant = test_early_ends.Falling()
    places = [0.2, 0.6, 1.2, 1.3, 0.4, 0.5, 0.3, 1.1]
    states = torch.tensor([[place, 0.0] for place in places], dtype=torch.float64)
    log = rt.Trajectory(states, torch.zeros(7, 1).double(), torch.zeros(7, 1).double(), 5.0)
    first, second = between_ends(plant, log)
    assert first.states[:, 0].tolist() == places[:3] and second.states[:, 0].tolist() == places[4:]
    assert [part.start for part in (first, second)] == [5.0, 5.0 + 4 * plant.dt]
    assert not between_ends(plant, log._replace(states=states + 2.0))


class Ending(LinearQuadratic):
    def terminal_cost(self, state):
        return 0.5 * state[..., 0] ** 2


@pytest.mark.parametrize("plant", [Ending(horizon=2.0), test_early_ends.Falling()])
def test_transitions_of_a_record_are_those_of_a_flight(plant):
    """Its end, at the horizon or early, is that of an episode; a part of it has no such end."""
    env = rt.PlantEnv(plant, seed=0)
    episode = env.rollout(plant.n_steps)[0]
    states = torch.cat([episode["state"], episode["next", "state"][-1:]])
    record = rt.Trajectory(states, episode["next", "applied"], episode["exogenous"])
    found = transitions_of(plant, record)
    assert (len(episode) < plant.n_steps) == bool(episode["next", "terminated"].any()) == (plant.end_cost is not None)
    ends = [("next", key) for key in ("observation", "reward", "done", "terminated", "truncated")]
    for key in ("observation", *ends):
        torch.testing.assert_close(found[key], episode[key], rtol=1e-13, atol=1e-13)
    (flight,) = RecordedFlights(plant, [record]).flights(None)
    rest = (plant.n_steps - len(episode)) * (plant.end_cost or 0.0)
    assert flight.cost.item() == pytest.approx((rest - episode["next", "reward"].sum().item()) / plant.n_steps)
    part, rewards = transitions_of(plant, record.part(0, 10, plant.dt)), episode["next", "reward"][:10]
    torch.testing.assert_close(part["next", "reward"], rewards, rtol=1e-13, atol=1e-13)
