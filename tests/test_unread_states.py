"""States that no sensor reads, and that a twin does not know."""

import math

import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from seeds_and_numbers import seeded
from small_runs import SMALL
from test_classical import PD

from rt_torchrl import (
    BiasedSensor,
    PlantEnv,
    Run,
    RunConfig,
    export_c,
    load_run,
)
from rt_torchrl.control.predictive_control import PredictiveConfig, PredictiveControl
from rt_torchrl.evaluation.optimum import exact_optimum
from rt_torchrl.evaluation.unseen import UnseenEpisodes, mean_with_confidence
from rt_torchrl.plants.actuators import ResonantActuator
from rt_torchrl.systems.collectors import EpisodeCollector, collector_of
from rt_torchrl.systems.config import SafetyConfig
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.systems.real_system import Reading, RealSystem
from rt_torchrl.systems.safety import SafetyLayer
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.trajectory import control_cost, identification_cost

BASE = LinearQuadratic(horizon=2.0)


def real(base=BASE):
    """A slow actuator, and a sensor that is off."""
    return BiasedSensor(ResonantActuator(base, "force", 3.0, 0.4), "position", 0.2, scale=0.1)


class Config(RunConfig):
    """A system whose twin does not know its actuator and its sensor."""

    def plant(self):
        return real(LinearQuadratic(horizon=2.0))

    def believed(self):
        return LinearQuadratic(horizon=2.0)


def small_config(folder, **options):
    return Config(log_dir=folder, unseen=3, twinning=SMALL, **options)


def run_of(config, **options):
    return Run(config, config.plant(), believed=config.believed(), **options)


def test_a_run_judges_on_the_true_system_and_keeps_its_hidden_states_hidden(tmp_path):
    config = small_config(tmp_path, episodes=2, reference=True, start="controller")
    run = run_of(config, baselines={"PD": PD}, first=PD)
    found = run.train()["summary"]
    assert run.algorithm.short_term[-1].states.shape[-1] == 2
    assert (tmp_path / "figures" / "states.png").exists()
    policy, unseen = run.algorithm.policies["model_based"], run.unseen
    true = control_cost(real(), Rollout(real(), real().closure, policy)(unseen.initial_state, unseen.exogenous))
    assert found["unseen"]["J_a_model_based"]["mean"] == pytest.approx(true.mean().item(), rel=1e-9)
    flown = PD(BASE).fly(unseen.initial_state, unseen.exogenous, plant=unseen.plant)
    costs = control_cost(unseen.plant, flown).tolist()
    assert found["unseen"]["costs"]["PD"] == pytest.approx(costs, rel=1e-9)
    loaded = load_run(tmp_path, Config)
    assert loaded.physics.states == loaded.plant.readings == BASE.states
    torch.testing.assert_close(loaded.closure.matrix, run.algorithm.twin.closure.matrix)
    export_c(loaded.policy("model_free"), tmp_path / "policy.c", loaded.physics, function="policy")


def test_the_optimum_is_that_of_the_true_system():
    unseen = UnseenEpisodes(real(), 4)
    start = LinearGain([[0.1, 0.1]])
    found = exact_optimum(unseen, lambda _: LinearGain([[0.1, 0.1]]), starts=1, iterations=20, polish=10)
    nominal = UnseenEpisodes(BASE, 4)
    other = exact_optimum(nominal, lambda _: LinearGain([[0.1, 0.1]]), starts=1, iterations=20, polish=10)
    cost = control_cost(real(), Rollout(real(), real().closure, found.policy)(unseen.initial_state, unseen.exogenous))
    assert found.cost == pytest.approx(cost.mean().item(), rel=1e-9)
    assert found.cost < 0.9 * min(unseen.control_costs(policy).mean() for policy in (other.policy, start))


def test_a_twin_is_judged_by_what_sensors_read():
    unseen = UnseenEpisodes(real(), 3)
    flown = unseen.fly(LinearGain([[0.3, 0.3]]))
    read = flown.states[..., :2]
    rollout = Rollout(BASE, BASE.closure)
    replayed = rollout(read[:, 0], flown.exogenous, flown.actions)
    expected = identification_cost(BASE, replayed, read)
    torch.testing.assert_close(unseen.identification_costs(BASE, BASE.closure, flown), expected)
    halves = [flown.part(first, first + 10, BASE.dt) for first in (0, 10)]
    read = [half.states[..., :2] for half in halves]
    both = [rollout(s[:, 0], half.exogenous, half.actions) for s, half in zip(read, halves, strict=True)]
    costs = [identification_cost(BASE, replayed, s) for replayed, s in zip(both, read, strict=True)]
    found = unseen.identification_costs(BASE, BASE.closure, flown, segment=10)
    torch.testing.assert_close(found, 0.5 * (costs[0] + costs[1]))
    assert unseen.judge(flown).control_costs.tolist() == pytest.approx(control_cost(real(), flown).tolist())


