"""States that no sensor reads and a twin does not know, and policies that observe past observations."""

import math

import numpy as np
import pytest
import test_extensions as extensions
import torch
from c_build import needs_compiler
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from printed_commands import run_code
from seeds_and_numbers import drawn, seeded, stepped
from small_runs import SMALL
from test_classical import PD
from test_export_controller import InC
from test_extensions import flight
from test_real_system import Rig, connected

import rt_torchrl as rt
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.rosco import Answer
from rt_torchrl.evaluation.unseen import UnseenEpisodes, mean_with_confidence
from rt_torchrl.fit.log import SensorLog
from rt_torchrl.fit.resampling import resample
from rt_torchrl.systems.collectors import EpisodeCollector, FlightCollector
from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.systems.real_system import episode_seed

BASE = LinearQuadratic(horizon=2.0)


def real(base=BASE):
    """A slow actuator, and a sensor that is off."""
    return rt.BiasedSensor(rt.ResonantActuator(base, "force", 3.0, 0.4), "position", 0.2, scale=0.1)


class Config(rt.RunConfig):
    """A system whose twin does not know its actuator and its sensor."""

    def plant(self):
        return real(LinearQuadratic(horizon=2.0))

    def believed(self):
        return LinearQuadratic(horizon=2.0)


def test_a_run_judges_on_the_true_system_and_keeps_its_hidden_states_hidden(tmp_path):
    options = {"episodes": 2, "unseen": 3, "twinning": SMALL, "reference": True, "start": "controller"}
    run = rt.Run(Config(log_dir=tmp_path, **options), real(), baselines={"PD": PD}, first=PD)
    found = run.train()["summary"]
    assert run.algorithm.short_term[-1].states.shape[-1] == 2
    assert (tmp_path / "figures" / "states.png").exists()
    policy, unseen = run.algorithm.policies["model_based"], run.unseen
    true = rt.control_cost(real(), rt.Rollout(real(), real().closure, policy)(unseen.initial_state, unseen.exogenous))
    assert found["unseen"]["J_a_model_based"]["mean"] == pytest.approx(true.mean().item(), rel=1e-9)
    flown = PD(BASE).fly(unseen.initial_state, unseen.exogenous, plant=unseen.plant)
    costs = rt.control_cost(unseen.plant, flown).tolist()
    assert found["unseen"]["costs"]["PD"] == pytest.approx(costs, rel=1e-9)
    loaded = rt.load_run(tmp_path, Config)
    assert loaded.physics.states == loaded.plant.readings == BASE.states
    torch.testing.assert_close(loaded.closure.matrix, run.algorithm.twin.closure.matrix)
    rt.export_c(loaded.policy("model_free"), tmp_path / "policy.c", loaded.physics, function="policy")


def test_a_twin_is_judged_by_what_sensors_read():
    unseen = UnseenEpisodes(real(), 3)
    flown = unseen.fly(LinearGain([[0.3, 0.3]]))
    read = flown.states[..., :2]
    rollout = rt.Rollout(BASE, BASE.closure)
    replayed = rollout(read[:, 0], flown.exogenous, flown.actions)
    expected = rt.identification_cost(BASE, replayed, read)
    torch.testing.assert_close(unseen.identification_costs(BASE, BASE.closure, flown), expected)
    costs = []
    for half in (flown.part(0, 10, BASE.dt), flown.part(10, 20, BASE.dt)):
        read = half.states[..., :2]
        costs.append(rt.identification_cost(BASE, rollout(read[:, 0], half.exogenous, half.actions), read))
    found = unseen.identification_costs(BASE, BASE.closure, flown, segment=10)
    torch.testing.assert_close(found, 0.5 * (costs[0] + costs[1]))
    assert unseen.judge(flown).control_costs.tolist() == pytest.approx(rt.control_cost(real(), flown).tolist())


@pytest.mark.parametrize("kind", ["classical", "predictive"])
def test_state_feedback_acts_on_readings(kind):
    plant = real()
    planned = rt.PredictiveControl(BASE, BASE.closure, rt.PredictiveConfig(horizon=0.5))
    controller = PD(BASE) if kind == "classical" else planned
    state, exogenous = drawn(plant, 2, 1)
    flown = controller.fly(state, exogenous, plant=plant)
    assert flown.states.shape == (2, 21, 5)
    controller.begin()
    act = lambda k, t, s, z: controller.act(k * plant.dt, s[:, :2], z)  # noqa: E731
    states, *_ = stepped(plant, plant.closure, state, exogenous, act)
    torch.testing.assert_close(flown.states, states, rtol=1e-5, atol=1e-5)


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


# Policies that observe past observations: by hand, in both engines, with extensions, in C, in runs and from logs.


