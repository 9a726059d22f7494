"""Good twin, poor policy: which of seven reasons holds in a finished run, and what says so."""

import copy
import math
from typing import Any, NamedTuple

import torch

from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.evaluation.optimum import exact_optimum
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Costs
from rt_torchrl.plants.signal import bounds
from rt_torchrl.runs.loaded_run import LoadedRun
from rt_torchrl.runs.metrics import costs_at_the_end
from rt_torchrl.steps.belief import NOISE
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory

MINIMUM, CLASS, INPUTS, MERIT = 0.03, 0.1, 0.2, 0.2
"""Shares of J_a from which a better minimum, a better controller and dearer inputs count, and share of a merit."""
OVER = 5
"""How many times as many episodes weights are sought on as they are judged in: the best for few fail in others."""
JUMP, OFTEN = 0.5, 0.2
"""Change of an action from one interval to the next, as a share of its range, and share of such changes that count."""


class Reason(NamedTuple):
    """A reason why a policy may be poor.

    Args:
        name: the reason.
        holds: whether it holds; None where the run does not say.
        evidence: the numbers that say so, in words.
        remedy: what to change where it holds.
    """

    name: str
    holds: bool | None
    evidence: str
    remedy: str


def diagnose(run: LoadedRun, *, episodes: int = 10) -> list[Reason]:
    """Ask a finished run why its live policy is not better; each reason is checked by itself.

    What is computed flies the twin that is most likely to be right, in episodes that no training has drawn: the real
    system is not needed. It takes about as long as the option ``reference``, minutes for a perceptron.

    Args:
        run: the finished run.
        episodes: number of episodes, at least 2; more of them tell smaller differences.

    Raises:
        DivergenceError: if the twin diverges under the policy.
    """
    policy, believed = run.policy(run.live), run.twin.believed
    unseen = UnseenEpisodes(believed.plant, episodes)
    unseen.closure, unseen.physics = believed.closure, run.physics
    validation, flown = unseen.validation(OVER), unseen.fly(policy)
    costs = unseen.judge(flown).control_costs
    assert validation is not None  # the closure of a twin is known
    best, minimum = _minimum(run, unseen, validation, costs)
    return [
        _classical(run),
        _twin(run),
        minimum,
        _class(run, unseen, validation, best),
        _inputs(run, costs),
        _merits(run),
        _chattering(believed.plant, flown),
    ]


def _dearer(costs: Costs, others: Costs, share: float) -> bool | None:
    """Whether costs are above others by more than a share on average; None if that is within two standard errors."""
    above = costs - others
    mean, error = above.mean().item(), above.std().item() / math.sqrt(len(above))
    if mean <= share * abs(others.mean().item()):
        return False
    return True if mean > 2.0 * error else None


def _twin(run: LoadedRun) -> Reason:
    """Whether the alarm is up at the end."""
    name, remedy = "the twin is wrong where it matters", "hypotheses about what it lacks, or another closure"
    flown = [entry for entry in run.metrics["episodes"] if entry.get("alarm") is not None]
    if not flown:
        return Reason(name, None, "no real episode was flown again on the twin", remedy)
    last, words = flown[-1], "the last real episode cost {:.3g} times what the twin says"
    evidence = last.get("warning") or words.format(math.exp(last["paired_difference"]))
    return Reason(name, bool(last["alarm"]), evidence, remedy)


def _classical(run: LoadedRun) -> Reason:
    """Whether a classical controller was cheaper at the end, on the real system where it was flown."""
    name = "a classical controller is better"
    remedy = "more twinning.planner.iterations and realisations, observations of what that controller reads, or it"
    cost, known, where = costs_at_the_end(run.metrics["summary"])
    if cost is None or not known:
        return Reason(name, None, "no classical controller flew beside the policy, or it has no finite cost", remedy)
    best = min(known, key=known.__getitem__)
    evidence = f"{best} costs {known[best]:.4g}, the policy {cost:.4g} ({where})"
    return Reason(name, known[best] < cost, evidence, remedy)


def _minimum(run: LoadedRun, unseen: UnseenEpisodes, validation: UnseenEpisodes, costs: Costs) -> tuple[Costs, Reason]:
    """The least costs of this class of policies that are found on the twin, and whether the policy is far above them.

    What is best on some episodes is not so on others: weights are sought on validation episodes.
    """
    name, remedy = "the plan is in a poor minimum", "more twinning.planner.starts or iterations, or another --seed"
    if run.physics.end_cost is not None:
        remedy += ", a policy of at most forty weights, or a running cost that rises steeply before episodes end early"
    role, policy = run.live, run.policy(run.live)
    if isinstance(policy, StateFeedback):
        return costs, Reason(name, None, f"{type(policy).__name__} has no weights that are planned", remedy)

    def drawn(generator: torch.Generator) -> torch.nn.Module:
        return run.config.make_policies(run.physics, generator)[role]

    count = len(validation.initial_state)
    present = exact_optimum(validation, lambda generator: copy.deepcopy(policy), starts=1, few=count)
    candidates = exact_optimum(validation, drawn), present
    best = unseen.control_costs(min(candidates, key=lambda optimum: optimum.cost).policy)
    where = f"in {len(costs)} other episodes on the twin"
    evidence = f"{where} the policy costs {costs.mean():.4g}, and {best.mean():.4g} with the best weights found"
    # A search that ends far above the policy is poor itself, and says nothing of the plan.
    holds = None if _dearer(best, costs, MINIMUM) else _dearer(costs, best, MINIMUM)
    return min(costs, best, key=torch.mean), Reason(name, holds, evidence, remedy)


