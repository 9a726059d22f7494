"""A simulator that calls its controller, as an environment: its course, its ends, its failures."""

import threading

import numpy as np
import pytest
import scipy.linalg
import torch
from linear_quadratic import LinearQuadratic
from torchrl.envs.utils import check_env_specs

from rt_torchrl.systems.calling_simulator import CallingSimulator
from rt_torchrl.systems.reading import Reading
from rt_torchrl.systems.real_system import RealSystem

PLANT = LinearQuadratic(horizon=2.0)
CALLS: list[str] = []


def oscillator(seed, controller):
    """The linear-quadratic plant as somebody else would simulate it: it owns the loop, and solves it exactly."""
    (_, _), (spring, damping) = LinearQuadratic.true_closure
    augmented = np.zeros((3, 3))
    augmented[:2] = [[0.0, 1.0, 0.0], [-1.0 + spring, -0.3 + damping, 1.0]]
    transition = scipy.linalg.expm(augmented * PLANT.dt)
    state = np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
    try:
        for _ in range(PLANT.n_steps):
            (force,) = controller({"place and rate": state})
            state = (transition @ [*state, force])[:2]
        controller({"place and rate": state})
        CALLS.append("ended")
    except BaseException as error:
        CALLS.append(type(error).__name__)
        raise


def environment(simulate=oscillator, **options):
    return CallingSimulator(simulate, {"place and rate": 2}, PLANT.actions, **options)


def test_it_is_an_environment_of_torchrl():
    env = environment()
    check_env_specs(env, seed=0)
    env.close()


def test_stepping_it_is_what_the_simulator_does_by_itself():
    told = []

    def law(reported):
        told.append(np.array(reported["place and rate"]))
        return np.array([-0.5 * told[-1][0]])

    oscillator(7, law)
    env = environment(seed=7)
    flown = env.rollout(1000, lambda td: td.set("action", -0.5 * td["place and rate"][..., :1]))
    # A call more than there are intervals: at the end, and then the simulator returns.
    assert len(flown) == PLANT.n_steps + 1 and flown["next", "done"][-1] and not flown["next", "done"][:-1].any()
    assert np.array_equal(np.array(told), flown["place and rate"].numpy())


def test_an_episode_that_is_left_ends_the_simulator():
    env, threads = environment(), threading.active_count()
    CALLS.clear()
    for _ in range(3):
        env.rollout(4, lambda td: td.set("action", torch.zeros(1, dtype=torch.float64)))
    env.close()
    assert CALLS == ["EpisodeAbandoned"] * 3 and threading.active_count() == threads


def test_what_fails_in_the_simulator_is_told_where_it_is_stepped():
    def breaks(seed, controller):
        controller({"place and rate": np.zeros(2)})
        raise ZeroDivisionError("blade gone")

    env = environment(breaks)
    start = env.reset()
    with pytest.raises(RuntimeError, match="the simulator failed: ZeroDivisionError: blade gone"):
        env.step(start.set("action", torch.zeros(1, dtype=torch.float64)))
    with pytest.raises(RuntimeError, match="without calling its controller"):
        environment(lambda seed, controller: None).reset()


def within(seconds, call):
    """The error that a call raises, made in a thread because the call may hang."""
    raised = []

    def run():
        try:
            call()
        except Exception as error:
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    assert not thread.is_alive(), "it hangs"
    return raised[0]


def test_a_step_without_an_episode_is_refused():
    """There is no episode before the first reset, after the end and after a failure; a reset begins a new one."""

    def breaks(seed, controller):
        controller({"place and rate": np.zeros(2)})
        raise ZeroDivisionError("blade gone")

    still = lambda td: td.set("action", torch.zeros(1, dtype=torch.float64))  # noqa: E731
    env = environment()
    before = within(5.0, lambda: env.step(still(env.fake_tensordict().exclude("next"))))
    ended = env.rollout(1000, still)[-1]
    after = within(5.0, lambda: env.step(still(ended.exclude("next"))))
    assert len(env.rollout(1000, still)) == PLANT.n_steps + 1
    broken = environment(breaks)
    start = still(broken.reset())
    with pytest.raises(RuntimeError, match="blade gone"):
        broken.step(start)
    failed = within(5.0, lambda: broken.step(start))
    for error in (before, after, failed):
        assert isinstance(error, RuntimeError) and "no episode is running; reset" in str(error)


@pytest.mark.parametrize("reported", [{"place": np.zeros(2)}, {"place and rate": np.zeros(3)}])
def test_a_report_that_is_not_as_declared_is_refused(reported):
    env = environment(lambda seed, controller: controller(reported))
    with pytest.raises(ValueError, match="place and rate=.* must be 2 numbers"):
        env.reset()
    env.close()
    with pytest.raises(ValueError, match="must not be empty"):
        CallingSimulator(oscillator, {}, PLANT.actions)


def test_as_a_real_system_it_reports_what_the_plant_in_simulation_does():
    """Same start, same commands: the loop that somebody else owns gives the states of the plant's own step."""
    reading = Reading(keys=("place and rate",))
    system = RealSystem(environment(), PLANT, state=reading, exogenous=(0.0,), seed=3)
    generator = torch.Generator().manual_seed(0)
    commands = torch.rand(PLANT.n_steps, 1, 1, generator=generator, dtype=torch.float64) - 0.5
    drawn = iter(commands)
    real = system.rollout(PLANT.n_steps, lambda td: td.set("action", next(drawn)))[0]
    t, still = torch.zeros(1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    state = real["state"][:1]
    for k in range(PLANT.n_steps):
        reward = -PLANT.running_cost(t, state, commands[k], still)
        torch.testing.assert_close(real["next", "reward"][k], reward, rtol=1e-5, atol=1e-6)
        state = PLANT.step(t, state, commands[k], still, PLANT.closure).state
        # The error of the plant's Runge-Kutta step to the matrix exponential is some 1e-6 after two seconds.
        torch.testing.assert_close(real["next", "state"][k], state[0], rtol=0.0, atol=3e-6)
    assert real["next", "truncated"][-1] and state.abs().max() > 0.1
    system.env.close()
