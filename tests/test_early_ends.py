"""Episodes that end early, and what learns from them."""

import dataclasses

import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from printed_commands import run_code
from seeds_and_numbers import drawn, seeded
from small_runs import SMALL
from test_anchored import replays_on
from test_classical import PD
from test_collectors import compare, system
from test_learn import values
from test_real_system import Rig, connected

import rt_torchrl as rt
from rt_torchrl.control.command_cost import CommandCost
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.optimisers.descent import Descended
from rt_torchrl.runs.results import episode_record
from rt_torchrl.runs.run_start import operation_of
from rt_torchrl.steps.belief import Belief
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.steps.interact import RealFlights
from rt_torchrl.steps.learn import ActorCritic
from rt_torchrl.steps.plan import MultiStart, WholeEpisodes
from rt_torchrl.steps.switch import Imitation
from rt_torchrl.systems.collectors import EpisodeCollector, FlightCollector
from rt_torchrl.systems.exploration import LivePolicy
from rt_torchrl.trajectories.trajectory import batch_of, continued


class Falling(LinearQuadratic):
    """Upright is unstable; beyond one metre the rod lies on the ground, and each second there costs as much as ten."""

    name = "falling"
    A = ((0.0, 1.0), (2.0, 0.0))
    reach = 1.0
    end_cost = 10.0

    def ended(self, state):
        return state[..., 0].abs() > self.reach

    def terminal_cost(self, state):
        return 0.5 * state[..., 0] ** 2

    def draw_initial_state(self, batch, generator):
        return 0.3 * torch.tanh(super().draw_initial_state(batch, generator))


# Episodes that end early: their costs and gradients, what a real one leaves in the memories, and whole trainings.


WEAK, STRONG = [[0.1, 0.1]], [[4.0, 2.5]]


def by_hand(plant, policy, state, inputs):
    """Number of intervals flown and J_a of one episode."""
    total = 0.0
    for k, z in enumerate(inputs):
        t, action = torch.tensor(k * plant.dt).double(), policy(state)
        total += plant.running_cost(t, state, action, z).item()
        state = plant.step(t, state, action, z, plant.closure).state
        if abs(state[0]) > plant.reach:
            break
    final = 0.5 * state[0].item() ** 2 / plant.dt
    return k + 1, (total + final + (len(inputs) - k - 1) * plant.end_cost) / len(inputs)


@pytest.mark.parametrize("engine", ["native", "parallel", "autograd"])
@pytest.mark.parametrize("gain", [WEAK, STRONG])
def test_the_cost_of_an_episode_that_ends_is_the_sum_by_hand(engine, gain):
    plant, policy = Falling(), LinearGain(gain)
    start, inputs = drawn(plant, 6)
    found = [by_hand(plant, policy, *episode) for episode in zip(start, inputs, strict=True)]
    assert all(n < plant.n_steps for n, _ in found) == (gain is WEAK)
    rollout = rt.Rollout(plant, plant.closure, policy, engine=engine)
    expected = torch.tensor([cost for _, cost in found], dtype=torch.float64)
    # Rounding of fifty sums.
    torch.testing.assert_close(rollout.costs(start, inputs).detach(), expected, rtol=1e-10, atol=0.0)
    flown = rollout(start, inputs)
    torch.testing.assert_close(rt.control_cost(plant, flown).detach(), expected, rtol=1e-10, atol=0.0)
    for states, (n, _) in zip(flown.states, found, strict=True):
        assert (states[n:] == states[n]).all()


@pytest.mark.parametrize("engine", ["native", "autograd"])
def test_the_gradient_is_that_of_the_same_end(engine):
    """Between two weights whose episodes end after the same numbers of intervals, the cost is smooth."""
    plant, policy = Falling(), LinearGain(WEAK)
    start, inputs = drawn(plant, 6)
    rollout = rt.Rollout(plant, plant.closure, policy, engine=engine)
    rollout.costs(start, inputs).mean().backward()
    step = 1e-5
    for k in range(2):
        ends = []
        for sign in (1.0, -1.0):
            other = LinearGain(WEAK)
            other.gain.data[0, k] += sign * step
            each = [by_hand(plant, other, *episode) for episode in zip(start, inputs, strict=True)]
            ends.append(([n for n, _ in each], sum(cost for _, cost in each) / len(each)))
        (n_up, up), (n_down, down) = ends
        assert n_up == n_down
        # Central differences with a step of 1e-5.
        assert policy.gain.grad[0, k].item() == pytest.approx((up - down) / (2 * step), rel=1e-6)


