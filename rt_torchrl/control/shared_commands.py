r"""The mean cost of several futures, which share the commands until the next plan.

.. math:: J = \frac1S\sum_{i\le S} J_i(u_0, \dots, u_{p-1}, u^{(i)}_p, \dots, u^{(i)}_{m-1})

At the next plan the input is measured again, so that the later commands are those of one future each. A plan whose
commands are shared to the end cannot answer what comes, and is too cautious; a plan for one future is too bold.

Source: Lucia, Finkler and Engell, J. Process Control 23 (2013) 1306, with a tree that branches once.
"""

import numpy as np
from jaxtyping import Float

from rt_torchrl.control.command_cost import CommandCost


class SharedCommands:
    """J of the commands of several futures and its gradient, as one point; a single future has no others to share with.

    Args:
        cost: cost of each future, one realisation of its window each.
        shared: number p of held commands that all futures share, at least 1.
    """

    def __init__(self, cost: CommandCost, shared: int):
        self.cost, self.shared = cost, shared

    def point(self, plans: Float[np.ndarray, "n_futures m n_a"]) -> Float[np.ndarray, "variables n_a"]:
        """The variables of a plan for each future; where they must share commands, the means."""
        first = plans[:, : self.shared].mean(0)
        return np.concatenate([first, plans[:, self.shared :].reshape(-1, plans.shape[-1])])

    def plans(self, point: Float[np.ndarray, "variables n_a"], count: int) -> Float[np.ndarray, "{count} m n_a"]:
        """The plan of each of ``count`` futures; p is less where the window is shorter."""
        if count == 1:
            return point[None]
        n_a = point.shape[-1]
        shared = min(len(point), self.shared)
        first = np.broadcast_to(point[:shared], (count, shared, n_a))
        return np.concatenate([first, point[shared:].reshape(count, -1, n_a)], 1)

    def __call__(
        self, point: Float[np.ndarray, "variables n_a"], count: int
    ) -> tuple[float, Float[np.ndarray, "variables n_a"]]:
        """J and its gradient by the variables of ``count`` futures."""
        costs, slopes = self.cost(self.plans(point, count))
        if count == 1:
            return float(costs[0]), slopes[0]
        first = slopes[:, : self.shared].sum(0)
        slope = np.concatenate([first, slopes[:, self.shared :].reshape(-1, slopes.shape[-1])])
        return float(costs.mean()), slope / count
