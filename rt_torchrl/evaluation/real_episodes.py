"""Unseen episodes on a real system whose true closure nobody knows."""

import torch
from jaxtyping import Bool
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from rt_torchrl.evaluation.unseen import UNSEEN_SEED, Baseline, RealController, UnseenEpisodes
from rt_torchrl.plants.shapes import Costs
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of, continued, control_cost


class RealEpisodes(UnseenEpisodes):
    """Episodes that are flown on the real system itself, without exploration, each time they are asked for.

    A system that takes a seed flies the same episodes for every policy, and its sequence of training episodes then
    goes on as if nothing had been flown in between. A system without a seed flies other episodes each time.

    Args:
        system: the real system.
        count: number of episodes, at least 2.
        device: device of the twin, which replays the episodes.
    """

    judged_on = "real system"

    def __init__(self, system: RealSystem, count: int = 20, *, device: torch.device | str = "cpu"):
        super().__init__(system.plant, count, device=device)
        self.closure = None
        self._system, self._count = system, count

    def fly(self, policy: nn.Module) -> Trajectory:
        return self._flown(policy, self._count)

    def control_costs(self, policy: nn.Module) -> Costs:
        return control_cost(self.plant, self.fly(policy))

    def validation(self) -> None:
        """No validation episodes, because a real episode may take hours."""

    def fly_baseline(self, law: Baseline) -> Trajectory:
        """As many episodes on the real system.

        Raises:
            ValueError: if the controller is one that is flown on the plant.
        """
        if not isinstance(law, RealController):
            raise ValueError(
                f"law={type(law).__name__} is flown on the plant under the true closure, which is not known of this "
                "real system; give a RealController, or the RealSystem its closure."
            )
        return law.fly_real(self._count, seed=UNSEEN_SEED)

    @torch.no_grad()
    def _flown(self, policy: nn.Module, count: int) -> Trajectory:
        kept = self._system.state_dict()
        self._system.set_seed(UNSEEN_SEED)
        try:
            flown = [self._system.rollout(self.plant.n_steps, self._actor(policy)) for _ in range(count)]
        finally:
            self._system.load_state_dict(kept)
        return batch_of([self._to_the_horizon(episode[0]) for episode in flown])

    def _to_the_horizon(self, episode: TensorDictBase) -> Trajectory:
        """The trajectory of an episode; one that ended early stays in the state in which it ended."""
        rest = self.plant.n_steps - len(episode)
        end, action = episode["next", "state"][-1:], episode["next", "applied"][-1:]
        return Trajectory(
            torch.cat([episode["state"], end.expand(rest + 1, -1)]),
            torch.cat([episode["next", "applied"], action.expand(rest, -1)]),
            continued(episode["exogenous"], self.plant.n_steps),
        )

    def _actor(self, policy: nn.Module) -> TensorDictModule:
        """The policy at the beginning of an episode."""
        if not isinstance(policy, StateFeedback):
            return TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])
        device = self.initial_state.device
        live = LivePolicy(self.plant, policy, ExplorationConfig(), generator=torch.Generator(device=device))
        live.begin(policy, strength=0.0)
        return TensorDictModule(live, in_keys=["observation", "state", "exogenous"], out_keys=["action"])

    def categories(self) -> dict[str, Bool[Tensor, " count"]]:
        """No categories, because the exogenous inputs need not be the same each time."""
        return {}
