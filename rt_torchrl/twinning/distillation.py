r"""Distillation: the idle policy imitates the live one where it cannot take its weights, because architectures differ.

The imitation is behaviour cloning. It compares actions, as shares of their ranges, on observations from the real system
and from the twin:

.. math:: \min_w \mathbb E_e\,\Big\|\frac{\pi(e; w) - \pi_{live}(e)}{a_{hi} - a_{lo}}\Big\|^2
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.optimisers.descent import Descent, DescentConfig
from rt_torchrl.options import check_options
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback, commands_along
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

BLOWN_UP = 1e3
"""Observation, which is of order one in a sound flight, beyond which a twin has blown up."""


@dataclass(frozen=True, kw_only=True)
class DistillationConfig:
    """Parameters of a clone between two architectures; policies of the same architecture copy weights instead.

    Args:
        iterations: gradients of the imitation loss in each round (L-BFGS on all observations at once).
        rounds: number of rounds. Each round after the first adds observations of virtual episodes that the clone itself
            flies, so that it also learns what to do where its own errors lead (DAgger, Ross et al. 2011).
        samples: greatest number of observations from each source (the real system, and every set of virtual episodes).
            A source with more observations is thinned evenly.
    """

    iterations: int = 200
    rounds: int = 2
    samples: int = 5000

    def __post_init__(self) -> None:
        check_options(self)
        for argument in ("iterations", "rounds", "samples"):
            if getattr(self, argument) < 1:
                raise ValueError(f"{argument}={getattr(self, argument)} of the distillation must be at least 1.")


class Distillation:
    """Makes the idle policy imitate the live one.

    Args:
        twin: twin on which the policies are flown.
        config: parameters of the imitation.
    """

    def __init__(self, twin: DigitalTwin, config: DistillationConfig):
        self.twin, self.config = twin, config

    def imitate(
        self,
        live: nn.Module,
        idle: nn.Module,
        *,
        seen: Float[Tensor, "n n_o"] | Trajectory,
        draw: Callable[[], Scenario],
    ) -> float:
        """Train ``idle`` in place.

        Args:
            live: the teacher, which is not changed.
            idle: the student, which starts from its present weights.
            seen: observations of the real system, or episodes that the teacher has flown there. State feedback needs
                the episodes, because its actions are no function of the observation; they are taken as recorded.
            draw: function that draws new initial states and disturbances of virtual episodes at each call.

        Returns:
            RMS difference between the two policies' actions on all observations, as a share of the actions' ranges.
        """
        pairs = [self._of_record(seen) if isinstance(seen, Trajectory) else self._asked(live, seen)]
        pairs.append(self._flown(live, live, draw()))
        for number in range(self.config.rounds):
            if number:
                pairs.append(self._flown(live, idle, draw()))
            observations, actions = (torch.cat(part) for part in zip(*pairs, strict=True))
            error = match_actions(self.twin.plant, actions, idle, observations, self.config.iterations)
        return error

    def of_record(self, idle: nn.Module, record: Trajectory) -> float:
        """Train ``idle`` in place to act as in records, without the twin; the error is that of :meth:`imitate`."""
        observations, actions = self._of_record(record)
        return match_actions(self.twin.plant, actions, idle, observations, self.config.iterations)

    @torch.no_grad()
    def _flown(self, teacher: nn.Module, policy: nn.Module, episodes: Scenario) -> tuple[Tensor, Tensor]:
        """Observations of virtual episodes that a policy flies, and what the teacher does there, where both are sound.

        A twin that lacks dynamics of the real system may blow up in a flight, and says nothing of what comes after.
        """
        try:
            observations, actions = self._all_flown(teacher, policy, self.twin.control(policy, *episodes))
        except DivergenceError:
            plant, like = self.twin.plant, episodes.initial_state
            return like.new_empty(0, len(plant.observations)), like.new_empty(0, len(plant.actions))
        sound = (observations.abs() <= BLOWN_UP).all(-1) & actions.isfinite().all(-1)
        return observations[sound], actions[sound]

    def _all_flown(self, teacher: nn.Module, policy: nn.Module, flown: Trajectory) -> tuple[Tensor, Tensor]:
        if not isinstance(teacher, StateFeedback):
            return self._asked(teacher, self._observed(flown))
        if policy is teacher:
            return self._of_record(flown)
        return self._of_record(flown._replace(actions=commands_along(teacher, flown, self.twin.plant.dt)))

    @torch.no_grad()
    def _asked(self, teacher: nn.Module, observations: Float[Tensor, "n n_o"]) -> tuple[Tensor, Tensor]:
        """Observations of a source, thinned, and the teacher's actions."""
        thinned = self._thinned(observations)
        return thinned, teacher(thinned)

    def _of_record(self, flown: Trajectory) -> tuple[Tensor, Tensor]:
        """Observations and actions of a record of one episode or several, thinned."""
        return self._thinned(self._observed(flown)), self._thinned(flown.actions.reshape(-1, flown.actions.shape[-1]))

    def _observed(self, flown: Trajectory) -> Float[Tensor, "n n_o"]:
        plant, exogenous = self.twin.plant, flown.exogenous
        clock = plant.dt * torch.arange(exogenous.shape[-2], dtype=torch.float64, device=exogenous.device)
        t = (flown.start.unsqueeze(-1) if isinstance(flown.start, Tensor) else flown.start) + clock
        seen = plant.observe(t, flown.states[..., :-1, :], exogenous)
        return seen.reshape(-1, seen.shape[-1])

    def _thinned(self, values: Float[Tensor, "n width"]) -> Float[Tensor, "m width"]:
        return values[:: max(1, -(-len(values) // self.config.samples))]  # of none, none is left


def match_actions(
    plant: Plant,
    wanted: Float[Tensor, "n n_a"],
    student: nn.Module,
    observations: Float[Tensor, "n n_o"],
    iterations: int,
) -> float:
    """Fit the student's actions to a teacher's in place, by TorchRL's behaviour-cloning loss.

    Args:
        plant: plant that gives the ranges of the actions.
        wanted: the teacher's actions.
        student: policy whose weights are trained, from their present values.
        observations: observations on which the two are to agree.
        iterations: gradients of the loss on all observations.

    Returns:
        RMS difference between the actions as a share of their ranges.
    """
    # Here, because they take seconds to load, and a command line reads only the parameters above.
    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule
    from torchrl.objectives import BCLoss

    imitator = ShareOfRange(plant, student, device=observations.device)
    expert = TensorDict(
        {"observation": observations, "action": imitator.share(wanted)}, batch_size=observations.shape[:1]
    )
    actor = TensorDictModule(imitator, in_keys=["observation"], out_keys=["action"])
    with warnings.catch_warnings():
        # BCLoss has no target network; TorchRL warns that its class does not declare one.
        warnings.filterwarnings("ignore", message="The name target_actor_network_params", category=UserWarning)
        loss = BCLoss(actor, loss_function="l2")
    descent = Descent(student, DescentConfig(optimiser="lbfgs", rate=1.0))
    return descent.run(lambda: loss(expert)["loss_bc"], iterations).best ** 0.5


class ShareOfRange(nn.Module):
    """A policy whose actions are shares of their ranges, 0 at the low and 1 at the high end.

    Args:
        plant: plant that gives the ranges of the actions.
        policy: policy whose actions are in physical units.
        device: device of the observations; torch's default if None.
    """

    low: Tensor
    range: Tensor

    def __init__(self, plant: Plant, policy: nn.Module, *, device: torch.device | None = None):
        super().__init__()
        low, high = bounds(plant.actions, device=device)
        self.policy = policy
        self.register_buffer("low", low)
        self.register_buffer("range", high - low)

    def forward(self, observation: Float[Tensor, "*batch n_o"]) -> Float[Tensor, "*batch n_a"]:
        return self.share(self.policy(observation))

    def share(self, action: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_a"]:
        """Actions in physical units as shares of their ranges."""
        return (action - self.low.to(action)) / self.range.to(action)
