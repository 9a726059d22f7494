"""Flights of the real system after a training, and its real episodes."""

import dataclasses
import json
import operator
import signal

import pytest
import torch
from faulty_system import as_reported
from figure_reading import draw
from linear_quadratic import LinearGain, LinearQuadratic
from seeds_and_numbers import stepped
from small_runs import FULL, IDLE, small_run
from test_algorithm import flown, twinning
from test_classical import PD
from test_early_ends import STRONG, WEAK, Falling
from test_real_system import Rig, connected

from rt_torchrl import LaggedActuator, PlantEnv, SafetyConfig, SafetyLayer, load_run
from rt_torchrl.evaluation.unseen import RealController, RealEpisodes
from rt_torchrl.runs.results import entries, judged_before
from rt_torchrl.steps.interact import RealFlights

pytestmark = pytest.mark.training

STEPS = 20


class Machine(Rig):
    """A rig that counts its resets, keeps the actions and the cost of every flight, and fails where a test says so."""

    def __init__(self, plant, **options):
        super().__init__(plant, **options)
        self.resets, self.flights, self.costs, self.fails_at, self.interrupted_in = 0, [], [], None, None

    def _reset(self, tensordict=None, **kwargs):
        self.resets += 1
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict):
        if self.count == 0:
            self.flights.append([])
            self.costs.append(0.0)
        if self.interrupted_in is not None and len(self.flights) > self.interrupted_in:
            self.interrupted_in = None
            signal.raise_signal(signal.SIGINT)
        if self.count == self.fails_at:
            raise ConnectionError("no answer")
        s, z, plant = self.found["state"], self.found["exogenous"], self.inner.plant
        seen, told = self.found["observation"], super()._step(tensordict)
        t = torch.full((1,), (self.count - 1) * plant.dt).double()
        self.costs[-1] += plant.running_cost(t, s, self.found["applied"], z).item() / STEPS
        if self.count == STEPS:
            self.costs[-1] += plant.terminal_cost(self.found["state"]).item() / (STEPS * plant.dt)
        self.flights[-1].append((seen, self.found["applied"]))
        return told


def run_on(machine, folder, *, closure=None, baselines=None, first=None, callbacks=(), twinning=FULL, **options):
    plant = machine.inner.plant
    system = connected(plant, rig=machine, closure=closure)
    parts = {"env": system, "baselines": baselines, "first": first, "callbacks": callbacks}
    return small_run(folder, 2, plant, parts=parts, twinning=twinning, **options)


def costs_by_hand(plant, closure, episodes, act):
    """J_a of episodes that are flown in a loop of our own."""
    states, _, costs = stepped(plant, closure, plant.at_rest(episodes.initial_state), episodes.exogenous, act)
    return costs + plant.terminal_cost(states[:, -1]) / (STEPS * plant.dt)


def machine():
    return Machine(LinearQuadratic(horizon=2.0))


def test_a_training_flies_its_episodes_and_nothing_else_and_is_judged_on_the_twin(tmp_path, capsys):
    """Neither the policies, trained or not, nor random ones, are judged on a system that is not ours unasked."""
    rig = machine()
    run = run_on(rig, tmp_path, unseen_every=1)
    summary = run.train()["summary"]
    assert (rig.resets, len(rig.flights)) == (2, 2)
    assert "real_unseen" not in summary and summary["unseen"]["judged_on"] == "twin"
    paid, unseen, said = summary["cost_of_learning"], summary["unseen"], capsys.readouterr().out
    assert paid["episodes"] == 2 and paid["sum"] == pytest.approx(sum(rig.costs), rel=1e-9)
    assert "judged on 3 unseen ones on the twin" in said and "flights on the real system" not in said
    # A J_p on episodes that only the twin has flown would be zero; there is none.
    assert unseen["J_p"]["mean"] is None and unseen["J_p_before"]["mean"] is None
    # The same flights in a loop of our own, under the law that the twin has found.
    twin, policy, plant = run.algorithm.twin, run.algorithm.policies["model_based"], rig.inner.plant
    costs = costs_by_hand(plant, twin.closure, run.unseen, lambda k, t, s, z: policy(plant.observe(t, s, z)))
    assert unseen["costs"]["model_based"] == pytest.approx(costs.tolist(), rel=1e-9)
    # What nobody knows is not simulated as if it were the guess of the data sheet.
    finished = load_run(tmp_path, plant=plant)
    with pytest.raises(ValueError, match="nobody knows the true closure of this run's real system"):
        finished.simulate(finished.policy("model_based"))
    assert finished.simulate(finished.policy("model_based"), on="twin").states.isfinite().all()
    assert {"states", "flights"} <= set(finished.figure_names())
    assert "States, flight on the twin" in draw(finished.figure("states"))


