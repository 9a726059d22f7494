"""The physics that the twin of a run knows, once plants, controllers and options are found to go together."""

from rt_torchrl.contract.check import check_plant, require_controller
from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.evaluation.unseen import Baseline, RealController
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.configured_plant import require_plant
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.systems.real_system import RealSystem

CHECKED_STEPS = 10
"""Number of control intervals on which a plant is checked before a run; ``check_plant`` by itself checks more."""


def known_physics(
    config: RunConfig,
    plant: Plant,
    believed: Plant | None,
    real: RealSystem | None,
    first: type[ClassicalController] | None,
    baselines: dict[str, type[Baseline]] | None,
) -> Plant:
    """The physics of the twin, where all that a run is given fits; the arguments are those of :class:`Run`.

    Raises:
        PlantContractError: if a plant breaks its contract.
        ValueError: if options, controllers, the twin's physics and the real system do not go together.
    """
    require_simulation(config, plant, real, baselines)
    physics = require_physics(plant, believed)
    for one in filter(None, (plant, believed)):
        check_plant(one, steps=CHECKED_STEPS, traced=False, trained=one is physics)
    require_controllers(physics, first, baselines)
    return physics


def require_simulation(
    config: RunConfig, plant: Plant, env: RealSystem | None, baselines: dict[str, type[Baseline]] | None
) -> None:
    """Refuse options that only a plant in simulation can carry out, and controllers that need the other kind of system.

    Raises:
        ValueError: if there is such an option or controller; it names it.
    """
    if env is not None and (config.noise or config.wear(plant) is not None):
        raise ValueError(f"noise={config.noise} and wear need a plant in simulation; this run has a real system.")
    if env is None and config.real_unseen:
        raise ValueError(
            f"real_unseen={config.real_unseen} episodes after the training needs a real system, and this run simulates "
            "its own; leave it out, and unseen says how many episodes are simulated."
        )
    real = [name for name, law in (baselines or {}).items() if _acts_on_the_real_system(law)]
    on_the_plant = [name for name in baselines or {} if name not in real]
    if real and (env is None or env.closure is not None):
        raise ValueError(
            f"baselines {real} can only be flown on a real system, and this run judges on the plant in simulation. "
            "Give ClassicalController classes, or a RealSystem without its closure."
        )
    if real and not config.real_unseen:
        raise ValueError(
            f"baselines {real} can only be flown on the real system, which flies nothing after the training with "
            "real_unseen=0; say how many episodes each may fly, such as real_unseen=5, or leave them out."
        )
    if env is not None and env.closure is None and (config.reference or on_the_plant):
        raise ValueError(
            f"reference={config.reference} and baselines {on_the_plant} are flown on the plant under the true closure, "
            "and the real system's is not known; leave them out, or give the RealSystem its closure."
        )


def _acts_on_the_real_system(law: object) -> bool:
    return isinstance(law, type) and issubclass(law, RealController)


def require_controllers(
    physics: Plant, first: type[ClassicalController] | None, baselines: dict[str, type[Baseline]] | None
) -> None:
    """Refuse controllers that are no classes, or whose laws do not fit the plant.

    Raises:
        ValueError: if there is one; the message names it, and says what is expected.
    """
    given: dict[str, object] = {} if first is None else {"first": first}
    given |= {f"baselines[{name!r}]": law for name, law in (baselines or {}).items()}
    for name, law in given.items():
        if not _acts_on_the_real_system(law):
            require_controller(name, law, physics)


def require_physics(plant: Plant, believed: Plant | None) -> Plant:
    """The physics of the twin of a real system.

    Args:
        plant: the real system.
        believed: physics that the twin is given; None for those of the real system.

    Raises:
        ValueError: if one is no plant, or the twin has states that no sensor of the real system reads, or lacks some
            that one reads.
    """
    require_plant("plant", plant)
    if believed is not None:
        require_plant("believed", believed)
    physics = believed or plant
    known, read = ([state.name for state in states] for states in (physics.states, plant.readings))
    if known != read:
        raise ValueError(
            f"a twin of plant {plant.name!r} with the states {', '.join(known)} cannot be fitted to records of "
            f"{', '.join(read)}, which is all that sensors read; give believed, the plant without its extensions."
        )
    return physics
