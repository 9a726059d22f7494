"""Exploration by weights: a policy whose weights are drawn anew several times an episode."""

import copy

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.trajectory import Trajectory


class RedrawnPolicy(nn.Module):
    r"""A policy that acts with other weights after every part of an episode, around those that it has.

    .. math:: w = w_0 + \sigma\,\frac{n}{\sqrt{f}}, \qquad n \sim \mathcal N(0, 1)

    with the number f of inputs of a matrix of weights, and f = 1 for other weights. Noise on single actions hardly
    moves a slow plant; other weights lead to other states, and to the slope of the return by the actions there.

    Args:
        plant: plant that gives the observation, and the length of an episode.
        policy: policy of the observation; it is copied.
        parts: number of parts of an episode.
        spread: spread σ of the draws.
        generator: source of the draws.
    """

    def __init__(self, plant: Plant, policy: nn.Module, *, parts: int, spread: float, generator: torch.Generator):
        super().__init__()
        self._plant, self._spread, self._generator = [plant], spread, generator
        self.policy = copy.deepcopy(policy)
        self._weights = {name: weight.detach().clone() for name, weight in policy.named_parameters()}
        self._length = -(-plant.n_steps // parts)

    def draw_parts(self) -> list[tuple[nn.Module, int, int]]:
        """Policies with drawn weights, one for each part of an episode, which lasts from one interval to another."""
        found, n = [], self._plant[0].n_steps
        for first in range(0, n, self._length):
            self._redraw()
            found.append((copy.deepcopy(self.policy), first, min(first + self._length, n)))
        return found

    def begin(self) -> None:
        """See :meth:`StateFeedback.begin`."""

    def act(
        self, t: float, state: Float[Tensor, "batch n_s"], exogenous: Float[Tensor, "batch n_z"]
    ) -> Float[Tensor, "batch n_a"]:
        """See :meth:`StateFeedback.act`."""
        (plant,) = self._plant
        if round(t / plant.dt) % self._length == 0:
            self._redraw()
        time = torch.full((1,), t, dtype=torch.float64, device=state.device)
        found: Tensor = self.policy(plant.observe(time, state, exogenous))
        return found

    @torch.no_grad()
    def _redraw(self) -> None:
        for name, weight in self.policy.named_parameters():
            inputs = weight.shape[-1] if weight.dim() > 1 else 1
            noise = torch.randn(weight.shape, generator=self._generator, dtype=weight.dtype, device=weight.device)
            weight.copy_(self._weights[name] + self._spread * inputs**-0.5 * noise)

    def fly(
        self,
        initial_state: Float[Tensor, "batch n_s"],
        exogenous: Float[Tensor, "batch n n_z"],
        closure: nn.Module | None = None,
        *,
        plant: Plant | None = None,
    ) -> Trajectory:
        """Not offered: its draws belong to a real episode.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a policy whose weights are redrawn flies real episodes alone; fly its policy.")

    def report(self) -> dict[str, float]:
        """See :meth:`StateFeedback.report`; there is nothing to report."""
        return {}