class Blind(PlantEnv):
    """A simulation whose state cannot be read in the seventh interval of some episodes."""

    blind, flown = (), 0

    def _step(self, tensordict):
        self.flown += self._step_count == 0
        found = super()._step(tensordict)
        if self.flown in self.blind and self._step_count == 7:
            found["state"] = torch.full_like(found["state"], torch.nan)
        return found


@pytest.mark.parametrize(("blind", "flights"), [((2,), 3), ((2, 3, 4), None)])
def test_a_judged_flight_with_a_refused_reading_is_flown_again(blind, flights):
    """Its cost would be that of the reading which stands in for it."""
    plant = LinearQuadratic(horizon=2.0)
    machine = Blind(plant, seed=0)
    layer = SafetyLayer(machine, SafetyConfig(interval=plant.dt), fallback=(0.0,))
    system = as_reported(layer, plant)
    begun, machine.blind = machine.flown, [machine.flown + k for k in blind]
    if flights is None:
        with pytest.raises(ValueError, match="3 real episodes in a row cannot be used: the safety layer refused 1 of"):
            RealEpisodes(system, 2).fly(LinearGain([[-0.5, -0.5]]))
        return
    flown = RealEpisodes(system, 2).fly(LinearGain([[-0.5, -0.5]]))
    assert machine.flown == begun + flights and flown.states.isfinite().all()


class Asked(RealController):
    """A controller that is flown on the machine of the test."""

    rig = None

    def fly_real(self, count, *, seed):
        return RealEpisodes(connected(self.plant, rig=type(self).rig), count).fly(LinearGain([[-0.5, -0.5]]))


def test_judged_policies_keep_the_range_as_in_a_training():
    flown = RealEpisodes(connected(LinearQuadratic(horizon=2.0)), 2).fly(LinearGain([[8.0, 4.0]]))
    assert flown.actions.abs().max() == 2.0


def test_flights_of_the_same_episodes_are_compared_where_one_ends_early():
    plant = Falling()
    episodes = RealEpisodes(connected(plant), 3)
    flights = {name: episodes.fly(LinearGain(gain)) for name, gain in (("live", STRONG), ("weak", WEAK))}
    assert plant.ended(flights["weak"].states).any(1).all() and not plant.ended(flights["live"].states).any()
    judged = {name: episodes.judge(flown) for name, flown in flights.items()}
    costs, others = (judged[name].control_costs for name in ("live", "weak"))
    found = entries(episodes, flights, judged, "live")["controllers"]["weak"]
    assert found["ratio"]["mean"] == pytest.approx((costs.mean() / others.mean()).item()) and found["cheaper"] == 3
    flights["weak"].exogenous.add_(1e-9)  # of other episodes
    assert "ratio" not in entries(episodes, flights, judged, "live")["controllers"]["weak"]


@pytest.mark.parametrize("hidden", [False, True])
def test_flights_cost_what_the_system_measured_however_noisy_its_readings_are(monkeypatch, hidden):
    """An end early, and states that no sensor reads, show in no reading."""
    plant, costs, lengths = Falling(), [], []
    fly = RealFlights.fly

    def noted(self, *arguments, **options):
        flight = fly(self, *arguments, **options)
        costs.append(flight.cost.item())
        lengths.append(len(flight.record.actions))
        return flight

    monkeypatch.setattr(RealFlights, "fly", noted)
    system = PlantEnv(LaggedActuator(plant, "force", 0.3) if hidden else plant, seed=0, noise=0.05)
    episodes = RealEpisodes(system, 10, physics=plant)
    flown = episodes.fly(LinearGain(WEAK))
    over = plant.ended(flown.states[:, 1:]).any(1)
    assert min(lengths) < plant.n_steps and (hidden or not all(over[[n < plant.n_steps for n in lengths]]))
    assert episodes.paid == costs == episodes.judge(flown).control_costs.tolist()
    assert episodes.control_costs(LinearGain(WEAK)).tolist() == costs[10:]
    costs, lengths = costs[:10], lengths[:10]
    exact = episodes.identification_costs(plant, plant.closure, flown)
    ends = [len(flight.actions) for flight in episodes.to_their_end(flown)]
    assert ends == lengths and (hidden or exact.isfinite().all())


class Tracking(PD):
    """A PD law that cancels the disturbance that is measured."""

    def law(self, state, memory, exogenous):
        command, memory = super().law(state, memory, exogenous)
        return command - exogenous, memory


