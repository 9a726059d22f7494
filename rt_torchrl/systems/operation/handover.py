r"""Bumpless handover from one policy to the next while a real system is in operation."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy


class BumplessPolicy(LivePolicy):
    r"""The live policy of a system in operation, in which policies take over without a bump.

    A policy that takes over in interval h acts with an offset, which is the difference to the policy before it, and
    which fades component by component,

    .. math::
        a_k = \pi_{new}(e_k) + b_k, \qquad b_h = a_h^{old} - \pi_{new}(e_h), \qquad
        |b_{k+1}| = \max(0, |b_k| - r_k)

    The action of interval h is what the old policy would have sent. From then on the handover adds at most
    :math:`r_k = \min(\text{range}/n, \tfrac12\,\text{reach})` to the action in an interval: the range of the action
    over n intervals, and never more than the actuators' own rate. The reach is the width of what ``plant.actuate`` can
    make of commands in the present state within one interval.

    Integrators and filters of a plant are among its states, so that they carry over. State feedback that takes over
    begins with its first memory.

    Args:
        plant: plant that gives the ranges of the actions, the actuators and the control interval.
        policy: the policy that is live.
        config: parameters of the noise.
        intervals: number n of control intervals in which an offset as wide as the whole range fades.
        generator: source of the noise.
    """

    def __init__(
        self,
        plant: Plant,
        policy: nn.Module,
        config: ExplorationConfig,
        *,
        intervals: int,
        generator: torch.Generator,
    ):
        super().__init__(plant, policy, config, generator=generator)
        self._share = (self.high - self.low) / intervals
        self._former: nn.Module | None = None
        self._offset: Tensor | None = None

    def begin(self, policy: nn.Module, *, strength: float) -> None:
        """See :meth:`LivePolicy.begin`; after a reset of the system nothing is left of earlier policies."""
        super().begin(policy, strength=strength)
        self._former = self._offset = None

    def begin_window(self) -> None:
        """Begin a window of operation without a reset: the plant's clock begins anew, and all else goes on."""
        self._intervals = 0

    def hand_over(self, policy: nn.Module, *, strength: float) -> None:
        """Let a policy take over in the next interval.

        Args:
            policy: the new policy, ready to act; a module of its own, because the old one is asked once more.
            strength: strength ξ of the exploration from now on.
        """
        self._former = self._former or self.policy
        self.policy, self.strength = policy, strength

    def commanded(
        self, policy: nn.Module, observation: Tensor, state: Tensor | None, exogenous: Tensor | None
    ) -> Float[Tensor, "*batch n_a"]:
        """The command of the policy and what is left of the offset."""
        command = super().commanded(policy, observation, state, exogenous)
        if self._offset is not None and state is not None:
            self._offset = self._faded(self._offset, state)
        if self._former is not None:
            before = super().commanded(self._former, observation, state, exogenous)
            before = before if self._offset is None else before + self._offset
            self._former, self._offset = None, before.clamp(self.low, self.high) - command
        return command if self._offset is None else command + self._offset

    def _faded(self, offset: Tensor, state: Tensor) -> Tensor | None:
        (plant,) = self._plant
        full = plant.at_rest(state)
        ends = [plant.actuate(full, end.expand_as(offset)) for end in (self.low, self.high)]
        step = torch.minimum(self._share, 0.5 * (ends[1] - ends[0]).abs())
        left = offset.sign() * (offset.abs() - step).clamp(min=0.0)
        return left if left.any() else None

    def carried(self) -> dict[str, Tensor]:
        """What goes on over the end of a window: noise and offset, as far as there are any."""
        parts = {"noise": self._noise, "offset": self._offset}
        return {name: value for name, value in parts.items() if value is not None}

    def carry(self, carried: dict[str, Tensor]) -> None:
        """Go on with what :meth:`carried` has returned."""
        self._noise, self._offset = carried.get("noise"), carried.get("offset")
