"""Limits of what is sent to a machine: the range and the rate of every action."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torchrl.data import TensorSpec


class ActionLimits:
    r"""Saturation, then :math:`|a_k - a_{k-1}| \le r\,\Delta t`; from a last action outside the range, the range holds.

    Args:
        spec: of the action; its own range always holds.
        interval: control interval Δt [s].
        low: least actions, where they are to be above the spec's; −infinity leaves the spec's.
        high: greatest actions, where they are to be below the spec's; infinity leaves the spec's.
        rates: greatest change r of each action [unit/s]; infinity does not limit it.

    Raises:
        ValueError: if a number does not fit the actions, the range is empty, or the interval is not positive or not
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
        if not 0.0 < interval < math.inf:
            raise ValueError(f"interval={interval} s must be positive and finite: the system's control interval.")
        self.spec = spec
        whole = torch.full(spec.shape, torch.inf, dtype=spec.dtype, device=spec.device)
        own = getattr(spec.space, "low", -whole), getattr(spec.space, "high", whole)
        self.low = own[0] if low is None else torch.maximum(own[0], self.constant("low", low))
        self.high = own[1] if high is None else torch.minimum(own[1], self.constant("high", high))
        if not ((self.low <= self.high) & (self.low < math.inf) & (self.high > -math.inf)).all():
            raise ValueError(f"low={low} and high={high} leave no action of the system's own range {spec.space}.")
        if rates is not None and not min(rates) > 0.0:
            raise ValueError(f"rates={rates} must be positive; infinity does not limit an action.")
        self._increment = None if rates is None else interval * self.constant("rates", rates)

    def constant(self, argument: str, values: Sequence[float]) -> Tensor:
        """One number for each action, as an action.

        Raises:
            ValueError: if their number is wrong or one is NaN.
        """
        found = torch.tensor(tuple(values), dtype=self.spec.dtype, device=self.spec.device)
        if found.shape != self.spec.shape[-1:] or found.isnan().any():
            raise ValueError(f"{argument}={values} must have {self.spec.shape[-1]} numbers, one for each action.")
        return found.expand(self.spec.shape)

    def sendable(self, argument: str, values: Sequence[float]) -> Tensor:
        """An action that is sent as it is, because it lies in the range.

        Args:
            argument: its name, for the message.
            values: one number for each action.

        Raises:
            ValueError: if their number is wrong, one is not finite, or the action lies outside the range.
        """
        found = self.constant(argument, values)
        if not ((found >= self.low) & (found <= self.high) & found.isfinite()).all():
            raise ValueError(
                f"{argument}={values} must lie in the range of the actions, {self.low.flatten().tolist()} to "
                f"{self.high.flatten().tolist()}; the machine gets nothing outside it."
            )
        return found

    def __call__(self, action: Tensor, last: Tensor | None) -> tuple[Tensor, dict[str, str]]:
        """The nearest action within the limits, and which components were held by ``range`` and by ``rate``.

        Args:
            action: finite.
            last: what was applied before; None leaves the rate free.
        """
        inside = torch.minimum(torch.maximum(action, self.low), self.high)
        reached = inside
        if self._increment is not None and last is not None:
            reached = torch.minimum(torch.maximum(inside, last - self._increment), last + self._increment)
        # The rate may not lead out of the range, whatever was applied before.
        sent = torch.minimum(torch.maximum(reached, self.low), self.high)
        held = {"range": (inside != action) | (sent != reached), "rate": reached != inside}
        return sent, {name: _components(mask) for name, mask in held.items() if mask.any()}


def _components(mask: Tensor) -> str:
    return "action " + ", ".join(map(str, mask.flatten().nonzero().flatten().tolist()))
