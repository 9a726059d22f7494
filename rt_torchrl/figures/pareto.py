"""The figure of what one quantity costs another."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from rt_torchrl.figures.style import REFERENCE, ROLES, panels


def pareto(
    front: Sequence[tuple[float, float, float]],
    others: Mapping[str, tuple[float, float]],
    *,
    title: str,
    axes: tuple[str, str],
) -> Figure:
    """Optima along a weight as a curve, with the weight at each of them, and other controllers as points.

    Args:
        front: weight and the two quantities of each optimum.
        others: the two quantities of each other controller, by name.
        title: title of the figure.
        axes: names of the two quantities, with their units.
    """
    figure, grid = panels(1, 1, title=title, size=(6.4, 4.6))
    ax = grid[0, 0]
    ax.plot([x for _, x, _ in front], [y for _, _, y in front], "o-", color=ROLES["model_based"], markersize=6)
    for weight, x, y in front:
        ax.annotate(f"{weight:g}", (x, y), xytext=(6, 5), textcoords="offset points", fontsize=9)
    for name, (x, y) in others.items():
        ax.plot([x], [y], "D", color=REFERENCE, markersize=7)
        ax.annotate(name, (x, y), xytext=(8, -4), textcoords="offset points", fontsize=9, color=REFERENCE)
    ax.set_xlabel(axes[0])
    ax.set_ylabel(axes[1])
    ax.margins(0.12)
    return figure
