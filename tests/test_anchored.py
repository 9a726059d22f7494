"""Anchored replays against closed loops of the true system, and the belief that they make."""

import copy
import math

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from seeds_and_numbers import drawn

import rt_torchrl as rt
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.cryogenic_tank.unknown import unknown as tank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.flapping_wing.unknown import unknown as drone
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.unknown import unknown as turbine
from rt_torchrl.steps.belief import ANCHORS, LENGTH, NOISE, Belief
from rt_torchrl.steps.hypotheses.ensemble import ALONE
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.trajectories.anchored import Anchored, AnchoredReplays


def flown_on(real, policy, physics, *, seed=0, count=2):
    """Records of the real system under a policy, the inputs, and J_a."""
    starts, inputs = drawn(real, count, seed)
    with torch.no_grad():
        rollout = rt.Rollout(real, real.closure, policy)
        flown, costs = rollout(starts, inputs), rollout.costs(starts, inputs)
    states = flown.states[..., : len(physics.readings)]
    return [rt.Trajectory(states[k], flown.actions[k], inputs[k]) for k in range(count)], inputs, costs


def replays_on(plant, records, inputs, costs, policy, closure=None):
    """Replays of what one policy has flown, on a twin."""
    twin = rt.DigitalTwin(plant, closure or plant.closure)
    return AnchoredReplays(twin, twin.of(Anchored(plant)), records, inputs, costs, lambda k: policy)


def replayed(policy, *, horizon=5.0, closure=None):
    """The pushed plant, inputs and J_a of two of its flights under a policy, and their replays on the twin."""
    real, physics = pushed(horizon)
    records, inputs, costs = flown_on(real, policy, physics)
    return real, inputs, costs, replays_on(physics, records, inputs, costs, policy, closure)


def anchored_costs(replays, policy):
    """J_a that the anchored replays say of a policy."""
    alone = replays.twin.episode_costs(policy, replays.twin.plant.at_rest(replays.starts), replays.inputs)
    return (alone * replays.corrections(policy).exp()).detach()


class Whole(LinearQuadratic):
    """A plant that overrides its step as a whole."""

    def step(self, t, state, command, exogenous, closure):
        end, applied = super().step(t, state, command, exogenous, closure)
        return rt.Transition(end + 1e-3, applied)


SHIPPED = {
    "turbine": (WindTurbine(horizon=60.0), turbine, "inflow"),
    "drone": (FlappingWing(horizon=0.2), drone, "all_2"),
    "tank": (CryogenicTank(horizon=36e3), tank, "all"),
    "own step": (Whole(horizon=2.0), lambda plant, names: plant, "itself"),
}


@pytest.mark.parametrize(
    ("name", "suspected"), [(name, suspected) for name in SHIPPED for suspected in (False, True)][:-1]
)
def test_the_replay_of_what_flew_is_the_real_episode(name, suspected):
    """Whatever the twin lacks, with its first guess of the closure, and with a hypothesis that is wrong."""
    physics, unknown, system = SHIPPED[name]
    generator = torch.Generator().manual_seed(1)
    policy = physics.make_policy(generator)
    records, inputs, costs = flown_on(unknown(physics, [system]), policy, physics)
    plant, closure = physics, physics.make_closure(generator)
    if suspected:
        plant = list(physics.suspects().values())[-1]
        closure = plant.extended(closure)
    replays = replays_on(plant, records, inputs, costs, policy, closure)
    alone = replays.twin.episode_costs(policy, replays.twin.plant.at_rest(replays.starts), inputs).detach()
    assert anchored_costs(replays, policy).tolist() == pytest.approx(costs.tolist(), rel=1e-9)
    assert (alone / costs - 1.0).abs().max() > 1e-4
    assert torch.equal(replays.flown[0], replays.actions(policy)) and replays.explored.tolist() == [0.0, 0.0]


class Pushed(rt.Extension):
    """A plant on which more acts than its sensor reads, a wave with a random amplitude and phase."""

    advance = rt.Plant.advance

    def __init__(self, base):
        super().__init__(base, [rt.Signal(symbol=part, name=f"unread_{part}", unit="N") for part in "pq"])

    def vector_field(self, t, state, action, exogenous, closure):
        base, hidden = self.split(state)
        field = self.base.vector_field(t, base, action, exogenous + hidden[..., :1], closure)
        return torch.cat([field, -hidden[..., 1:], hidden[..., :1]], -1)

    def rest(self, base):
        return torch.zeros_like(base)

    def draw_initial_state(self, batch, generator):
        base = self.base.draw_initial_state(batch, generator)
        return torch.cat([base, torch.randn(batch, 2, generator=generator, dtype=torch.float64)], -1)