def test_flights_that_are_asked_for_are_announced_and_paid(tmp_path, capsys):
    rig = machine()
    Asked.rig, options = rig, {"real_unseen": 2, "start": "controller", "first": PD, "figures": True}
    run = run_on(rig, tmp_path, baselines={"cascade": Asked, "mine": Tracking}, **options)
    metrics = run.train()
    # The controller's episode, two episodes, and then the live policy, the cascade and two classical controllers.
    assert len(rig.flights) == 3 + 2 * 4
    summary, said = metrics["summary"], capsys.readouterr().out
    live = summary["live"]
    assert f"8 flights on the real system, which count as paid: 2 of {live}, 2 of cascade, 2 of mine, 2 of PD" in said
    paid = summary["cost_of_learning"]
    assert paid["episodes"] == 11 and paid["sum"] == pytest.approx(sum(rig.costs), rel=1e-9)
    assert paid["largest"] == pytest.approx(max(rig.costs), rel=1e-9)
    costs, flown = summary["real_unseen"]["costs"], summary["real_unseen"]["controllers"]
    assert [*costs] == [live, "cascade", "mine", "PD"] and (tmp_path / "figures" / "flights.png").is_file()
    assert "ratio" not in flown[live] and flown["PD"]["cheaper"] == sum(map(operator.lt, costs[live], costs["PD"]))
    ratio, pairs = flown["PD"]["ratio"], [live / other for live, other in zip(costs[live], costs["PD"], strict=True)]
    assert ratio["mean"] == pytest.approx(sum(costs[live]) / sum(costs["PD"]), rel=1e-9)
    assert ratio["confidence_interval"] == pytest.approx(sorted(pairs), rel=1e-9)
    assert f"the live policy costs {ratio['mean']:.4g} [{min(pairs):.4g}, {max(pairs):.4g}] of it" in said
    assert [cost for each in costs.values() for cost in each] == pytest.approx(rig.costs[3:], rel=1e-9)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    policy = run.algorithm.policies[live]
    for observation, applied in rig.flights[3] + rig.flights[4]:
        wanted = policy(observation).detach().clamp(-2.0, 2.0)  # within the range of the action
        torch.testing.assert_close(applied, wanted, rtol=1e-9, atol=1e-12)
    # A classical controller is judged on the twin as it is at the end, too; here in a loop of our own.
    plant, twin = rig.inner.plant, run.algorithm.twin.believed
    law = Tracking(plant)
    memory = [law.first_memory(run.unseen.initial_state)]

    def act(k, t, s, z):
        command, memory[0] = law.respond(s, memory[0], z)
        return command

    mean, baselines = costs_by_hand(plant, twin.closure, run.unseen, act).mean().item(), summary["unseen"]["baselines"]
    assert [*baselines] == ["mine", "PD"] and baselines["mine"]["J_a"]["mean"] == pytest.approx(mean, rel=1e-9)


def test_a_policy_that_was_never_trained_does_not_fly_when_flights_are_asked_for(tmp_path, capsys):
    """The model-free arm acts; without iterations its weights are still the random ones.

    Controllers that fly where it does not are compared with no policy.
    """
    rig, twinning = machine(), dataclasses.replace(FULL, arm="model_free", learner=IDLE)
    run = run_on(rig, tmp_path, real_unseen=2, twinning=twinning, baselines={"PD": PD, "mine": Tracking})
    flown = run.train()["summary"]["real_unseen"]["controllers"]
    assert [*flown] == ["PD", "mine"] and not any("ratio" in one for one in flown.values())
    assert len(rig.flights) == 2 + 2 * 2
    said = capsys.readouterr().out
    assert "random initial weights" in said and said.count("the live policy costs") == 2  # on the twin


def test_a_policy_that_may_not_act_does_not_fly_when_flights_are_asked_for(tmp_path, capsys):
    rig = machine()

    def destabilise(episodes):
        with torch.no_grad():
            for policy in run.algorithm.policies.values():
                policy.gain.fill_(-2.0)

    run = run_on(rig, tmp_path, real_unseen=2, start="controller", first=PD, callbacks=[destabilise])
    summary = run.train()["summary"]
    assert [*summary["real_unseen"]["controllers"]] == ["PD"] and len(rig.flights) == 3 + 2
    assert set(summary["may_not_act"]) == {"model_based", "model_free"}
    said = capsys.readouterr().out
    assert f"  {summary['may_not_act'][summary['live']]}\n" in said
    assert "does not fly the real system: model_" in said and "next: judge the live policy" not in said


