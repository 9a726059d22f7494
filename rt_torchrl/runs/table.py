"""The results of a run in words: the table for the terminal, the line of an episode, and what to do next."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rt_torchrl.runs.console import call_of
from rt_torchrl.runs.metrics import by_place, costs_at_the_end, judged_at_the_end, on_the_twin
from rt_torchrl.runs.run_config import MakesPlant, RunConfig
from rt_torchrl.steps.config import Role
from rt_torchrl.steps.report import in_words
from rt_torchrl.steps.switch import other_than

MOST_WEIGHTS = 12
"""Greatest number of weights of the closure that the table shows."""
MOST_CORRELATIONS = 3
"""Greatest number of correlations of errors that the table shows."""
RELEVANT = 1e-3
"""Share of a cost that counts as a gain; less is rounding, whatever its interval is."""
MOST_ERRORS = 2
"""Number of RMS errors of the twin on the progress line."""
WHERE = {
    "simulation of the real system": (
        " in simulation, with the closure that the real system was given, without noise of the sensors"
    ),
    "twin": " on the twin, not on the real system",
    "simulation": "",
}
"""What the heading says of the place where the unseen episodes were flown; others are named as they are."""


def progress(record: dict[str, Any]) -> str:
    """The costs of an episode and its live policy, as the progress bar shows them."""
    errors = {key.removeprefix("rms/"): value for key, value in record.items() if key.startswith("rms/")}
    named = {"J_a mb": "J_a_model_based", "J_a mf": "J_a_model_free", "real": "real_cost"}
    named["there the first controller on the twin"] = "J_a_first"
    costs = [f"{name} {in_words(record[key])}" for name, key in named.items() if record.get(key) is not None]
    early = [f"ended after {record['ended_after']:.0f} intervals"] if "ended_after" in record else []
    return ", ".join([*rms_words(errors)[:MOST_ERRORS], *costs, *early, f"live {record['live'].replace('_', '-')}"])


def rms_words(errors: dict[str, float | None]) -> list[str]:
    """RMS errors of the twin in words, each with its unit; None stands for one that is not finite.

    Args:
        errors: the errors, by ``STATE [UNIT]``.
    """
    words = []
    for label, value in errors.items():
        name, unit = label.removesuffix("]").split(" [")
        finite = value is not None and math.isfinite(value)
        words.append(f"{name} {value:.3g} {unit}".removesuffix(" -") if finite else f"{name} diverges")
    return [f"RMS {words[0]}", *words[1:]] if words else []


def results_table(metrics: dict[str, Any]) -> str:
    """The table of results that the terminal shows at the end of a run."""
    summary, episodes = metrics["summary"], metrics["episodes"]
    unseen, fitted, paid = summary["unseen"], summary["twin"], summary["cost_of_learning"]
    place, twin = unseen["judged_on"], " on the twin" if on_the_twin(unseen) else ""
    where = WHERE.get(place, f" in {place}")
    if twin and fitted["noise"]:
        where = where.replace(twin, f"{twin} with noise of the sensors")
    width = 22 + len(twin)
    lines = ["", f"{metrics['plant']}, {len(episodes)} episodes, judged on {unseen['episodes']} unseen ones{where}"]
    lines.append(f"  {'cost':<{width}}{'untrained':>12}{'after':>12}   {'95 % interval':<24}{'ratio':>10}")
    # A twin has no J_p on episodes that it has flown itself.
    rows = [] if twin else [("J_p (twin)", "J_p_before", "J_p", summary["J_p_ratio"])]
    for role, before in (("model_based", "J_a_before"), ("model_free", "J_a_before_model_free")):
        rows.append((f"J_a {role.replace('_', '-')}{twin}", before, f"J_a_{role}", summary[f"J_a_ratio_{role}"]))
    for name, before, after, ratio in rows:
        means = f"{_number(unseen[before]['mean'], '.5g'):>12}{_number(unseen[after]['mean'], '.5g'):>12}"
        lines.append(f"  {name:<{width}}{means}   {_interval(unseen[after]):<24}{_number(ratio, '.3g'):>10}")
    if "reference" in summary:
        best, share = (summary["reference"][key] for key in ("J_a", "better_over_reference"))
        best, share = _number(best, ".5g"), _number(share, ".3f")
        lines.append(f"  exact gradients on the true plant: J_a {best}; the better policy is at {share} of it")
    lines += controller_lines(unseen["baselines"], twin, width)
    simulated, *real = by_place(summary).values()
    lines += merit_lines(simulated, twin)
    for controllers in real:
        over = f", over segments of {fitted['segment']} intervals" if fitted["segment"] else ""
        if "J_p" in summary["real_unseen"]:
            before, after = (_number(summary["real_unseen"][key]["mean"], ".5g") for key in ("J_p_before", "J_p"))
            lines.append(f"  J_p on the real system{over}: {after}, with the first closure {before}")
        lines += controller_lines(controllers, " on the real system", width)
        lines += merit_lines(controllers, " on the real system")
    whole, most = (_number(paid[key], ".4g") for key in ("sum", "largest"))
    after = f", {len(paid['judging'])} of them after the training" if "judging" in paid else ""
    lines.append(
        f"  paid on the real system: sum of J_a {whole} over {paid['episodes']} episodes{after}, largest {most}"
    )
    lines += live_lines(summary["live"], episodes, summary["may_not_act"].get(summary["live"], ""))
    lines += [f"  {sentence}" for sentence in [dearer_than_first(summary)] if sentence]
    lines += hypothesis_lines(summary["hypotheses"], summary["believed"])
    # A fit whose residuals are noise has answered the doubts of the first flight.
    if fitted["note"] or not fitted["rms"]:
        lines += [f"  first flight: {doubt}" for doubt in episodes[0].get("doubts", ())]
    lines += alarm_lines(episodes)
    lines += fit_lines(fitted)
    lines += closure_lines(summary["closure"], fitted["standard_errors"])
    lines += law_lines(fitted["law"])
    if high := [f"{pair} {value:.3f}" for pair, value in fitted["correlations"].items()][:MOST_CORRELATIONS]:
        lines.append(f"  correlation of errors: {', '.join(high)}")
    lines += [f"  {note}" for note in [fitted["note"]] if note]
    lines.append("  seconds: " + ", ".join(f"{step} {value:.1f}" for step, value in summary["seconds"].items()))
    return "\n".join(lines)


def live_lines(live: Role, episodes: Sequence[Mapping[str, Any]], reason: str = "") -> list[str]:
    """Lines with the policy that is live at the end, what both are expected to cost, and what each half gave.

    Args:
        live: role of the policy.
        episodes: records of the training.
        reason: why the policy may not act; empty if it may.
    """
    line, last = f"  live at the end: {live.replace('_', '-')}", episodes[-1]
    if f"expected/{live}" in last:
        cost, other = (_number(last[f"expected/{role}"], ".4g") for role in (live, other_than(live)))
        line += f", expected to cost {cost} on the real system in the last virtual episodes, and"
        line += f" {other_than(live).replace('_', '-')} {other}"
    judged = [record["update_accepted"] for record in episodes if "update_accepted" in record]
    if judged:
        line += f"; updates of model-free that were kept while it was live: {sum(judged):.0f} of {len(judged)}"
    clones = [record["episode"] for record in episodes if record["event"] == "clone"]
    line += f"; the idle one was a clone after episode {clones[-1]}" if clones else ""
    return [line, *([f"  {reason}"] if reason else [])]


def controller_lines(controllers: Mapping[str, Any], where: str, width: int) -> list[str]:
    """Lines with what controllers cost, and what the live policy costs beside each in the same episodes."""
    lines = []
    for name, entry in controllers.items():
        mean, label = _number(entry["J_a"]["mean"], ".5g"), f"J_a {name.replace('_', '-')}{where}"
        lines.append(f"  {label:<{width}}{'':>12}{mean:>12}   {_interval(entry['J_a'])}")
        if "ratio" in entry:
            ratio = f"{_number(entry['ratio']['mean'], '.4g')} {_interval(entry['ratio'])}"
            cheaper = f"cheaper in {entry['cheaper']} of {entry['episodes']}"
            lines.append(f"    on the same episodes the live policy costs {ratio} of it, {cheaper}")
    return lines


def _number(value: float | None, digits: str) -> str:
    """A number as text; None, which stands for a number that is not finite, becomes a dash."""
    return "-" if value is None else format(value, digits)


def _interval(statistics: dict[str, Any]) -> str:
    low, high = (_number(end, ".4g") for end in statistics["confidence_interval"])
    return f"[{low}, {high}]"


def merit_lines(controllers: Mapping[str, Any], where: str) -> list[str]:
    """Lines with the plant's own quantities under every controller."""
    merits: list[dict[str, Any]] = [entry["merit"] for entry in controllers.values()]
    if not merits[0]:
        return []
    heading = f"mean (median){where}"
    lines = [f"  {heading:<36}" + "".join(f"{name.replace('_', '-'):>20}" for name in controllers)]
    for name in merits[0]:
        lines.append(f"    {name:<34}" + "".join(f" {_value(merit[name]):>19}" for merit in merits))
    return lines


