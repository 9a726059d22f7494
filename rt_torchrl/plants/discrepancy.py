"""How far a twin is from what was measured."""

import math

from rt_torchrl.plants.shapes import Cost, State
from rt_torchrl.plants.signal import Signal, differences


class Discrepancy:
    """The cost of a difference between a twin's state and a measured one, given by the scales of the states."""

    name: str
    states: tuple[Signal, ...]
    state_sizes: tuple[float, ...] = ()
    """Usual sizes of the states, in their units; by default ones."""

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Differences c_i of the states that count alike in L_p, in their units; infinite for one not compared.

        By default these are :attr:`state_sizes`; a plant may override them.
        """
        return self.state_sizes or (1.0,) * len(self.states)

    def discrepancy(self, state: State, measured: State) -> Cost:
        r"""Lagrangian L_p of the identification problem; :math:`J_p = \int L_p(s, \check s)\,dt`.

        .. math:: L_p(s, \check s) = \tfrac12 \sum_i \Big(\frac{s_i - \check s_i}{c_i}\Big)^2

        The scales c are :attr:`discrepancy_scales`; a periodic state differs the short way round.

        Raises:
            ValueError: if there is not one scale for each state, or one is not positive.
        """
        scales = self.discrepancy_scales
        if len(scales) != len(self.states) or not all(scale > 0.0 for scale in scales):
            named = ", ".join(f"{signal.name} [{signal.unit}]" for signal in self.states)
            raise ValueError(
                f"state_sizes={scales} of plant {self.name!r} must have one positive number each: {named}."
            )
        compared = [k for k, scale in enumerate(scales) if scale < math.inf]
        signals = [self.states[k] for k in compared]
        difference = differences(signals, state[..., compared], measured[..., compared])
        return 0.5 * ((difference / state.new_tensor([scales[k] for k in compared])) ** 2).sum(-1)
