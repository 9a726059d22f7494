"""The results of a run in numbers, as ``metrics.json`` holds them."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.evaluation.checks import rms_error, visited_features
from rt_torchrl.evaluation.unseen import Baseline, Judged, UnseenEpisodes, mean_with_confidence
from rt_torchrl.plants.closures import described_weights, named_weights
from rt_torchrl.plants.extension import ExtendedClosure
from rt_torchrl.steps.config import Role
from rt_torchrl.steps.hypotheses.ensemble import ALONE, TwinEnsemble
from rt_torchrl.steps.imitation import of_each_role
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

ROLES: tuple[Role, ...] = ("model_based", "model_free")


def episode_record(found: TensorDict, *, episode: int) -> dict[str, Any]:
    """One entry of ``episodes`` in ``metrics.json``, in plain numbers.

    Args:
        found: return value of :meth:`ReinforcementTwinning.episode`.
        episode: number of the episode, from 0.
    """
    record: dict[str, Any] = {"episode": episode, "event": "keep"}
    for key in found.keys():  # noqa: SIM118  (a TensorDict iterates over its batch; items() wraps what is no tensor)
        value = found[key]
        if key == "seconds":
            record["seconds"] = {step: float(seconds) for step, seconds in value.items()}
        else:
            record[key] = value if isinstance(value, str) else float(value)
    return record


def twin_entries(twin: DigitalTwin) -> dict[str, Any]:
    """What the record of an episode says of the twin: named weights of the ``closure``, and whose they are.

    They are those of the twin that is most likely to be right; ``believed`` names its hypothesis, and is None where it
    is the twin alone.
    """
    return {"closure": named_weights(twin.believed_law), "believed": twin.hypothesis}


@torch.no_grad()
def judge(
    unseen: UnseenEpisodes, flights: dict[Role, Trajectory], baselines: Mapping[str, Baseline]
) -> dict[str, Judged]:
    """Judge both policies by their flights, and fly and judge the classical controllers, on the unseen episodes.

    Args:
        unseen: unseen episodes on the real system as it is now.
        flights: flights of both policies on these episodes.
        baselines: controllers to compare the policies with, by name; one under which the system diverges is left out.
    """
    judged: dict[str, Judged] = {role: unseen.judge(flights[role]) for role in ROLES}
    for name, law in baselines.items():
        try:
            judged[name] = unseen.judge(unseen.fly_baseline(law))
        except DivergenceError as error:  # a controller to compare with must not take the results of a training
            warnings.warn(f"baseline {name!r} is left out of the results: {error}", stacklevel=2)
    return judged


@torch.no_grad()
def summarise(
    algorithm: ReinforcementTwinning,
    unseen: UnseenEpisodes,
    flights: dict[Role, Trajectory],
    judged: dict[str, Judged],
    initial_policies: dict[Role, nn.Module],
    initial_closure: nn.Module,
    episodes: list[dict[str, Any]],
    untrained: Float[Tensor, " starts"] | None,
) -> dict[str, Any]:
    """The entry ``summary`` of ``metrics.json``.

    Every ratio is a cost on the unseen episodes after training over the same cost before. J_p before and after belong
    to the same episodes, which the final live policy has flown. What is said of the twin is said of the one that is
    most likely to be right; ``believed`` names its hypothesis, and is None where it is the twin alone.
    """
    closure, live = algorithm.twin.believed_law, algorithm.referee.live
    laws = {"found": closure, "true": unseen.closure, "start": initial_closure}
    before = of_each_role(initial_policies, unseen.control_costs)
    J_p, J_p_before = twin_costs(unseen, algorithm, initial_closure, flights[live])
    after = {role: judged[role].control_costs.mean().item() for role in ROLES}
    better, chosen_on = better_of(algorithm, unseen)
    means = {"J_p": J_p, "J_p_before": J_p_before} | ({} if untrained is None else {"J_a_untrained": untrained})
    means |= {"J_a_before": before["model_based"], "J_a_before_model_free": before["model_free"]}
    return {
        "J_p_ratio": (J_p.mean() / J_p_before.mean()).item(),
        **{f"J_a_ratio_{role}": after[role] / before[role].mean().item() for role in ROLES},
        **over_untrained(after, untrained),
        "unseen": {"episodes": len(unseen.initial_state), "judged_on": unseen.judged_on, "J_p_each": J_p.tolist()}
        | {name: mean_with_confidence(values) for name, values in means.items()}
        | results(unseen, judged),
        "cost_of_learning": cost_of_learning(episodes),
        "live": live,
        "better": better,
        "better_chosen_on": chosen_on,
        "closure": {name: named_weights(law) for name, law in laws.items() if law is not None}
        | {"described": described_weights(closure)},
        "twin": fit_of(algorithm),
        "closure_error": closure_errors(algorithm, initial_closure, unseen.closure),
        "hypotheses": hypotheses_of(algorithm.twin),
        "believed": algorithm.twin.hypothesis,
        "seconds": seconds_per_step(episodes),
    }


def fit_of(algorithm: ReinforcementTwinning) -> dict[str, Any]:
    """How the believed twin replays the records that it was last fitted to.

    ``rms`` holds RMS errors by ``STATE [UNIT]``, over segments of ``segment`` control intervals, or whole records with
    0; ``standard_errors`` those of the closure's coefficients.
    """
    records, assimilation = list(algorithm.short_term), algorithm.assimilation
    if not records or algorithm.config.arm == "model_free":
        return {"rms": {}, "segment": 0, "standard_errors": {}}
    latest, _ = algorithm.virtual.paired(records)
    return {
        "rms": assimilation.rms_errors(latest),
        "segment": assimilation.length,
        "standard_errors": assimilation.standard_errors(latest),
    }


@torch.no_grad()
def better_of(algorithm: ReinforcementTwinning, unseen: UnseenEpisodes) -> tuple[Role, str]:
    """The better policy, and the name of the episodes that decided; its cost is reported on other episodes.

    It is the policy with the smaller mean J_a on validation episodes. On a real system of unknown closure these would
    have to be flown; there it is the live one.
    """
    validation = unseen.validation()
    if validation is None:
        return algorithm.referee.live, "twin"
    costs = of_each_role(algorithm.policies, lambda policy: validation.control_costs(policy).mean().item())
    return min(ROLES, key=costs.__getitem__), "validation episodes"


def over_untrained(after: dict[Role, float], untrained: Float[Tensor, " starts"] | None) -> dict[str, float]:
    """Mean J_a after training over the mean J_a of random initial policies; empty without these."""
    if untrained is None:
        return {}
    return {f"J_a_over_untrained_{role}": cost / untrained.mean().item() for role, cost in after.items()}


def twin_costs(
    unseen: UnseenEpisodes, algorithm: ReinforcementTwinning, initial_closure: nn.Module, flown: Trajectory
) -> list[Float[Tensor, " count"]]:
    """J_p of the believed twin, and of the twin with its initial closure, on the unseen episodes as flown."""
    believed, plant = algorithm.twin.believed, algorithm.twin.plant
    laws = ((believed.plant, believed.closure), (plant, initial_closure))
    return [unseen.identification_costs(physics, closure, flown) for physics, closure in laws]


def results(unseen: UnseenEpisodes, judged: dict[str, Judged]) -> dict[str, Any]:
    """Statistics of all controllers on all unseen episodes, and on each kind of these episodes."""
    overall = {name: found.statistics() for name, found in judged.items()}
    kinds = {name: chosen for name, chosen in unseen.categories().items() if chosen.sum() > 1}
    return {
        **{f"J_a_{role}": overall[role]["J_a"] for role in ROLES},
        "costs": {name: found.control_costs.tolist() for name, found in judged.items()},
        "merit": {role: overall[role]["merit"] for role in ROLES},
        "baselines": {name: found for name, found in overall.items() if name not in ROLES},
        "categories": {
            kind: {"episodes": int(chosen.sum())} | {name: found.statistics(chosen) for name, found in judged.items()}
            for kind, chosen in kinds.items()
        },
    }


def closure_errors(
    algorithm: ReinforcementTwinning, start: nn.Module, true: nn.Module | None
) -> dict[str, list[float]] | None:
    """RMS error of every coefficient of the closures ``found`` and ``start`` along the last real episode.

    It is None if the real system's closure is not known.
    """
    if true is None:
        return None
    laws = {"found": algorithm.twin.believed_law, "start": start}
    features = visited_features(algorithm.twin.plant, algorithm.short_term[-1])
    return {name: rms_error(law, true, features).tolist() for name, law in laws.items()}


def hypotheses_of(twin: DigitalTwin) -> dict[str, Any]:
    """``weight`` and named ``weights`` of what is planned on beside the twin alone, by name; empty if nothing is.

    They are the parameters of all extensions of a hypothesis, in which nested ones have different names.
    """
    if not isinstance(twin, TwinEnsemble):
        return {}
    found: dict[str, Any] = {}
    for name, weight in twin.weights.items():
        if name != ALONE:
            closure = twin.twins[name].closure
            # A delay of whole intervals has no parameters of its own.
            parts = closure.all_own if isinstance(closure, ExtendedClosure) else ()
            weights = {key: value for part in parts for key, value in (named_weights(part) or {}).items()}
            described = {key: value for part in parts for key, value in described_weights(part).items()}
            found[name] = {"weight": weight, "weights": weights, "described": described}
    return found


def cost_of_learning(episodes: list[dict[str, Any]], judging: Sequence[float | None] = ()) -> dict[str, Any]:
    """What the real system has paid: sum and largest of the J_a of all real episodes, with that of the start.

    Args:
        episodes: records of the training.
        judging: J_a of the flights on the real system after it, which count as well; None for one that is not finite.
    """
    costs = [record[key] for record in episodes for key in ("start_cost", "real_cost") if key in record]
    costs += [torch.inf if cost is None else cost for cost in judging]
    found = {"sum": sum(costs), "largest": max(costs), "episodes": len(costs)}
    return found | ({"judging": list(judging)} if judging else {})


def seconds_per_step(episodes: list[dict[str, Any]]) -> dict[str, float]:
    """Wall time of each step over all episodes [s]."""
    total: dict[str, float] = {}
    for record in episodes:
        for step, seconds in record["seconds"].items():
            total[step] = total.get(step, 0.0) + seconds
    return total
