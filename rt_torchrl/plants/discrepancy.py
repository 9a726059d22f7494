"""How far a twin is from what was measured."""

from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plants.signal import Signal, differences


class Discrepancy:
    """The cost of a difference between a twin's state and a measured one; a plant may override it."""

    name: str
    states: tuple[Signal, ...]
    state_sizes: tuple[float, ...] = ()
    """Differences c_i of the states that count alike in the default discrepancy, in their units; by default ones."""

    def discrepancy(
        self, state: Float[Tensor, "*#batch n_s"], measured: Float[Tensor, "*#batch n_s"]
    ) -> Float[Tensor, "*batch"]:
        r"""Lagrangian L_p of the identification problem; :math:`J_p = \int L_p(s, \check s)\,dt`.

        By default it is half the sum of the squared differences in units of :attr:`state_sizes`, with a periodic state
        the short way round:

        .. math:: L_p(s, \check s) = \tfrac12 \sum_i \Big(\frac{s_i - \check s_i}{c_i}\Big)^2

        Raises:
            ValueError: if ``state_sizes`` has not one entry for each state, or one that is not positive.
        """
        sizes = self.state_sizes or (1.0,) * len(self.states)
        if len(sizes) != len(self.states) or not all(size > 0.0 for size in sizes):
            named = ", ".join(f"{signal.name} [{signal.unit}]" for signal in self.states)
            raise ValueError(f"state_sizes={sizes} of plant {self.name!r} must have one positive number each: {named}.")
        return 0.5 * ((differences(self.states, state, measured) / state.new_tensor(sizes)) ** 2).sum(-1)
