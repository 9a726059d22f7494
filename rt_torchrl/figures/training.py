"""Figures of a training that any plant has: its last episode, costs and weights over the episodes, and policies."""

import math
import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from rt_torchrl.evaluation.law import name_of, varying
from rt_torchrl.figures import style
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.figures.style import REAL, ROLES, TWIN, array, caption, legend_below, role_name
from rt_torchrl.plants.closures import described_weights, named_weights
from rt_torchrl.plants.signal import Signal
from rt_torchrl.steps.config import Role
from rt_torchrl.trajectories.state_feedback import StateFeedback

CONTROL: dict[str, dict[str, Any]] = {
    "real_cost": {"color": REAL, "marker": "o", "label": "real system, live"},
    "J_a_first": {"color": "0.55", "marker": "x", "linestyle": ":", "label": "first controller, twin"},
    "J_a_unseen": {"color": REAL, "marker": "*", "linestyle": ":", "label": "live, unseen"},
    "J_a_unseen_on_the_twin": {"color": TWIN, "marker": "*", "linestyle": ":", "label": "live, unseen, twin"},
    "J_a_model_based": {"color": ROLES["model_based"], "marker": "s", "label": "model-based, twin"},
    "J_a_model_free": {"color": ROLES["model_free"], "marker": "^", "label": "model-free, twin"},
}
IDENTIFICATION: dict[str, dict[str, Any]] = {
    "J_p_before": {"color": "0.55", "marker": "v", "label": "before assimilation"},
    "J_p": {"color": TWIN, "marker": "o", "label": "after assimilation"},
}


RESOLUTION = 81
"""Number of points along each observation."""
HALF_INTERVAL = 1.96
"""Half of a 95 % interval, in standard errors."""
MOST_OUTPUTS, MOST_FEATURES = 4, 3
"""Greatest numbers of outputs and of features of a law that are shown."""
SHOWN = 400
"""Greatest number of visited observations that are shown; more would hide the contours."""
DOTS: dict[str, Any] = {"s": 9, "color": "white", "edgecolors": "black", "linewidths": 0.4, "alpha": 0.6}


def figures_of(snapshot: Snapshot) -> dict[str, Figure]:
    """The figures of a training by name; a figure with nothing to show is left out.

    ``exogenous`` needs an arm that trains a twin, and a plant with inputs. ``closure_weights`` needs an arm that trains
    a twin, and episodes that report coefficients by name. ``learned_law`` needs one, and a closure whose outputs depend
    on its features. ``learning_curves`` needs a reported episode.
    """
    twin = snapshot.large_scale is not None
    chosen = [states, policy_contours]
    chosen += [exogenous] if twin and snapshot.plant.inputs else []
    chosen += [closure_weights] if twin and tracked_weights(snapshot.episodes) else []
    chosen += [learned_law] if twin and law_panels(snapshot) else []
    chosen += [learning_curves] if snapshot.episodes else []
    return {figure.__name__: figure(snapshot) for figure in chosen}


