"""Limits on the actions that a machine gets: their range and their rate."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torchrl.data import TensorSpec

from rt_torchrl.options import array_of, require_number


class ActionLimits:
    r"""Limits that saturate an action, and then hold :math:`|a_k - a_{k-1}| \le r\,\Delta t`.

    If the last action lies outside the range, both limits cannot hold; then the range holds.

    Args:
        spec: spec of the action; its own range always holds.
        interval: control interval Δt [s].
        low: least value of each action, where it is to be above the spec's; −infinity leaves the spec's.
        high: greatest value of each action, where it is to be below the spec's; infinity leaves the spec's.
        rates: greatest rate of change r of each action [unit/s]; infinity does not limit it.

    Raises:
        ValueError: if a number does not fit the actions, the range is empty, or the interval is not positive and
            finite.
    """

    def __init__(
        self,
        spec: TensorSpec,
        *,
        interval: float,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        rates: Sequence[float] | None = None,
    ):
        require_number("interval", interval, finite=False)
        if not 0.0 < interval < math.inf:
            raise ValueError(f"interval={interval} s must be positive and finite: the system's control interval.")
        self.spec = spec
        whole = torch.full(spec.shape, torch.inf, dtype=spec.dtype, device=spec.device)
        own = getattr(spec.space, "low", -whole), getattr(spec.space, "high", whole)
        self.low = own[0] if low is None else torch.maximum(own[0], self.constant("low", low))
        self.high = own[1] if high is None else torch.minimum(own[1], self.constant("high", high))
        if not ((self.low <= self.high) & (self.low < math.inf) & (self.high > -math.inf)).all():
            raise ValueError(f"low={low} and high={high} leave no action of the system's own range {spec.space}.")
        self._increment = None if rates is None else interval * self.constant("rates", rates)
        if self._increment is not None and not (self._increment > 0.0).all():
            raise ValueError(f"rates={rates} must be positive; infinity does not limit an action.")

    def constant(self, argument: str, values: Sequence[float]) -> Tensor:
        """The action of these values, one number for each component.

        Raises:
            ValueError: if the values are too many or too few, or one is NaN.
        """
        array = array_of(argument, values)
        found = torch.as_tensor(array, dtype=self.spec.dtype, device=self.spec.device)
        if found.shape != self.spec.shape[-1:] or found.isnan().any():
            raise ValueError(f"{argument}={values} must have {self.spec.shape[-1]} numbers, one for each action.")
        return found.expand(self.spec.shape)

    def sendable(self, argument: str, values: Sequence[float]) -> Tensor:
        """The action of these values, which must lie in the range, so that it is sent without a change.

        Args:
            argument: name of the values in an error.
            values: one number for each action.

        Raises:
            ValueError: if the values are too many or too few, one is not finite, or one lies outside the range.
        """
        found = self.constant(argument, values)
        if not ((found >= self.low) & (found <= self.high) & found.isfinite()).all():
            raise ValueError(
                f"{argument}={values} must lie in the range of the actions, {self.low.flatten().tolist()} to "
                f"{self.high.flatten().tolist()}; the machine gets nothing outside it."
            )
        return found

    def __call__(self, action: Tensor, last: Tensor | None) -> tuple[Tensor, dict[str, str]]:
        """The nearest action within the limits, and the components that ``range`` and ``rate`` have changed.

        Args:
            action: finite action.
            last: action that was applied before; None leaves the rate free.
        """
        inside = torch.minimum(torch.maximum(action, self.low), self.high)
        reached = inside
        if self._increment is not None and last is not None:
            reached = torch.minimum(torch.maximum(inside, last - self._increment), last + self._increment)
        # The rate must not lead out of the range, even if the last action was outside it.
        sent = torch.minimum(torch.maximum(reached, self.low), self.high)
        held = {"range": (inside != action) | (sent != reached), "rate": reached != inside}
        return sent, {name: components(mask) for name, mask in held.items() if mask.any()}


def components(mask: Tensor) -> str:
    """The components of an action that a mask marks, in words."""
    return "action " + ", ".join(map(str, mask.flatten().nonzero().flatten().tolist()))
