"""Noise of sensors: what increments tell of it, closed loops that meet it, and alarms that it explains."""

import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from seeds_and_numbers import drawn
from small_runs import small_run
from tensordict.nn import TensorDictModule
from test_classical import PD

from rt_torchrl import DigitalTwin, ExogenousConfig, PlantEnv, load_run
from rt_torchrl.control.predictive_control import PredictiveConfig, PredictiveControl
from rt_torchrl.evaluation.unseen import UNSEEN_SEED, TwinEpisodes
from rt_torchrl.fit.sensors import noise_levels
from rt_torchrl.plants.sensors import NoisySensors
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.trajectories.trajectory import Trajectory

LEVELS = torch.tensor([0.03, 0.2], dtype=torch.float64)


class Remembering(LinearQuadratic):
    """A plant whose second state is what its controller read of the first one at the start of the interval."""

    controller_states = memories = ("velocity",)

    def memorise(self, t, state, exogenous):
        return torch.stack([state[..., 0], state[..., 0]], -1)

    def vector_field(self, t, state, action, exogenous, closure):
        return torch.stack([action[..., 0] - 0.3 * state[..., 0], torch.zeros_like(state[..., 0])], -1)


def episode(plant, policy, levels, *, seed, closure=None):
    """Readings of a closed loop with noise of the sensors, what was applied, and J_a of the readings, interval by
    interval in PyTorch; and the noise."""
    generator = torch.Generator().manual_seed(seed)
    state, inputs = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
    noise = levels * torch.randn(1, plant.n_steps, len(levels), generator=generator, dtype=torch.float64)
    noise[:, 0] = 0.0
    readings, actions, cost = [state], [], 0.0
    with torch.no_grad():
        for k in range(plant.n_steps):
            t, z = torch.tensor(k * plant.dt, dtype=torch.float64), inputs[:, k]
            read = state + noise[:, k]
            readings[-1] = read
            end, applied = plant.step(t, state, policy(plant.observe(t, read, z)), z, closure or plant.closure)
            if plant.memories:
                end = torch.stack([end[:, 0], plant.memorise(t, read, z)[:, 1]], -1)
            cost += plant.running_cost(t, read, applied, z).item() / plant.n_steps
            actions.append(applied)
            state = end
            readings.append(state)
    return Trajectory(torch.cat(readings), torch.cat(actions), inputs[0]), noise, cost


@pytest.mark.parametrize("engine", ["native", "autograd"])
@pytest.mark.parametrize("kind", [LinearQuadratic, Remembering])
def test_flights_with_noise_are_those_of_the_closed_loop_step_by_step(kind, engine):
    plant, policy = kind(horizon=5.0), LinearGain([[0.8, 0.6]])
    levels = LEVELS * torch.tensor([name not in plant.memories for name in ("position", "velocity")])
    record, noise, cost = episode(plant, policy, levels, seed=1)
    twin = DigitalTwin(NoisySensors(plant), plant.closure, engine=engine)
    inputs = torch.cat([record.exogenous[None], noise], -1)
    flown = twin.control(policy, record.states[:1], inputs)
    torch.testing.assert_close(flown.actions[0].detach(), record.actions)
    torch.testing.assert_close(flown.states[0, :-1].detach() + noise[0], record.states[:-1])
    assert twin.cost(policy, record.states[:1], inputs).item() == pytest.approx(cost, rel=1e-12)


class Integrating(LinearQuadratic):
    """A plant whose second state is the integral of the first one, which its controller computes."""

    controller_states = ("velocity",)

    def vector_field(self, t, state, action, exogenous, closure):
        return torch.stack([action[..., 0] - 0.3 * state[..., 0], state[..., 0]], -1)


def test_costs_of_a_simulated_system_are_those_of_its_readings():
    plant = LinearQuadratic(horizon=3.0)
    flown = PlantEnv(plant, seed=2, noise=0.2).rollout(plant.n_steps)[0, :-1]
    t = plant.dt * torch.arange(len(flown), dtype=torch.float64)
    read = plant.running_cost(t, flown["state"], flown["next", "applied"], flown["exogenous"])
    torch.testing.assert_close(-flown["next", "reward"].flatten(), read, rtol=1e-12, atol=0.0)


