r"""The cost of commands that actuators with rate limits cannot follow at once, for a descent that ends where they can.

.. math::
    J(u) = \frac1N\sum_{k<N}\Big(L_a(t_k, s_k, c_k, z_k) + w\sum_i\big(v_{k,i} - \Pi_{k,i}(v)\big)^2\Big)
        + \frac{V(s_N)}{N\Delta t}, \qquad v_k = c_k + \mu_k

The actuators of this model apply every command c, and what a real one would hold back is charged: Π is the action that
it applies instead, and differences count in units of the range. Unlike the cost behind a clamp, this one has a
continuous gradient: with a clamp, commands at the edge of its window have one slope inside and another outside, and a
descent ends there. After each descent the shifts μ become the differences v − Π(v), so that 2wμ are the multipliers of
an augmented Lagrangian, and the commands come to be such that real actuators follow them.

Source: Rockafellar, Math. Programming 5 (1973) 354, for constraints by a projection.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.control.command_cost import CommandCost, PenalisedInterval, TerminalCost
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.engines.interval import Drive

FIRST_WEIGHT = 0.1
"""Weight w of the first descent, in units of L_a."""


class RelaxedInterval(PenalisedInterval):
    """A control interval whose state (s, J) sums L_a and the charge; its exogenous inputs are (z, μ)."""

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """State and cost, (s, J), at the end of the interval."""
        n_z, s, command = len(self.plant.inputs), state[..., :-1], self.low + self.span * drive.command
        z, shifted = drive.exogenous[..., :n_z], command + self.span * drive.exogenous[..., n_z:]
        excess = ((shifted - self.plant.actuate(s, shifted)) / self.span).square().sum(-1)
        cost = self.plant.running_cost(drive.t, s, command, z) + self.penalty * excess
        end = self.plant.latch(self.plant.advance(drive.t, s, command, z, self.closure), command)
        return torch.cat([end, (state[..., -1] + cost).unsqueeze(-1)], -1)


class RelaxedCost(CommandCost):
    """J of commands that the model applies at once, with its gradient; :meth:`charge` goes on to the next descent.

    The plant must become machine code (:attr:`CommandCost.traced`).

    Args:
        plant: the physics.
        closure: closure of the system.
        terminal: cost V after the window; None for none.

    Raises:
        ValueError: if :class:`CommandCost` refuses them.
    """

    def __init__(self, plant: Plant, closure: nn.Module, *, terminal: TerminalCost | None = None):
        super().__init__(plant, closure, terminal=terminal)
        self.closure, self.interval = closure, RelaxedInterval(plant, closure, FIRST_WEIGHT)

    def begin(
        self,
        initial_state: Float[Tensor, "batch n_s"],
        exogenous: Float[Tensor, "batch n n_z"],
        *,
        start: float = 0.0,
    ) -> None:
        """Set the window, without shifts; see :meth:`CommandCost.begin`."""
        self._n_z, self._charged = exogenous.shape[-1], False
        super().begin(initial_state, torch.nn.functional.pad(exogenous, (0, len(self.plant.actions))), start=start)

    def charge(self, unit: Float[np.ndarray, "batch n n_a"], weight: float) -> None:
        """Charge what is held back by a new weight w; the shifts become the differences v − Π(v) under some commands.

        Without shifts of an earlier charge they stay zero.

        Args:
            unit: commands in [0, 1], such as those where a descent ended.
            weight: new weight w, in units of L_a.
        """
        z, shifts = self._drive.exogenous.transpose(0, 1).split([self._n_z, len(self.plant.actions)], -1)
        if self._charged:
            shifts = self._differences(unit, shifts) * (self.interval.penalty.item() / weight)
        with torch.no_grad():
            self.interval.penalty.fill_(weight)
        super().begin(self._state[:, :-1], torch.cat([z, shifts], -1), start=self._drive.t[0].item())
        self._charged = True

    def excess(self, unit: Float[np.ndarray, "batch n n_a"]) -> float:
        """Greatest distance of a command from what real actuators would make of it, in units of its range."""
        return self._differences(unit, torch.zeros(len(self.plant.actions), dtype=torch.float64)).abs().max().item()

    @torch.no_grad()
    def _differences(self, unit: np.ndarray, shifts: Tensor) -> Float[Tensor, "batch n n_a"]:
        """v − Π(v) in units of the range."""
        self(unit)  # which leaves the states
        each = [self._states[k, :-1, :-1, : group.live] for k, group in enumerate(self._groups)]
        states = torch.from_numpy(np.concatenate([part.transpose(2, 0, 1) for part in each]))
        low, high = bounds(self.plant.actions)
        shifted = self.commands(unit, self.n) + (high - low) * shifts
        return (shifted - self.plant.actuate(states, shifted)) / (high - low)


def held_back(plant: Plant, state: Float[Tensor, "batch n_s"]) -> bool:
    """Whether the actuators hold back some of the commands at the ends of all ranges, such as by rate limits."""
    ends = bounds(plant.actions)
    return any(
        not torch.equal(plant.actuate(state, end.expand(len(state), -1)), end.expand(len(state), -1)) for end in ends
    )