def actor_of(plant, policy):
    live = LivePolicy(plant, policy, rt.ExplorationConfig(), generator=seeded())
    live.begin(policy, strength=0.0)
    return live


def test_both_collectors_fly_the_same_episode_to_its_end():
    env, actor, policy = system(Falling())
    actor.begin(policy, strength=0.0)
    flown = FlightCollector(env, actor).rollout()
    n = flown.shape[1]
    assert flown["next", "terminated"].flatten().tolist() == [False] * (n - 1) + [True] and n < env.plant.n_steps
    compare(lambda: system(Falling()), rtol=1e-12, atol=1e-12)


def test_sums_of_rewards_end_with_the_known_value_of_the_end():
    plant = Falling()
    config = rt.LearnerConfig(return_steps=4, discount=0.9, reward_scale=0.5, batch_size=8)
    learner = ActorCritic(plant, LinearGain(WEAK), config, generator=seeded())
    episode = EpisodeCollector(rt.PlantEnv(plant, seed=1), actor_of(plant, LinearGain(WEAK)), plant).rollout()[0]
    found, n = learner.transitions(episode), len(episode)
    rewards = episode["next", "reward"].flatten().tolist()
    after = [-plant.end_cost] * 3000  # 0.9 to this power is zero
    assert len(found) == n
    for k in range(n):
        ends = k + 4 >= n
        ahead = [*rewards[k:], *after] if ends else rewards[k : k + 4]
        summed = 0.5 * sum(0.9**j * reward for j, reward in enumerate(ahead))
        assert found["next", "reward"][k].item() == pytest.approx(summed, rel=1e-9)
        assert found["next", "terminated"][k].item() == ends
        if ends:  # nothing is bootstrapped
            q = values(learner, found["observation"][k : k + 1], found["action"][k : k + 1]).item()
            assert learner.td_errors(found[k : k + 1]).item() == pytest.approx(abs(summed - q), rel=1e-6)


def algorithm(env, plant, config=SMALL, **parts):
    generator, policies = seeded(), {role: LinearGain(WEAK) for role in ("model_free", "model_based")}
    twin = rt.DigitalTwin(plant, plant.make_closure(generator))
    return rt.ReinforcementTwinning(env, twin, **policies, config=config, generator=generator, **parts)


def test_a_training_learns_from_episodes_of_unequal_length():
    plant = Falling(noise=0.01)
    fit = rt.AssimilationConfig(iterations=20, inputs="record", method="levenberg_marquardt")
    planner = rt.PlannerConfig(iterations=30, descent=rt.DescentConfig(optimiser="lbfgs", rate=1.0))
    config = dataclasses.replace(SMALL, records=2, assimilation=fit, planner=planner)
    env = connected(plant, rig=Rig(plant, seed=1))
    found = algorithm(env, plant, config)
    first = found.episode()
    resumed = algorithm(env, plant, config)
    resumed.load_state_dict(found.state_dict())
    snapshot = rt.Snapshot.take(resumed, plant.make_closure(seeded()), [episode_record(first, episode=0)])
    n = len(resumed.short_term[-1].actions)
    assert len(snapshot.large_scale) == snapshot.realisations.shape[1] == n < plant.n_steps
    last = [found.episode() for _ in range(4)][-1]
    lengths = [len(flown.trajectory.actions) for flown in found.belief.flown]
    assert lengths[0] == first["ended_after"] == n and len(set(lengths)) > 1
    record = found.belief.flown[0].trajectory
    t = plant.dt * torch.arange(n).double()
    running = plant.running_cost(t, record.states[:-1], record.actions, record.exogenous).sum()
    final = plant.terminal_cost(record.states[-1]) / plant.dt
    expected = (running + final + (plant.n_steps - n) * plant.end_cost) / plant.n_steps
    assert first["real_cost"].item() == pytest.approx(expected.item(), rel=1e-9)
    # Records of unequal length, without noise of sensors, say all of four weights.
    torch.testing.assert_close(found.twin.closure.matrix, torch.tensor(plant.true_closure).double(), rtol=0, atol=1e-4)
    assert "ended_after" not in last and last["real_cost"] < 0.1 * first["real_cost"]