def _value(merit: dict[str, Any]) -> str:
    """The mean of a quantity, and its median if it has one."""
    return _number(merit["mean"], ".4g") + (f" ({_number(merit['median'], '.4g')})" if "median" in merit else "")


def fit_lines(twin: dict[str, Any]) -> list[str]:
    """Lines with the twin's RMS errors over the records, or the segments, of the last fit, and the sensors' noise."""
    where = f"segments of {twin['segment']} intervals" if twin["segment"] else "its last records"
    entries = {f"twin over {where}": twin["rms"], "noise of the sensors": twin["noise"]}
    return [f"  {name}: {', '.join(rms_words(errors))}" for name, errors in entries.items() if errors]


def closure_lines(closure: dict[str, Any], errors: dict[str, float | None]) -> list[str]:
    """Lines with the closure's weights at the start and as found, with units and meanings that the closure states.

    The true weights of the same names and the standard errors are shown, if there are any.
    """
    weights, true = closure["found"], closure.get("true") or {}
    if not weights or not all(isinstance(value, float | None) for value in weights.values()):
        return []
    if len(weights) > MOST_WEIGHTS:
        return [f"  closure: {len(weights)} weights, in metrics.json"]
    columns = {"start": closure["start"], "found": weights}
    columns |= {"std. error": errors} if errors else {}
    columns |= {"true": true} if weights.keys() & true.keys() else {}
    lines = [f"  {'closure weight':<22}" + "".join(f"{column:>12}" for column in columns)]
    for name in weights:
        description = closure["described"].get(name, {"unit": "", "meaning": ""})
        label = f"{name} [{description['unit']}]" if description["unit"] else name
        cells = {column: _number(values.get(name), ".5g") for column, values in columns.items()}
        if errors.get(name) == 0.0:
            cells["std. error"] = "fixed"
        row = "".join(f"{cell:>12}" for cell in cells.values())
        lines.append(f"  {label:<22}{row}   {description['meaning']}".rstrip())
    if any(error is None or math.isinf(error) for name, error in errors.items() if name in weights):
        lines.append("  std. error -: the records say nothing of the weight alone, at most of combinations with others")
    if errors:
        lines.append("  std. error: of noise alone, not of what the equations lack")
    return lines


