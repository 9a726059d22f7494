"""The formula by which critics learn slopes."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.twinning.learners.explicit.critic_formulas import CriticShape, derivatives_of

REACH = 0.1
"""Half the distance ε of the two actions whose values give a slope."""


@dataclass(frozen=True)
class SlopeDifferences:
    r"""The formula of a lesson in slopes for rescaled critics :math:`f_i = h(q_i)`, along a direction d of the actions.

    .. math::
        \eta_i = \frac{f_i(x, u + \varepsilon d) - f_i(x, u - \varepsilon d)}{2\varepsilon}
            - e^{-|\bar f_i|}\,g^\top d, \qquad J_s = \sum_i\mathbb E[w\,\eta_i^2]

    g is the slope dq/du that is wanted, and :math:`\bar f_i` the mean of both values, which is not differentiated. A
    row holds x, ε d, g·d and w. The results of a row are, for each critic in turn, the scaled slopes dJ/dz_l and the
    outputs h_l of all layers, first at u + ε d and then at u − ε d.

    Args:
        shape: numbers of each critic.
        members: number of critics.
    """

    shape: CriticShape
    members: int

    @property
    def n_in(self) -> int:
        """Length of a row."""
        return self.shape.n_x + self.shape.n_a + 2

    @property
    def sizes(self) -> list[int]:
        """Lengths of the results."""
        return [*self.shape.hidden, *self.shape.hidden, 1] * 2 * self.members

    def __call__(self, rows: Float[Tensor, "n n_in"], weights: Float[Tensor, " n_w"]) -> list[Tensor]:
        shape, found = self.shape, list[Tensor]()
        x, way, wanted, share = rows.split([shape.n_x, shape.n_a, 1, 1], -1)
        ends = [
            torch.cat([x[:, : shape.n_o], action], -1) for action in (x[:, shape.n_o :] + way, x[:, shape.n_o :] - way)
        ]
        for part in weights.split(shape.n_w)[: self.members]:
            high, low = (derivatives_of(shape.layers(part), end, normal=shape.normalised) for end in ends)
            rate = (high[0] - low[0]) / (2.0 * REACH)
            error = rate - torch.exp(-0.5 * (high[0] + low[0]).abs()) * wanted
            scale = share * error / REACH
            for sign, (_, hidden, slopes) in ((1.0, high), (-1.0, low)):
                found += [*hidden, *(sign * scale * slope for slope in slopes[1:]), sign * scale]
        return found