def test_a_training_learns_from_episodes_that_end_at_once():
    """The rod falls within ten intervals whatever acts; each of these episodes counts."""

    class Brittle(Falling):
        A = ((0.0, 1.0), (100.0, 0.0))

    checked = list[int]()
    found = algorithm(rt.PlantEnv(Brittle(), seed=2), Brittle())
    found.flights.check = lambda record: checked.append(len(record.actions))
    reports = [found.episode() for _ in range(3)]
    lengths = [int(report["ended_after"]) for report in reports]
    assert max(lengths) < 10 and lengths == [len(flown.trajectory.actions) for flown in found.belief.flown]
    assert checked == lengths[:1]  # by what looks for mistakes in the wiring, which may be the cause
    assert len(found.learner.memory) == sum(lengths) and len(found.virtual.processes) == 3
    assert all("refusal" not in report and report["real_cost"] > 5.0 for report in reports)
    # Policies are judged in twenty times as many episodes, because ends may be rare.
    counts = found.steps["switch"].imitation.count, found.steps["plan"].counts[1], found.steps["learn"].count
    assert counts == (20 * SMALL.virtual_episodes,) * 3


class Tripping(Falling):
    """A stable rod that must go near to where it trips."""

    A = ((0.0, 1.0), (-1.0, -0.2))
    reach = 0.5

    def running_cost(self, t, state, applied, exogenous):
        return (state[..., 0] - 0.49) ** 2 + 0.01 * applied.square().sum(-1)


class Pushing(LinearGain):
    def forward(self, observation):
        push, damping = self.gain.unbind(-1)
        return push + 0.0 * observation[..., :1] - damping * observation[..., 1:2]


def test_few_weights_are_searched_on_where_gradients_do_not_see_an_end(monkeypatch):
    """Gradients lead the rod into the trip, beyond which nothing changes; the search stays before it."""

    def planner_of(plant, **options):
        return WholeEpisodes(rt.DigitalTwin(plant, plant.closure), Pushing([[0.1, 0.1]]), rt.PlannerConfig(**options))

    plant, costs = Tripping(noise=0.0), {}
    episodes = rt.Scenario(torch.zeros(4, 2).double(), plant.draw_exogenous(4, seeded()))
    for searches in (False, True):
        planner = planner_of(plant, iterations=30)
        assert [weight.numel() for weight in planner.searched] == [2]
        monkeypatch.setattr(planner, "searched", planner.searched if searches else [])
        report = planner.plan(episodes)
        costs[searches] = planner.twin.cost(planner.policy, *episodes).item()
        assert report.best == pytest.approx(costs[searches])
    assert costs[True] < 0.97 * costs[False]
    idle = planner_of(plant, iterations=0)
    idle.plan(episodes)
    assert idle.policy.gain.tolist() == [[0.1, 0.1]]
    assert not planner_of(plant, method="single_start").searched and not planner_of(LinearQuadratic()).searched


def test_a_plan_that_falls_from_a_rare_start_is_made_again_with_that_start():
    class Greedy:
        """A planner that plans a weak policy, or a strong one where it sees that the weak one falls."""

        policy, seen = LinearGain([[3.0, 2.0]]), list[torch.Tensor]()

        def plan(self, episodes):
            self.seen.append(episodes.initial_state[:, 0])
            wary = bool((episodes.initial_state[:, 0] > 0.5).any())
            self.policy.load_state_dict({"gain": torch.tensor(STRONG if wary else WEAK).double()})
            return Descended(1.0, 0.5, 0.0, 1)

        def restart(self):
            pass

        def state_dict(self):
            return {}

    plant, planner = Falling(noise=0.0), Greedy()
    virtual = VirtualEpisodes(rt.DigitalTwin(plant, plant.closure), rt.ExogenousConfig(), 1, generator=seeded())
    starts, still = torch.zeros(12, 2).double(), torch.zeros(12, plant.n_steps, 1).double()
    planned_on = rt.Scenario(starts[:3].clone(), still[:3])
    starts[7, 0] = 0.9
    planning = MultiStart(planner, Belief({}, virtual), rt.PlannerConfig(), (1, 1))
    report = planning.plan(1, planned_on, rt.Scenario(starts, still))
    assert [len(starts) for starts in planner.seen] == [3, 8] and planner.seen[1][3] == 0.9
    assert planner.policy.gain.tolist() == STRONG and report["plan_accepted"] == 1.0
    # What the plan costs is said of the episodes that judge, not of the dear ones that it was made on.
    assert report["J_a_plan"].item() == virtual.cost(planner.policy, rt.Scenario(starts, still))