def pushed(horizon=5.0):
    """A linear plant on which more acts than its sensor reads, and the plant that its twin knows."""
    physics = LinearQuadratic(horizon=horizon)
    return Pushed(physics), physics


def test_an_unread_force_on_a_linear_plant_is_replayed_exactly_under_any_policy():
    """Its Jacobians are those of the twin, so that anchored replays are no approximation."""
    other = LinearGain([[3.0, 2.0]])
    real, inputs, _, replays = replayed(LinearGain([[0.5, 0.5]]))
    starts = real.draw_initial_state(2, torch.Generator().manual_seed(0))
    true = rt.Rollout(real, real.closure, other).costs(starts, inputs).tolist()
    assert anchored_costs(replays, other).tolist() == pytest.approx(true, rel=1e-9)
    alone = replays.twin.episode_costs(other, replays.starts, inputs).tolist()
    assert alone != pytest.approx(true, rel=0.1)


def test_gradients_of_corrections_agree_with_finite_differences():
    policy = LinearGain([[0.6, 0.4]])
    *_, replays = replayed(policy, horizon=2.0, closure=LinearClosure([[0.1, 0.0], [0.3, -0.2]]))
    with torch.no_grad():
        policy.gain += 0.2
    for measure in (replays.corrections, replays.actions):
        (slope,) = torch.autograd.grad(measure(policy).sum(), [policy.gain])
        for k in range(2):
            ends = []
            for step in (1e-6, -1e-6):
                moved = copy.deepcopy(policy)
                with torch.no_grad():
                    moved.gain[0, k] += step
                ends.append(measure(moved).sum().item())
            assert slope[0, k].item() == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5)


def test_distances_are_those_of_actions_in_shares_of_half_their_range():
    real, physics = pushed()
    policy, generator = LinearGain([[0.5, 0.0]]), torch.Generator().manual_seed(7)
    records, inputs, costs = flown_on(real, policy, physics, count=1)
    beside = torch.randn(records[0].actions.shape, generator=generator, dtype=torch.float64)
    records = [records[0]._replace(actions=records[0].actions + beside)]
    replays = replays_on(physics, records, inputs, costs, policy)
    distance = (replays.actions(LinearGain([[0.9, 0.0]])) - replays.flown[0]).square().sum().item()
    positions = records[0].states[:-1, 0]  # fifty intervals, all of which are compared
    assert distance == pytest.approx((0.4 * positions / 2.0).square().mean().item(), rel=1e-12)
    assert replays.explored.item() == pytest.approx((beside / 2.0).square().mean().item(), rel=1e-12)


@pytest.mark.parametrize(("reported", "counts"), [(3.0, 3.0), (0.0, 1.0)])  # a cost of zero has no log
def test_what_sensors_do_not_read_of_a_cost_counts(reported, counts):
    (real, physics), policy = pushed(), LinearGain([[0.5, 0.5]])
    records, inputs, costs = flown_on(real, policy, physics)
    replays = replays_on(physics, records, inputs, reported * costs, policy)
    torch.testing.assert_close(anchored_costs(replays, policy), counts * costs, rtol=1e-6, atol=0.0)


def belief_of(gains, real=None, physics=None, *, twin=None):
    """The belief after one flight with each of some gains, under other inputs; by default of the pushed plant."""
    real, physics = (real, physics or real) if real else pushed()
    twin = twin or rt.DigitalTwin(physics, physics.closure)
    virtual = VirtualEpisodes(twin, rt.ExogenousConfig(), 3, generator=torch.Generator().manual_seed(0))
    belief = Belief({"model_based": LinearGain([[0.0, 0.0]])}, virtual)
    for seed, gain in enumerate(gains):
        policy = LinearGain([gain])
        (record,), _, cost = flown_on(real, policy, physics, seed=seed, count=1)
        belief.append(record, "model_based", cost.item(), weights=policy.state_dict())
    return belief


def test_a_twin_that_has_been_right_keeps_the_word():
    belief = belief_of([(0.5, 0.5), (0.6, 0.5)], LinearQuadratic())
    assert belief.correction(LinearGain([[2.0, 2.0]])).item() == 0.0 and belief.anchors() is None
    dear = belief.flown[0]._replace(cost=1.1 * belief.flown[0].cost)
    belief.append(dear.trajectory, "model_based", dear.cost, weights=dear.weights)
    assert belief.anchors() and belief.correction(LinearGain([[0.5, 0.5]])).item() > 0.03
    assert belief.expected(LinearGain([[0.5, 0.5]]), -4.0) == -4.0
    assert belief.expected(LinearGain([[0.5, 0.5]]), math.inf) == math.inf


