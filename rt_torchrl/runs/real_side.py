"""The real side of a run: the system in simulation, the episodes that judge on it, and what does not go with it."""

import torch

from rt_torchrl.evaluation.baseline import Baseline, RealController
from rt_torchrl.evaluation.real_episodes import RealEpisodes
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.real_system import RealSystem


def simulated(plant: Plant, config: RunConfig, *, device: torch.device, compiled: bool) -> PlantEnv:
    """The real system in simulation, with the sensors and the wear of the configuration."""
    wear = config.wear(plant)
    return PlantEnv(plant, seed=config.seed, device=device, compiled=compiled, noise=config.noise, wear=wear)


def judged_on(
    plant: Plant, env: RealSystem | None, count: int, *, device: torch.device, compiled: bool
) -> UnseenEpisodes:
    """The unseen episodes: on the plant, or on the real system itself if its closure is not known."""
    if env is None or env.closure is not None:
        return UnseenEpisodes(plant, count, compiled=compiled, device=device)
    return RealEpisodes(env, count, device=device)


def require_simulation(
    config: RunConfig, plant: Plant, env: RealSystem | None, baselines: dict[str, type[Baseline]] | None
) -> None:
    """Refuse options that only a plant in simulation can carry out, and controllers that need the other kind of system.

    Raises:
        ValueError: if there is such an option or controller; it names it.
    """
    if env is not None and (config.noise or config.wear(plant) is not None):
        raise ValueError(f"noise={config.noise} and wear need a plant in simulation; this run has a real system.")
    real = [name for name, law in (baselines or {}).items() if issubclass(law, RealController)]
    on_the_plant = [name for name in baselines or {} if name not in real]
    if real and (env is None or env.closure is not None):
        raise ValueError(
            f"baselines {real} can only be flown on a real system, and this run judges on the plant in simulation. "
            "Give ClassicalController classes, or a RealSystem without its closure."
        )
    if env is not None and env.closure is None and (config.reference or on_the_plant):
        raise ValueError(
            f"reference={config.reference} and baselines {on_the_plant} are flown on the plant under the true closure, "
            "and the real system's is not known; leave them out, or give the RealSystem its closure."
        )


def physics_known(plant: Plant, believed: Plant | None) -> Plant:
    """The physics of the twin of a real system.

    Args:
        plant: the real system.
        believed: physics that the twin is given; None for those of the real system.

    Raises:
        ValueError: if the twin has states that no sensor of the real system reads, or lacks some that one reads.
    """
    physics = believed or plant
    known, read = ([state.name for state in states] for states in (physics.states, plant.readings))
    if known != read:
        raise ValueError(
            f"a twin of plant {plant.name!r} with the states {', '.join(known)} cannot be fitted to records of "
            f"{', '.join(read)}, which is all that sensors read; give believed, the plant without its extensions."
        )
    return physics