@pytest.mark.parametrize("kind", ["classical", "predictive"])
def test_state_feedback_acts_on_readings(kind):
    plant = real()
    if kind == "classical":
        controller = PD(BASE)
    else:
        controller = PredictiveControl(BASE, BASE.closure, PredictiveConfig(horizon=0.5))
    generators = seeded(1)
    state, exogenous = plant.draw_initial_state(2, generators), plant.draw_exogenous(2, generators)
    flown = controller.fly(state, exogenous, plant=plant)
    assert flown.states.shape == (2, 21, 5)
    controller.begin()
    s = state
    for k in range(plant.n_steps):
        command = controller.act(k * plant.dt, s[:, :2], exogenous[:, k])
        s = plant.step(torch.tensor(k * plant.dt).double(), s, command, exogenous[:, k], plant.closure).state
    torch.testing.assert_close(flown.states[:, -1], s, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("controller", [LinearGain([[0.3, 0.3]]), PD(BASE)], ids=["policy", "PD"])
def test_machine_code_flies_as_steps_do(controller):
    found = []
    for kind in (collector_of, EpisodeCollector):
        env = PlantEnv(real(), seed=3, noise=0.01)
        actor = LivePolicy(BASE, controller, ExplorationConfig(), generator=seeded())
        actor.begin(controller, strength=0.5)
        found.append(kind(env, actor, BASE).rollout())
    for key in ("state", "observation", "action", ("next", "reward")):
        torch.testing.assert_close(found[0][key], found[1][key], rtol=1e-9, atol=1e-9)


def test_a_safety_layer_sees_readings_alone(tmp_path):
    plant = real()
    state, exogenous, applied = (Reading(keys=(name,)) for name in ("state", "exogenous", "applied"))
    limits = SafetyConfig(interval=plant.dt, log=tmp_path / "log.jsonl")
    guarded = SafetyLayer(PlantEnv(plant), limits, fallback=lambda reported: torch.zeros(1, 1, dtype=torch.float64))
    system = RealSystem(guarded, BASE, state=state, exogenous=exogenous, applied=applied)
    policy = LivePolicy(BASE, LinearGain([[0.3, 0.3]]), ExplorationConfig(), generator=seeded())
    policy.begin(policy.policy, strength=0.0)
    episode = EpisodeCollector(system, policy, BASE).rollout()
    system.close()
    start = plant.at_rest(episode["state"][:, 0])
    expected = Rollout(plant, plant.closure)(start, episode["exogenous"], episode["next", "applied"]).states
    torch.testing.assert_close(episode["next", "state"], expected[:, 1:, :2], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: Run(small_config(folder), real()), "all that sensors read; give believed"),
        (
            lambda folder: RealSystem(PlantEnv(BASE), real(), state=Reading(keys=("state",))),
            "no sensor reads resonant_force, rate_of_force, bias_of_position",
        ),
    ],
)
def test_a_twin_that_holds_what_no_sensor_reads_is_refused(make, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        make(tmp_path)


def test_a_twin_that_diverges_on_some_episodes_is_infinitely_wrong_there_alone():
    unseen = UnseenEpisodes(BASE, 3)
    flown = unseen.fly(LinearGain([[0.3, 0.3]]))
    closure = LinearClosure([[0.0, 0.0], [0.0, 0.0]])
    exogenous = flown.exogenous.clone()
    exogenous[1] = 1.7e308  # the sum of the stages of one step overflows
    wild = flown._replace(exogenous=exogenous)
    found = unseen.identification_costs(BASE, closure, wild)
    assert found.isinf().tolist() == [False, True, False]
    assert mean_with_confidence(found) == {"mean": math.inf, "confidence_interval": [math.inf, math.inf]}
    sound = unseen.identification_costs(BASE, closure, flown)
    torch.testing.assert_close(found[[0, 2]], sound[[0, 2]])
