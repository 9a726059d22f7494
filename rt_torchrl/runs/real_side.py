"""The real system of a run: in simulation, operated beside the learning, and flown after the training."""

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.evaluation.unseen import Judged, TwinEpisodes, UnseenEpisodes, compared
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import StateBounds
from rt_torchrl.runs.metrics import read_metrics
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.steps.config import Role
from rt_torchrl.steps.start import Start
from rt_torchrl.steps.switch import clones
from rt_torchrl.systems.config import SafetyConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.operation import FIRST, Operation, Operator
from rt_torchrl.systems.real_system import RealSystem, episode_seed
from rt_torchrl.systems.safety import OperatingLimits, SafetyLayer
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory, until_end
from rt_torchrl.trajectories.twin import DigitalTwin


def simulated(
    plant: Plant, config: RunConfig, first: type[ClassicalController] | None, *, device: torch.device
) -> EnvBase:
    """The real system in simulation, with the sensors of the configuration.

    With limits it is behind a safety layer, whose fallback is the controller that the real system has had so far, or
    the action nearest to zero within the limits.
    """
    env = PlantEnv(plant, seed=config.seed, device=device, noise=config.noise)
    if not config.twinning.limits:
        return env
    limits = OperatingLimits(plant, config.twinning.limits)
    config_of_layer = SafetyConfig(interval=plant.dt, **limits.safety())
    if first is not None:
        return SafetyLayer(env, config_of_layer, fallback=first(plant).to(device))
    space = env.action_spec.space
    ends = zip(*limits.actions, space.low.flatten().tolist(), space.high.flatten().tolist(), strict=True)
    rest = [min(max(0.0, low, least), high, greatest) for low, high, least, greatest in ends]
    return SafetyLayer(env, config_of_layer, fallback=rest)


def judged_on(
    plant: Plant, twin: DigitalTwin, env: RealSystem | None, config: RunConfig, *, device: torch.device
) -> UnseenEpisodes:
    """The unseen episodes, for which no real system moves: on the plant, or on the twin if nobody knows the closure.

    Policies for them are made for the physics that the twin knows, and leaving the bounds of states counts.
    """
    if env is None:
        unseen = UnseenEpisodes(plant, config.unseen, device=device)
        beside = {"noise of the sensors": config.noise, "the safety layer": config.twinning.limits}
        if left_out := " and ".join(what for what, there in beside.items() if there):
            unseen.judged_on = f"simulation without {left_out}"  # with which real_unseen flies
    elif env.closure is not None:
        unseen = UnseenEpisodes(plant, config.unseen, device=device)
        unseen.closure, unseen.judged_on = env.closure, "simulation of the real system"
    else:
        unseen = TwinEpisodes(twin, plant, config.unseen, device=device)
    unseen.physics, unseen.bounds = twin.plant, StateBounds(plant.readings, config.twinning.limits.states)
    return unseen


NOISE = 2**20
"""Number of the seed of the exploration's noise among the seeds of a run; episodes have smaller ones."""


def learner_threads(config: RunConfig) -> int:
    """Number of CPU threads of the learner; 0 leaves torch's default.

    Threads of torch wait actively: where there are more of them than cores, they take the time from each other.
    """
    if config.threads or not config.asynchronous:
        return config.threads
    return min(torch.get_num_threads(), max(1, (os.cpu_count() or 1) - 1))