def law_lines(law: dict[str, Any]) -> list[str]:
    """Lines with the law of the closure where its last records went; elsewhere it says nothing."""
    if not law:
        return []
    ranges = [f"{name} from {low:.3g} to {high:.3g}" for name, (low, high) in law["features"].items()]
    lines = [f"  law of the closure where its last records went, {', '.join(ranges)}:"]
    for name, output in list(law["outputs"].items())[:MOST_WEIGHTS]:
        low, high = output["range"]
        median, greatest = (_number(output[key], ".2g") for key in ("median", "greatest"))
        lines.append(f"    {name} from {low:.4g} to {high:.4g}, standard error {median} (median), at most {greatest}")
    return lines


def hypothesis_lines(hypotheses: dict[str, Any], believed: str | None) -> list[str]:
    """Lines with what the twin lacks, as the hypotheses that explain the records have found it.

    Args:
        hypotheses: entry ``hypotheses`` of the summary.
        believed: name of the likeliest, whose J_p and closure the table shows.
    """
    lines = []
    for name, hypothesis in hypotheses.items():
        line = f"  beside the twin: {name}, weight {hypothesis['weight']:.2f}"
        for key, value in hypothesis["weights"].items():
            if isinstance(value, float):
                unit = hypothesis["described"].get(key, {}).get("unit", "")
                line += f", {key} = {value:.4g} {unit}".rstrip()
        lines.append(line + ("; J_p and closure weights are its own" if name == believed else ""))
    return lines


def alarm_lines(episodes: list[dict[str, Any]]) -> list[str]:
    """The number of alarms, and the last one."""
    watched = [record for record in episodes if "alarm" in record]
    if not watched:
        return []
    raised = sum(record["alarm"] > 0.0 for record in watched)
    text = f"alarm, the twin is wrong where it matters: in {raised} of {len(watched)} episodes"
    warned = [record for record in watched if record.get("warning")][-1:]
    return [f"  {text}", *(f"  episode {record['episode']}: {record['warning']}" for record in warned)]


