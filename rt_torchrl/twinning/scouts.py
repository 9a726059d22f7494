"""Random policies on the twin, with the best of which one more plan begins."""

import copy
from collections.abc import Callable

import torch
from torch import Tensor, nn

from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario
from rt_torchrl.twinning.architecture import same_architecture
from rt_torchrl.twinning.virtual_episodes import VirtualEpisodes

FIRST = 4
"""Number of the first episode with scouts. Before, the twin is right at best about what has flown."""
GAINED = 0.05
"""Share of the cost that a plan from a scout must save: it lies far from all that has flown, and costs a flight."""
STRIDE = 1_000_003
"""Difference of the seeds of two episodes."""
SEEDS = 2**63
"""Number of seeds of a generator."""


class Scouts:
    """Random policies, each of which flies the virtual episodes of a plan.

    Plans from the present weights stay in their minimum, and the first one was made on a twin that had seen one flight.
    A descent from the best of some random policies ends elsewhere. Scouts have random numbers of their own, so that a
    training whose plan they do not improve is the same without them.

    Args:
        virtual: virtual episodes.
        policy: policy that is planned.
        count: number of scouts; 0 sends none. State feedback has no weights, and no scouts.
        make_policy: function that draws a random policy of the same architecture; None for that of the plant.

    Raises:
        ValueError: if it draws policies of another architecture.
    """

    def __init__(
        self,
        virtual: VirtualEpisodes,
        policy: nn.Module,
        count: int,
        make_policy: Callable[[torch.Generator], nn.Module] | None = None,
    ):
        self.virtual, self.policy = virtual, policy
        self.count = 0 if isinstance(policy, StateFeedback) else count
        self.make_policy = make_policy or virtual.twin.plant.make_policy
        if self.count and not same_architecture(drawn := self.make_policy(self._generator(0)), policy):
            raise ValueError(
                f"planner.scouts={count} draws random policies of the class {type(drawn).__name__}, and model_based is "
                f"another {type(policy).__name__}; give make_policy, a function that draws a random policy like it, or "
                "use planner.scouts=0."
            )

    def due(self, episode: int) -> bool:
        """Whether step 5 of an episode sends scouts: of the fourth, the eighth, the sixteenth and so on."""
        return self.count > 0 and episode >= FIRST and episode.bit_count() == 1

    @torch.no_grad()
    def best(self, episode: int, planned_on: Scenario) -> dict[str, Tensor]:
        """The weights of the scout that costs least; the policy keeps its own. What is not trained is not drawn.

        Args:
            episode: number of the real episode, which decides on what is drawn.
            planned_on: virtual episodes that the scouts fly.
        """
        kept, generator = copy.deepcopy(self.policy.state_dict()), self._generator(episode)
        trained = {name for name, weight in self.policy.named_parameters() if weight.requires_grad}
        found: list[tuple[float, dict[str, Tensor]]] = []
        try:
            for _ in range(self.count):
                drawn = self.make_policy(generator).state_dict()
                weights = {name: drawn[name] if name in trained else value for name, value in kept.items()}
                self.policy.load_state_dict(weights)
                found.append((self.virtual.price(self.policy, planned_on).item(), weights))
        finally:
            self.policy.load_state_dict(kept)
        return min(found, key=lambda each: each[0])[1]

    def _generator(self, episode: int) -> torch.Generator:
        own = self.virtual.generator
        return torch.Generator(device=own.device).manual_seed((own.initial_seed() + STRIDE * episode) % SEEDS)
