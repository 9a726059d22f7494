"""A start with a recorded log of the real system."""

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.steps.config import Role
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.twinning.flight import Flight
from rt_torchrl.twinning.starts.start import Fly


class RecordedFlights:
    """Records of the real system under any controller: policies imitate its actions; see :class:`Start`.

    Args:
        plant: plant of the records.
        records: records of equal length, oldest first; at least one.
    """

    live: Role = "model_based"
    teacher: nn.Module | None = None

    def __init__(self, plant: Plant, records: Sequence[Trajectory]):
        self.plant, self.records = plant, records

    def take(self, policies: Mapping[Role, nn.Module], closure: nn.Module) -> list[Role]:
        return list(policies)

    def flights(self, fly: Fly) -> list[Flight]:
        return [Flight(transitions_of(self.plant, record), record, []) for record in self.records]


def transitions_of(plant: Plant, record: Trajectory) -> TensorDict:
    """The transitions of a record, as a learner stores those of a real episode; the last one is truncated.

    The last one pays the terminal cost if the record is as long as an episode.
    """
    states, actions, inputs, start, _ = record
    n = len(actions)
    t = start + plant.dt * torch.arange(n + 1, dtype=torch.float64, device=states.device)
    # There is no input after the last interval; the last input takes its place.
    observation = plant.observe(t, states, torch.cat([inputs, inputs[-1:]]))
    reward = -plant.running_cost(t[:-1], states[:-1], actions, inputs)
    if n == plant.n_steps:
        reward = torch.cat([reward[:-1], reward[-1:] - plant.terminal_cost(states[-1:]) / plant.dt])
    never: Tensor = torch.zeros(n, 1, dtype=torch.bool, device=states.device)
    truncated = never.clone()
    truncated[-1] = True
    ended = {"reward": reward.unsqueeze(-1), "done": truncated, "truncated": truncated.clone(), "terminated": never}
    begun = {key: never.clone() for key in ("done", "truncated", "terminated")}
    return TensorDict(
        {
            "observation": observation[:-1],
            "action": actions,
            **begun,
            "next": {"observation": observation[1:], **ended},
        },
        batch_size=[n],
        device=states.device,
    )
