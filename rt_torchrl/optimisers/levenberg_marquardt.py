r"""Levenberg-Marquardt steps, the natural descent for a closure with a few weights of very different effect.

.. math::
    (H + \mu D)\,\Delta w = -g, \qquad
    H = \mathbb E\sum_kS_k^\top\frac{\partial^2L}{\partial s^2}S_k\,\Delta t

A first-order step follows the weight that the record shows best and leaves the others behind. A
Levenberg-Marquardt step weighs each weight by what the record says of it.

D is the greatest diag H of the run (Moré 1978), so that damping also holds a weight that has lost its effect. After a
step that lowers the cost by ρ times what its quadratic model promises, μ is multiplied by max(0.1, 1 − (2ρ − 1)³)
(Nielsen 1999).

Sources: J. J. Moré, *The Levenberg-Marquardt algorithm: implementation and theory*, Lecture Notes in Mathematics 630
(1978) 105-116; H. B. Nielsen, *Damping parameter in Marquardt's method*, IMM-REP-1999-05, Technical University of
Denmark.
"""

import copy
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from rt_torchrl.interruption import safe_point
from rt_torchrl.optimisers.descent import Descended


def place(values: Float[Tensor, " n_w"], weights: Sequence[nn.Parameter]) -> None:
    """Give weights these values; in place, because torch's ``vector_to_parameters`` would make them views of a vector.

    Call it without gradients.
    """
    for weight, part in zip(weights, values.split([w.numel() for w in weights]), strict=True):
        weight.copy_(part.view_as(weight))


class NormalEquations(NamedTuple):
    """Cost, gradient ``n_w`` and Gauss-Newton matrix ``n_w n_w`` at the module's present weights."""

    cost: Tensor
    gradient: Tensor
    matrix: Tensor


class LevenbergMarquardt:
    """Updates the trainable weights of a module in place; the damping μ is kept from run to run.

    Args:
        module: module with the weights.
        damping: μ at the start; it follows what steps promise, and rises by factors of 2, 4, 8, ... when steps in a
            row raise the cost.
        tolerance: share of the cost; the run ends when an undamped step promises to lower the cost by less than this
            share. The weights are then not the reason for the rest of the cost, and more equations would not help.
    """

    least_damping, greatest_damping = 1e-12, 1e12
    # Greatest change of a weight in one step; a change of 1 is a factor of e for a weight that is a logarithm. Far from
    # the minimum, a longer step can end where the states no longer depend on the weight, and the weight would stay
    # there. More damping shortens a step, because it takes from those combinations of weights that the record shows
    # least; a shorter step in the same direction would take from all.
    longest_step = 1.0
    least_step = 1e-9  # change of the weights below which they have arrived, whatever rounding is left of the cost

    def __init__(self, module: nn.Module, *, damping: float = 1e-3, tolerance: float = 1e-4):
        self.module, self.damping, self.tolerance = module, damping, tolerance

    @torch.no_grad()
    def run(
        self, equations: Callable[[], NormalEquations], iterations: int, *, stop_below: float = -math.inf
    ) -> Descended:
        """Try ``iterations`` steps; a step that raises the cost, or makes it infinite, is taken back.

        Args:
            equations: function that returns the equations at the module's present weights.
            iterations: number of trial steps; 0 does nothing.
            stop_below: cost below which the run stops early.
        """
        if iterations == 0:
            return Descended(float("nan"), float("nan"), float("nan"), 0)
        weights = [w for w in self.module.parameters() if w.requires_grad]
        current = equations()
        start, gradient, count = current.cost.item(), current.gradient.norm().item(), 0
        scale, growth = torch.zeros_like(current.gradient), 2.0
        while count < iterations and current.cost >= stop_below:
            safe_point()
            if self._arrived(current):
                break
            count += 1
            before = copy.deepcopy(self.module.state_dict())
            scale = torch.maximum(scale, current.matrix.diagonal())
            step, damping = self._limited_step(current, scale)
            place(parameters_to_vector(weights) + step, weights)
            try:
                trial = equations()
                lower = bool(trial.cost <= current.cost and trial.cost.isfinite() and trial.matrix.isfinite().all())
            except FloatingPointError:  # the trajectory diverges there, which only refuses the step
                lower = False
            if lower:
                share = ((current.cost - trial.cost) / promised(current, step)).clamp(0.0, 1.0).item()
                self.damping = max(self.damping * max(0.1, 1.0 - (2.0 * share - 1.0) ** 3), self.least_damping)
                current, growth = trial, 2.0
            else:
                self.module.load_state_dict(before)
                self.damping = min(growth * damping, self.greatest_damping)
                growth *= 2.0
        return Descended(start, current.cost.item(), gradient, count)

    def _arrived(self, current: NormalEquations) -> bool:
        if not current.gradient.any():
            return True  # where the record shows no weight, the matrix may be singular
        newton = _step(current, self.least_damping, current.matrix.diagonal())
        little = promised(current, newton) <= self.tolerance * current.cost.abs()
        return bool(little or newton.abs().max() < self.least_step)

    def _limited_step(self, current: NormalEquations, scale: Tensor) -> tuple[Tensor, float]:
        """The step with the present damping, or with as much more that no weight changes by more than it may."""
        damping = self.damping
        step = _step(current, damping, scale)
        while step.abs().max() > self.longest_step and damping < self.greatest_damping:
            damping = min(4.0 * damping, self.greatest_damping)
            step = _step(current, damping, scale)
        return step * (self.longest_step / step.abs().max()).clamp(max=1.0), damping


def _step(current: NormalEquations, damping: float, scale: Tensor) -> Tensor:
    # A weight that the record does not show gets the smallest curvature that exceeds rounding.
    floor = scale.max() * torch.finfo(scale.dtype).eps
    return -torch.linalg.solve(current.matrix + damping * torch.diag(scale.clamp_min(floor)), current.gradient)


def promised(equations: NormalEquations, step: Tensor) -> Tensor:
    """The decrease of the cost by a step, according to its quadratic model."""
    return -(equations.gradient @ step + 0.5 * step @ equations.matrix @ step)
