"""The results of a run in numbers, as ``metrics.json`` holds them, with those of flights after the training."""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.atomic_file import finite
from rt_torchrl.evaluation.law import asked_features, name_of, varying
from rt_torchrl.evaluation.unseen import (
    Baseline,
    Judged,
    RealEpisodes,
    UnseenEpisodes,
    compared,
    mean_with_confidence,
)
from rt_torchrl.fit.least_squares import not_white
from rt_torchrl.fit.uncertainty import Uncertainty
from rt_torchrl.plants.closures import described_weights, named_weights
from rt_torchrl.plants.extension import ExtendedClosure
from rt_torchrl.runs.metrics import read_metrics, real_costs
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.steps.config import ROLES, Role
from rt_torchrl.steps.hypotheses.ensemble import ALONE, TwinEnsemble
from rt_torchrl.steps.switch import clones, of_each_role
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import Remembering, StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

HIGH_CORRELATION = 0.9
"""Correlation of the errors of two coefficients that the results name."""
LAW_ROWS = 100
"""Number of visited features at which the law of the closure is judged."""


def episode_record(entries: TensorDict, *, episode: int) -> dict[str, Any]:
    """One entry of ``episodes`` in ``metrics.json``, in plain numbers.

    Args:
        entries: return value of :meth:`ReinforcementTwinning.episode`.
        episode: number of the episode, from 1.
    """
    record: dict[str, Any] = {"episode": episode, "event": "keep"}
    for key in entries.keys():  # noqa: SIM118  (a TensorDict iterates over its batch; items() wraps what is no tensor)
        value = entries[key]
        if key == "seconds":
            record["seconds"] = {step: float(seconds) for step, seconds in value.items()}
        else:
            record[key] = value if isinstance(value, str) else float(value)
    return record


def first_there(algorithm: ReinforcementTwinning) -> dict[str, float]:
    """``J_a_first`` of the controller that flew first: what it would cost in the last real episode, on the twin.

    Real costs alone do not compare: starts and inputs make episodes dear that a policy flies well. It is left out of a
    part of an episode, and of a controller that plans, whose episodes take too long.
    """
    belief, record = algorithm.belief, algorithm.short_term[-1]
    controller = algorithm.first.teacher if algorithm.first is not None and belief.first else None
    plans = isinstance(controller, StateFeedback) and not isinstance(controller, Remembering)
    whole = bool(belief.flown) and belief.flown[-1].trajectory is record
    if controller is None or plans or not whole or algorithm.config.arm == "model_free":
        return {}
    return {"J_a_first": belief.virtual.cost(controller, belief.virtual.repeated(record))}


def twin_entries(twin: DigitalTwin) -> dict[str, Any]:
    """What the record of an episode says of the twin: named weights of the ``closure``, and whose they are.

    They are those of the twin that is most likely to be right; ``believed`` names its hypothesis, and is None where it
    is the twin alone.
    """
    return {"closure": named_weights(twin.believed_law), "believed": twin.hypothesis}


@torch.no_grad()
def flights_of(
    unseen: UnseenEpisodes, policies: Mapping[Role, nn.Module], baselines: Mapping[str, Baseline]
) -> dict[str, Trajectory]:
    """The unseen episodes under both policies and under the classical controllers, by name.

    Args:
        unseen: unseen episodes on the real system as it is now.
        policies: both policies by role.
        baselines: controllers to compare the policies with, by name; one under which the system diverges is left out.
    """
    flights: dict[str, Trajectory] = dict(of_each_role(policies, unseen.fly).items())
    for name, law in baselines.items():
        try:
            flights[name] = unseen.fly(law)
        except DivergenceError as error:  # a controller to compare with must not take the results of a training
            warnings.warn(f"baseline {name!r} is left out of the results: {error}", stacklevel=2)
    return flights