class Timed(LinearQuadratic):
    """The oracle plant, of which policies observe what depends on time, state and input."""

    def observe(self, t, state, exogenous):
        x, _ = state.unbind(-1)
        return torch.stack([x + torch.sin(3.0 * t), exogenous[..., 0] + 0.0 * x], -1)

    def suspects(self):
        return {"late": rt.DelayedActuator(self, "force", 2 * self.dt), "lag": rt.LaggedActuator(self, "force", 0.3)}


EXTENSIONS = {name: extensions.EXTENSIONS[name] for name in ("lag", "delay", "bias", "residual")}
EXTENSIONS["none"] = lambda base: base


def observed(plant, states, exogenous):
    """The observations in every interval of a flight."""
    n = exogenous.shape[1]
    return plant.observe(plant.dt * torch.arange(n, dtype=torch.float64), states[:, :n], exogenous)


def by_hand(now, count):
    """Present and past observations, from the present ones of a flight."""
    places = torch.arange(now.shape[1])
    return torch.cat([now[:, (places - k).clamp(min=0)] for k in range(count + 1)], -1)


@pytest.mark.parametrize("kind", EXTENSIONS)
def test_observations_are_those_by_hand_in_whatever_order_the_plant_is_extended(kind):
    extend, base, engine = EXTENSIONS[kind], Timed(), "native"
    plain = extend(base)
    start, exogenous, commands = flight(plain, 12, 3)
    flown = rt.Rollout(plain, plain.closure, engine=engine)(start, exogenous, commands)
    expected = by_hand(observed(plain, flown.states, exogenous), 3)
    for plant in (rt.StackedObservations(plain, 3), extend(rt.StackedObservations(base, 3))):
        assert plant.unread == plain.unread and len(plant.observations) == 8
        stacked = plant.draw_initial_state(3, seeded(3))
        found = rt.Rollout(plant, plant.closure, engine=engine)(stacked, exogenous, commands)
        torch.testing.assert_close(observed(plant, found.states, exogenous), expected, rtol=1e-13, atol=1e-13)
        costs = [
            p.running_cost(torch.zeros(1), x.states[:, :-1], commands, exogenous)
            for p, x in ((plain, flown), (plant, found))
        ]
        torch.testing.assert_close(*costs, rtol=1e-13, atol=1e-13)
    suspects = rt.StackedObservations(base, 3).suspects()
    assert suspects.keys() == base.suspects().keys()
    assert all(suspect.observations == plant.observations for suspect in suspects.values())


class Mass(LinearQuadratic):
    """A free mass of which only the position is seen: x_{k+1} = x_k + Δt v_k + ½Δt² a_k, v_{k+1} = v_k + Δt a_k."""

    A, true_closure = ((0.0, 1.0), (0.0, 0.0)), ((0.0, 0.0), (0.0, 0.0))
    observations = LinearQuadratic.observations[:1]

    def observe(self, t, state, exogenous):
        return state[..., :1]


@needs_compiler
def test_the_controller_in_c_holds_the_past_observations(tmp_path):
    plant = rt.StackedObservations(Mass(dt=0.1, horizon=5.0), 2)
    agreement = rt.export_controller(LinearGain([[3.0, -2.0, 0.5]]), tmp_path / "mass.c", plant, name="mass")
    assert agreement < 1e-12
    in_c, positions = InC(tmp_path / "mass.c", 1, 2, 1), [0.3, 0.5, -0.2, 0.1, 0.4]
    in_c.start(positions[0])
    seen = [positions[0]] * 2 + positions
    for k, x in enumerate(positions):
        assert in_c.step(x)[0] == pytest.approx(-3.0 * x + 2.0 * seen[k + 1] - 0.5 * seen[k], rel=1e-14)


def test_past_observations_follow_from_a_log():
    plant = rt.StackedObservations(Timed(), 3)
    start, exogenous, commands = flight(plant, 12)
    states = rt.Rollout(plant, plant.closure)(start, exogenous, commands).states[0].detach()
    log = {signal.name: states[:, k] for k, signal in enumerate(LinearQuadratic.states)}
    found = plant.complete_states(log, exogenous[0], commands[0])
    torch.testing.assert_close(found[1:], states[1:], rtol=1e-14, atol=1e-14)
    assert torch.equal(found[0, 2:], observed(plant, states[None], exogenous[:1])[0, 0, 2:])
    before = plant.observe(torch.tensor(-1.0).double(), states[5], exogenous[0, 5])  # of a log that counts down to zero
    assert torch.equal(before[2:], states[5, 2:])


