"""The page of a finished run: one HTML file without a server, whose plots can be zoomed and read."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.evaluation.unseen import UNSEEN_SEED
from rt_torchrl.figures.style import REAL, REFERENCE, ROLES, TWIN, array, role_name, time_axis
from rt_torchrl.plants.signal import Signal
from rt_torchrl.plants.state_bounds import OUTSIDE
from rt_torchrl.runs.loaded_run import LoadedRun
from rt_torchrl.runs.settings import RAN, read_settings
from rt_torchrl.runs.summary import on_the_twin

if TYPE_CHECKING:
    import plotly.graph_objects as go  # only its types

FILE = "report.html"
PALE = 0.45
"""Opacity of curves that stand behind others."""


def write_report(run: LoadedRun) -> Path:
    """Write ``report.html`` into the folder of a finished run: the story of the training, with interactive plots.

    Args:
        run: the finished run.

    Returns:
        Path of the file, which holds everything that it shows.

    Raises:
        ValueError: if Plotly is missing, or the run has no results.
        OSError: if the file cannot be written.
    """
    try:
        import plotly.io
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise ValueError("a report needs Plotly: install the extra, pip install 'rt_torchrl[report]'.") from error
    metrics = run.metrics
    plots = plots_of(run, metrics)
    parts = [
        {
            "title": title,
            "says": says,
            "html": plotly.io.to_html(
                plot,
                full_html=False,
                include_plotlyjs=k == 0,
                div_id=f"plot-{k}",
                config={"responsive": True, "displaylogo": False},
            ),
        }
        for k, (title, says, plot) in enumerate(plots)
    ]
    page = Environment(loader=PackageLoader("rt_torchrl.runs", "."), autoescape=True, undefined=StrictUndefined)
    path = run.folder / FILE
    html = page.get_template("report.html.jinja").render(
        plant=metrics["plant"].replace("_", " "),
        folder=run.folder.name,
        numbers=numbers(metrics),
        story=story(metrics),
        bounds=bounds(metrics),
        parts=parts,
        ran=(read_settings(run.folder).get(RAN) or [{}])[-1],
    )
    write_atomically(path, html.encode())
    return path


def numbers(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """What a reader wants to know first: a number as text, and what it is."""
    found = metrics["summary"]
    unseen, live = found["unseen"], found["live"]
    where = " on the twin" if on_the_twin(unseen) else ""
    shown = [(_text(unseen[f"J_a_{live}"]["mean"]), f"cost of the live policy ({role_name(live)}){where}")]
    shown += [(_text(law["J_a"]["mean"]), f"cost of {name}") for name, law in unseen["baselines"].items()]
    for name, one in found.get("real_unseen", {}).get("controllers", {}).items():
        shown.append((_text(one["J_a"]["mean"]), f"cost of {role_name(name)} on the real system"))
    paid = found["cost_of_learning"]
    shown.append((_text(paid["sum"]), f"paid on the real system in {paid['episodes']} episodes"))
    if not where:  # a twin has no error on episodes that it has flown itself
        shown.append((_text(found["J_p_ratio"]), "the twin's error, after over before"))
    return shown


def bounds(metrics: dict[str, Any]) -> list[list[str]]:
    """How often, and how far at most, bounded states were beyond their bounds on the unseen episodes.

    Returns:
        Rows of a table, the names of the controllers first; none without bounds.
    """
    unseen = metrics["summary"]["unseen"]
    merits: dict[str, Any] = {role_name(role): unseen["merit"][role] for role in ROLES}
    merits |= {name: law["merit"] for name, law in unseen["baselines"].items()}
    first = next(iter(merits.values()))
    bounded = {name.removesuffix(OUTSIDE) for name in first if name.endswith(OUTSIDE)}
    shown = [name for name in first if name.split(" ")[0] in bounded]
    rows = [[name, *(_text(merit[name]["mean"]) for merit in merits.values())] for name in shown]
    where = " on the twin" if on_the_twin(unseen) else ""
    return [[f"mean over the episodes{where}", *merits], *rows] if rows else []


def story(metrics: dict[str, Any]) -> list[str]:
    """What happened in the training, a sentence for each event, in the order of the episodes."""
    told: list[str] = []
    for episode in metrics["episodes"]:
        k, live = episode["episode"], role_name(episode["live"])
        if "start_cost" in episode:
            told.append(
                f"Before the first episode the policies learned from a flight of cost {_text(episode['start_cost'])}."
            )
        if not told or k == 0:
            told.append(f"Episode {k}: the {live} policy acts first and costs {_text(episode['real_cost'])}.")
        if "ended_after" in episode:
            told.append(f"Episode {k}: the episode ends early, after {episode['ended_after']:g} control intervals.")
        if episode.get("event") == "swap":
            told.append(f"Episode {k}: the {live} policy hands over to the other one.")
        if episode.get("event") == "clone":
            told.append(f"Episode {k}: the idle policy becomes a copy of the {live} one.")
        if episode.get("closure_refused"):
            told.append(f"Episode {k}: the new closure made the twin diverge and was refused.")
        told += [f"Episode {k}: {episode[key]}." for key in ("reason", "warning") if episode.get(key)]
        if episode.get("episodes_refused"):
            told.append(
                f"Episode {k}: the safety layer refused {episode['episodes_refused']:g} flights before this one."
            )
    kept = [episode.get("plan_accepted") for episode in metrics["episodes"] if "plan_accepted" in episode]
    if kept:
        told.append(f"{sum(map(bool, kept))} of {len(kept)} plans were better than the policy before and were kept.")
    last = metrics["episodes"][-1]
    told.append(f"The last episode costs {_text(last['real_cost'])}, with the {role_name(last['live'])} policy.")
    return told


def plots_of(run: LoadedRun, metrics: dict[str, Any]) -> "list[tuple[str, str, go.Figure]]":
    """Title, explanation and plot of each part of the page."""
    flown = {role: run.simulate(run.policy(role), seed=UNSEEN_SEED) for role in ROLES}
    live, where = run.live, " on the twin" if on_the_twin(metrics["summary"]["unseen"]) else ""
    record = flown[live]
    read = run.physics.at_rest(record.states[..., : len(run.plant.readings)])
    replay = run.twin.replayed(record._replace(states=read))
    found = [
        ("Cost", "What each real episode cost, by who acted, beside the twin's view of both policies.", costs(metrics)),
        (f"Cost on unseen episodes{where}", "A box for each controller, over the same episodes.", boxes(metrics)),
    ]
    if any("J_p" in episode for episode in metrics["episodes"]):
        says = "How far the twin was from each real episode, before and after it had learned from it."
        found.append(("The twin's error", says, twin_error(metrics)))
    signals = run.plant.readings
    traces = {"real": (read, REAL, 2.0), "twin": (replay, TWIN, 1.0)}
    says = f"An episode that no training has seen, under the {role_name(live)} policy; the twin takes the same actions."
    found.append(("Twin against real", says, time_plot(run, signals, traces)))
    acted = {role_name(role): (one.actions, ROLES[role], 1.5) for role, one in flown.items()}
    says = "The actions of both policies in the same episode, from the same state."
    found.append(("Policies", says, time_plot(run, run.plant.actions, acted)))
    return found


def costs(metrics: dict[str, Any]) -> "go.Figure":
    """J_a over the episodes; classical controllers are lines."""
    import plotly.graph_objects as go

    plot, episodes = _plot("control cost J_a", "episode"), metrics["episodes"]
    number = [episode["episode"] for episode in episodes]
    for role, colour in ROLES.items():
        line = {"color": colour, "dash": "dot"}
        on_twin = [episode.get(f"J_a_{role}") for episode in episodes]
        plot.add_trace(go.Scatter(x=number, y=on_twin, line=line, name=f"{role_name(role)}, twin", opacity=PALE))
        chosen = [(e["episode"], e["real_cost"]) for e in episodes if e["live"] == role]
        x, y = zip(*chosen, strict=True) if chosen else ((), ())
        marker = {"color": colour, "size": 9}
        plot.add_trace(go.Scatter(x=x, y=y, mode="markers", marker=marker, name=f"real, {role_name(role)} acts"))
    if any("J_a_unseen" in episode for episode in episodes):
        seen = [episode.get("J_a_unseen") for episode in episodes]
        plot.add_trace(go.Scatter(x=number, y=seen, line={"color": REAL}, name="live policy, unseen episodes"))
    if any("J_a_unseen_on_the_twin" in episode for episode in episodes):
        seen = [episode.get("J_a_unseen_on_the_twin") for episode in episodes]
        plot.add_trace(go.Scatter(x=number, y=seen, line={"color": TWIN}, name="live policy, unseen episodes, twin"))
    for name, law in metrics["summary"]["unseen"]["baselines"].items():
        ends = [number[0], number[-1]]
        line = {"color": REFERENCE, "dash": "dash"}
        mean = [law["J_a"]["mean"]] * 2
        plot.add_trace(go.Scatter(x=ends, y=mean, mode="lines", line=line, name=name))
    return plot.update_yaxes(type="log")


def boxes(metrics: dict[str, Any]) -> "go.Figure":
    """J_a of every unseen episode, a box for each controller."""
    import plotly.graph_objects as go

    plot = _plot("control cost J_a", "")
    for name, values in metrics["summary"]["unseen"]["costs"].items():
        colour = {str(role): colour for role, colour in ROLES.items()}.get(name, REFERENCE)
        look = {"marker_color": colour, "boxpoints": "all", "showlegend": False}
        plot.add_trace(go.Box(y=values, name=name.replace("_", "-"), **look))
    return plot.update_yaxes(type="log")


def twin_error(metrics: dict[str, Any]) -> "go.Figure":
    """J_p over the episodes, before and after assimilation."""
    import plotly.graph_objects as go

    plot, episodes = _plot("identification cost J_p", "episode"), metrics["episodes"]
    number = [episode["episode"] for episode in episodes]
    for key, name, colour in (("J_p_before", "before assimilation", "gray"), ("J_p", "after assimilation", TWIN)):
        values = [episode.get(key) for episode in episodes]
        plot.add_trace(go.Scatter(x=number, y=values, mode="lines+markers", line={"color": colour}, name=name))
    return plot.update_yaxes(type="log")


def time_plot(
    run: LoadedRun, signals: Sequence[Signal], traces: dict[str, tuple[torch.Tensor, str, float]]
) -> "go.Figure":
    """Signals over time, one below the other on one axis of time.

    Args:
        run: the finished run.
        signals: signals of the columns.
        traces: values, colour and width of each curve, by name.
    """
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    titles = [f"{signal.name.replace('_', ' ')} [{signal.unit}]" for signal in signals]
    plot = make_subplots(
        len(signals), 1, shared_xaxes=True, subplot_titles=titles, vertical_spacing=0.25 / len(signals)
    )
    for name, (values, colour, width) in traces.items():
        time, label = time_axis(run.plant, len(values))
        for k in range(len(signals)):
            look = {"color": colour, "width": width}
            shown = {"legendgroup": name, "showlegend": k == 0}
            plot.add_trace(go.Scatter(x=time, y=array(values)[:, k], line=look, name=name, **shown), row=k + 1, col=1)
    plot.update_xaxes(title_text=label, row=len(signals), col=1)
    return _styled(plot, height=120 + 150 * len(signals))


def _plot(vertical: str, horizontal: str) -> "go.Figure":
    import plotly.graph_objects as go

    return _styled(go.Figure(), height=420).update_layout(xaxis_title=horizontal, yaxis_title=vertical)


def _styled(plot: "go.Figure", *, height: int) -> "go.Figure":
    legend = {"orientation": "h", "yanchor": "bottom", "y": 1.02, "x": 0.0}
    margin = {"l": 60, "r": 12, "t": 70, "b": 48}
    return plot.update_layout(template="simple_white", height=height, margin=margin, legend=legend, autosize=True)


def _text(value: float | None) -> str:
    """A number to four digits; None stands for one that is not finite."""
    return "not finite" if value is None else f"{value:.4g}"
