"""The table of results to hold: default trainings and unknown systems, over several seeds.

``uv run tests/ruler.py --seeds 5 --folder runs/ruler`` trains what is missing in the folder, two
trainings side by side on one thread each, and prints the table as Markdown. The same command goes on where it was
interrupted; another folder is another measurement. It takes about 40 minutes on two cores.
"""

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

RECIPES = Path(__file__).resolve().parent.parent / "recipes"


def planned(*options: str, episodes: int, unseen: int) -> tuple[str, ...]:
    """Options of the model-based half alone."""
    return ("--twinning.arm", "model_based", "--episodes", str(episodes), "--unseen", str(unseen), *options)


SCHEDULED = ("--policy", "scheduled")
VALVE = ("--command", "drop", "--end-weight", "0")
HOP = ("--policy", "paper", "--task", "hop")
ROWS: dict[str, tuple[str, tuple[str, ...]]] = {
    "turbine": ("wind_turbine", ()),
    "drone": ("flapping_wing", ()),
    "tank": ("cryogenic_tank", ()),
    "turbine, engineering": ("wind_turbine", ("--task", "engineering")),
    "turbine, pitch": ("wind_turbine", planned(*SCHEDULED, "--unknown", "pitch", episodes=3, unseen=50)),
    "turbine, inflow": ("wind_turbine", planned(*SCHEDULED, "--unknown", "inflow", episodes=3, unseen=50)),
    "tank, bias_15": ("cryogenic_tank", planned(*VALVE, "--unknown", "bias_15", episodes=3, unseen=50)),
    "hop, plane_6.3": ("flapping_wing", planned(*HOP, "--unknown", "plane_6.3", episodes=10, unseen=192)),
}
"""Recipe and options of each row of the table."""


def train(recipe: str, options: Sequence[str], seed: int, folder: Path) -> Path:
    """Run the recipe, unless its results are there; ``seconds.json`` takes the seconds of the whole process."""
    if not (folder / "seconds.json").exists():
        shutil.rmtree(folder, ignore_errors=True)  # a training that was interrupted
        folder.mkdir(parents=True)
        command = [sys.executable, str(RECIPES / f"{recipe}.py"), "--seed", str(seed), "--threads", "1"]
        command += ["--no-figures", "--log-dir", str(folder), *options]
        start = time.perf_counter()
        with (folder / "training.log").open("w") as log:
            subprocess.run(command, check=True, stdout=log, stderr=log)
        (folder / "seconds.json").write_text(json.dumps(time.perf_counter() - start))
    return folder


def kept(file: Path, measure: Callable[[], Any]) -> Any:
    """The result of a measurement, which a file keeps."""
    if not file.exists():
        result = measure()
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(result))
    return json.loads(file.read_text())


def span(values: Sequence[float], digits: int = 5) -> str:
    """Least and greatest value."""
    least, greatest = f"{min(values):.{digits}g}", f"{max(values):.{digits}g}"
    return least if least == greatest else f"{least} … {greatest}"


class Result(NamedTuple):
    """What a training ended with: costs of the live and of the cheaper policy on unseen episodes, Σ, alarms, seconds.

    Σ is the sum of J_a of its real episodes, without that of the controller that flew before them.
    """

    live: float
    cheaper: float
    paid: float
    alarms: int
    seconds: float

    @classmethod
    def of(cls, folder: Path) -> "Result":
        metrics = json.loads((folder / "metrics.json").read_text())
        summary, episodes = metrics["summary"], metrics["episodes"]
        paid, alarms = sum(one["real_cost"] for one in episodes), sum(one.get("alarm", 0.0) > 0.0 for one in episodes)
        costs = {role: summary["unseen"][f"J_a_{role}"]["mean"] for role in ("model_based", "model_free")}
        seconds = json.loads((folder / "seconds.json").read_text())
        return cls(costs[summary["live"]], min(costs.values()), paid, alarms, seconds)


def line(name: str, results: list[Result]) -> str:
    """A row of the table: least and greatest over seeds, alarms of all, and the median of the seconds."""
    live, cheaper, paid, alarms, seconds = (list(values) for values in zip(*results, strict=True))
    dearer = sum(one.live > 1.001 * one.cheaper for one in results)
    costs, time = f"{span(live)} | {span(cheaper)} | {dearer}", f"{statistics.median(seconds):.0f}"
    return f"| {name} | {len(results)} | {costs} | {span(paid, 4)} | {sum(alarms)} | {time} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("runs/ruler"))
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    tasks = {
        (name, seed): options.folder / name.replace(", ", "-") / f"{seed}" for name in options.rows for seed in seeds
    }
    with ThreadPoolExecutor(options.jobs) as pool:
        running = {task: pool.submit(train, *ROWS[task[0]], *task[1:], folder) for task, folder in tasks.items()}
        for (name, seed), training in running.items():
            training.result()
            print(f"{name}, seed {seed}: {Result.of(tasks[name, seed])}", file=sys.stderr, flush=True)
    costs = "J_a of the live policy | J_a of the cheaper policy | live is dearer"
    print(f"| system | seeds | {costs} | Σ | alarms | seconds |")
    print("|---|---|---|---|---|---|---|---|")
    for name in options.rows:
        print(line(name, [Result.of(tasks[name, seed]) for seed in seeds]))


if __name__ == "__main__":
    main()