def test_corrections_are_averaged_and_those_of_like_policies_count_once():
    belief, policy = belief_of([(0.5, 0.5), (1.5, 0.4), (1.5, 0.4)]), LinearGain([[1.0, 0.5]])
    anchors = belief.anchors()
    points = torch.cat([anchors.replays.actions(policy)[None], anchors.replays.flown]).detach().numpy()
    c = anchors.replays.corrections(policy).detach().numpy()
    apart = ((points[:, None] - points[None]) ** 2).sum(-1)
    alike = np.exp(-0.5 * apart[1:, 1:] / LENGTH**2).sum(1)
    assert alike.tolist() == pytest.approx([1.0, 2.0, 2.0], abs=0.1)
    precisions = 1.0 / (anchors.noise + anchors.growth * alike * apart[0, 1:])
    mean, variance = precisions @ c / precisions.sum(), 1.0 / precisions.sum()
    assert belief.correction(policy).item() == pytest.approx(mean + 0.5 * variance, rel=1e-9)
    assert belief.expected(policy, 2.0) == pytest.approx(2.0 * math.exp(mean + 0.5 * variance))


def test_no_correction_says_that_a_policy_is_cheaper_than_any_flight_was(monkeypatch):
    """A closed loop that falls on the twin, and not in an anchored replay, would be the cheapest of all."""
    belief, policy = belief_of([(0.5, 0.5), (1.5, 0.4)]), LinearGain([[1.0, 0.5]])
    anchors, cheapest = belief.anchors(), min(0.0, *(flight.d for flight in belief.compared()))
    monkeypatch.setattr(anchors.replays, "latest", lambda count: anchors.replays)
    monkeypatch.setattr(anchors.replays, "corrections", lambda policy: torch.tensor([-4.0, -5.0]).double())
    spread = (anchors.noise + anchors.growth * 4.0) ** 0.5  # actions differ by at most twice half their ranges
    assert cheapest <= belief.correction(policy).item() < cheapest + 0.5 * spread**2
    monkeypatch.setattr(anchors.replays, "corrections", lambda policy: torch.tensor([4.0, 4.0]).double())
    assert belief.correction(policy).item() >= 4.0


class Told:
    """Replays whose corrections are known of each policy, a multiple of ten of which says how far it is from others."""

    def __init__(self, corrections, explored, apart):
        self.told, self.apart = corrections, apart
        self.offsets, self.explored = torch.zeros(3).double(), torch.tensor([explored] * 3).double()

    def distances(self):
        places = self.apart * torch.arange(3).double()
        return (places.unsqueeze(-1) - places).square()

    def corrections(self, policy):
        told = self.told[round(10.0 * policy.gain[0, 0].item())]
        if told is None:
            raise rt.DivergenceError
        return torch.tensor(told).double()


@pytest.mark.parametrize(
    ("scatter", "slope", "explored", "apart"),
    # Scatter between like policies is noise, and that between others grows with their distance.
    [(0.0, 0.0, 0.0, 0.1), (0.0, 0.3, 0.0, 0.1), (0.4, 0.0, 0.0, 0.01), (0.4, 1.0, 0.0, 0.1), (0.4, 0.3, 0.04, 0.1)],
)
def test_noise_and_growth_are_the_most_likely_ones(scatter, slope, explored, apart):
    """Three episodes predict each other's corrections of 1 with errors; the optimum is found on a grid."""
    belief = belief_of([(0.1 * k, 0.0) for k in range(3)], LinearQuadratic(horizon=2.0))
    signs = [[0.0, 1.0, -1.0], [-1.0, 0.0, 1.0], [1.0, -1.0, 0.0]]
    corrections = [[1.0 + slope * (k - j) + scatter * signs[j][k] for k in range(3)] for j in range(3)]
    found = belief._variances(Told(corrections, explored, apart), belief.flown, [1.0] * 3)
    noise = np.exp(np.linspace(math.log(NOISE**2), math.log(NOISE**2) + 6.0, 401))
    growth = np.exp(np.linspace(math.log(10.0) - 5.0, math.log(10.0) + 5.0, 401))
    sigma, v = np.meshgrid(noise, growth, indexing="ij")
    chances = 2.0 * (np.log(sigma) + NOISE**2 / sigma + np.log(v) + 10.0 / v)
    for j in range(3):
        for k in {0, 1, 2} - {j}:
            variance = 2.0 * sigma + v * ((apart * (j - k)) ** 2 + 2.0 * explored)
            chances += 0.5 * (np.log(variance) + (corrections[j][j] - corrections[j][k]) ** 2 / variance)
    best = np.unravel_index(chances.argmin(), chances.shape)
    assert found == (pytest.approx(noise[best[0]], rel=0.03), pytest.approx(growth[best[1]], rel=0.05))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 1.0])
