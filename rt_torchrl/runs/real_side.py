"""The real side of a run: the system in simulation, and the episodes that judge on it."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.evaluation.unseen import TwinEpisodes, UnseenEpisodes
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import StateBounds
from rt_torchrl.runs.run_config import RunConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.operating_limits import OperatingLimits
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.systems.safety import SafetyLayer
from rt_torchrl.systems.safety_config import SafetyConfig
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.twin import DigitalTwin


class Resting:
    """The fallback of a safety layer where nothing else is known: the action nearest to zero within the limits.

    Args:
        controller: controller that the real system has had so far, which acts instead; None if there is none.
        rest: that action.
        dt: control interval [s].
    """

    def __init__(self, controller: StateFeedback | None, rest: Tensor, *, dt: float):
        self.controller, self.rest = controller, rest
        self._dt, self._intervals = dt, 0

    def begin(self) -> None:
        """Begin an episode."""
        self._intervals = 0
        if self.controller is not None:
            self.controller.begin()

    def __call__(self, reported: TensorDictBase) -> Tensor:
        """The action of the next interval; the controller is asked in each one, so that its memory goes on."""
        if self.controller is None:
            return self.rest
        t, self._intervals = self._intervals * self._dt, self._intervals + 1
        return self.controller.act(t, reported["state"], reported["exogenous"])


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
    controller = None if first is None else first(plant, compiled=compiled).to(device)
    zero = env.action_spec.zero()
    low, high = (zero.new_tensor(end) for end in limits.actions)
    rest = torch.minimum(torch.maximum(zero, low), high).clamp(env.action_spec.space.low, env.action_spec.space.high)
    config_of_layer = SafetyConfig(interval=plant.dt, **limits.safety())
    return SafetyLayer(env, config_of_layer, fallback=Resting(controller, rest, dt=plant.dt))


def judged_on(
    plant: Plant, twin: DigitalTwin, env: RealSystem | None, config: RunConfig, *, device: torch.device, compiled: bool
) -> UnseenEpisodes:
    """The unseen episodes, for which no real system moves: on the plant, or on the twin if nobody knows the closure.

    Policies for them are made for the physics that the twin knows, and leaving the bounds of states counts.
    """
    if env is None or env.closure is not None:
        unseen = UnseenEpisodes(plant, config.unseen, compiled=compiled, device=device)
        unseen.judged_on = "simulation" if env is None else "simulation of the real system"
    else:
        unseen = TwinEpisodes(twin, plant, config.unseen, device=device)
    physics = twin.plant
    unseen.physics, unseen.bounds = physics, StateBounds(plant.readings, config.twinning.bounded_states)
    return unseen