def _class(run: LoadedRun, unseen: UnseenEpisodes, validation: UnseenEpisodes, best: Costs) -> Reason:
    """Whether a controller that plans at every step is better on the twin than the best policy of the class.

    One that is worse says nothing: it may lack plans, such as for the tank's half-open valve, or a forecast.
    """
    name, remedy = "the class of policies is too small", "further observations, --policy mlp with more hidden units"
    if run.physics.end_cost is not None:
        return Reason(name, None, "model predictive control does not consider that an episode may end early", remedy)
    window = run.config.twinning.planner.receding_horizon
    controller = PredictiveControl(unseen.plant, unseen.known_closure(), window)
    controller.learn(validation.exogenous)
    costs = unseen.control_costs(controller)
    evidence = f"model predictive control costs {costs.mean():.4g} on the twin, the best of the class {best.mean():.4g}"
    holds = None if _dearer(costs, best, CLASS) else _dearer(best, costs, CLASS)
    return Reason(name, holds, evidence, f"{remedy}, or model predictive control (--preset mpc)" if holds else remedy)


def _inputs(run: LoadedRun, costs: Costs) -> Reason:
    """Whether episodes that no training has drawn cost more on the twin than those that plans were made on."""
    name = "unseen inputs differ from those that plans were made on"
    remedy = "records of other conditions, or --twinning.exogenous.large-scale mixed or drawn"
    entries = run.metrics["episodes"]
    planned = [entry["J_a_plan"] for entry in entries if entry.get("J_a_plan") is not None]
    if not planned:
        return Reason(name, None, "no plan was made", remedy)
    corrected = abs(entries[-1].get("paired_difference") or 0.0) > NOISE
    if corrected or run.live != "model_based":
        return Reason(name, None, "what the last plan expected is not the cost of the live policy on the twin", remedy)
    evidence = f"unseen episodes cost {costs.mean():.4g} on the twin, the last plan expected {planned[-1]:.4g}"
    return Reason(name, _dearer(costs, costs.new_full((1,), planned[-1]), INPUTS), evidence, remedy)


def _merits(run: LoadedRun) -> Reason:
    """Whether the policy is cheaper than a classical controller, and yet another one in what users look at.

    A plant does not say whether more of a quantity is better, so that the user has to judge.
    """
    name, remedy = "the cost is not what was meant", "weights of the cost (docs/observations_and_costs.md)"
    unseen: dict[str, Any] = run.metrics["summary"]["unseen"]
    live, others = run.live, unseen["baselines"]
    merit = unseen["merit"][live]
    if not merit or not others:
        missing = "the plant has no merit" if others else "no classical controller flew beside the policy"
        return Reason(name, None, missing, remedy)
    cost, differences = unseen[f"J_a_{live}"]["mean"], []
    costs = {key: other["J_a"]["mean"] for key, other in others.items()}
    dearer = [key for key, its_cost in costs.items() if None not in (cost, its_cost) and cost < its_cost]
    if not dearer:
        return Reason(name, False, "it is cheaper than no classical controller", remedy)
    for key in dearer:
        for quantity, value in merit.items():
            mean, its_mean = value["mean"], others[key]["merit"][quantity]["mean"]
            if None not in (mean, its_mean) and abs(mean - its_mean) > MERIT * abs(its_mean):
                differences.append(f"{quantity} {mean:.3g} against {its_mean:.3g} of {key}")
    if differences:
        return Reason(name, None, f"it is cheaper; judge whether it is better: {'; '.join(differences)}", remedy)
    return Reason(name, False, f"it is cheaper than {', '.join(dearer)}, and alike in every merit", remedy)


def _chattering(plant: Plant, flown: Trajectory) -> Reason:
    """Whether an action jumps to and fro every few intervals, as in a limit cycle between the ends of its range."""
    name, remedy = "the policy chatters", "a price on changes of the action in the cost, or a shorter dt"
    low, high = bounds(plant.actions, device=flown.actions.device)
    jumps = (flown.actions.diff(dim=1).abs() > JUMP * (high - low)).double().mean((0, 1))
    worst = int(jumps.argmax())
    where = f"in {100.0 * jumps[worst]:.3g} % of the intervals on the twin"
    evidence = f"{plant.actions[worst].name} changes by more than half its range {where}"
    return Reason(name, bool(jumps[worst] > OFTEN), evidence, remedy)