def test_past_observations_of_a_log_that_begins_later_know_the_time():
    plant, rows = rt.StackedObservations(Timed(), 3), np.linspace(0.0, 1.0, 13)
    signals = (*LinearQuadratic.states, *plant.actions, *plant.inputs)
    log = SensorLog(times=5.0 + plant.dt * np.arange(13), columns={signal.name: rows for signal in signals})
    (segment,) = resample(log, plant).segments
    t = 5.0 + plant.dt * torch.arange(12, dtype=torch.float64)
    seen = plant.base.observe(t, plant.split(segment.states[:-1])[0], segment.exogenous)
    torch.testing.assert_close(plant.split(segment.states)[1][1:, : seen.shape[-1]], seen, rtol=1e-14, atol=1e-14)


def test_a_real_system_that_reports_the_states_of_the_plant_alone():
    """Two episodes are those of the stacked plant itself."""
    base = Timed(horizon=2.0)
    plant = rt.StackedObservations(base, 2)
    policy = LinearGain(0.1 * torch.arange(1.0, 7.0).double()[None])
    system, own = connected(plant, rig=Rig(base), computes=True), rt.PlantEnv(plant)
    for number in range(2):
        found = system.reset()
        own.set_seed(episode_seed(0, number), static_seed=True)
        other, seen = own.reset(), []
        for _ in range(plant.n_steps):
            stepped = [
                env.step(now.set("action", policy(now["observation"]).detach()))
                for env, now in ((system, found), (own, other))
            ]
            seen.append(stepped[0]["observation"])
            for key in ("observation", "state", "action", ("next", "reward"), ("next", "observation")):
                torch.testing.assert_close(*(entries[key] for entries in stepped), rtol=1e-11, atol=1e-11)
            found, other = (env.step_mdp(entries) for env, entries in zip((system, own), stepped, strict=True))
        seen = torch.stack(seen, 1)
        torch.testing.assert_close(seen, by_hand(seen[..., :2], 2), rtol=1e-13, atol=1e-13)
        assert found["done"].all()


@pytest.mark.parametrize("name", ["lag", "delay"])
def test_noise_of_sensors_leaves_what_no_sensor_reads(name):
    plant = EXTENSIONS[name](BASE)
    factor = rt.PlantEnv(plant, noise=0.3, seed=4).sensor_factor()
    assert (factor[:, :2] != 1.0).all() and (factor[:, 2:] == 1.0).all() and factor.shape[1] == len(plant.states)


def test_past_observations_are_what_sensors_read_then():
    """Noise falls on a measurement once: what a policy remembers of it gets no other one."""
    noise = 0.3
    stacked = rt.StackedObservations(Timed(horizon=2.0), 2)
    for plant in (stacked, EXTENSIONS["lag"](stacked)):
        found = rt.PlantEnv(plant, noise=noise, seed=4).rollout(10)
        seen = found["observation"]
        torch.testing.assert_close(seen, by_hand(seen[..., :2], 2), rtol=1e-14, atol=0.0)
        torch.testing.assert_close(found["state"][:, 1:, 2:4], seen[:, :-1, :2], rtol=1e-14, atol=0.0)
        clean = rt.PlantEnv(plant, seed=4).rollout(10)["observation"]
        assert ((seen - clean).abs()[..., :1] > 1e-3).any()
        policy = plant.make_policy(seeded())
        actor = LivePolicy(plant, policy, rt.ExplorationConfig(), generator=seeded(5))
        actor.begin(policy, strength=0.0)
        envs = [rt.PlantEnv(plant, noise=noise, seed=4) for _ in range(2)]
        collectors = FlightCollector(envs[0], actor), EpisodeCollector(envs[1], actor, plant)
        by_machine, by_steps = (collector.rollout()["observation"] for collector in collectors)
        torch.testing.assert_close(by_machine, by_steps, rtol=1e-12, atol=1e-13)
        torch.testing.assert_close(by_machine, by_hand(by_machine[..., :2], 2), rtol=1e-14, atol=0.0)


def test_the_page_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = run_code("observations_and_costs.md")
    assert len(found["run"].algorithm.policies["model_based"](torch.zeros(1, 8).double())[0]) == 2


def test_roscos_simulator_remembers_past_observations():
    plant = rt.StackedObservations(WindTurbine(horizon=4.0), 2)
    start, wind, seen = plant.draw_initial_state(1, seeded())[0], 11.0 + 0.1 * torch.arange(8.0), []

    def decide(state, speed, report):
        seen.append(plant.observe(state.new_tensor(plant.dt * len(seen)), state, state.new_tensor([speed])))
        return plant.actuate(state, state.new_tensor([3e4, 1.0]))

    answer = Answer(plant, start, wind.numpy(), decide, 5)
    for step in range(40):
        answer.call_controller({"rot_speed": 1.0 + 0.002 * step, "ws": 11.0})
    seen = torch.stack(seen)[None]
    torch.testing.assert_close(seen, by_hand(seen[..., :2], 2), rtol=0.0, atol=0.0)
