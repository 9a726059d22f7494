"""The operation of an asynchronous run, as its configuration asks for it."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.steps.config import Role
from rt_torchrl.steps.start import Start
from rt_torchrl.systems.operation.acting import Crew
from rt_torchrl.systems.operation.cores import chosen_core
from rt_torchrl.systems.operation.event_log import EventLog
from rt_torchrl.systems.operation.operation import Operation
from rt_torchrl.systems.operation.order import FIRST
from rt_torchrl.systems.operation.process import ProcessOperation
from rt_torchrl.systems.operation.simulated import SimulatedOperation
from rt_torchrl.systems.real_system import episode_seed

EVENTS = "events.jsonl"
"""File of the operation's events in a run folder."""
NOISE = 2**20
"""Number of the seed of the exploration's noise among the seeds of a run; episodes have smaller ones."""


def learner_threads(config: RunConfig) -> int:
    """Number of CPU threads of the learner; 0 leaves torch's default.

    Threads of torch wait actively: where there are more of them than cores, they take the time from each other.
    """
    options = config.operation
    beside = config.asynchronous and options.clock == "wall"
    if config.threads or not beside or chosen_core(options.core) is None:
        return config.threads
    return min(torch.get_num_threads(), max(1, len(os.sched_getaffinity(0)) - 1))


def acting_by_name(policies: Mapping[Role, nn.Module], first: Start | None) -> dict[str, nn.Module]:
    """Everything that may act in a run: the policies by role, and what the training begins with."""
    found: dict[str, nn.Module] = {str(role): policy for role, policy in policies.items()}
    teacher = None if first is None else first.teacher
    return found if teacher is None else found | {FIRST: teacher}


def operation_of(
    config: RunConfig,
    env: EnvBase,
    make_env: Callable[[], EnvBase] | None,
    plant: Plant,
    policies: dict[str, nn.Module],
    *,
    folder: Path,
) -> Operation:
    """The operation of a run.

    Args:
        config: options of the run.
        env: the real system.
        make_env: function that makes the real system in another process; None if there is none.
        plant: physics of the twin.
        policies: everything that may act, by name.
        folder: run folder, for the log of the events.

    Raises:
        ValueError: if episodes of the plant may end early; if model predictive control is to ask the critic; on the
            wall clock, if there is no function that makes the real system, the device is not the CPU, or what acts
            cannot be sent to another process.
    """
    if plant.end_cost is not None:
        raise ValueError(
            f"episodes of plant {plant.name!r} may end early, which windows of operation do not; leave out "
            "--asynchronous."
        )
    options, planner = config.operation, config.twinning.planner
    if planner.method == "receding_horizon" and planner.receding_horizon.terminal == "critic":
        raise ValueError(
            "twinning.planner.receding_horizon.terminal='critic' does not go with asynchronous: the critic goes on "
            "learning while the controller acts. Use terminal plant."
        )
    crew = Crew(
        make_env or (lambda: env),
        plant,
        policies,
        config.twinning.exploration,
        options,
        seed=episode_seed(config.seed, NOISE),
    )
    log = EventLog(folder / EVENTS)
    if options.clock == "simulated":
        learning = round(options.learning * plant.n_steps)
        return SimulatedOperation(crew.operator(env), learning=learning, log=log)
    if make_env is None:
        raise ValueError(
            "clock='wall' needs the real system in a process of its own; give Run(..., env=) a function that makes it."
        )
    if config.device != "cpu":
        raise ValueError(f"clock='wall' acts on the CPU alone, and device={config.device!r}; give --device cpu.")
    return ProcessOperation(crew, env, log=log)


def end_operation(algorithm: ReinforcementTwinning) -> None:
    """End the operation of the real system, if it operates while the algorithm learns."""
    if algorithm.operating is not None:
        algorithm.operating.operation.close()
