"""The figures of the paper's section 6 that have described axes or printed numbers, from trainings by its algorithm."""

from pathlib import Path
from typing import Any, Literal

import rt_torchrl as rt

rt.begin_loading(__name__)

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from study import Training, run_all

from rt_torchrl.figures.style import ROLES, TWIN, array, caption, legend_below, panels, role_name
from rt_torchrl.runs.metrics import read_metrics
from rt_torchrl.steps.config import ROLES as POLICIES

RATIOS = {
    "wind_turbine": {"J_p": (0.21, 0.08), "model_based": (0.08, 0.05), "model_free": (0.13, 0.12)},
    "flapping_wing": {"J_p": (3.2e-2, 4.9e-2), "model_based": (0.418, 0.001), "model_free": (0.201, 0.045)},
    "cryogenic_tank": {"J_p": (3.15e-4, 0.9e-4), "model_based": (0.447, 0.268), "model_free": (0.480, 0.315)},
}
"""Mean and deviation of costs after the training over costs before (paper, table of learning performances)."""
SWITCHES = {"wind_turbine": 7, "flapping_wing": 4, "cryogenic_tank": 4}
"""Episode after which the roles change first in the paper (figure 11)."""
OF_A_RUN = {
    "wind_turbine": ("power_and_speed", "policy_contours", "power_coefficient"),  # 00 and 14a, 13, 14b
    "flapping_wing": ("states", "flight", "control_surfaces"),  # 16a, 17, 18
    "cryogenic_tank": ("tank", "states", "policy_contours", "heat_exchanger"),  # 21, 22 a to c, 23
}
"""Figures that every training draws, by name, beside those below."""
OPTIONS = ("--preset", "paper")
"""Options of the trainings beside those that each run of a study has."""
EPISODES = 5
"""Number of unseen episodes in the figures of predictions."""
START, HOURS = 540e3, 45.0
"""Pressure that the paper's tank is vented from [Pa], and the time that it takes [h]."""


@rt.configuration
class Config:
    """Train what is missing by ``--preset paper``, and draw the paper's figures beside its printed numbers.

    Args:
        plant: the plant.
        seeds: seeds of the trainings.
        jobs: number of trainings side by side, each on one thread; 0 for one on each core.
        log_dir: folder of the trainings and, in ``PLANT/figures``, of the figures.
    """

    plant: Literal["wind_turbine", "flapping_wing", "cryogenic_tank"] = "wind_turbine"
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    jobs: int = 0
    log_dir: Path = Path("runs/paper")

    def __post_init__(self):
        if not self.seeds or min(self.seeds) < 0:
            raise ValueError(f"seeds={self.seeds} must name seeds, which are not negative.")


def band(ax: Axes, curves: np.ndarray, colour: str, label: str) -> None:
    """Mean over the seeds as a dashed line, and a standard deviation above and below, but not below all seeds."""
    mean, deviation, episodes = curves.mean(0), curves.std(0), np.arange(1, curves.shape[1] + 1)
    low = np.maximum(mean - deviation, curves.min(0))
    ax.fill_between(episodes, low, mean + deviation, color=colour, alpha=0.2, linewidth=0)
    ax.plot(episodes, mean, color=colour, linestyle="--", label=label)


def numbers(values: list[Any]) -> np.ndarray:
    """An array of the numbers of ``metrics.json``, which holds null for those that are not finite."""
    return np.array(values, dtype=float)


def learning(plant: str, metrics: list[dict[str, Any]]) -> Figure:
    """Figures 10 and 11: costs over the mean initial cost of the seeds, and which policy was live."""
    start = numbers([run["summary"]["unseen"]["J_a_before"]["mean"] for run in metrics]).mean()
    start_of_twin = np.nanmean(numbers([run["episodes"][0]["J_p_before"] for run in metrics]))

    def curves(key: str, start: float = start) -> np.ndarray:
        return numbers([[episode[key] for episode in run["episodes"]] for run in metrics]) / start

    figure, axes = panels(3, title=f"{plant}: learning, {len(metrics)} seeds", size=(7.5, 9.0), sharex=True)
    control, assimilation, live = axes.flat
    band(control, curves("real_cost"), "0.3", "real episode (live policy)")
    for role in POLICIES:
        band(control, curves(f"J_a_{role}"), ROLES[role], f"{role_name(role)}, on the twin")
        mean = RATIOS[plant][role][0]
        control.axhline(mean, color=ROLES[role], linewidth=0.8, label=f"{role_name(role)} at the end, paper")
    band(assimilation, curves("J_p", start_of_twin), TWIN, "twin")
    assimilation.axhline(RATIOS[plant]["J_p"][0], color=TWIN, linewidth=0.8, label="at the end, paper")
    for row, run in enumerate(metrics):
        for role in POLICIES:
            spans = [(k + 0.5, 1.0) for k, episode in enumerate(run["episodes"]) if episode["live"] == role]
            live.broken_barh(spans, (row - 0.4, 0.8), facecolors=ROLES[role])
    live.axvline(SWITCHES[plant] + 0.5, color="0.2", linestyle=":", label="first change of roles, paper")
    live.set_xlabel("episode")
    live.xaxis.set_major_locator(MaxNLocator(integer=True))
    live.set_yticks(range(len(metrics)), [f"seed {run['seed']}" for run in metrics])
    for ax, label in ((control, "J_a over its mean at the start"), (assimilation, "J_p over its mean at the start")):
        ax.set_yscale("log")
        caption(ax, label)
    caption(live, "live policy")
    legend_below(figure, list(axes.flat))
    return figure


