r"""Levenberg-Marquardt steps, the natural descent for a closure with a few weights of very different effect.

.. math::
    (H + \mu\,\mathrm{diag}\,H)\,\Delta w = -g, \qquad
    H = \mathbb E\sum_kS_k^\top\frac{\partial^2L}{\partial s^2}S_k\,\Delta t

A first-order step follows the weight that the record shows best and leaves the others behind. A
Levenberg-Marquardt step weighs each weight by what the record says of it.
"""

import copy
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.descent import Descended


class NormalEquations(NamedTuple):
    """Cost, gradient ``n_w`` and Gauss-Newton matrix ``n_w n_w`` at the module's present weights."""

    cost: Tensor
    gradient: Tensor
    matrix: Tensor


class LevenbergMarquardt:
    """Updates the trainable weights of a module in place; the damping μ is kept from run to run.

    Args:
        module: module with the weights.
        damping: μ at the start; it falls tenfold after each step that lowers the cost and rises tenfold otherwise.
        tolerance: share of the cost; the run ends when an undamped step promises to lower the cost by less than this
            share. The weights are then not the reason for the rest of the cost, and more equations would not help.
        longest_step: greatest change of a weight in one step; a change of 1 is a factor of e for a weight that is a
            logarithm. Far from the minimum, a longer step can end where the states no longer depend on the weight, and
            the weight would stay there.
    """

    least_damping, greatest_damping = 1e-12, 1e12
    least_step = 1e-9  # change of the weights below which they have arrived, whatever rounding is left of the cost

    def __init__(self, module: nn.Module, *, damping: float = 1e-3, tolerance: float = 1e-4, longest_step: float = 1.0):
        for argument, value in (("damping", damping), ("longest_step", longest_step)):
            if not value > 0:
                raise ValueError(f"{argument}={value} of Levenberg-Marquardt must be positive.")
        if not tolerance >= 0:
            raise ValueError(f"tolerance={tolerance} of Levenberg-Marquardt must not be negative.")
        self.module, self.damping, self.tolerance, self.longest_step = module, damping, tolerance, longest_step

    @torch.no_grad()
    def run(self, equations: Callable[[], NormalEquations], iterations: int, *, stop_below: float = 0.0) -> Descended:
        """Try ``iterations`` steps; a step that raises the cost, or makes it infinite, is taken back.

        Args:
            equations: function that returns the equations at the module's present weights.
            iterations: number of trial steps; 0 does nothing.
            stop_below: share of the first cost below which the run stops early; 0 never stops it.
        """
        if iterations == 0:
            return Descended(float("nan"), float("nan"), float("nan"), 0)
        weights = [w for w in self.module.parameters() if w.requires_grad]
        current = equations()
        start, gradient, count = current.cost.item(), current.gradient.norm().item(), 0
        while count < iterations and not current.cost < stop_below * start:
            safe_point()
            if self._arrived(current):
                break
            count += 1
            before = copy.deepcopy(self.module.state_dict())
            step = self._step(current, self.damping)
            step *= (self.longest_step / step.abs().max()).clamp(max=1.0)
            _add(step, weights)
            trial = self._attempt(equations)
            if trial is not None and trial.cost <= current.cost:
                current, self.damping = trial, max(0.1 * self.damping, self.least_damping)
            else:
                self.module.load_state_dict(before)
                self.damping = min(10.0 * self.damping, self.greatest_damping)
        return Descended(start, current.cost.item(), gradient, count)

    def _arrived(self, current: NormalEquations) -> bool:
        if not current.gradient.any():
            return True  # where the record shows no weight, the matrix may be singular
        newton = self._step(current, self.least_damping)
        little = promised(current, newton) <= self.tolerance * current.cost
        return bool(little or newton.abs().max() < self.least_step)

    def _step(self, current: NormalEquations, damping: float) -> Tensor:
        diagonal = current.matrix.diagonal()
        # A weight that the record does not show gets the smallest curvature that exceeds rounding.
        floor = diagonal.max() * torch.finfo(diagonal.dtype).eps
        damped = current.matrix + damping * torch.diag(diagonal.clamp_min(floor))
        return -torch.linalg.solve(damped, current.gradient)

    def _attempt(self, equations: Callable[[], NormalEquations]) -> NormalEquations | None:
        """The equations at the trial weights; None if the trajectory diverges there, which only refuses the step."""
        try:
            found = equations()
        except FloatingPointError:
            return None
        return found if found.cost.isfinite() and found.matrix.isfinite().all() else None


def _add(step: Tensor, weights: list[nn.Parameter]) -> None:
    """Move the weights; in place, because torch's ``vector_to_parameters`` would make them views of one vector."""
    for weight, part in zip(weights, step.split([w.numel() for w in weights]), strict=True):
        weight.add_(part.view_as(weight))


def promised(equations: NormalEquations, step: Tensor) -> Tensor:
    """The decrease of the cost by a step, according to its quadratic model."""
    return -(equations.gradient @ step + 0.5 * step @ equations.matrix @ step)
