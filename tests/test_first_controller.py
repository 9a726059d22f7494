"""A controller that the real system has had so far flies first; twin and policies begin with what it did."""

import pytest
import torch
from linear_quadratic import LinearQuadratic
from small_runs import small_run
from test_algorithm import twinning
from test_classical import PD

from rt_torchrl import AssimilationConfig, FirstController, LearnerConfig, PlannerConfig, RefereeConfig
from rt_torchrl.runs.results import first_there
from rt_torchrl.steps.switch import Imitation
from rt_torchrl.trajectories.trajectory import Scenario, control_cost

pytestmark = pytest.mark.training

GAINS = (0.4, 0.3)


class Beside(LinearQuadratic):
    """Episodes begin to one side, where no controller of these gains asks for more than the actuators give."""

    def draw_initial_state(self, batch, generator):
        return 0.1 + 0.1 * torch.rand(batch, 2, generator=generator, dtype=torch.float64)


def begun(*, gains=GAINS, **options):
    """The algorithm that begins with a controller of these gains."""
    usual = {
        "learner": LearnerConfig(critic_iterations=1, actor_iterations=1, batch_size=4),
        "planner": PlannerConfig(iterations=0),
        "assimilation": AssimilationConfig(iterations=3),
        "virtual_episodes": 4,
    }
    first = FirstController(PD(LinearQuadratic(horizon=2.0), gains))
    return twinning(Beside(horizon=2.0), first=first, **usual | options)


def started(**options):
    """The algorithm after the flight of the controller, and the record of that."""
    found = begun(**options)
    found.start()
    (record,) = found.short_term
    return found, record


def test_policies_begin_as_the_controller_and_the_twin_has_learned_from_it():
    found = begun()
    closure = found.twin.closure.matrix.detach().clone()
    report = found.start()
    gain, (record,) = torch.tensor([GAINS], dtype=torch.float64), found.short_term
    for policy in found.policies.values():
        torch.testing.assert_close(policy.gain.detach(), gain, rtol=1e-3, atol=1e-3)
    assert found.referee.live == "model_based"
    assert report["start_cost_ratio_model_based"] == pytest.approx(1.0, abs=1e-3)
    wanted = -(record.states[:-1] * gain).sum(-1, keepdim=True).clamp(-2.0, 2.0)
    torch.testing.assert_close(record.actions, wanted, rtol=1e-12, atol=1e-12)
    assert not torch.equal(closure, found.twin.closure.matrix) and len(found.learner.observations()) == 20
    cost = found.twin.plant.running_cost(0.0, record.states[:-1], record.actions, record.exogenous).mean()
    assert report["start_cost"].item() == pytest.approx(cost.item(), rel=1e-9)


@pytest.mark.parametrize("arm", ["model_free", "model_based"])
def test_each_half_alone_begins_with_it(arm):
    found = begun(arm=arm)
    closure = found.twin.closure.matrix.detach().clone()
    found.episode()
    assert torch.equal(closure, found.twin.closure.matrix) == (arm == "model_free")
    assert found.referee.live == arm and (len(found.virtual.processes) > 0) == (arm == "model_based")


def test_a_harmful_controller_is_not_imitated():
    found = begun(gains=(30.0, 1e-6))
    before = found.policies["model_based"].gain.detach().clone()
    assert "does not imitate the controller" in found.start()["reason"]
    assert torch.equal(before, found.policies["model_based"].gain)


def wild(found):
    """Policies that make the system diverge."""
    with torch.no_grad():
        for policy in found.policies.values():
            policy.gain.fill_(-2.0)


def test_the_controller_flies_while_policies_are_expected_to_cost_twice_as_much(monkeypatch):
    monkeypatch.setattr(Imitation, "imitate", lambda self, teacher, pupil, **data: 1.0)
    found = begun(planner=PlannerConfig(iterations=20))
    wild(found)
    report = found.episode()
    paid = [flight.cost for flight in found.belief.first]
    assert report["live"] == "first" and paid == [report["start_cost"].item(), report["real_cost"].item()]
    assert report["exploration"] == 0.0 and not found.belief.flown
    assert "model_based may not act: it is expected to cost" in report["reason"]
    # The plan of that episode flies, and the controller again as soon as both policies are as bad as before.
    assert found.episode()["live"] == "model_based"
    state = found.state_dict()
    wild(found)
    policy, role, _ = found.steps["interact"].supervisor.choose("model_based")
    assert role == "first" and policy is found.first.teacher
    other = begun()
    other.load_state_dict(state)
    assert [one.cost for one in other.belief.first] == paid