def robustness(plant: str, metrics: list[dict[str, Any]]) -> Figure:
    """Figures 15, 19 and 25: costs of both policies and of the twin on unseen episodes, of all seeds."""
    unseen = [run["summary"]["unseen"] for run in metrics]
    samples = {f"J_a, {role_name(role)}": [cost for run in unseen for cost in run["costs"][role]] for role in POLICIES}
    samples["J_p"] = [cost for run in unseen for cost in run["J_p_each"]]
    figure, axes = panels(1, 3, title=f"{plant}: unseen episodes of {len(unseen)} seeds", size=(9.0, 4.5))
    for ax, (label, sample) in zip(axes.flat, samples.items(), strict=True):
        finite = [cost for cost in sample if cost is not None]
        ax.violinplot(np.log10(np.maximum(finite, 1e-300)), showmedians=True)
        ax.set_xticks([])
        caption(ax, f"log10 of {label}")
    return figure


@torch.no_grad()
def prediction(run: rt.LoadedRun) -> Figure:
    """Figures 12b, 16b and 22 d to f: states of the twin against real ones, in unseen episodes of the live policy."""
    replay, flown = run.twin.believed.replay, [run.simulate(run.policy(run.live), seed=k) for k in range(EPISODES)]
    twins = [replay(flight.states[None, 0], flight.exogenous[None], flight.actions[None]).states[0] for flight in flown]
    real, twin = (array(torch.cat(states)) for states in ([flight.states for flight in flown], twins))
    names = {name.split(" ")[0] for name in run.metrics["summary"]["twin"]["rms"]}
    compared = [k for k, state in enumerate(run.plant.states) if state.name in names]
    title, size = f"{run.plant.name}: twin and reality", (4.2 * len(compared), 4.5)
    figure, axes = panels(1, len(compared), title=title, size=size)
    for ax, k in zip(axes.flat, compared, strict=True):
        signal, ends = run.plant.states[k], [real[:, k].min(), real[:, k].max()]
        ax.plot(real[:, k], twin[:, k], ".", color=TWIN, markersize=2, alpha=0.4)
        ax.plot(ends, ends, color="0.5", linewidth=1.0)
        ax.set_xlabel("real")
        rms = np.sqrt(np.mean((twin[:, k] - real[:, k]) ** 2))
        caption(ax, f"twin's {signal.name.replace('_', ' ')} [{signal.unit}]", f"RMS {rms:.2g}")
    return figure


@torch.no_grad()
def power_over_wind(run: rt.LoadedRun) -> Figure:
    """Figure 14b: the power coefficient at the wind speeds of unseen episodes, and its greatest mean."""
    figure, ((ax,),) = panels(1, title="Power coefficient where the turbine operates", size=(6.5, 4.5))
    flown = [run.simulate(run.policy(run.live), seed=seed) for seed in range(EPISODES)]
    u = torch.cat([flight.exogenous[:, 0] for flight in flown])
    ratio = torch.cat([flight.states[:-1, 0] for flight in flown]) * run.plant.radius / u
    pitch = torch.cat([flight.actions[:, 1] for flight in flown])
    C_p, bins = array(run.plant.closure(torch.stack([ratio, pitch], -1)).squeeze(-1)), np.floor(array(u))
    ax.plot(array(u), C_p, ".", markersize=2, color=ROLES["model_based"], alpha=0.4)
    greatest = max(C_p[bins == low].mean() for low in np.unique(bins) if (bins == low).mean() > 0.01)
    ax.set_xlabel("wind speed [m/s]")
    caption(ax, "C_p [-]", f"greatest mean over 1 m/s {greatest:.2g}, paper 0.42")
    return figure