@torch.no_grad()
def summarise(
    algorithm: ReinforcementTwinning,
    unseen: UnseenEpisodes,
    flights: dict[str, Trajectory],
    judged: dict[str, Judged],
    initial_policies: dict[Role, nn.Module],
    initial_closure: nn.Module,
    refusals: Mapping[Role, str],
) -> dict[str, Any]:
    """What the entry ``summary`` of ``metrics.json`` says of twin and policies.

    Every ratio is a cost on the unseen episodes after training over the same cost before. J_p before and after belong
    to the same episodes, which the final live policy has flown. What is said of the twin is said of the one that is
    most likely to be right; ``believed`` names its hypothesis, and is None where it is the twin alone. ``first`` says
    what the live policy is ``expected`` to cost where the controller that flew first ``paid`` so much; None without.
    """
    closure, live = algorithm.twin.believed_law, algorithm.referee.live
    laws = {"found": closure, "true": unseen.closure, "start": initial_closure}
    before = of_each_role(initial_policies, unseen.control_costs)
    J_p, J_p_before = twin_costs(unseen, algorithm, initial_closure, flights[live])
    after = {role: judged[role].control_costs.mean().item() for role in ROLES}
    teacher = None if algorithm.first is None else algorithm.first.teacher
    first = algorithm.belief.beside_first(algorithm.policies[live], teacher)
    means = {"J_p": J_p, "J_p_before": J_p_before}
    means |= {"J_a_before": before["model_based"], "J_a_before_model_free": before["model_free"]}
    overall = {name: judgement.statistics() for name, judgement in judged.items()}
    baselines = {
        name: overall[name] | compared(judged[live].control_costs, judgement.control_costs)
        for name, judgement in judged.items()
        if name not in ROLES
    }
    return {
        "J_p_ratio": (J_p.mean() / J_p_before.mean()).item(),
        **{f"J_a_ratio_{role}": after[role] / before[role].mean().item() for role in ROLES},
        "unseen": {
            "episodes": len(unseen.initial_state),
            "judged_on": unseen.judged_on,
            "J_p_each": J_p.tolist(),
            **{name: mean_with_confidence(values) for name, values in means.items()},
            **{f"J_a_{role}": overall[role]["J_a"] for role in ROLES},
            "costs": {name: judgement.control_costs.tolist() for name, judgement in judged.items()},
            "merit": {role: overall[role]["merit"] for role in ROLES},
            "baselines": baselines,
        },
        "live": live,
        "may_not_act": dict(refusals),
        "first": None if first is None else {"expected": first.expected, "paid": first.paid},
        "better": better_of(algorithm, unseen),
        "closure": {name: named_weights(law) for name, law in laws.items() if law is not None}
        | {"described": described_weights(closure)},
        "twin": fit_of(algorithm),
        "hypotheses": hypotheses_of(algorithm.twin),
        "believed": algorithm.twin.hypothesis,
    }


def fit_of(algorithm: ReinforcementTwinning) -> dict[str, Any]:
    """How the believed twin replays the records that it was last fitted to.

    ``rms`` holds RMS errors by ``STATE [UNIT]``, over segments of ``segment`` control intervals, or whole records with
    0; ``noise`` the noise of the sensors; ``standard_errors`` those of the closure's coefficients, ``correlations`` of
    these beyond 0.9, the greatest ones first, ``note`` what the standard errors do not hold, in words, and ``law`` what
    outputs of the closure that depend on its features are worth, see :func:`law_of`.
    """
    records, assimilation = list(algorithm.short_term), algorithm.assimilation
    fitted: dict[str, Any] = {"segment": 0, "note": ""}
    fitted |= {name: {} for name in ("rms", "noise", "standard_errors", "correlations", "law")}
    if not records or algorithm.config.arm == "model_free":
        return fitted
    plant = algorithm.twin.plant
    levels = zip(plant.readings, algorithm.twin.noise.tolist(), strict=True)
    sensors = [(signal, level) for signal, level in levels if level and signal.name not in plant.controller_states]
    latest, _ = algorithm.virtual.paired(records)
    uncertainty = assimilation.uncertainty(latest)
    if uncertainty is not None:
        law = law_of(algorithm.twin, latest, uncertainty)
        fitted |= {"note": not_white(uncertainty.likelihood), "law": law}
        if hasattr(algorithm.twin.believed.closure, "named_coefficients"):
            errors, correlations = uncertainty.standard_errors(), high_correlations(uncertainty)
            fitted |= {"standard_errors": errors, "correlations": correlations}
    return fitted | {
        "rms": assimilation.rms_errors(latest),
        "segment": assimilation.length,
        "noise": {f"{signal.name} [{signal.unit}]": level for signal, level in sensors},
    }