def test_what_a_run_found_of_the_noise_is_loaded_and_said(tmp_path, capsys):
    run = small_run(tmp_path, episodes=1, noise=0.05, real_unseen=2)
    run.algorithm.twin.noise = LEVELS
    metrics = run.train()
    noise = load_run(tmp_path, plant=LinearQuadratic(horizon=2.0)).twin.noise
    assert noise.any() and torch.equal(noise, run.algorithm.twin.noise)
    assert metrics["summary"]["unseen"]["judged_on"] == "simulation without noise of the sensors"
    assert "unseen ones in simulation without noise of the sensors" in capsys.readouterr().out
    # Flights of the real system itself have it.
    env, policy = PlantEnv(run.algorithm.twin.plant, noise=0.05), run.algorithm.policies[metrics["summary"]["live"]]
    env.set_seed(UNSEEN_SEED)
    env.pass_over()  # as before every flight
    actor = TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])
    reward = env.rollout(env.plant.n_steps, actor)["next", "reward"]
    costs = metrics["summary"]["real_unseen"]["costs"][metrics["summary"]["live"]]
    assert len(costs) == 2 and costs[0] == pytest.approx(-reward.mean().item())


@torch.no_grad()
def test_an_integral_of_what_is_read_tells_nothing_of_the_noise():
    plant, records = Integrating(horizon=40.0), []
    for seed in range(4):
        record = episode(plant, LinearGain([[0.8, 0.0]]), LEVELS * torch.tensor([1.0, 0.0]), seed=seed)[0]
        for k, (command, z) in enumerate(zip(record.actions, record.exogenous, strict=True)):  # of the readings
            end = plant.step(torch.tensor(k * plant.dt).double(), record.states[k], command, z, plant.closure).state
            record.states[k + 1, 1] = end[1]
        records.append(record)
    found = noise_levels(DigitalTwin(plant, plant.closure), records)
    assert found.tolist() == pytest.approx([LEVELS[0].item(), 0.0], rel=0.1)


