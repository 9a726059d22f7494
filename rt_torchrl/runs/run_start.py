"""What a run begins with: the sources that its option ``start`` names, read and checked before any work."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.fit.log import READERS, Column, checked, read_log
from rt_torchrl.fit.resampling import resample
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal
from rt_torchrl.runs import checkpoint
from rt_torchrl.runs.configured_plant import MakesPlant
from rt_torchrl.runs.loaded_run import load_run
from rt_torchrl.runs.run_config import STARTS, RunConfig
from rt_torchrl.runs.settings import read_settings
from rt_torchrl.steps.config import ROLES, Role
from rt_torchrl.steps.hypotheses.ensemble import TwinEnsemble, make_twin
from rt_torchrl.steps.start import EarlierPolicies, FirstController, RecordedFlights, Start
from rt_torchrl.trajectories.trajectory import Trajectory, pieces_of_equal_length
from rt_torchrl.trajectories.twin import DigitalTwin

SHORTEST = 10
"""Least number of control intervals of a part of a log."""
MakesStart = Callable[[Plant, nn.Module], Start | None]
"""Function of the twin's physics and closure, both on their device, that makes the start."""


def start_of(config: RunConfig, plant: Plant, controller: type[ClassicalController] | None) -> MakesStart:
    """Read and check what ``config.start`` names.

    A run that goes on from a checkpoint has begun already, so that nothing is read for it.

    Args:
        config: options of the run.
        plant: physics of the twin, for which policies and controllers are made.
        controller: class of the classical controller that the real system has had so far, if it has had one.

    Returns:
        Function that makes the start.

    Raises:
        ValueError: if there is no such source, or it does not fit the run.
    """
    name = config.start
    begun = config.resume and config.log_dir is not None and checkpoint.exists(config.log_dir / checkpoint.NAME)
    if begun or name == "random":
        return lambda physics, closure: None
    if name == "controller":
        if controller is None:
            raise ValueError("start='controller' needs the controller: give Run(..., first=...), or start='random'.")
        law = controller(plant)
        return lambda physics, closure: FirstController(law.to(_device_of(physics, closure)))
    if name == "mpc":
        # No critic has learned anything yet that could price the end of a window.
        options = dataclasses.replace(config.twinning.planner.receding_horizon, terminal="plant")
        return lambda physics, closure: FirstController(PredictiveControl(physics, closure, options))
    path = Path(name)
    if path.is_dir():
        return _of_run(path, config, plant)
    if path.suffix.lower() in READERS and path.is_file():
        return _of_log(path, config, plant)
    raise ValueError(
        f"start={name!r} is none of {', '.join(STARTS)}, and there is no such run folder or log; a log ends in "
        f"{' or '.join(READERS)}."
    )


def twin_of(
    config: RunConfig, physics: Plant, closure: nn.Module, first: Start | None, *, compiled: bool
) -> DigitalTwin:
    """The twin of a run, with the hypotheses of an earlier one that it begins with."""
    twin = make_twin(physics, closure, config.twinning.hypotheses, engine=config.engine, compiled=compiled)
    if isinstance(first, EarlierPolicies):
        first.hand_over(twin)
    return twin


def _of_run(folder: Path, config: RunConfig, plant: Plant) -> MakesStart:
    name = read_settings(folder)["plant"]
    if name != plant.name:
        raise ValueError(f"start={str(folder)!r} is a run of plant {name!r}, this run is of plant {plant.name!r}.")
    kind = type(config)
    run = load_run(folder, kind, plant=None if issubclass(kind, MakesPlant) else plant)
    for what in ("observations", "actions"):
        its, ours = (_described(getattr(each, what)) for each in (run.physics, plant))
        if its != ours:
            raise ValueError(
                f"start={str(folder)!r} is a run whose {what} are {', '.join(map(str, its))}; here they are "
                f"{', '.join(map(str, ours))}. Give the options of that run, such as --observe, or another start."
            )
    _require_same_closure(folder, run.closure, config.make_closure(plant, torch.Generator()))
    hypotheses = _hypotheses(folder, run.twin, config, plant)
    arm = run.config.twinning.arm
    policies = {role: run.policies[role] for role in ROLES if arm in ("twinning", role)}

    def start(physics: Plant, closure: nn.Module) -> EarlierPolicies:
        device = _device_of(physics, closure)
        return EarlierPolicies(
            {role: policy.to(device) for role, policy in policies.items()},
            run.closure.to(device),
            _live(folder),
            hypotheses,
        )

    return start


def _described(signals: tuple[Signal, ...]) -> list[Any]:
    """What two policies must agree about: names, units and ranges of signals."""
    return [(signal.name, signal.unit, signal.low, signal.high) for signal in signals]


def _require_same_closure(folder: Path, its: nn.Module, ours: nn.Module) -> None:
    shapes = [{name: weight.shape for name, weight in each.state_dict().items()} for each in (its, ours)]
    if type(its) is not type(ours) or shapes[0] != shapes[1]:
        raise ValueError(
            f"start={str(folder)!r} is a run whose twin has a closure {type(its).__name__}, which does not fit the "
            f"{type(ours).__name__} of this run; give that run's --closure and --closure-hidden."
        )


def _hypotheses(folder: Path, its: DigitalTwin, config: RunConfig, plant: Plant) -> dict[str, Any] | None:
    """The hypotheses of a run, where this run has some, too: the same ones, or else the run believed none."""
    ours = make_twin(plant, config.make_closure(plant, torch.Generator()), config.twinning.hypotheses)
    if not isinstance(its, TwinEnsemble) or not isinstance(ours, TwinEnsemble):
        return None
    found: dict[str, Any] = its.state_dict()["hypotheses"]
    try:
        ours.load_hypotheses(found)
    except ValueError as error:
        if its.hypothesis is None:
            return None
        raise ValueError(
            f"start={str(folder)!r} is a run that believes {its.hypothesis!r}, but {error} Give the "
            "--twinning.hypotheses.names of that run, or --twinning.hypotheses.which none to plan on the twin alone."
        ) from error
    return found


def _live(folder: Path) -> Role:
    """The role that was live at the end of a run."""
    file = folder / "metrics.json"
    try:
        role = json.loads(file.read_text(encoding="utf-8"))["summary"]["live"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{file} does not say which policy was live ({error!r}); take a finished run.") from error
    if role not in ROLES:
        raise ValueError(f"{file} says that {role!r} was live; it must be {' or '.join(ROLES)}.")
    return role


def _of_log(path: Path, config: RunConfig, physics: Plant) -> MakesStart:
    options = config.log
    columns = [Column.parse(text) for text in options.columns]
    log = checked(read_log(path, physics, columns), physics, drop=options.drop)
    # A learner sums the rewards of several intervals.
    shortest = max(SHORTEST, config.twinning.learner.return_steps)
    segments = resample(log, physics, gap=options.gap, shortest=shortest).segments
    records = pieces_of_equal_length(segments, physics.n_steps, physics.dt)

    def start(physics: Plant, closure: nn.Module) -> RecordedFlights:
        device = _device_of(physics, closure)
        return RecordedFlights(physics, [on(device, record) for record in records])

    return start


def on(device: torch.device, record: Trajectory) -> Trajectory:
    """The record on a device."""
    return record.mapped(lambda part: part.to(device))


def _device_of(*modules: nn.Module) -> torch.device:
    parts = (part for module in modules for part in (*module.parameters(), *module.buffers()))
    return next((part.device for part in parts), torch.device("cpu"))
