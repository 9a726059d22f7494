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
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.trajectories.twin import DigitalTwin


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
        seen: Float[Tensor, "n n_o"],
        draw: Callable[[], Scenario],
    ) -> float:
        """Train ``idle`` in place.

        Args:
            live: the teacher, which is not changed.
            idle: the student, which starts from its present weights.
            seen: observations of the real system.
            draw: function that draws new initial states and disturbances of virtual episodes at each call.

        Returns:
            RMS difference between the two policies' actions on all observations, as a share of the actions' ranges.
        """
        observations = [self._thinned(seen), self._thinned(self._observed(live, draw()))]
        for number in range(self.config.rounds):
            if number:
                observations.append(self._thinned(self._observed(idle, draw())))
            error = match_actions(self.twin.plant, live, idle, torch.cat(observations), self.config.iterations)
        return error

    @torch.no_grad()
    def _observed(self, policy: nn.Module, episodes: Scenario) -> Float[Tensor, "n n_o"]:
        plant, exogenous = self.twin.plant, episodes.exogenous
        flown = self.twin.control(policy, *episodes)
        t = plant.dt * torch.arange(exogenous.shape[1], dtype=torch.float64, device=exogenous.device)
        return plant.observe(t, flown.states[:, :-1], exogenous).flatten(0, 1)

    def _thinned(self, observations: Float[Tensor, "n n_o"]) -> Float[Tensor, "m n_o"]:
        return observations[:: -(-len(observations) // self.config.samples)]


def match_actions(
    plant: Plant, teacher: nn.Module, student: nn.Module, observations: Float[Tensor, "n n_o"], iterations: int
) -> float:
    """Fit the student's actions to the teacher's in place, by TorchRL's behaviour-cloning loss.

    Args:
        plant: plant that gives the ranges of the actions.
        teacher: policy that is imitated; it is not changed.
        student: policy whose weights are trained, from their present values.
        observations: observations on which the two policies are to agree.
        iterations: gradients of the loss on all observations.

    Returns:
        RMS difference between the actions as a share of their ranges.
    """
    # Here, because they take seconds to load, and a command line reads only the parameters above.
    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule
    from torchrl.objectives import BCLoss

    with torch.no_grad():
        wanted = ShareOfRange(plant, teacher, device=observations.device)(observations)
    expert = TensorDict({"observation": observations, "action": wanted}, batch_size=observations.shape[:1])
    imitator = ShareOfRange(plant, student, device=observations.device)
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

    def __init__(self, plant: Plant, policy: nn.Module, *, device: torch.device | None = None):
        super().__init__()
        low, high = bounds(plant.actions, device=device)
        self.policy = policy
        self.register_buffer("low", low)
        self.register_buffer("range", high - low)

    def forward(self, observation: Float[Tensor, "*batch n_o"]) -> Float[Tensor, "*batch n_a"]:
        action = self.policy(observation)
        return (action - self.low.to(action)) / self.range.to(action)
