r"""The price of trajectories that leave bounds on states, beside J_a.

With g the distance of a state beyond one of its bounds (negative within), in shares of the width between them, the
augmented Lagrangian of Powell, Hestenes and Rockafellar is

.. math::
    J_a + J_0\sum_i\overline{\frac{\max(0, \mu_i + \rho g_i)^2}{2\rho}}

with the mean over all intervals and episodes. Once the plans of a real episode are judged, :math:`\mu_i` grows by ρ
times the mean excess, where there is one, of the policy that stays: it is the common multiplier of a bound in all
intervals. Until then it is the same for a plan and for the policy that the plan would replace. States within μ/ρ of a
bound have a price, too, so that plans keep some distance from it. J_0 is the cost of the first policy that is priced.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import StateBounds
from rt_torchrl.steps.config import ConstraintsConfig
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin


class Constraints:
    """Prices trajectories of the twin; the module says how.

    Args:
        plant: plant of the twin.
        config: bounds and weight.

    Raises:
        ValueError: if the plant has no such state.
    """

    def __init__(self, plant: Plant, config: ConstraintsConfig):
        self.bounds, self.config = StateBounds(plant.readings, config.states), config
        self.reference = 0.0
        self.multipliers = [0.0 for _ in self.bounds.names]
        self._excess = list(self.multipliers)

    def costs(self, twin: DigitalTwin, policy: nn.Module, episodes: Scenario) -> Float[Tensor, " batch"]:
        """The expected costs of virtual episodes and of their price, differentiable by the policy's weights."""
        costs = twin.episode_costs(policy, *episodes)
        return twin.corrected(policy, self.priced(costs, twin.control(policy, *episodes)))

    def priced(self, costs: Float[Tensor, " batch"], flown: Trajectory) -> Float[Tensor, " batch"]:
        """J_a of trajectories with their price."""
        self.reference = self.reference or abs(costs.mean().item()) or 1.0
        rho, sides = self.config.weight, self.bounds.beyond(flown.states[:, 1:])
        forces = [torch.relu(side.new_tensor(self.multipliers) + rho * side) for side in sides]
        price = sum((force.square().mean(1).sum(-1) for force in forces), start=torch.zeros_like(costs))
        return costs + self.reference * price / (2.0 * rho)

    @torch.no_grad()
    def update(self, flown: Trajectory) -> None:
        """Raise the multipliers of an augmented Lagrangian by the excess of trajectories of the policy that stays."""
        shares = self.bounds.shares(flown.states[:, 1:])
        self._excess = shares.mean((0, 1)).tolist()
        beyond = (shares.sum((0, 1)) / (shares > 0.0).sum((0, 1)).clamp_min(1)).tolist()
        raised = zip(self.multipliers, beyond, strict=True)
        self.multipliers = [mu + self.config.weight * excess for mu, excess in raised]

    def report(self) -> dict[str, float]:
        """Mean excess of the policy that stays in shares of the width, and the multiplier, of each bounded state."""
        found = {f"excess/{name}": share for name, share in zip(self.bounds.names, self._excess, strict=True)}
        return found | {f"multiplier/{name}": mu for name, mu in zip(self.bounds.names, self.multipliers, strict=True)}

    def state_dict(self) -> dict[str, Any]:
        return {"reference": self.reference, "multipliers": list(self.multipliers), "excess": list(self._excess)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.reference, self.multipliers = state["reference"], list(state["multipliers"])
        self._excess = list(state["excess"])