def operation_of(
    config: RunConfig,
    env: EnvBase,
    make_env: Callable[[], EnvBase] | None,
    plant: Plant,
    policies: Mapping[Role, nn.Module],
    *,
    first: Start | None = None,
) -> Operation:
    """The operation of a run.

    Args:
        config: options of the run.
        env: the real system.
        make_env: function that makes the real system in another process; None if there is none.
        plant: physics of the twin.
        policies: both policies by role.
        first: what the training begins with, whose teacher may act, too.

    Raises:
        ValueError: if one of these does not allow it, or :class:`Operation` raises it.
    """
    if plant.end_cost is not None or make_env is None or config.device != "cpu":
        raise ValueError(
            "asynchronous needs a function that makes the real system in another process, Run(..., env=), episodes "
            f"that do not end early, and the CPU; here device={config.device!r}, and the plant is {plant.name!r}."
        )
    acting: dict[str, nn.Module] = {str(role): policy for role, policy in policies.items()}
    if first is not None and first.teacher is not None:
        acting[FIRST] = first.teacher
    seed = episode_seed(config.seed, NOISE)
    operator = Operator(make_env, plant, acting, config.twinning.exploration, config.operation, seed=seed)
    return Operation(operator, env)


def grounded(config: RunConfig, algorithm: ReinforcementTwinning, untrained: Mapping[Role, nn.Module]) -> str:
    """Why the live policy does not fly the real system after the training; empty if it does.

    It does not where it still has the random weights that it began with, and where it may not act.

    Args:
        config: options of the run.
        algorithm: the training at its end.
        untrained: the policies before it.
    """
    live, interact = algorithm.referee.live, algorithm.steps["interact"]
    policy = algorithm.policies[live]
    if config.start == "random" and not isinstance(policy, StateFeedback) and clones(policy, untrained[live]):
        return f"{live} has its random initial weights"
    return interact.supervisor.refusal(live, interact.supervisor.episodes())[0]


def entries(
    plant: Plant, flights: Mapping[str, Trajectory], judged: Mapping[str, Judged], live: Role
) -> dict[str, Any]:
    """The entry ``real_unseen`` of the summary, without J_p.

    Where the live policy flew the same episodes as another controller, ``ratio`` is the mean of its costs over that of
    the other one, with a confidence interval, and ``cheaper`` the number of episodes in which it is cheaper.

    Args:
        plant: plant of the real system.
        flights: flights by the name of the controller.
        judged: what these cost.
        live: name of the live policy, which need not have flown.
    """
    controllers = {}
    for name, judgement in judged.items():
        controllers[name] = judgement.statistics()
        if name != live and live in flights and _same_episodes(plant, flights[name], flights[live]):
            controllers[name] |= compared(judged[live].control_costs, judgement.control_costs)
    return {
        "controllers": controllers,
        "costs": {name: judgement.control_costs.tolist() for name, judgement in judged.items()},
    }


def _same_episodes(plant: Plant, flown: Trajectory, other: Trajectory) -> bool:
    """Whether starts are the same, and inputs until one of both ends early: nothing is read after that."""
    if not torch.equal(flown.states[:, 0], other.states[:, 0]):
        return False
    for flights in zip(flown.each(), other.each(), strict=True):
        inputs = [until_end(plant, flight).exogenous for flight in flights]
        n = min(map(len, inputs))
        if not torch.equal(inputs[0][:n], inputs[1][:n]):
            return False
    return True


def judged_before(folder: Path, episodes: int, names: Iterable[str], count: int) -> dict[str, Any] | None:
    """The entry that an earlier end of a run has left after as many episodes; None without.

    Args:
        folder: run folder.
        episodes: number of episodes of the training.
        names: names of the controllers that are to fly.
        count: number of flights of each.
    """
    if not (folder / "metrics.json").is_file():
        return None
    metrics = read_metrics(folder)
    entry: dict[str, Any] | None = metrics["summary"].get("real_unseen")
    if entry is None or len(metrics["episodes"]) != episodes:
        return None
    flown = {name: controller["episodes"] for name, controller in entry["controllers"].items()}
    return entry if flown == dict.fromkeys(names, count) else None


def paid_before(folder: Path) -> list[float | None]:
    """J_a of the flights that earlier ends of a resumed run have made; null stands for one that is not finite."""
    if not (folder / "metrics.json").is_file():
        return []
    return list(read_metrics(folder)["summary"]["cost_of_learning"].get("judging", []))
