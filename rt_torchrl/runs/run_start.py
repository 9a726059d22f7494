"""What a run begins with: plant, controllers and options that go together, its start, and its real system."""

import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl.contract.check import check_plant, require_controller
from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.evaluation.unseen import Baseline, RealController, TwinEpisodes, UnseenEpisodes
from rt_torchrl.export.program import interface
from rt_torchrl.fit.log import READERS, Column, checked, read_log
from rt_torchrl.fit.resampling import resample
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import StateBounds
from rt_torchrl.runs.loaded_run import load_run
from rt_torchrl.runs.run_config import STARTS, MakesPlant, RunConfig, require_plant
from rt_torchrl.runs.run_folder import checkpoints
from rt_torchrl.steps.config import ROLES, Role
from rt_torchrl.steps.hypotheses.ensemble import TwinEnsemble, make_twin
from rt_torchrl.steps.start import EarlierPolicies, FirstController, RecordedFlights, Start
from rt_torchrl.systems.config import SafetyConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.operation import FIRST, Operation, Operator
from rt_torchrl.systems.real_system import RealSystem, episode_seed
from rt_torchrl.systems.safety import OperatingLimits, SafetyLayer
from rt_torchrl.trajectories.trajectory import SHORTEST, between_ends, pieces_of_equal_length
from rt_torchrl.trajectories.twin import DigitalTwin


def start_of(config: RunConfig, plant: Plant, controller: type[ClassicalController] | None) -> Start | None:
    """Read and check what ``config.start`` names; None for random weights, and where predictive control flies first.

    A run that goes on from a checkpoint has begun already: the flights of a log are in it, so that the log is not read
    again. What has flown first may act again.

    Args:
        config: options of the run.
        plant: physics of the twin on its device, for which policies and controllers are made.
        controller: class of the classical controller that the real system has had so far, if it has had one.

    Raises:
        ValueError: if there is no such source, or it does not fit the run.
    """
    name = config.start or "random"
    if name in ("random", "mpc"):
        return None
    if name == "controller":
        if controller is None:
            raise ValueError("start='controller' needs the controller: give Run(..., first=...), or start='random'.")
        return FirstController(controller(plant).to(config.device))
    path = Path(name)
    if path.is_dir():
        return _of_run(path, config, plant)
    is_log = path.suffix.lower() in READERS
    if is_log and config.resume and config.log_dir is not None and checkpoints(config.log_dir):
        return None
    if is_log and path.is_file():
        return _of_log(path, config, plant)
    raise ValueError(
        f"start={name!r} is none of {', '.join(STARTS)}, and there is no such run folder or log; a log ends in "
        f"{' or '.join(READERS)}."
    )


def _of_run(folder: Path, config: RunConfig, plant: Plant) -> EarlierPolicies:
    where, kind = f"start={str(folder)!r} is a run", type(config)
    run = load_run(folder, kind, plant=None if issubclass(kind, MakesPlant) else plant)
    closure, hypotheses = config.make_closure(plant, torch.Generator()), None
    earlier_ends, ends = interface(run.physics), interface(plant)  # offsets and scales of observations, too
    compared = {what: (earlier_ends[what], ends[what]) for what in ("plant", "observation", "action")}
    # Weights of the same shapes may be those of another law.
    compared["closure"] = type(run.closure).__name__, type(closure).__name__
    for what, (earlier, present) in compared.items():
        if earlier != present:
            raise ValueError(
                f"{where} whose {what} is {earlier}; here it is {present}. Give the options of that run, such as "
                "--observe or --closure, or another start."
            )
    try:
        closure.load_state_dict(run.closure.state_dict())
        twin = make_twin(plant, closure, config.twinning.hypotheses)
        if isinstance(run.twin, TwinEnsemble) and isinstance(twin, TwinEnsemble):
            hypotheses = run.twin.state_dict()["hypotheses"]
            twin.load_hypotheses(hypotheses)
    except RuntimeError as error:
        raise ValueError(f"{where} whose closure does not fit that of this run; give its --closure. {error}") from error
    except ValueError as error:
        if run.twin.hypothesis is not None:
            raise ValueError(
                f"{where} that believes {run.twin.hypothesis!r}, but {error} Give the "
                "--twinning.hypotheses.which of that run, or none to plan on the twin alone."
            ) from error
        hypotheses = None
    arm = run.config.twinning.arm
    policies = {role: run.policies[role].to(config.device) for role in ROLES if arm in ("twinning", role)}
    return EarlierPolicies(policies, run.closure.to(config.device), run.live, hypotheses)


