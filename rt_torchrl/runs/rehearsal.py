"""A rehearsal of model predictive control in real time, on the closure that a training has found."""

import dataclasses
import gc
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.loaded_run import LoadedRun
from rt_torchrl.systems.collectors import EpisodeCollector
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.systems.reading import Reading
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.systems.safety import SafetyConfig, SafetyLayer
from rt_torchrl.systems.wall_clock import WallClock

SHARE = 0.8
"""Share of the time between two plans that a solve may take by default; the rest is for what comes around it."""


def controller(run: LoadedRun, physics: Plant, deadline: float | None) -> PredictiveControl:
    """Model predictive control with a deadline, on the closure of a training.

    Args:
        run: the training; if model predictive control acted in it, its forecast is taken too.
        physics: physics of the twin, with the horizon of the rehearsal.
        deadline: longest wall-clock time of a solve [s]; None for 0.8 of the time between two plans.
    """
    options = run.config.twinning.planner.receding_horizon
    period = options.period or options.hold or physics.dt
    options = dataclasses.replace(options, deadline=SHARE * period if deadline is None else deadline)
    found, acted = PredictiveControl(physics, run.closure, options), run.policy("model_based")
    if isinstance(acted, PredictiveControl):
        found.load_state_dict(acted.state_dict())
    return found


def rehearsed(
    policy: PredictiveControl, run: LoadedRun, plant: Plant, physics: Plant, *, seed: int, log: Path
) -> dict[str, float]:
    """Fly an episode in real time, behind a safety layer.

    Args:
        policy: the controller.
        run: the training whose model-free policy is the fallback of the safety layer.
        plant: plant that is simulated, with its own closure.
        physics: physics of the twin, which reads the sensors and judges by them.
        seed: seed of the episode.
        log: file of the safety layer's events, which is written anew.

    Returns:
        J_a, the numbers of what was late, and the times of solves and answers [ms].
    """
    log.unlink(missing_ok=True)
    clock = WallClock(plant)
    # An observation comes at the end of its interval; half an interval later the machine has stopped to answer.
    limits = SafetyConfig(interval=plant.dt, deadline=1.5 * plant.dt, log=log)
    guarded = SafetyLayer(clock.environment(), limits, fallback=Fallback(physics, run))
    state, exogenous, applied = (Reading(keys=(name,)) for name in ("state", "exogenous", "applied"))
    system = RealSystem(
        guarded, physics, state=state, exogenous=exogenous, applied=applied, closure=plant.closure, seed=seed
    )
    actor = LivePolicy(physics, policy, ExplorationConfig(), generator=torch.Generator())
    actor.begin(policy, strength=0.0)
    gc.collect()
    gc.freeze()  # a collection of all objects that the libraries have made would stop an action
    try:
        episode = EpisodeCollector(system, actor, physics).rollout()
    finally:
        gc.unfreeze()
        system.close()
    found = {
        "J_a": -episode["next", "reward"].mean().item(),
        "intervals": float(plant.n_steps),
        "solves": float(len(policy.solves)),
        "late_solves": float(sum(solve.late for solve in policy.solves)),
        "late_actions": float(clock.late),
        "safety_events": float(len(guarded.report.events)),
    }
    return found | _times("solve", [solve.seconds for solve in policy.solves]) | _times("answer", clock.answers)


class Fallback:
    """The model-free policy of a training, in the place of a controller whose observation is faulty.

    Args:
        plant: the plant.
        run: the training.
    """

    def __init__(self, plant: Plant, run: LoadedRun):
        self.plant, self.policy = plant, run.policy("model_free")

    def __call__(self, reported: TensorDictBase) -> Tensor:
        return self.policy(self.plant.observe(reported["time"][..., 0], reported["state"], reported["exogenous"]))


def _times(name: str, seconds: list[float]) -> dict[str, float]:
    """Median, 99th percentile and greatest of some times [ms]."""
    milliseconds = 1e3 * np.array(seconds)
    median, p99 = np.percentile(milliseconds, [50.0, 99.0]).tolist()
    return {f"{name}_median_ms": median, f"{name}_p99_ms": p99, f"{name}_max_ms": float(milliseconds.max())}
