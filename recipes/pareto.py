"""What one quantity costs another: the Pareto front of a plant over one weight of its cost, as table and figure."""

from dataclasses import field
from pathlib import Path
from typing import Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

from rt_torchrl import ClassicalController, configuration, main_of
from rt_torchrl.atomic_file import make_folder
from rt_torchrl.envs.cryogenic_tank.controllers import OnOffValve, PIValve
from rt_torchrl.envs.flapping_wing.controllers import TrimmedPD
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.study.pareto import Effort, Point, classical_point, keep, pareto_front


@configuration
class Front:
    """What is weighed against what on a plant.

    Args:
        options: options of the plant's recipe.
        weight: the option that is the weight.
        values: its values.
        merits: names of the two quantities of the plant.
        controllers: classical controllers beside the front.
        effort: how thoroughly the optima are sought.
    """

    options: tuple[str, ...]
    weight: str
    values: tuple[float, ...]
    merits: tuple[str, str]
    controllers: dict[str, type[ClassicalController]]
    effort: Effort


FRONTS = {
    "wind_turbine": Front(
        options=("--task", "engineering", "--policy", "bias", "--observe", "measured"),
        weight="engineering.pitch-rate",
        values=(0.0003, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3),
        merits=("pitch travel [deg/s]", "speed above rated [rad/s]"),
        controllers={"Jonkman": JonkmanController},
        effort=Effort(planned_on=20, unseen=20, starts=2, approach=300, iterations=150),
    ),
    "flapping_wing": Front(
        options=("--policy", "paper", "--observe", "paper"),
        weight="energy",
        values=(0.0, 0.3, 1.0, 3.0, 10.0),
        merits=("wing power [-]", "final distance [m]"),
        controllers={"PD": TrimmedPD},
        effort=Effort(planned_on=10, unseen=50, starts=2, approach=0, iterations=40),
    ),
    "cryogenic_tank": Front(
        options=("--policy", "paper", "--command", "duty", "--end-weight", "43200"),
        weight="vented-weight",
        values=(2e3, 10e3, 25e3, 50e3),
        merits=("vented mass [kg]", "late pressure error [kPa]"),
        controllers={"on-off": OnOffValve, "PI": PIValve},
        effort=Effort(planned_on=10, unseen=50, starts=2, approach=0, iterations=40),
    ),
}


@configuration
class Config:
    """Find the optima of a plant's policy along one weight of its cost, on the true plant, and judge them on unseen
    episodes.

    Args:
        plant: plant whose weight is varied: the blades' rate in the turbine's task engineering, the power of the
            drone's wings, or the mass that the tank vents.
        values: values of the weight; by default those of the plant.
        log_dir: folder of the results, which are PLANT.json and PLANT.png.
    """

    plant: Literal["wind_turbine", "flapping_wing", "cryogenic_tank"] = "wind_turbine"
    values: tuple[float, ...] = ()
    log_dir: Path = field(default=Path("runs/pareto"))


def main(config: Config) -> None:
    make_folder("log_dir", config.log_dir)
    front, recipe = FRONTS[config.plant], Path(__file__).with_name(f"{config.plant}.py")
    values = config.values or front.values
    found = pareto_front(recipe, front.options, front.weight, values, front.effort)
    print(f"{len(values)} optima along {front.weight}, each on {front.effort.planned_on} episodes", flush=True)
    others = {
        name: classical_point(recipe, front.options, kind, unseen=front.effort.unseen)
        for name, kind in front.controllers.items()
    }
    merits = list(next(iter(others.values())).merit)
    print(f"{front.weight:<24}{'J_a':>12}" + "".join(f"  {merit}" for merit in merits))
    for name, other in others.items():
        print(row(name, other), flush=True)
    path, title = (
        config.log_dir / f"{config.plant}.json",
        f"{config.plant.replace('_', ' ')}: optima along {front.weight}",
    )
    points: list[Point] = []
    for point in found:
        print(row(f"{point.weight:g}", point), flush=True)
        points.append(point)
        keep(path, points, others, weight=front.weight, merits=front.merits, effort=front.effort, title=title)
    print(f"results in {path} and {path.with_suffix('.png')}")


def row(name: str, point: Point) -> str:
    """A line of the table in the terminal."""
    cost = "" if point.cost is None else f"{point.cost:.5g}"
    return f"{name:<24}{cost:>12}" + "".join(f"  {value:>{len(merit)}.4g}" for merit, value in point.merit.items())


if __name__ == "__main__":
    main_of(Config, main)