def states(snapshot: Snapshot) -> Figure:
    """Every state over time, as measured and as the twin replays it with the same actions, and the RMS difference.

    A flight on the twin, which no system has measured, has no replay.
    """
    signals, real, twin = snapshot.plant.states, array(snapshot.record.states), array(snapshot.replay)
    columns = 1 if len(signals) <= 3 else 2
    replayed = snapshot.segment and not snapshot.on_the_twin
    anew = f", replayed in segments of {snapshot.segment} intervals" if replayed else ""
    figure, axes, time = style.timeline(
        snapshot.plant,
        len(real) - 1,
        len(signals),
        columns,
        title=f"{'States' if snapshot.on_the_twin else 'Real and twin states'}, {style.episode(snapshot)}{anew}",
        size=(7.5 + 3.5 * (columns - 1), 1.0 + 1.9 * -(-len(signals) // columns)),
    )
    for k, (ax, signal) in enumerate(zip(axes, signals, strict=True)):
        ax.plot(time, real[:, k], color=REAL, linewidth=1.9, label=style.record_label(snapshot))
        if snapshot.on_the_twin:  # its replay is the same curve
            caption(ax, signal.label)
            continue
        ax.plot(time, twin[:, k], color=TWIN, linewidth=0.9, label=style.twin_label(snapshot))
        rms = np.sqrt(np.mean(signal.short_way(twin[:, k] - real[:, k]) ** 2))
        rms = 0.0 if rms <= 1e-10 * np.abs(real[:, k]).max() else rms
        caption(ax, signal.label, f"RMS {'diverges' if np.isnan(rms) else style.with_unit(rms, signal.unit)}")
    legend_below(figure, axes[:1])
    return figure


def exogenous(snapshot: Snapshot) -> Figure:
    """Each input that acts on the plant as recorded, with its large scale, and below it samples of other possible ones.

    Each input has a column.
    """
    assert snapshot.large_scale is not None and snapshot.realisations is not None
    signals, recorded = snapshot.plant.acting_inputs, array(snapshot.record.exogenous)
    mean, samples, columns = array(snapshot.large_scale), array(snapshot.realisations[:3]), len(signals)
    title, size = f"Exogenous input, {style.episode(snapshot)}", (max(7.5, 5.0 * columns), 5.7)
    of_grid: dict[str, Any] = {"title": title, "size": size, "sharey": "col"}
    figure, axes, time = style.timeline(snapshot.plant, len(recorded), 2 * columns, columns, **of_grid)
    for k, signal in enumerate(signals):
        above, below = axes[k::columns]
        above.plot(time[:-1], recorded[:, k], color=REAL, linewidth=1.0, label="recorded")
        for sample, label in zip(samples, (f"{len(samples)} samples", "_", "_"), strict=False):
            below.plot(time[:-1], sample[:, k], color=style.SAMPLES, linewidth=0.8, label=label)
        for ax in (above, below):
            ax.plot(time[:-1], mean[:, k], color=style.LARGE_SCALE, linewidth=2.2, label="large scale (SVR)")
            caption(ax, signal.label)
    legend_below(figure, axes[::columns])
    return figure


def learning_curves(snapshot: Snapshot) -> Figure:
    """Costs of control on the real system and on the twin, the twin's error, and the live policy, over the episodes.

    The strip at the bottom has a row for each policy, which is filled where the policy was live and pale where it was
    idle. A panel is left out if the arm does not report its values.
    """
    episodes = snapshot.episodes
    panels = [
        (name, curves)
        for name, curves in (("control cost $J_a$", CONTROL), ("identification cost $J_p$", IDENTIFICATION))
        if any(np.isfinite(_column(episodes, key)).any() for key in curves)
    ]
    heights = [2.6] * len(panels) + [0.9]
    figure, (*axes, strip) = style.grid(
        len(heights),
        title="Learning curves and live policy",
        size=(8.5, 1.1 + sum(heights)),
        xlabel="episode",
        height_ratios=heights,
    )
    for (name, curves), ax in zip(panels, axes, strict=True):
        for key, look in curves.items():
            if np.isfinite(column := _column(episodes, key)).any():
                ax.plot(np.arange(1, len(episodes) + 1), column, linewidth=1.4, markersize=4, **look)
        style.logarithmic_if_wide(ax)
        caption(ax, name)
    legend_below(figure, axes)
    _draw_timeline(strip, episodes, snapshot.live)
    return figure


@torch.no_grad()
def closure_weights(snapshot: Snapshot) -> Figure:
    """Each named coefficient of the twin after every episode, with its initial and, if it is known, its true value.

    The number above a panel is the relative difference between the last value and the true one.

    Args:
        snapshot: snapshot whose episodes report ``closure``, see :func:`tracked_weights`.
    """
    columns = tracked_weights(snapshot.episodes)
    laws = snapshot.true_closure, snapshot.initial_closure
    true, start = ({} if law is None else _numbers(named_weights(law)) for law in laws)
    errors = {} if snapshot.uncertainty is None else snapshot.uncertainty.standard_errors()
    described = described_weights(snapshot.initial_closure)
    wide = min(3, len(columns))
    size = (0.6 + 3.6 * wide, 1.3 + 2.8 * -(-len(columns) // wide))
    title = "Closure weights of the twin over the episodes"
    figure, axes = style.grid(len(columns), wide, title=title, size=size, xlabel="episode")
    for ax, (name, values) in zip(axes, columns.items(), strict=True):
        ax.plot(np.arange(1, len(values) + 1), values, "o-", color=TWIN, linewidth=1.4, markersize=4, label="twin")
        if 0.0 < errors.get(name, 0.0) < math.inf:
            ends: dict[str, Any] = {"capsize": 3, "label": "95 % interval"}
            ax.errorbar(len(values), values[-1], HALF_INTERVAL * errors[name], color=TWIN, linewidth=1.0, **ends)
        if name in start:
            ax.axhline(start[name], color="0.55", linestyle=(0, (1, 1.5)), linewidth=1.5, label="start")
        if name in true:
            ax.axhline(true[name], label="true", **style.REFERENCE_LINE)
        style.logarithmic_if_wide(ax)
        about = described.get(name, {"unit": "-", "meaning": ""})
        words = name.replace("_", " ") + ("" if about["unit"] == "-" else f" [{about['unit']}]")
        label = "\n".join([words, *textwrap.wrap(about["meaning"], 44)])
        caption(ax, label, f"{100.0 * (values[-1] / true[name] - 1.0):+.2g} %" if true.get(name) else "")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes[0].set_xlim(0.5, len(snapshot.episodes) + 0.5)
    legend_below(figure, axes)
    return figure


@torch.no_grad()
def learned_law(snapshot: Snapshot) -> Figure:
    """The outputs of the closure that depend on its features, over each of these; the others have their median.

    Curves span the features of the latest records, some of which are marked below: a twin can only know what was
    visited. The band is the 95 % interval that the noise of the last fit leaves.
    """
    places = law_panels(snapshot)
    rows, columns = (len({place[axis] for place in places}) for axis in (0, 1))
    title, size = "Learned law, where the last records went", (max(5.5, 0.8 + 3.8 * columns), 1.3 + 2.6 * rows)
    figure, grid = style.panels(rows, columns, title=title, size=size)
    for place, ax in zip(places, grid.flat, strict=True):
        _draw_law(ax, snapshot, *place)
    legend_below(figure, grid.flat[:1].tolist())
    return figure


def _draw_law(ax: Axes, snapshot: Snapshot, output: int, feature: int) -> None:
    """Draw an output of the true closure, of the twin's with its 95 % interval, and of the initial twin's."""
    visited = snapshot.features
    low, high = visited[:, feature].min().item(), visited[:, feature].max().item()
    axis = torch.linspace(low, high, RESOLUTION, dtype=visited.dtype, device=visited.device)
    points = visited.quantile(0.5, 0).expand(RESOLUTION, -1).clone()
    points[:, feature] = axis
    for name, law in style.closures(snapshot).items():
        if name != "true" or snapshot.true_closure is not None:
            ax.plot(array(axis), array(law(points)[:, output]), **style.closure_look(name))
    if snapshot.uncertainty is not None:
        values = snapshot.closure(points)[:, output]
        reach = HALF_INTERVAL * snapshot.uncertainty.errors_of(lambda: snapshot.closure(points)[:, output])
        reach[reach.isinf()] = math.nan
        below, above = array(values - reach), array(values + reach)
        ax.fill_between(array(axis), below, above, color=TWIN, alpha=0.2, linewidth=0, label="95 % interval")
    _draw_visited(ax, visited[:, feature])
    plant = snapshot.plant.innermost
    caption(ax, name_of(plant.closure_outputs, output, "output"))
    ax.set_xlabel(name_of(plant.closure_inputs, feature, "feature"))


@torch.no_grad()
def law_panels(snapshot: Snapshot) -> list[tuple[int, int]]:
    """Places of the output and the feature of each panel of :func:`learned_law`, of the first ones that vary."""
    visited = snapshot.features
    if not len(visited):
        return []
    outputs, features = varying(snapshot.closure(_some(visited))), varying(visited)
    return [(output, feature) for output in outputs[:MOST_OUTPUTS] for feature in features[:MOST_FEATURES]]


def tracked_weights(episodes: list[dict[str, Any]]) -> dict[str, Float[np.ndarray, " episodes"]]:
    """Coefficients that episodes report as a number with a name; nan in an episode that does not report them."""
    reported = [_numbers(episode.get("closure")) for episode in episodes]
    return {name: _column(reported, name) for name in dict.fromkeys(name for weights in reported for name in weights)}


def _numbers(closure: dict[str, Any] | None) -> dict[str, float]:
    """Weights from :func:`named_weights` that are numbers with a name."""
    return {name: value for name, value in (closure or {}).items() if isinstance(value, float)}


def _column(episodes: list[dict[str, Any]], key: str) -> np.ndarray:
    """One value per episode; nan in an episode that does not report it."""
    values = (episode.get(key) for episode in episodes)
    return np.array([np.nan if value is None else float(value) for value in values])


def _draw_timeline(ax: Axes, episodes: list[dict[str, Any]], live: Role) -> None:
    """Draw a row for each policy, filled in the episodes in which it was live and pale in the others."""
    acted = [episode.get("live") or live for episode in episodes]
    for row, role in enumerate(reversed(ROLES)):
        for is_live, alpha in ((True, 1.0), (False, 0.15)):
            spans = [(k - 0.5, 1.0) for k, actor in enumerate(acted, 1) if (actor == role) == is_live]
            ax.broken_barh(spans, (row - 0.4, 0.8), facecolors=ROLES[role], alpha=alpha, linewidth=0)
    ax.set_yticks(range(len(ROLES)), [role_name(role) for role in reversed(ROLES)])
    ax.set_ylim(-0.55, len(ROLES) - 0.45)
    ax.grid(False)
    caption(ax, "live (filled) and idle (pale)")
    ax.set_xlim(0.5, len(episodes) + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))


@torch.no_grad()
def policy_contours(snapshot: Snapshot) -> Figure:
    """Every action as a function of the observations, model-based beside model-free on the same colour scale.

    Dots are observations of the last real episode; the axes span these and the declared ranges of the observations.
    With one observation the figure shows curves on both sides of zero error. With more observations it shows contours
    over the first two; the others have their mean value in the episode. State feedback, which is no function of the
    observation, has no curve, and a panel with the visited observations alone.
    """
    return _curves(snapshot) if len(snapshot.plant.observations) == 1 else _contours(snapshot)


@torch.no_grad()
def visited_observations(snapshot: Snapshot) -> Float[Tensor, "n n_o"]:
    """Observations of the live policy in the last real episode."""
    plant, record = snapshot.plant, snapshot.record
    clock = torch.arange(len(record.actions), dtype=torch.float64, device=record.states.device)
    return plant.observe(record.start + plant.dt * clock, record.states[:-1], record.exogenous)


def _curves(snapshot: Snapshot) -> Figure:
    plant, observations = snapshot.plant, visited_observations(snapshot)
    # The axis has errors of both signs, so that it shows the target.
    axis = _axis(plant.observations[0], torch.cat([observations[:, 0], -observations[:, 0]]))
    figure, axes = style.grid(
        len(plant.actions),
        title=f"Policies after episode {len(snapshot.episodes)}",
        size=(6.5, 1.2 + 2.4 * len(plant.actions)),
        xlabel=plant.observations[0].label,
    )
    for role in ROLES:
        if isinstance(snapshot.policies[role], StateFeedback):
            continue
        values = array(snapshot.policies[role](axis[:, None]))
        for k, ax in enumerate(axes):
            ax.plot(array(axis), values[:, k], color=ROLES[role], linewidth=1.8, label=role_name(role))
    for ax, action in zip(axes, plant.actions, strict=True):
        style.limits(ax, action)
        ax.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
        _draw_visited(ax, observations[:, 0])
        caption(ax, action.label)
    axes[0].set_xlim(axis[0].item(), axis[-1].item())
    legend_below(figure, axes)
    return figure


def _contours(snapshot: Snapshot) -> Figure:
    mean, rows = visited_observations(snapshot).mean(0), len(snapshot.plant.actions)
    others = "" if len(mean) == 2 else "\nother observations at their mean in the last episode"
    figure, axes = style.panels(
        rows,
        2,
        title=f"Policies after episode {len(snapshot.episodes)}{others}",
        size=(9.5, 1.0 + 2.9 * rows),
        sharex=True,
        sharey=True,
    )
    for k in range(rows):
        contours(snapshot, k, {(0, 1): axes[k]}, others=mean)
    for ax in axes[:-1].flat:
        ax.set_xlabel("")
    legend_below(figure, [axes[0, 0]])
    return figure


@torch.no_grad()
def contours(
    snapshot: Snapshot,
    action: int,
    planes: Mapping[tuple[int, int], np.ndarray],
    *,
    others: Float[Tensor, " n_o"],
) -> None:
    """Draw one action over pairs of observations, all on one colour scale.

    Args:
        snapshot: snapshot with the policies and the record.
        action: index of the action.
        planes: two axes, for the model-based and the model-free policy, for each pair of observations by index.
        others: values of the observations that are not in the pair.
    """
    signals, visited = snapshot.plant.observations, visited_observations(snapshot)
    grids = {plane: [_axis(signals[i], visited[:, i]) for i in plane] for plane in planes}
    fields = {}
    for plane, grid in grids.items():
        points = others.expand(RESOLUTION**2, -1).clone()
        points[:, plane] = torch.cartesian_prod(*grid)
        for role in ROLES:
            if not isinstance(snapshot.policies[role], StateFeedback):
                values = array(snapshot.policies[role](points)[:, action])
                fields[plane, role] = values.reshape(RESOLUTION, RESOLUTION)
    levels = _levels(list(fields.values()))
    for plane, pair in planes.items():
        for role, ax in zip(ROLES, pair, strict=True):
            x, y = map(array, grids[plane])
            if (plane, role) in fields:
                filled = ax.contourf(x, y, fields[plane, role].T, levels=levels, cmap="viridis")
            else:
                place: dict[str, Any] = {"transform": ax.transAxes, "ha": "center", "va": "center", "fontsize": 9}
                ax.text(0.5, 0.5, "plans its actions:\nno function of the observation", **place)
            ax.scatter(*array(_some(visited[:, plane])).T, label="visited in the last episode", **DOTS)
            caption(ax, role_name(role), "live" if role == snapshot.live else "idle")
            ax.set_xlabel(signals[plane[0]].label)
            ax.xaxis.set_major_locator(MaxNLocator(5))
        pair[0].set_ylabel(signals[plane[1]].label)
    axes = [ax for pair in planes.values() for ax in pair]
    axes[0].figure.colorbar(filled, ax=axes, label=snapshot.plant.actions[action].label, aspect=16 * len(planes))


def _draw_visited(ax: Axes, visited: Float[Tensor, " n"]) -> None:
    """Draw a mark at the foot of a panel for each visited value that is shown."""
    marks = array(_some(visited))
    rug: dict[str, Any] = {"transform": ax.get_xaxis_transform(), "color": "0.4", "alpha": 0.4, "markersize": 7}
    ax.plot(marks, np.full_like(marks, 0.02), "|", label="visited", **rug)


def _some(visited: Tensor) -> Tensor:
    """As many of the visited observations as are shown."""
    return visited[:: -(-len(visited) // SHOWN)]


def _axis(signal: Signal, visited: Float[Tensor, " n"]) -> Float[Tensor, " m"]:
    """Points over the declared range and the visited values of a signal, so that no dot lies outside.

    At an end that is not declared there is a margin beyond the visited values.
    """
    least, greatest = visited.min().item(), visited.max().item()
    margin = 0.05 * (greatest - least) or 1.0
    low = min(signal.low, least) if math.isfinite(signal.low) else least - margin
    high = max(signal.high, greatest) if math.isfinite(signal.high) else greatest + margin
    return torch.linspace(low, high, RESOLUTION, dtype=visited.dtype, device=visited.device)


def _levels(fields: list[Float[np.ndarray, "m m"]]) -> Float[np.ndarray, " levels"]:
    """Round levels that include all values of the policies."""
    low, high = min(field.min() for field in fields), max(field.max() for field in fields)
    return np.asarray(MaxNLocator(12).tick_values(low, high))