def _of_log(path: Path, config: RunConfig, physics: Plant) -> RecordedFlights:
    options = config.log
    columns = [Column.parse(text) for text in options.columns]
    log = checked(read_log(path, physics, columns), physics, drop=options.drop)
    # A learner sums the rewards of several intervals.
    shortest = max(SHORTEST, config.twinning.learner.return_steps)
    segments = resample(log, physics, gap=options.gap, shortest=shortest).segments
    flown = [part for segment in segments for part in between_ends(physics, segment)]
    if not flown:
        raise ValueError(
            f"log {str(path)!r}: every row has a state in which episodes of plant {physics.name!r} have ended; log the "
            "operation, or correct units and `ended`."
        )
    records = pieces_of_equal_length(flown, physics.n_steps, physics.dt)
    return RecordedFlights(physics, [record.mapped(lambda part: part.to(config.device)) for record in records])


CHECKED_STEPS, COARSE = 10, 0.01
"""Number of control intervals on which a plant is checked before a run, and share of its move by which a step may err
without a warning; ``check_plant`` by itself checks more."""


def known_physics(
    config: RunConfig,
    plant: Plant,
    real: RealSystem | None,
    first: type[ClassicalController] | None,
    baselines: dict[str, type[Baseline]] | None,
) -> Plant:
    """The physics of the twin, where all that a run is given fits; the arguments are those of :class:`Run`.

    Raises:
        PlantContractError: if a plant breaks its contract.
        ValueError: if options, controllers, the twin's physics and the real system do not go together, or the twin has
            states that no sensor of the real system reads, or lacks some that one reads.
    """
    require_plant("plant", plant)
    unknown = real is not None and real.closure is None
    laws: dict[str, object] = dict(baselines or {})
    flown = [name for name, law in laws.items() if isinstance(law, type) and issubclass(law, RealController)]
    if real is not None and config.noise:
        raise ValueError(f"noise={config.noise} needs a plant in simulation; this run has a real system.")
    if flown and not (unknown and config.real_unseen):
        raise ValueError(
            f"baselines {flown} can only be flown on the real system: give a RealSystem without its closure, and "
            "real_unseen, the number of episodes that each may fly, or leave them out."
        )
    if unknown and config.reference:
        raise ValueError(
            f"reference={config.reference} is computed on the plant under the true closure, and the real system's is "
            "not known; leave it out, or give the RealSystem its closure."
        )
    believed = config.believed()
    physics = plant if believed is None else believed
    require_plant("config.believed()", physics)
    modelled, sensed = ([state.name for state in states] for states in (physics.states, plant.readings))
    if modelled != sensed:
        raise ValueError(
            f"a twin of plant {plant.name!r} with the states {', '.join(modelled)} cannot be fitted to records of "
            f"{', '.join(sensed)}, which is all that sensors read; let believed() of the Config give the plant without "
            "its extensions."
        )
    models = [plant] if believed is None else [plant, believed]
    reports = [check_plant(model, steps=CHECKED_STEPS, traced=False, trained=model is physics) for model in models]
    step_error = reports[-1].step_error  # of the twin's physics
    if step_error is not None and step_error > COARSE:
        warnings.warn(
            f"a Runge-Kutta step of dt={physics.dt:g} s of plant {physics.name!r} errs by {step_error:.2%} of "
            "its move, which a fit takes for one of the coefficients: use a smaller dt or an advance of several steps.",
            stacklevel=3,
        )
    controllers: dict[str, object] = {} if first is None else {"first": first}
    controllers |= {f"baselines[{name!r}]": law for name, law in laws.items() if name not in flown}
    for name, law in controllers.items():
        require_controller(name, law, physics)
    return physics


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
