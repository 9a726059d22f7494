"""The snapshot of a training after an episode, which figures are drawn from."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.evaluation.law import asked_features
from rt_torchrl.fit.uncertainty import Uncertainty
from rt_torchrl.plants.plant import Plant
from rt_torchrl.steps.config import Role
from rt_torchrl.trajectories.trajectory import Trajectory

if TYPE_CHECKING:
    from rt_torchrl.algorithm import ReinforcementTwinning  # only its type: it loads TorchRL


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """State of a training after an episode, from which every figure is drawn.

    Args:
        plant: physics of the twin.
        true_closure: the true closure as it is now; None if that is not known, such as that of a real system.
        closure: the learned closure of the plant, as the likeliest hypothesis has it.
        initial_closure: the closure that the training started from.
        policies: both policies, by role.
        live: role of the live policy.
        record: the last real episode, or its longest sound part.
        replay: states of the believed twin with the record's actions and exogenous input.
        segment: number of control intervals after which the replay begins anew in the record; 0 for never.
        large_scale: large scale d̃ of the inputs that act in the record; None if the arm trains no twin.
        realisations: samples of the exogenous process of the record; None as ``large_scale``.
        episodes: entries of the episodes, as in ``metrics.json``.
        simulated: words of a title for a record that is no episode of the training; empty for one that is.
        on_the_twin: whether the twin has flown the record.
        features: features for which the twin asked its closure in the latest records, or in the one of a flight.
        uncertainty: what the closure's weights are worth by the last fit; None if that is not known.
    """

    plant: Plant
    true_closure: nn.Module | None
    closure: nn.Module
    initial_closure: nn.Module
    policies: dict[Role, nn.Module]
    live: Role
    record: Trajectory
    replay: Float[Tensor, "samples n_s"]
    segment: int
    large_scale: Float[Tensor, "n n_acting"] | None
    realisations: Float[Tensor, "k n n_acting"] | None
    episodes: list[dict[str, Any]]
    simulated: str = ""
    on_the_twin: bool = False
    features: Float[Tensor, "rows f"] = field(default_factory=lambda: torch.empty(0, 0))
    uncertainty: Uncertainty | None = None

    @classmethod
    @torch.no_grad()
    def take(
        cls, algorithm: "ReinforcementTwinning", initial_closure: nn.Module, episodes: list[dict[str, Any]]
    ) -> "Snapshot":
        """The snapshot of an algorithm after an episode; its realisations are drawn with a generator of its own."""
        record, twin = algorithm.short_term[-1], algorithm.twin
        # Parts of episodes are cut to pieces of one length, as step 4 replays them.
        latest = algorithm.virtual.paired(algorithm.short_term)[0] if algorithm.config.arm != "model_free" else []
        process = algorithm.virtual.paired([record])[1][0] if algorithm.virtual.processes else None
        generator = torch.Generator(device=record.states.device).manual_seed(0)
        return cls(
            plant=twin.plant,
            true_closure=algorithm.env.closure,
            closure=twin.believed_law,
            initial_closure=initial_closure,
            policies=algorithm.policies,
            live=algorithm.referee.live,
            record=record,
            replay=twin.replayed(record, algorithm.assimilation.length),
            segment=algorithm.assimilation.length,
            large_scale=None if process is None else process.mean,
            realisations=None if process is None else process.sample(5, generator),
            episodes=episodes,
            features=asked_features(twin, latest),
            uncertainty=algorithm.assimilation.uncertainty(latest),
        )
