"""Trainings and results of a study, written by hand, that several tests of the study share."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np

from rt_torchrl.study.results import Entry, Results, arm_entry, yardstick_entry
from rt_torchrl.study.training import CHANGED, Training

EPISODES = 30
RECIPES = Path(__file__).parent.parent / "recipes"


def recipe(name):
    """A recipe as a module; tyro reads its source for the help."""
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def training(tmp_path, seed=0, **options):
    arguments = {"recipe": tmp_path / "some_plant.py", "arm": "twinning", "variant": "nominal", "seed": seed}
    arguments["episodes"] = 3
    return Training(**arguments | {"folder": tmp_path / f"seed-{seed}"} | options)


WRITE_RESULTS = (
    "(config.log_dir / 'metrics.json').write_text(json.dumps("
    "{'process': os.getpid(), 'summary': {}, 'episodes': [{}] * config.episodes}))"
)
"""Main of a recipe that does nothing but leave results."""


def written(path, main):
    """A recipe with the options that every recipe has, and with this code as its main."""
    path.write_text(
        "import json, os\n"
        "from rt_torchrl import RunConfig, configuration\n\n"
        "@configuration\n"
        "class Config(RunConfig):\n    pass\n\n"
        f"def main(config):\n    {main}\n"
    )
    return path


def summary(costs, live="model_based"):
    mean = {"mean": float(np.mean(costs))}
    return {
        "live": live,
        "J_p_ratio": 1e-3,
        "closure_error": {"found": [0.1, 0.02], "start": [1.0, 0.2]},
        "closure": {"found": {"a": 1.1, "b": 2.0}, "true": {"a": 1.0, "b": 2.0}},
        "unseen": {
            "costs": {"model_based": costs, "model_free": [2.0 * c for c in costs]},
            "merit": {role: {"m [m]": mean} for role in ("model_based", "model_free")},
            "J_a_before": {"mean": 10.0},
            "J_a_model_based": mean,
            "J_a_model_free": {"mean": 2.0 * mean["mean"]},
            "J_p_before": {"mean": 1.0},
            "J_p": {"mean": 1e-3},
        },
    }


def finished(tmp_path, seed, shift, **options):
    """A finished training, whose costs are about 1 + shift."""
    return finish(training(tmp_path, seed, **options), shift)


def finish(found, shift=0.0):
    """Write the results of a training, with costs of about 1 + shift in each of its episodes, at most three."""
    costs = (1.0 + shift + 0.1 * np.random.default_rng(7).standard_normal(EPISODES)).tolist()
    found.folder.mkdir(parents=True)
    episodes = [
        {"episode": k, "J_a_unseen": cost, "J_p": cost / 100, "event": event}
        for k, (cost, event) in enumerate(((5.0, "keep"), (1.05, "swap"), (1.0, "keep")))
    ]
    content = {"summary": summary(costs), "episodes": episodes[: found.episodes]}
    (found.folder / "metrics.json").write_text(json.dumps(content))
    return found


def results(tmp_path):
    trainings = [finished(tmp_path, seed, 0.0) for seed in range(2)]
    twinning = arm_entry("twinning", trainings)
    ruler = np.array(twinning.costs[0])
    yardsticks = [
        yardstick_entry(name, {"costs": (ruler * factor).tolist(), "merit": {"m [m]": {"mean": 1.0}}})
        for name, factor in (("PD", 1.5), ("oracle", 0.98))
    ]
    halves = [Entry(name="model_free", costs=twinning.costs * 3.0, merit=twinning.merit, curves=[[3.0]] * 2)]
    halves.append(Entry(name="model_based", costs=twinning.costs, merit=twinning.merit, curves=twinning.curves))
    halves.append(Entry(name="twinning, other", costs=twinning.costs * 2.0, merit=twinning.merit, curves=[[2.0]] * 2))
    noisy = [Entry(name=e.name, costs=1.5 * e.costs[:1], merit=e.merit) for e in (twinning, *halves[:2])]
    changed = [Entry(name=e.name, costs=e.costs, merit=e.merit, twin_errors=e.twin_errors) for e in (twinning, *halves)]
    variants = {"noise 1 %": noisy, CHANGED: [*changed[:3], yardsticks[0]]}
    summaries = [t.metrics()["summary"] for t in trainings]
    plant = "flapping_wing"
    few = np.array(ruler[:8])
    limits = [
        yardstick_entry("limit", {"costs": (0.5 * few).tolist(), "merit": {"m [m]": {"mean": 1.0}}}),
        yardstick_entry(
            "mpc",
            {"costs": (0.75 * few).tolist(), "merit": {"m [m]": {"mean": 1.0}}, "milliseconds": {"median": 3.25}},
        ),
    ]
    return Results({plant: [twinning, *halves, *yardsticks]}, {plant: summaries}, {plant: variants}, {plant: limits})