def test_a_policy_is_compared_in_the_very_episodes_of_the_controller():
    found, record = started()
    belief, policy, teacher = found.belief, found.model_based, found.first.teacher
    paid = control_cost(found.twin.plant, record).item()

    def on_twin(policy, *others):
        flights = [(record.states[:1], record.exogenous[None]), *others]
        costs = [
            control_cost(found.twin.plant, found.twin.control(policy, *flight)).mean().item() for flight in flights
        ]
        return sum(costs) / len(costs)

    # Before a policy has flown, the twin errs for it as for the controller; then the belief corrects it.
    ratio = on_twin(policy) / on_twin(teacher)
    assert belief.beside_first(policy, teacher)[:2] == pytest.approx((paid * ratio, paid))
    supervisor, before = found.steps["interact"].supervisor, found.generator.get_state()
    others = supervisor.episodes()  # one flight holds no rare end
    assert torch.equal(found.generator.get_state(), before)
    ratio = on_twin(policy, others) / on_twin(teacher, others)
    assert belief.beside_first(policy, teacher, others)[:2] == pytest.approx((paid * ratio, paid))
    starts = torch.tensor([[[0.1, -0.1]], [[0.3, -0.3]]]).double()  # whose sums are equal, and whose costs are not
    for start in starts:
        others = Scenario(start, torch.zeros(1, 20, 1).double())
        ratio = on_twin(policy, others) / on_twin(teacher, others)
        assert belief.beside_first(policy, teacher, others).expected == pytest.approx(paid * ratio)
    others = supervisor.episodes()
    belief.append(record, "model_based", paid)
    expected = belief.expected(policy, on_twin(policy))
    assert belief.beside_first(policy, teacher)[:2] == pytest.approx((expected, paid))
    expected = belief.expected(policy, on_twin(policy, others)) * on_twin(teacher) / on_twin(teacher, others)
    assert belief.beside_first(policy, teacher, others)[:2] == pytest.approx((expected, paid))


@pytest.mark.parametrize(("error", "dearest"), [(1.0, 1.05), (1.2, 2.0)])
def test_a_policy_may_be_dearer_only_while_the_twin_is_wrong(monkeypatch, error, dearest):
    found, record = started(assimilation=AssimilationConfig(iterations=0))
    belief, supervisor = found.belief, found.steps["interact"].supervisor
    costs = {found.first.teacher: 1.0}
    monkeypatch.setattr(found.virtual, "cost", lambda module, episodes, deviation=None: costs[module])
    belief.first = [belief.first[0]._replace(cost=error)]
    for share, allowed in ((dearest - 0.01, True), (dearest + 0.01, False)):
        costs[found.model_based] = share
        reason, _ = supervisor.refusal("model_based", None)
        assert (not reason) == allowed


def test_a_controller_whose_costs_have_no_ratio_is_named():
    found, record = started()
    with pytest.raises(ValueError, match=r"J_a=-1 of a real episode of plant .* is negative"):
        found.belief.append(record, "first", -1.0)
    found.belief.first = [found.belief.first[0]._replace(cost=0.0)]
    # Nor does the twin alone know a controller.
    for each in (found, started(referee=RefereeConfig(rule="decision_tree"))[0]):
        assert each.belief.beside_first(each.model_based, each.first.teacher) is None


def test_each_episode_says_what_the_controller_would_cost_there_on_the_twin():
    found = begun(assimilation=AssimilationConfig(iterations=0))
    found.twin.closure.load_state_dict(found.twin.plant.closure.state_dict())
    found.episode()
    record, (entry,) = found.short_term[-1], first_there(found).values()
    flown = found.first.teacher.fly(record.states[:1], record.exogenous[None], found.twin.plant.closure)
    assert entry == pytest.approx(control_cost(found.twin.plant, flown).item(), rel=1e-9)
    found.belief.first.clear()
    assert not first_there(found)  # nothing flew before the policies, as where they have the weights of an earlier run


def test_a_run_begins_with_its_first_controller_once_and_knows_it_when_it_is_resumed(tmp_path, capsys):
    metrics = small_run(tmp_path / "whole", 2, parts={"first": PD}).train()
    (first, second), unseen = metrics["episodes"], metrics["summary"]["unseen"]
    assert first["start_cost"] > 0.0 and "start_cost" not in second
    assert '"start": "controller"' in (tmp_path / "whole" / "config.json").read_text()
    assert unseen["baselines"].keys() == {"PD"} and len(unseen["costs"]["PD"]) == 3
    ratio = sum(unseen["costs"][metrics["summary"]["live"]]) / sum(unseen["costs"]["PD"])
    assert unseen["baselines"]["PD"]["ratio"]["mean"] == pytest.approx(ratio)
    assert f"costs {ratio:.4g} [" in capsys.readouterr().out
    small_run(tmp_path / "half", 1, parts={"first": PD}).train()
    resumed = small_run(tmp_path / "half", 2, parts={"first": PD}, resume=True)
    assert isinstance(resumed.algorithm.steps["interact"].supervisor.controller, PD)
    summary = resumed.train()["summary"]
    assert summary["first"] == metrics["summary"]["first"] and summary["unseen"]["costs"] == unseen["costs"]


def test_a_run_is_not_resumed_with_another_controller_whose_flights_it_lacks(tmp_path, monkeypatch):
    def resume(first, **parts):
        small_run(tmp_path, 2, parts={"first": first, **parts}, resume=True)

    small_run(tmp_path, 1, parts={"first": PD}).train()
    with pytest.raises(ValueError, match="classical controller.*first.class is Quick here and was PD in the run"):
        resume(type("Quick", (PD,), {}))
    monkeypatch.setattr(PD, "default_gains", (0.3, 0.6))
    with pytest.raises(ValueError, match=r"first.K_2 is \[0.6\] here and was \[0.3\] in the run.* by --start"):
        resume(PD)
    monkeypatch.undo()
    small_run(tmp_path, 1, parts={"first": PD, "baselines": {"new": PD}}, resume=True).train()


def test_a_run_without_a_controller_cannot_begin_with_one(tmp_path):
    with pytest.raises(ValueError, match=r"start='controller' needs the controller: give Run\(..., first=...\)"):
        small_run(tmp_path / "run", start="controller")
    assert not (tmp_path / "run").exists()