def test_an_end_where_the_plant_has_none_is_refused():
    plant = Falling()
    plant.reach = 100.0  # so that the plant goes on
    env = connected(plant, rig=Rig(plant, ends_after=12, seed=3))  # by a time limit
    found = algorithm(env, plant)
    with pytest.raises(ValueError, match=r"ended the episode after 12 of 50 .* does not end there.*end_cost"):
        found.episode()


class Noisy(Rig):
    """A rig that ends where the rod truly lies on the ground, and reads its state with noise."""

    def __init__(self):
        super().__init__(Falling(), noise=0.1)

    def _step(self, tensordict):
        ended = super()._step(tensordict)
        return ended.update({key: self.found[key][0].clone() for key in ("done", "terminated")})


def test_an_episode_has_ended_where_the_system_says_so_whatever_noise_lets_be_read():
    plant, policy, short = Falling(), LinearGain(WEAK), 0
    for seed in range(6):
        env, actor = connected(plant, rig=Noisy(), seed=seed), actor_of(plant, policy)
        flights = RealFlights(env, actor, EpisodeCollector(env, actor, plant).rollout, plant)
        flight = flights.fly(policy, strength=0.0, whole=True)
        states, actions, n = flight.record.states, flight.record.actions, len(flight.record.actions)
        assert n < plant.n_steps and flight.whole and not flight.refused and not flights.faults
        short += env.env.inner._state[0, 0].abs().item() > 1.0 > states[-1, 0].abs().item()
        (q_x, _), (_, q_v), ((r,),) = *plant.Q, plant.R
        total = sum(q_x * x**2 + q_v * v**2 for x, v in states[:-1].tolist()) + sum(
            r * a**2 for (a,) in actions.tolist()
        )
        total += 0.5 * states[-1, 0].item() ** 2 / plant.dt + (plant.n_steps - n) * plant.end_cost
        assert flight.cost.item() == pytest.approx(total / plant.n_steps, rel=1e-9)
        assert flight.transitions["next", "terminated"].flatten().tolist() == [False] * (n - 1) + [True]
        assert not flight.transitions["next", "truncated"].any()
    assert short >= 2


def test_what_does_not_go_with_ends_is_refused(tmp_path):
    plant, free, begun = Falling(), Falling(), Falling()
    free.end_cost, begun.reach = None, 0.0
    with pytest.raises(ValueError, match=r"'falling' defines ended\(\) and no end_cost"):
        rt.DigitalTwin(free, free.closure)
    with pytest.raises(ValueError, match="draws initial states in which the episode has ended"):
        rt.PlantEnv(begun).reset()
    with pytest.raises(ValueError, match=r"odeint_adjoint.*'falling' has episodes that end early; use one of native"):
        rt.Rollout(plant, plant.closure, LinearGain(WEAK), engine="odeint_adjoint")
    with pytest.raises(ValueError, match="may end early, which optimal commands do not consider"):
        CommandCost(plant, plant.closure, 10)
    config = rt.RunConfig(asynchronous=True, log_dir=tmp_path, twinning=SMALL)
    with pytest.raises(ValueError, match="episodes that do not end early, .*the plant is 'falling'"):
        operation_of(config, rt.PlantEnv(plant), None, plant, {})


def test_the_plant_of_the_documentation_breaks_its_rod():
    plant = run_code("real_system.md")["Fragile"]()
    assert plant.ended(torch.tensor([[3.0, -7.6], [7.6, 7.4]]).double()).tolist() == [True, False]
    start, inputs = plant.draw_initial_state(3, seeded()), torch.zeros(3, 5, 0).double()
    flown = rt.Trajectory(torch.full((3, 6, 2), 8.0).double(), torch.zeros(3, 5, 1).double(), inputs)
    assert rt.control_cost(plant, flown).tolist() == [20.0] * 3 and not plant.ended(start).any()


