"""The real side of a run: the system in simulation, the episodes that judge on it, and what does not go with it."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from rt_torchrl.baselines.acting import ActingController
from rt_torchrl.baselines.check import require_controller
from rt_torchrl.baselines.classical import ClassicalController
from rt_torchrl.evaluation.baseline import Baseline, RealController
from rt_torchrl.evaluation.real_episodes import RealEpisodes
from rt_torchrl.evaluation.unseen import UnseenEpisodes
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs.configured_plant import require_plant
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.operating_limits import OperatingLimits
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.systems.safety import SafetyConfig, SafetyLayer


class Resting:
    """The fallback of a safety layer where nothing else is known: the action nearest to zero within the limits.

    Args:
        controller: controller that the real system has had so far, which acts instead; None if there is none.
        rest: that action.
    """

    def __init__(self, controller: ActingController | None, rest: Tensor):
        self.controller, self.rest = controller, rest

    def begin(self) -> None:
        """Begin an episode."""
        if self.controller is not None:
            self.controller.begin()

    def __call__(self, reported: TensorDictBase) -> Tensor:
        if self.controller is None:
            return self.rest
        return self.controller.act(0.0, reported["state"], reported["exogenous"])


def simulated(
    plant: Plant,
    config: RunConfig,
    first: type[ClassicalController] | None,
    *,
    device: torch.device,
    compiled: bool,
) -> EnvBase:
    """The real system in simulation, with the sensors and the wear of the configuration.

    With limits it is behind a safety layer, whose fallback is the controller that the real system has had so far, or
    rest.
    """
    wear = config.wear(plant)
    env = PlantEnv(plant, seed=config.seed, device=device, compiled=compiled, noise=config.noise, wear=wear)
    if not config.twinning.limits:
        return env
    limits = OperatingLimits(plant, config.twinning.limits)
    controller = None if first is None else ActingController(first(plant, compiled=compiled).to(device))
    zero = env.action_spec.zero()
    low, high = (zero.new_tensor(end) for end in limits.actions)
    rest = torch.minimum(torch.maximum(zero, low), high).clamp(env.action_spec.space.low, env.action_spec.space.high)
    config_of_layer = SafetyConfig(interval=plant.dt, **limits.safety())
    return SafetyLayer(env, config_of_layer, fallback=Resting(controller, rest))


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
    real = [name for name, law in (baselines or {}).items() if _acts_on_the_real_system(law)]
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


def physics_known(plant: Plant, believed: Plant | None) -> Plant:
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
