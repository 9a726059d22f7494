"""The results of a run in numbers: the records of ``metrics.json``, the progress line and the table at the end."""

from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.evaluation import Judged, Optimum, UnseenEpisodes, mean_with_confidence
from rt_torchrl.real_episodes import Baseline
from rt_torchrl.switching import Role
from rt_torchrl.trajectory import Trajectory
from rt_torchrl.visited import rms_error, visited_features

ROLES: tuple[Role, ...] = ("model_based", "model_free")


def episode_record(found: TensorDict, *, episode: int, live: str) -> dict[str, Any]:
    """One entry of ``episodes``: what :meth:`ReinforcementTwinning.episode` found, as plain numbers.

    Args:
        found: its return value.
        episode: number of the episode, from 0.
        live: role that acted on the real system in it.
    """
    record: dict[str, Any] = {"episode": episode, "live": live, "event": "keep"}
    for key in found.keys():  # noqa: SIM118  (a TensorDict iterates over its batch; items() wraps what is no tensor)
        value = found[key]
        if key == "seconds":
            record["seconds"] = {step: float(seconds) for step, seconds in value.items()}
        else:
            record[key] = value if isinstance(value, str) else float(value)
    return record


def progress(record: dict[str, Any]) -> str:
    """The part of the progress line behind the bar."""
    costs = [(name, record.get(key)) for name, key in (("J_p", "J_p"), ("J_a mb", "J_a_model_based"))]
    costs += [("J_a mf", record.get("J_a_model_free")), ("real", record["real_cost"])]
    shown = [f"{name} {value:.3g}" for name, value in costs if value is not None]
    return ", ".join([*shown, f"live {record['live'].replace('_', '-')}"])


@torch.no_grad()
def judge(unseen: UnseenEpisodes, flights: dict[Role, Trajectory], baselines: dict[str, Baseline]) -> dict[str, Judged]:
    """Both policies as flown, then the classical controllers, on the unseen episodes of the system as it is."""
    judged = {role: unseen.judge(flights[role]) for role in ROLES}
    return judged | {name: unseen.judge(unseen.fly_baseline(law)) for name, law in baselines.items()}


@torch.no_grad()
def summary(
    algorithm: ReinforcementTwinning,
    unseen: UnseenEpisodes,
    flights: dict[Role, Trajectory],
    judged: dict[str, Judged],
    initial_policies: dict[Role, nn.Module],
    initial_closure: nn.Module,
    episodes: list[dict[str, Any]],
    untrained: Float[Tensor, " starts"] | None,
    optimum: Optimum | None,
) -> dict[str, Any]:
    """The entry ``summary`` of ``metrics.json``; every ratio is a cost after training over the cost before, unseen.

    J_p before and after are of the same episodes, flown by the final live policy.
    """
    closure, live = algorithm.twin.closure, algorithm.switch.live
    laws = {"found": closure, "true": unseen.closure, "start": initial_closure}
    before = {role: unseen.control_costs(initial_policies[role]) for role in ROLES}
    J_p, J_p_before = twin_costs(unseen, algorithm, initial_closure, flights[live])
    after = {role: judged[role].control_costs.mean().item() for role in ROLES}
    better = min(ROLES, key=after.__getitem__)
    means = {"J_p": J_p, "J_p_before": J_p_before} | ({} if untrained is None else {"J_a_untrained": untrained})
    means |= {"J_a_before": before["model_based"], "J_a_before_model_free": before["model_free"]}
    found = {
        "J_p_ratio": (J_p.mean() / J_p_before.mean()).item(),
        **{f"J_a_ratio_{role}": after[role] / before[role].mean().item() for role in ROLES},
        **over_untrained(after, untrained),
        "unseen": {"episodes": len(unseen.initial_state)}
        | {name: mean_with_confidence(values) for name, values in means.items()}
        | results(unseen, judged),
        "live": live,
        "better": better,
        "closure": {name: named_weights(law) for name, law in laws.items() if law is not None},
        "closure_error": closure_errors(algorithm, laws),
        "seconds": seconds_per_step(episodes),
    }
    if optimum is None:
        return found
    reference = {"J_a": optimum.cost, "J_a_of_each_start": optimum.costs}
    return found | {"reference": reference | {"better_over_reference": after[better] / optimum.cost}}


def over_untrained(after: dict[Role, float], untrained: Float[Tensor, " starts"] | None) -> dict[str, float]:
    """Mean J_a after training over that of random starts; nothing without these."""
    if untrained is None:
        return {}
    return {f"J_a_over_untrained_{role}": cost / untrained.mean().item() for role, cost in after.items()}


def twin_costs(
    unseen: UnseenEpisodes, algorithm: ReinforcementTwinning, initial_closure: nn.Module, flown: Trajectory
) -> list[Float[Tensor, " count"]]:
    """J_p of the twin as it is and as it was, on the unseen episodes as flown."""
    twin = algorithm.twin
    return [unseen.identification_costs(twin.plant, closure, flown) for closure in (twin.closure, initial_closure)]