def law_of(twin: DigitalTwin, records: Sequence[Trajectory], uncertainty: Uncertainty) -> dict[str, Any]:
    """The range of each of the ``features`` in the records, and of each output that depends on them, by name and unit.

    An output has its ``range`` and the ``median`` and the ``greatest`` of its standard errors there. It is empty if no
    output depends on the features.
    """
    features = asked_features(twin, records)
    values = twin.believed_law(features) if len(features) else features
    places = varying(values)
    if not places:
        return {}
    visited = features[:: max(1, len(features) // LAW_ROWS)]
    errors = uncertainty.errors_of(lambda: twin.believed_law(visited)[:, places])
    plant, outputs = twin.believed.plant.innermost, dict[str, Any]()
    for k, error in zip(places, errors.T, strict=True):
        spread = {"median": error.quantile(0.5).item(), "greatest": error.max().item()}
        outputs[name_of(plant.closure_outputs, k, "output")] = {"range": _ends(values[:, k])} | spread
    inputs = [name_of(plant.closure_inputs, k, "feature") for k in range(features.shape[-1])]
    return {"features": dict(zip(inputs, map(_ends, features.T), strict=True)), "outputs": outputs}


def _ends(values: Tensor) -> list[float]:
    """The least and the greatest value."""
    return [values.min().item(), values.max().item()]


def high_correlations(uncertainty: Uncertainty) -> dict[str, float]:
    """Correlations of the errors of two coefficients beyond ``HIGH_CORRELATION``, the greatest ones first."""
    R, names = uncertainty.correlations(), uncertainty.names  # nan for those of which the data say nothing
    pairs = (R.abs() > HIGH_CORRELATION).triu(1).nonzero().tolist()
    found = {f"{names[i]} and {names[j]}": R[i, j].item() for i, j in pairs}
    return dict(sorted(found.items(), key=lambda pair: -abs(pair[1])))


@torch.no_grad()
def better_of(algorithm: ReinforcementTwinning, unseen: UnseenEpisodes) -> Role:
    """The better policy; its cost is reported on other episodes.

    It is the policy with the smaller mean J_a on validation episodes. On a real system of unknown closure these would
    have to be flown; there it is the live one.
    """
    validation = unseen.validation()
    if validation is None:
        return algorithm.referee.live
    costs = of_each_role(algorithm.policies, lambda policy: validation.control_costs(policy).mean().item())
    return min(ROLES, key=costs.__getitem__)


def twin_costs(
    unseen: UnseenEpisodes, algorithm: ReinforcementTwinning, initial_closure: nn.Module, flown: Trajectory
) -> list[Float[Tensor, " count"]]:
    """J_p of the believed twin, and of the twin with its initial closure, on the unseen episodes as flown.

    They are those of the segments over which the twin was last fitted.
    """
    believed, plant = algorithm.twin.believed, algorithm.twin.plant
    laws, segment = ((believed.plant, believed.closure), (plant, initial_closure)), algorithm.assimilation.length
    return [unseen.identification_costs(physics, closure, flown, segment) for physics, closure in laws]


def hypotheses_of(twin: DigitalTwin) -> dict[str, Any]:
    """``weight`` and named ``weights`` of what is planned on beside the twin alone, by name; empty if nothing is.

    They are the parameters of all extensions of a hypothesis, in which nested ones have different names.
    """
    if not isinstance(twin, TwinEnsemble):
        return {}
    hypotheses: dict[str, Any] = {}
    for name, weight in twin.weights.items():
        if name == ALONE:
            continue
        closure = twin.twins[name].closure
        weights: dict[str, Any] = {}
        described: dict[str, Any] = {}
        # A delay of whole intervals has no parameters of its own.
        for part in closure.extension_parameters if isinstance(closure, ExtendedClosure) else ():
            weights |= named_weights(part) or {}
            described |= described_weights(part)
        hypotheses[name] = {"weight": weight, "weights": weights, "described": described}
    return hypotheses


def cost_of_learning(episodes: list[dict[str, Any]], judging: Sequence[float | None] = ()) -> dict[str, Any]:
    """What the real system has paid: sum and largest of the J_a of all real episodes, with that of the start.

    Args:
        episodes: records of the training.
        judging: J_a of the flights on the real system after it, which count as well; None for one that is not finite.
    """
    costs = [record["start_cost"] for record in episodes if "start_cost" in record]
    costs += [torch.inf if cost is None else cost for cost in (*real_costs(episodes), *judging)]
    windows = [record["largest_cost"] for record in episodes if "largest_cost" in record]
    paid = {"sum": sum(costs), "largest": max(costs + windows), "episodes": len(costs)}
    return paid | ({"judging": list(judging)} if judging else {})


def seconds_per_step(episodes: list[dict[str, Any]]) -> dict[str, float]:
    """Wall time of each step over all episodes [s]."""
    total = Counter[str]()
    for record in episodes:
        total.update(record["seconds"])
    return dict(total)


def grounded(
    config: RunConfig,
    algorithm: ReinforcementTwinning,
    untrained: Mapping[Role, nn.Module],
    refusals: Mapping[Role, str],
) -> str:
    """Why the live policy does not fly the real system after the training; empty if it does.

    It does not where it still has the random weights that it began with, and where it may not act.

    Args:
        config: options of the run.
        algorithm: the training at its end.
        untrained: the policies before it.
        refusals: why policies may not act, see :func:`refused`.
    """
    live = algorithm.referee.live
    policy = algorithm.policies[live]
    if config.start == "random" and not isinstance(policy, StateFeedback) and clones(policy, untrained[live]):
        return f"{live} has its random initial weights"
    return refusals.get(live, "")


def refused(algorithm: ReinforcementTwinning) -> dict[Role, str]:
    """Why policies may not act, by role, at the end of a training."""
    supervisor = algorithm.steps["interact"].supervisor
    episodes = supervisor.checked()
    reasons = {role: supervisor.refusal(role, episodes)[0] for role in supervisor.policies}
    return {role: reason for role, reason in reasons.items() if reason}


def entries(
    episodes: RealEpisodes, flights: Mapping[str, Trajectory], judged: Mapping[str, Judged], live: Role
) -> dict[str, Any]:
    """The entry ``real_unseen`` of the summary, without J_p.

    Where the live policy flew the same episodes as another controller, ``ratio`` is the mean of its costs over that of
    the other one, with a confidence interval, and ``cheaper`` the number of episodes in which it is cheaper.

    Args:
        episodes: the episodes on the real system.
        flights: flights by the name of the controller.
        judged: what these cost.
        live: name of the live policy, which need not have flown.
    """
    controllers, ends = {}, {name: episodes.to_their_end(flown) for name, flown in flights.items()}
    for name, judgement in judged.items():
        controllers[name] = judgement.statistics()
        if name != live and live in flights and all(map(_same_episode, ends[name], ends[live])):
            controllers[name] |= compared(judged[live].control_costs, judgement.control_costs)
    return {
        "controllers": controllers,
        "costs": {name: judgement.control_costs.tolist() for name, judgement in judged.items()},
    }


def _same_episode(flown: Trajectory, other: Trajectory) -> bool:
    """Whether starts are the same, and inputs until one of both ends early: nothing is read after that."""
    n = min(len(flown.exogenous), len(other.exogenous))
    return torch.equal(flown.states[0], other.states[0]) and torch.equal(flown.exogenous[:n], other.exogenous[:n])


def judged_before(folder: Path, episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """The entry ``real_unseen`` that an earlier end of a run has left after the same episodes; None without."""
    if not (folder / "metrics.json").is_file():
        return None
    metrics = read_metrics(folder)
    entry: dict[str, Any] | None = metrics["summary"].get("real_unseen")
    return entry if metrics["episodes"] == finite(list(episodes)) else None


def paid_before(folder: Path) -> list[float | None]:
    """J_a of the flights that earlier ends of a resumed run have made; null stands for one that is not finite."""
    if not (folder / "metrics.json").is_file():
        return []
    return list(read_metrics(folder)["summary"]["cost_of_learning"].get("judging", []))
