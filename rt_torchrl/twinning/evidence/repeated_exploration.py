"""A real episode that explored, flown again on the twin with the same exploration."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extension import Extension
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal, bounds
from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin


class Nudged(Extension):
    """A plant whose observation also holds by how much its policy is to deviate: further inputs, which do not act.

    Args:
        base: the plant.

    Raises:
        ValueError: if the plant overrides ``step`` as a whole.
    """

    def __init__(self, base: Plant):
        super().__init__(base, [])
        nudges = [Signal(symbol=rf"\Delta {a.symbol}", name=f"nudge_{a.name}", unit=a.unit) for a in base.actions]
        self._read = len(base.inputs)
        self.inputs, self.observations = (*base.inputs, *nudges), (*base.observations, *nudges)

    def meeting(
        self, hidden: Float[Tensor, "*batch n_x"], exogenous: Float[Tensor, "*#batch n_z"]
    ) -> Float[Tensor, "*#batch n_b"]:
        return exogenous[..., : self._read]

    def observe(
        self, t: Float[Tensor, "*#batch"], state: Float[Tensor, "*batch n_s"], exogenous: Float[Tensor, "*#batch n_z"]
    ) -> Float[Tensor, "*batch n_o"]:
        seen = self.base.observe(t, state, exogenous[..., : self._read])
        nudges = exogenous[..., self._read :]
        return torch.cat([seen, nudges + torch.zeros_like(seen[..., :1])], -1)

    def running_cost(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch"]:
        return self.base.running_cost(t, state, applied, exogenous[..., : self._read])


class Deviating(nn.Module):
    """A policy of a :class:`Nudged` plant that deviates as it is told, within the ranges of the actions.

    Args:
        policy: policy of the plant.
        plant: the plant.
    """

    low: Tensor
    high: Tensor

    def __init__(self, policy: nn.Module, plant: Plant):
        super().__init__()
        self.policy = policy
        device = next((weight.device for weight in policy.parameters()), torch.device("cpu"))
        low, high = bounds(plant.actions, device=device)
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def forward(self, observation: Float[Tensor, "*batch n_o"]) -> Float[Tensor, "*batch n_a"]:
        n = len(self.low)
        action = self.policy(observation[..., :-n]) + observation[..., -n:]
        return torch.maximum(torch.minimum(action, self.high), self.low)


class RepeatedExploration:
    r"""Flies real episodes again on the twin with the exploration that they had.

    .. math:: \hat a_k = \pi(\hat o_k) + \big(a_k - \pi(o_k)\big)

    The deviation of the recorded action from that of the policy is repeated, and the policy reacts to what the twin
    does. So luck cancels, that of the exploration included. A replay of the recorded actions alone would not tell what
    the policy makes of the twin's error: a closure that was fitted to the record reproduces it.
    """

    def __init__(self) -> None:
        self._kept: tuple[DigitalTwin, DigitalTwin] | None = None

    @torch.no_grad()
    def cost(self, twin: DigitalTwin, policy: nn.Module, record: Trajectory, episode: Scenario) -> float:
        """J_a of a real episode on the twin; infinite if the twin diverges.

        Args:
            twin: the twin.
            policy: policy that flew the episode, with its weights of then.
            record: the episode, as sensors read it.
            episode: its start, and its inputs to the horizon; where it ended early, nothing deviates afterwards.
        """
        nudged, n = self._nudged(twin), len(record.actions)
        time = record.start + twin.plant.dt * torch.arange(n, dtype=torch.float64, device=record.actions.device)
        states = twin.plant.at_rest(record.states[:-1])
        nudges = torch.zeros_like(record.actions[:1]).repeat(episode.exogenous.shape[1], 1)
        nudges[:n] = record.actions - policy(twin.plant.observe(time, states, record.exogenous))
        start = nudged.plant.at_rest(episode.initial_state)
        try:
            cost = nudged.cost(Deviating(policy, twin.plant), start, torch.cat([episode.exogenous, nudges[None]], -1))
        except DivergenceError:
            return float("inf")
        return cost.nan_to_num(nan=torch.inf).item()

    def _nudged(self, twin: DigitalTwin) -> DigitalTwin:
        if self._kept is None or self._kept[0] is not twin:
            self._kept = (twin, twin.of(Nudged(twin.plant)))
        return self._kept[1]


def repeatable(plant: Plant) -> bool:
    """Whether a policy of the plant can be told to deviate: it cannot where the plant overrides ``step`` as a whole."""
    return type(plant).step is Plant.step