@pytest.mark.parametrize("shares", [(1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
def test_increments_tell_the_noise_of_each_sensor(shares):
    plant, policy = LinearQuadratic(horizon=40.0), LinearGain([[0.8, 0.6]])
    levels = LEVELS * torch.tensor(shares)
    records = [episode(plant, policy, levels, seed=seed)[0] for seed in range(4)]
    found = noise_levels(DigitalTwin(plant, plant.closure), records)
    assert found.tolist() == pytest.approx(levels.tolist(), rel=0.1, abs=0.003)


def test_what_was_not_measured_tells_no_noise():
    plant, policy = LinearQuadratic(horizon=40.0), LinearGain([[0.8, 0.6]])
    twin, (record, *_) = DigitalTwin(plant, plant.closure), episode(plant, policy, LEVELS, seed=1)
    seen = torch.rand(len(record.states), generator=torch.Generator().manual_seed(0)) > 0.1
    record.states[~seen] = 100.0
    assert noise_levels(twin, [record._replace(seen=seen)]).tolist() == pytest.approx(LEVELS.tolist(), rel=0.15)
    every_second = torch.arange(len(record.states)) % 2 == 0
    assert noise_levels(twin, [record._replace(seen=every_second)]).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("missing", [0.0, 0.3, 1.0, 3.0])
def test_what_the_twin_lacks_is_no_noise(missing):
    plant, policy = LinearQuadratic(horizon=40.0), LinearGain([[0.8, 0.6]])
    record, *_ = episode(plant, policy, 0.0 * LEVELS, seed=1)
    wrong = LinearClosure(torch.tensor(plant.true_closure) + missing)
    assert noise_levels(DigitalTwin(plant, wrong), [record]).tolist() == [0.0, 0.0]


def believed(records, *, closure=None, level=LEVELS, known=True):
    """The belief of a twin that has flown some episodes, the costs of the readings and the noise of the sensors."""
    plant, policy = LinearQuadratic(horizon=20.0, noise=0.1), LinearGain([[0.8, 0.6]])
    twin = DigitalTwin(plant, closure or plant.closure)
    twin.noise = level if known else twin.noise
    virtual = VirtualEpisodes(twin, ExogenousConfig(), 5, generator=torch.Generator().manual_seed(0))
    belief = Belief({"model_based": policy}, virtual)
    for seed in range(records):
        record, _, cost = episode(plant, policy, level, seed=seed)
        belief.append(record, "model_based", cost)
    return belief


def test_noise_raises_no_alarm_where_it_explains_what_an_episode_cost():
    quiet, deaf, noisy = believed(4, level=0.0 * LEVELS), believed(4, known=False), believed(4)
    assert max(abs(flight.d) for flight in quiet.compared()) < 1e-9
    assert deaf.examine()["alarm"] == 1.0 and deaf.contradicted  # who knows nothing of the noise
    assert sum(abs(flight.d) for flight in noisy.compared()) < 0.5 * sum(abs(flight.d) for flight in deaf.compared())
    assert noisy.examine()["alarm"] == 0.0 and not noisy.contradicted and noisy.unexplained < 0.05


def test_noise_excuses_no_fall():
    belief = believed(2, level=3.0 * LEVELS)
    last = belief.flown[-1]
    belief.append(last.trajectory, "model_based", 1e4 * last.cost)
    assert belief.examine()["alarm"] == 1.0 and belief.unexplained == 5.0


def test_plans_and_costs_of_policies_know_the_noise():
    """The gradient is that of finite differences, and a gain that makes noise dear is cheaper only without it."""
    plant, soft, hard = LinearQuadratic(horizon=10.0, noise=0.0), LinearGain([[0.3, 0.3]]), LinearGain([[1.5, 1.5]])
    twin, episodes = DigitalTwin(plant, plant.closure), drawn(plant, 50)
    assert twin.cost(hard, *episodes) < twin.cost(soft, *episodes)
    twin.noise = 5.0 * LEVELS
    assert twin.cost(soft, *episodes) < twin.cost(hard, *episodes)
    assert torch.equal(twin.expected_costs(soft, *episodes), twin.episode_costs(soft, *episodes))
    twin.cost(soft, *episodes).backward()
    with torch.no_grad():
        soft.gain[0, 1] += 1e-5
        ahead = twin.cost(soft, *episodes)
        soft.gain[0, 1] -= 2e-5
        slope = (ahead - twin.cost(soft, *episodes)) / 2e-5
    assert soft.gain.grad[0, 1].item() == pytest.approx(slope.item(), rel=1e-6)


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_noise_hides_no_twin_that_is_wrong(share):
    belief = believed(4, closure=LinearClosure([[0.0, 0.0], [-0.2, 1.0]]), level=share * LEVELS)
    assert belief.examine()["alarm"] == 1.0 and belief.contradicted
    assert belief.unexplained == pytest.approx(abs(belief.compared()[-1].d), rel=0.1)


class Proportional(PD):
    def law(self, state, memory, exogenous):
        assert exogenous.shape[-1] == 1  # without the noise
        return super().law(state, memory, exogenous)


def test_unseen_episodes_on_the_twin_meet_the_noise_of_the_sensors():
    """Policies and controllers with a memory read it, and costs are those of readings."""
    plant = LinearQuadratic(horizon=5.0, noise=0.0)
    twin = DigitalTwin(plant, plant.closure)
    unseen = TwinEpisodes(twin, plant, 200)
    law, policy = Proportional(plant), LinearGain([[0.3, 0.3]])
    quiet = unseen.control_costs(policy)
    torch.testing.assert_close(unseen.control_costs(law), quiet)
    twin.noise = LEVELS
    noisy = unseen.fly(policy)
    torch.testing.assert_close(unseen.fly(law).states, noisy.states)
    costs = unseen.control_costs(policy)
    assert torch.equal(costs, unseen.control_costs(policy))
    assert (costs - quiet).mean() > 0.01
    jumps = noisy.states[:, 1:] - noisy.states[:, :-1]
    assert jumps[..., 1].std() > LEVELS[1]  # of readings, and not of states
    assert unseen.judge(noisy).control_costs.tolist() == pytest.approx(costs.tolist())


def test_predictive_control_plans_from_readings_with_noise():
    plant = LinearQuadratic(horizon=2.0, noise=0.0)
    twin = DigitalTwin(plant, plant.closure)
    unseen = TwinEpisodes(twin, plant, 2)
    controller = PredictiveControl(plant, plant.closure, PredictiveConfig(horizon=1.0))
    controller.learn(unseen.exogenous)
    quiet = unseen.fly(controller).actions
    twin.noise = LEVELS
    noisy = unseen.fly(controller)
    assert noisy.exogenous.shape == unseen.exogenous.shape and (noisy.actions - quiet).abs().amax() > 0.01
    # The first command is that of the first reading.
    first = controller.fly(noisy.states[:, 0], unseen.exogenous).actions[:, 0]
    torch.testing.assert_close(noisy.actions[:, 0], first)