def test_an_episode_that_flew_costs_what_it_did_whatever_hypotheses_weigh(share):
    real, physics = pushed()
    suspect = rt.LaggedActuator(physics, "force", 0.5)
    twin = rt.TwinEnsemble(physics, physics.closure, {"lags": suspect}, {"lags": suspect.closure})
    twin.weights = {name: weight for name, weight in ((ALONE, 1.0 - share), ("lags", share)) if weight}
    belief, policy = belief_of([(0.5, 0.5)], twin=twin), LinearGain([[0.5, 0.5]])
    (record,), inputs, cost = flown_on(real, policy, physics, count=1)
    replays = belief.anchors().replays
    assert replays.corrections(policy).item() == pytest.approx(belief.compared()[0].d, rel=1e-9)
    said = twin.cost(policy, record.states[:1], inputs).item()
    assert said * replays.corrections(policy).exp().item() == pytest.approx(cost.item(), rel=1e-9)


def test_of_weights_that_flew_their_own_flights_count_and_not_those_of_their_neighbours():
    """Two episodes of one policy, which an unread force makes dearer by different factors."""
    belief = belief_of([(0.5, 0.5), (0.5, 0.5), (0.501, 0.5), (0.502, 0.5)])
    noise, (first, second, *_) = belief.anchors().noise, [flight.d for flight in belief.compared()]
    assert abs(first - second) > 0.1
    same, beside = LinearGain([[0.5, 0.5]]), LinearGain([[0.5005, 0.5]])
    assert belief.expected(same, 2.0) == pytest.approx(2.0 * math.exp(0.5 * (first + second) + 0.25 * noise))
    assert belief.expected(beside, 2.0) == pytest.approx(2.0 * math.exp(belief.correction(beside).item()))


@pytest.mark.parametrize("gain", [-1e3, -1e40])
def test_an_episode_on_which_the_twin_nearly_diverges_or_does_is_left_out(gain):
    belief = belief_of([(0.5, 0.5), (0.6, 0.5)], *pushed(horizon=2.0))
    before = belief.correction(LinearGain([[0.55, 0.5]])).item()
    wild = belief.flown[0]._replace(weights={"gain": torch.tensor([[gain, 0.0]]).double()})
    belief.append(wild.trajectory, "model_based", wild.cost, weights=wild.weights)
    assert abs(belief.compared()[-1].d) == 5.0 and len(belief.anchors().replays.starts) == 2
    assert belief.correction(LinearGain([[0.55, 0.5]])).item() == pytest.approx(before, rel=1e-9)


@pytest.mark.parametrize(("factor", "expected"), [(140.0, 140.0), (200.0, math.exp(5.0))])
def test_a_twin_that_is_wrong_by_any_factor_is_not_believed(factor, expected):
    """Beyond e⁵ the size does not count, and the episode still corrects what has not flown."""
    physics = LinearQuadratic(horizon=2.0)
    (flown,) = belief_of([(0.5, 0.5)], physics).flown
    dear, belief = flown._replace(cost=factor * flown.cost), belief_of([], physics)
    belief.append(dear.trajectory, "model_based", dear.cost, weights=dear.weights)
    noise = belief.anchors().noise
    assert belief.expected(LinearGain([[0.5, 0.5]]), 1.0) == pytest.approx(expected * math.exp(0.5 * noise))
    assert belief.expected(LinearGain([[0.51, 0.5]]), 1.0) > 100.0


def test_a_belief_that_corrects_nothing_withdraws_what_another_one_said():
    belief, policy = belief_of([(0.5, 0.5)]), LinearGain([[0.5, 0.5]])
    twin, episodes = belief.virtual.twin, drawn(LinearQuadratic(), 20, 99)
    assert twin.expected_costs(policy, *episodes).mean() > 1.1 * twin.episode_costs(policy, *episodes).mean()
    Belief({"model_based": policy}, belief.virtual, corrects=False)
    assert torch.equal(twin.expected_costs(policy, *episodes), twin.episode_costs(policy, *episodes))