def dearer_than_first(summary: Mapping[str, Any]) -> str:
    """That the controller that flew first is expected to cost less than the live policy; empty if it is not."""
    first = summary["first"]
    if first is None or (first["expected"] is not None and first["expected"] <= first["paid"]):
        return ""
    expected = _number(first["expected"], ".4g")
    return (
        f"in the real episodes of the controller that flew first, which cost {first['paid']:.4g}, the live policy is "
        f"expected to cost {expected}"
    )


def clearly_cheaper(summary: Mapping[str, Any], name: str) -> bool:
    """Whether the live policy costs less than a controller by a share that counts, with 95 % confidence.

    The ratio tells it, or disjoint intervals on a real system whose flights were not of the same episodes.
    """
    judged, _ = judged_at_the_end(summary)
    entry, (_, greatest) = judged[name], judged[summary["live"]]["J_a"]["confidence_interval"]
    if "ratio" not in entry:
        return bool(greatest < (1.0 - RELEVANT) * entry["J_a"]["confidence_interval"][0])
    greatest = entry["ratio"]["confidence_interval"][1]
    return greatest is not None and greatest < 1.0 - RELEVANT


def clearly_dearer(summary: Mapping[str, Any], name: str) -> bool:
    """Whether the live policy costs more than a controller on the same episodes, with 95 % confidence."""
    ratio = judged_at_the_end(summary)[0][name].get("ratio")
    return ratio is not None and (ratio["confidence_interval"][0] is None or ratio["confidence_interval"][0] > 1.0)


def next_steps(metrics: dict[str, Any], folder: Path, config: RunConfig | None = None) -> str:
    """What to do with the run, from what its results say: one line for each thing.

    Args:
        metrics: content of ``metrics.json``.
        folder: run folder.
        config: options of the run; where they do not make the plant, the recipes cannot read the run without it.
    """
    summary, alone = metrics["summary"], config is None or isinstance(config, MakesPlant)
    live, (cost, known, place) = summary["live"], costs_at_the_end(summary)
    twin = place == "twin"
    best = min(known, key=known.__getitem__, default=None)
    call = f"rt_torchrl.load_run({str(folder)!r}{'' if alone else ', plant=...'})"
    steps = [f"look: tensorboard --logdir {folder}, or figures/ there; in code: {call}"]
    rival = best if best is not None and not clearly_cheaper(summary, best) else None
    # The few episodes of the controller say less than many on a twin, unless the twin is wrong.
    wrong = twin and bool(metrics["episodes"][-1].get("alarm"))
    if rival is None and (wrong or best is None) and dearer_than_first(summary):
        rival = "the controller that flew first"
    if cost is None:
        where = "unseen episodes on the twin" if twin else "unseen episodes"
        steps.append(f"the live policy diverges on {where}: see `reason` in metrics.json, and train longer")
    elif rival is not None:
        how = "dearer" if rival == best and clearly_dearer(summary, rival) else "not clearly better"
        larger = "" if config is not None and config.policy == "mlp" else "take --policy mlp, "
        steps.append(
            f"the live policy is {how} than {rival}: keep it, let the policy observe what it computes, or give it "
            f"its form (make_policy), {larger}train with more --twinning.planner.iterations, or judge both in more "
            f"episodes (--unseen, --real-unseen); rt_torchrl.diagnose({call}) says why"
        )
    elif summary["better"] != live:
        steps.append(f"the idle policy is the better one ({summary['better'].replace('_', '-')}): export that role")
    elif not alone:
        steps.append(f"take the controller away: rt_torchrl.export_controller(run.policy({live!r}), 'it.c', plant)")
    elif live == "model_based" and config is not None and config.twinning.planner.method == "receding_horizon":
        steps.append(f"take the twin away, on which it plans: {call_of('export')} {folder} --what twin")
    else:
        steps.append(f"take the controller away: {call_of('export')} {folder} --role {live}")
    if (twin or place.startswith("simulation without")) and "real_unseen" not in summary:
        steps.append(
            "judge the live policy on the real system: go on with --resume and, for five flights, --real-unseen 5"
        )
    return "\n".join(f"  next: {step}" for step in steps)