def results(unseen: UnseenEpisodes, judged: dict[str, Judged]) -> dict[str, Any]:
    """What the controllers reach on all unseen episodes, and on each kind of them apart."""
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
    algorithm: ReinforcementTwinning, laws: dict[str, nn.Module | None]
) -> dict[str, list[float]] | None:
    """RMS error of every coefficient of the closures ``found`` and ``start`` where the last real episode went.

    None if the real system's closure is not known.
    """
    if laws["true"] is None:
        return None
    features = visited_features(algorithm.twin.plant, algorithm.short_term[-1])
    return {name: rms_error(laws[name], laws["true"], features).tolist() for name in ("found", "start")}


@torch.no_grad()
def named_weights(closure: nn.Module) -> dict[str, Any] | None:
    """Weights of a closure, in physical units where it has ``named_coefficients``; None if it has no weights."""
    if hasattr(closure, "named_coefficients"):
        return {name: float(value) for name, value in closure.named_coefficients().items()}
    return {name: weight.tolist() for name, weight in closure.named_parameters()} or None


def seconds_per_step(episodes: list[dict[str, Any]]) -> dict[str, float]:
    """Wall time of each step over all episodes [s]."""
    total: dict[str, float] = {}
    for record in episodes:
        for step, seconds in record["seconds"].items():
            total[step] = total.get(step, 0.0) + seconds
    return total


def table(metrics: dict[str, Any]) -> str:
    """The results for the terminal."""
    found = metrics["summary"]
    unseen, n = found["unseen"], found["unseen"]["episodes"]
    lines = ["", f"{metrics['plant']}, {len(metrics['episodes'])} episodes, judged on {n} unseen ones"]
    lines.append(f"  {'cost':<22}{'before':>12}{'after':>12}   {'95 % interval':<24}{'ratio':>10}")
    rows = [("J_p (twin)", "J_p_before", "J_p", found["J_p_ratio"])]
    for role, before in (("model_based", "J_a_before"), ("model_free", "J_a_before_model_free")):
        rows.append((f"J_a {role.replace('_', '-')}", before, f"J_a_{role}", found[f"J_a_ratio_{role}"]))
    for name, before, after, ratio in rows:
        means = f"{unseen[before]['mean']:>12.5g}{unseen[after]['mean']:>12.5g}"
        lines.append(f"  {name:<22}{means}   {_interval(unseen[after]):<24}{ratio:>10.3g}")
    if "J_a_untrained" in unseen:
        shares = ", ".join(f"{role.replace('_', '-')} {found[f'J_a_over_untrained_{role}']:.3g}" for role in ROLES)
        lines.append(f"  over a random start's mean J_a of {unseen['J_a_untrained']['mean']:.4g}: {shares}")
    if "reference" in found:
        best, share = found["reference"]["J_a"], found["reference"]["better_over_reference"]
        lines.append(f"  exact gradients on the true plant: J_a {best:.5g}; the better policy is at {share:.3f} of it")
    for name, baseline in unseen["baselines"].items():
        lines.append(f"  {f'J_a {name}':<22}{'':>12}{baseline['J_a']['mean']:>12.5g}   {_interval(baseline['J_a'])}")
    lines += merit_lines(unseen)
    lines.append(f"  live at the end: {found['live'].replace('_', '-')}")
    lines += closure_lines(found["closure"])
    lines.append("  seconds: " + ", ".join(f"{step} {value:.1f}" for step, value in found["seconds"].items()))
    return "\n".join(lines)


def _interval(found: dict[str, Any]) -> str:
    return "[{:.4g}, {:.4g}]".format(*found["confidence_interval"])


def merit_lines(unseen: dict[str, Any]) -> list[str]:
    """The plant's own quantities under every controller: of all episodes, then with J_a of each kind apart."""
    merits = {role: unseen["merit"][role] for role in ROLES}
    merits |= {name: baseline["merit"] for name, baseline in unseen["baselines"].items()}
    if not merits[ROLES[0]]:
        return []
    lines = [f"  {'mean (median)':<28}" + "".join(f"{name.replace('_', '-'):>20}" for name in merits)]
    lines += _rows(merits)
    for kind, found in unseen["categories"].items():
        lines.append(f"  {kind}, {found['episodes']} of {unseen['episodes']} episodes")
        lines += _rows({name: {"J_a": found[name]["J_a"]} | found[name]["merit"] for name in merits})
    return lines


def _rows(columns: dict[str, dict[str, Any]]) -> list[str]:
    """A line for each quantity."""
    lines = []
    for name in next(iter(columns.values())):
        values = [merit[name] for merit in columns.values()]
        shown = (f"{v['mean']:.4g}" + (f" ({v['median']:.4g})" if "median" in v else "") for v in values)
        lines.append(f"    {name:<26}" + "".join(f"{text:>20}" for text in shown))
    return lines


def closure_lines(closure: dict[str, Any]) -> list[str]:
    """Weights found, beside the true ones where the real plant has the same closure."""
    if not closure["found"] or not all(isinstance(value, float) for value in closure["found"].values()):
        return []
    true = closure.get("true") or {}
    lines = [f"  {'closure weight':<22}{'start':>12}{'found':>12}{'true':>12}"]
    for name, value in closure["found"].items():
        known = f"{true[name]:>12.5g}" if name in true else f"{'-':>12}"
        lines.append(f"  {name:<22}{closure['start'][name]:>12.5g}{value:>12.5g}{known}")
    return lines
