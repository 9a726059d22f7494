"""The choice between the formulas and TorchRL's losses."""

import warnings
from collections.abc import Callable

from torch import nn

from rt_torchrl.twinning.learners.actor_critic import ActorCritic, Critic
from rt_torchrl.twinning.learners.explicit.iterations import ExplicitIterations
from rt_torchrl.twinning.learners.explicit.perceptron import activation_of
from rt_torchrl.twinning.learners.iterations import Iterations

COVERED = ("make_loss", "critic_loss", "actor_loss", "critic_step", "actor_step", "batches", "move_targets")
"""The methods whose computations the formulas replace."""


def iterations_of(
    learner: ActorCritic, kind: type[ActorCritic], explicit: Callable[[ActorCritic], ExplicitIterations]
) -> Iterations:
    """The iterations of an update: by formula where the formulas hold, else those of TorchRL's losses.

    Args:
        learner: learner to iterate.
        kind: class of the library whose iterations the formulas compute.
        explicit: function that makes the iterations by formula.
    """
    if learner.config.update == "torchrl":
        return learner
    found = obstacle(learner, kind)
    if found is None:
        return explicit(learner)
    if found not in TOLD:
        TOLD.add(found)
        warnings.warn(f"Step 2 uses TorchRL's losses, which are slower, because {found}.", stacklevel=3)
    return learner


TOLD: set[str] = set()
"""The obstacles of which a notice has been given."""


def obstacle(learner: ActorCritic, kind: type[ActorCritic]) -> str | None:
    """Why the formulas do not hold for a learner; None if they do."""
    own = type(learner)
    changed = [name for name in COVERED if getattr(own, name) is not getattr(kind, name)]
    if changed:
        return f"{own.__name__} has its own {' and '.join(changed)}"
    for critic in learner.critics:
        if type(critic) is not Critic or activation_of(critic.network) is not nn.SiLU:
            return f"the critic {type(critic).__name__} is no Critic of SiLU layers"
        if not all(weight.requires_grad for weight in critic.parameters()):
            return f"some weights of the critic {type(critic).__name__} are frozen"
    return None