def test_the_latest_whole_episodes_are_replayed_and_again_where_the_twin_has_changed():
    belief = belief_of([(0.5 + 0.01 * k, 0.5) for k in range(ANCHORS + 2)], *pushed(horizon=2.0))
    belief.append(belief.flown[-1].trajectory.part(0, 10, 0.1), "model_based", 1.0)
    anchors, policy = belief.anchors(), LinearGain([[0.52, 0.5]])
    assert len(anchors.replays.starts) == ANCHORS + 2 and belief.anchors() is anchors
    few = anchors.replays.latest(ANCHORS)
    assert torch.equal(few.corrections(policy), anchors.replays.corrections(policy)[2:])
    assert belief.correction(policy, latest=ANCHORS) != belief.correction(policy)
    with torch.no_grad():
        belief.virtual.twin.closure.matrix[0, 0] += 1e-3
    assert belief.anchors() is not anchors


def test_plans_on_expected_costs_find_what_the_twin_alone_does_not():
    """With one anchored record of an unread force the gradient is that of the real episode."""
    (real, physics), policy = pushed(), LinearGain([[0.5, 0.5]])
    twin = belief_of([(0.5, 0.5)]).virtual.twin
    (record,), inputs, _ = flown_on(real, policy, physics, count=1)
    start = real.draw_initial_state(1, torch.Generator().manual_seed(0))
    true, expected, alone = (
        torch.autograd.grad(costs.mean().log(), [policy.gain])[0]
        for costs in (
            rt.Rollout(real, real.closure, policy).costs(start, inputs),
            twin.expected_costs(policy, record.states[:1], inputs),
            twin.episode_costs(policy, record.states[:1], inputs),
        )
    )
    assert torch.allclose(expected, true, rtol=1e-6) and not torch.allclose(alone, true, rtol=0.05)


def test_weights_that_flew_are_dear_also_where_no_episode_can_be_replayed():
    real, physics = pushed(horizon=2.0)
    (record,), _, cost = flown_on(real, LinearGain([[0.5, 0.5]]), physics, count=1)
    belief, wild = belief_of([], real, physics), LinearGain([[-1e40, 0.0]])
    belief.append(record, "model_based", cost.item(), weights=wild.state_dict())
    assert belief.contradicted and belief.anchors() is None and [flight.d for flight in belief.compared()] == [5.0]
    assert belief.expected(wild, 1.0) == pytest.approx(math.exp(5.0 + 0.5 * NOISE**2))
    assert belief.expected(LinearGain([[0.5, 0.5]]), 1.0) == 1.0


def test_the_best_that_flew_is_found_whatever_was_computed_before():
    gains, episodes = [(2.0, 0.5), (0.5, 0.5), (1.0, 0.5)], rt.Scenario(*drawn(LinearQuadratic(), 20, 99))
    fresh, warm, like = belief_of(gains), belief_of(gains), LinearGain([[0.0, 0.0]])
    warm.anchors()
    (weights, judged), (same, again) = fresh.best_flown(like, episodes), warm.best_flown(like, episodes)
    assert judged == again and torch.equal(weights["gain"], same["gain"])
    policy = LinearGain(weights["gain"].tolist())
    assert warm.judge(policy, episodes).expected == pytest.approx(judged.expected, rel=1e-12)


def test_what_refuted_weights_counts_also_where_extreme_episodes_diverge():
    belief, refuted = belief_of([(0.5, 0.5)]), LinearGain([[0.5, 0.5]])
    belief.virtual.judge = lambda policy, episodes: (math.inf, 1.0)
    judged = belief.judge(refuted, rt.Scenario(*drawn(LinearQuadratic(), 20, 99)))
    assert judged == (math.inf, belief.expected(refuted, 1.0), 1.0) and belief.expected(refuted, 1.0) > 1.1


class Walled(LinearClosure):
    """A law that makes no sense where only the real system goes."""

    def __init__(self, matrix, wall):
        super().__init__(matrix)
        self.wall = wall

    def forward(self, features):
        return super().forward(features) / (features[..., :1].abs() < self.wall)


def test_a_twin_that_diverges_within_an_interval_from_where_the_real_system_was_is_refused():
    belief = belief_of([(0.5, 0.5)])
    twin, (flight,) = belief.virtual.twin, belief.flown
    episode = belief.virtual.repeated(flight.trajectory)
    alone = twin.control(LinearGain([[0.5, 0.5]]), *episode).states[..., 0].abs().max().item()
    real = flight.trajectory.states[:, 0].abs().max().item()
    assert alone < real
    belief.require_sound_twin(episode)
    walled = rt.DigitalTwin(twin.plant, Walled(twin.closure.matrix.detach(), 0.5 * (alone + real)))
    belief = belief_of([(0.5, 0.5)], twin=walled)
    with pytest.raises(rt.DivergenceError, match="position is not finite"):
        belief.require_sound_twin(episode)