@torch.no_grad()
def venting(run: rt.LoadedRun) -> Figure:
    """Figure 21: the tank vented from 5.4 bar, and figure 21c, the flow over the pressure."""
    start = run.plant.state_at(torch.tensor([START], dtype=torch.float64))
    flown = run.simulate(run.policy(run.live), initial_state=start[0])
    law = run.plant.closure
    flow = 1e3 * array(run.plant.vent(flown.states[:-1], flown.actions, law).flow)
    vented = array(run.plant.vented_mass(flown.states, flown.actions, law)[:-1])
    hours, pressure = run.plant.dt / 3600.0 * np.arange(len(flow)), 1e-3 * array(flown.states[:-1, 2])
    arrived = min(hours[1e3 * pressure <= 1.005 * run.plant.set_point], default=np.nan)
    curves = (
        (hours, pressure, "pressure [kPa]", f"within 0.5 % after {arrived:.0f} h, paper {HOURS:g}"),
        (hours, vented, "vented mass [kg]", f"{np.interp(HOURS, hours, vented):.0f} in {HOURS:g} h, paper 87"),
        (pressure, flow, "vent flow [g/s]", f"greatest {flow.max():.2g}, paper 0.63"),
    )
    figure, axes = panels(1, 3, title="Tank vented from 5.4 bar", size=(12.0, 4.0))
    for ax, (x, y, label, note) in zip(axes.flat, curves, strict=True):
        ax.plot(x, y, ".", markersize=2, color=ROLES[run.live])
        ax.set_xlabel("time [h]" if x is hours else "pressure [kPa]")
        caption(ax, label, note)
    return figure


OF_A_PLANT = {"wind_turbine": {"power_over_wind": power_over_wind}, "cryogenic_tank": {"venting": venting}}
"""Figures of one plant alone, by name."""


def table(plant: str, metrics: list[dict[str, Any]]) -> str:
    """The paper's table of learning performances, with its numbers beside."""
    lines = [f"{plant}, {len(metrics)} seeds: cost on unseen episodes after the training over the cost before"]
    keys = {"J_p": "J_p_ratio", **{role: f"J_a_ratio_{role}" for role in POLICIES}}
    for name, key in keys.items():
        ratios, (mean, deviation) = numbers([run["summary"][key] for run in metrics]), RATIOS[plant][name]
        text = f"{ratios.mean():.3g} ± {ratios.std(ddof=1):.3g}, median {np.median(ratios):.3g}"
        lines.append(f"  {name}: {text} (paper {mean:g} ± {deviation:g})")
    first = [next((k + 1 for k, e in enumerate(run["episodes"]) if e["event"] == "swap"), None) for run in metrics]
    lines.append(f"  first change of roles after episode: {', '.join(map(str, first))} (paper {SWITCHES[plant]})")
    seeds = [run["seed"] for run in metrics if run["summary"]["live"] == "model_free"]
    lines.append(f"  the model-free policy is live at the end with seeds: {', '.join(map(str, seeds)) or 'none'}")
    return "\n".join(lines)


def main(config: Config) -> None:
    from rt_torchrl.figures import save_figure

    folder = config.log_dir / config.plant
    recipe = Path(__file__).with_name(f"{config.plant}.py")
    trainings = [Training(recipe, OPTIONS, seed, folder / f"seed-{seed}") for seed in config.seeds]
    if failures := run_all(trainings, jobs=config.jobs):
        raise ValueError("\n".join(failures))
    metrics = [read_metrics(training.folder) | {"seed": training.seed} for training in trainings]
    costs = numbers([result["summary"]["unseen"][f"J_a_{result['summary']['live']}"]["mean"] for result in metrics])
    run = rt.load_run(trainings[int(np.argsort(costs)[len(costs) // 2])].folder)  # that of the median cost
    figures = {"learning": learning(config.plant, metrics), "robustness": robustness(config.plant, metrics)}
    figures["prediction"] = prediction(run)
    figures |= {name: draw(run) for name, draw in OF_A_PLANT.get(config.plant, {}).items()}
    figures |= {name: run.figure(name) for name in OF_A_RUN[config.plant]}
    (folder / "figures").mkdir(exist_ok=True)
    for name, figure in figures.items():
        save_figure(figure, folder / "figures" / f"{name}.png")
    print(table(config.plant, metrics))
    print(f"figures in {folder / 'figures'}")


if __name__ == "__main__":
    rt.main_of(Config, main)