@pytest.mark.parametrize("cause", ["the environment ended the episode after 5 of 20", "ConnectionError: no answer"])
def test_a_system_that_fails_while_it_is_judged_leaves_the_results_of_the_training(tmp_path, capsys, cause):
    rig = machine()

    def fail(episodes):
        if len(episodes) == 2:
            rig.ends_after, rig.terminates, rig.fails_at = 5, True, 4 if "answer" in cause else None

    metrics = run_on(rig, tmp_path, real_unseen=2, baselines={"PD": PD}, callbacks=[fail]).train()
    assert len(metrics["episodes"]) == 2 and "real_unseen" not in metrics["summary"]
    said = capsys.readouterr().out
    why = f"3 real episodes in a row cannot be used: the system failed in interval 4, at 0.4 s: {cause}"
    assert f"PD is not judged on the real system: {why}" in said


def test_a_finished_run_that_is_resumed_flies_and_pays_nothing_again(tmp_path):
    rig = machine()
    first = run_on(rig, tmp_path, real_unseen=2).train()["summary"]
    again = run_on(rig, tmp_path, real_unseen=2, resume=True).train()["summary"]
    assert len(rig.flights) == 2 + 2 and again["real_unseen"] == first["real_unseen"]
    assert again["cost_of_learning"] == first["cost_of_learning"]
    episodes = json.loads((tmp_path / "metrics.json").read_text())["episodes"]
    assert judged_before(tmp_path, episodes) == first["real_unseen"]
    episodes[1]["real_cost"] += 1e-9  # flown again from an earlier checkpoint, with another outcome
    assert judged_before(tmp_path, episodes) is None
    # A controller that has not flown yet flies, and so does the policy beside it; what was paid before stays paid.
    run_on(rig, tmp_path, real_unseen=2, resume=True, baselines={"mine": Tracking}).train()
    paid = run_on(rig, tmp_path, resume=True).train()["summary"]["cost_of_learning"]
    assert len(rig.flights) == 2 + 2 + 2 * 2 == paid["episodes"]
    assert paid["sum"] == pytest.approx(sum(rig.costs), rel=1e-9)


@pytest.mark.parametrize("whole", [1, 3])
def test_an_interrupt_of_the_judging_flights_leaves_the_results_and_the_controllers_that_have_flown(tmp_path, whole):
    rig = machine()

    def press(episodes):
        if len(episodes) == 2:
            rig.interrupted_in = len(rig.flights) + whole

    metrics = run_on(rig, tmp_path, real_unseen=2, baselines={"PD": PD}, callbacks=[press]).train()
    summary = metrics["summary"]
    flown = summary.get("real_unseen", {"controllers": {}})["controllers"]
    assert [*flown] == ([summary["live"]] if whole == 3 else []) and len(rig.flights) == 2 + whole + 1
    # What has flown is paid, and stays so when other flights end earlier still, which leave what was known.
    paid = summary["cost_of_learning"]
    assert paid["judging"] == pytest.approx(rig.costs[2:-1], rel=1e-9) and paid["episodes"] == 2 + whole
    rig.interrupted_in = len(rig.flights) + 1
    again = run_on(rig, tmp_path, real_unseen=3, baselines={"PD": PD}, resume=True).train()["summary"]
    assert again.get("real_unseen") == summary.get("real_unseen")
    assert again["cost_of_learning"]["episodes"] == 2 + whole + 1


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


# Real episodes of the algorithm: one reset each, what the system draws, who steps it, and what a failure leaves.


def test_after_a_failure_the_next_episode_begins_with_a_reset():
    rig = machine()
    found = twinning(env=connected(rig.inner.plant, rig=rig))
    found.episode()
    assert (rig.resets, [len(flight) for flight in rig.flights]) == (1, [20])
    rig.fails_at = 7  # too little of the episode is sound then
    for _ in range(2):
        with pytest.raises(ValueError, match="3 real episodes in a row .*in interval 7, at 0.7 s: Connection"):
            found.episode()
    assert len(found.learner.memory) == 20 and len(found.short_term) == 1 and found.episodes_done == 1
    rig.fails_at, failed = None, rig.resets
    assert found.episode()["real_cost"].isfinite()
    assert rig.resets == failed + 1 and len(rig.flights[-1]) == 20 and len(found.learner.memory) == 40


@pytest.mark.parametrize("guarded", [False, True])
def test_episodes_of_a_simulation_are_every_second_draw_of_its_seed(guarded):
    """As in version 0.1, whose figures rest on them."""
    plant = LinearQuadratic(horizon=2.0)
    env = PlantEnv(plant, seed=4)
    found = twinning(env=SafetyLayer(env, SafetyConfig(interval=0.1), fallback=(0.0,)) if guarded else env)
    generator = torch.Generator().manual_seed(4)
    for _ in range(3):
        flown(found)
        for _ in range(2):
            state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
        record = found.short_term[-1]
        assert torch.equal(record.states[0], state[0]) and torch.equal(record.exogenous, exogenous[0])