def test_inputs_are_continued_without_a_jump():
    record = torch.arange(3.0).double().unsqueeze(-1)
    assert continued(record, 8).flatten().tolist() == [0, 1, 2, 2, 1, 0, 0, 1]


def test_a_twin_is_compared_with_an_episode_to_its_end():
    """After the end the real system stands still, and what is replayed runs on."""
    plant, wrong = Falling(), LinearClosure([[0.0, 0.0], [0.3, 0.1]])
    unseen = UnseenEpisodes(plant, 4)
    flown = unseen.fly(LinearGain(WEAK))
    for segment in (0, 10, 40):
        assert unseen.identification_costs(plant, plant.closure, flown, segment).max() < 1e-20
    expected = []
    for episode in flown.each():
        n = int(plant.ended(episode.states).int().argmax())
        flight = batch_of([episode.part(0, n, plant.dt)])
        replayed = rt.Rollout(plant, wrong)(flight.states[:, 0], flight.exogenous, flight.actions)
        expected.append(rt.identification_cost(plant, replayed, flight.states))
    torch.testing.assert_close(unseen.identification_costs(plant, wrong, flown), torch.cat(expected))


def begun():
    """The algorithm after a flight of a controller under which the rod falls."""
    plant, limits = Falling(noise=0.01), rt.OperatingLimitsConfig(states={"velocity": (-0.5, 0.5)})
    safety = rt.SafetyConfig(interval=plant.dt, **rt.OperatingLimits(plant, limits).safety())
    layer = rt.SafetyLayer(rt.PlantEnv(plant, seed=1), safety, fallback=(0.0,))
    first = rt.FirstController(PD(plant, (1.0, 0.1)))
    return algorithm(layer, plant, dataclasses.replace(SMALL, limits=limits), first=first)


def test_a_first_flight_that_ends_early_tells_what_policies_would_do(monkeypatch):
    """Virtual episodes are whole, nobody imitates after an end, and no policy acts that would leave the limits."""
    found, imitated, match = begun(), [], Imitation._match

    def matched(self, pupil, pairs):
        imitated.extend(observations for observations, _ in pairs)
        return match(self, pupil, pairs)

    monkeypatch.setattr(Imitation, "_match", matched)
    found.start()
    plant = found.twin.plant
    assert len(found.belief.first[0].trajectory.actions) < plant.n_steps
    assert found.virtual.draw(2).exogenous.shape[1] == plant.n_steps
    assert imitated and not any(plant.ended(observations).any() for observations in imitated)
    _, role, report = found.steps["interact"].supervisor.choose("model_based")
    assert role == "first" and "would leave the limits" in report["reason"]
    (record,) = found.short_term  # the twin is fitted to it with those to come
    with torch.no_grad():
        found.twin.closure.matrix.copy_(torch.tensor(plant.true_closure) + torch.tensor([[0.0, 0.0], [-0.02, 0.0]]))
    replayed = found.twin.replay(record.states[:1], record.exogenous[None], record.actions[None])
    assert plant.ended(record.states[-1]) and not plant.ended(replayed.states).any()
    assert found.belief.replayed([record], plant.n_steps) < 0.01  # a moment earlier or later hardly costs anything


def test_the_anchored_replay_of_an_end_that_noise_hides_costs_what_the_episode_did():
    """The last reading says that the rod has not fallen; the replay falls one interval later."""
    plant, policy = Falling(), LinearGain(WEAK)
    env, closure, actor = rt.PlantEnv(plant, seed=1), plant.make_closure(seeded()), actor_of(plant, policy)
    flight = RealFlights(env, actor, FlightCollector(env, actor).rollout, plant)
    flown = flight.fly(policy, strength=0.0, whole=True)
    states = flown.record.states.clone()
    states[-1, 0] = 0.99 * states[-1, 0].sign()
    inputs = continued(flown.record.exogenous, plant.n_steps)[None]
    replays = replays_on(plant, [flown.record._replace(states=states)], inputs, flown.cost[None], policy, closure)
    alone = replays.twin.episode_costs(policy, states[:1], inputs)
    torch.testing.assert_close(replays.corrections(policy), (flown.cost / alone).log(), rtol=0.0, atol=0.05)
