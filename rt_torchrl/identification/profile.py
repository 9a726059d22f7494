r"""Profile likelihood of one weight: the least cost that all other unknowns can reach while it is held.

.. math:: J_p(\omega) = \min_{\theta:\,w_i = \omega} J(\theta), \qquad
    \{\omega: 2(J_p(\omega) - J) \le \chi^2_1\} \text{ is its confidence interval}

Unlike a standard error it needs no parabola: it shows an interval that is lopsided, or open to one side, because no
data bounds the weight there.
"""

import copy
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.identification.likelihood import Likelihood
from rt_torchrl.identification.output_error import NOISE_TOLERANCE
from rt_torchrl.identification.uncertainty import Interval, normal_factor
from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt, NormalEquations

FREE_STEP = 0.5
"""Step of a weight without a standard error; a logarithm then changes by a factor of 1.6."""


class Profile(NamedTuple):
    """Values of a weight with the rise of the cost over its minimum, and the confidence interval.

    An end of the interval is infinite where the cost stays below the level as far as the profile goes.
    """

    values: Float[Tensor, " points"]
    rise: Float[Tensor, " points"]
    interval: Interval


class _Held:
    """Normal equations with one unknown that does not move.

    Args:
        likelihood: the likelihood.
        place: place of the unknown.
    """

    def __init__(self, likelihood: Likelihood, place: int):
        self.likelihood, self.place = likelihood, place

    def __call__(self) -> NormalEquations:
        cost, gradient, matrix = self.likelihood.normal_equations()
        gradient[self.place] = 0.0
        matrix[self.place], matrix[:, self.place] = 0.0, 0.0
        matrix[self.place, self.place] = 1.0
        return NormalEquations(cost, gradient, matrix)


def profile(
    likelihood: Likelihood,
    place: int,
    error: float,
    *,
    level: float = 0.95,
    step: float = 0.5,
    reach: int = 12,
    iterations: int = 15,
) -> Profile:
    """The profile of one trained weight of the closure, which leaves all unknowns as they are.

    Args:
        likelihood: the likelihood at its minimum.
        place: place of the weight in the closure's trained weights, in the order of ``parameters()``.
        error: standard error of the weight; infinite if nothing is known of it.
        level: probability of the interval.
        step: distance of neighbouring values, in standard errors.
        reach: greatest number of values on either side.
        iterations: trial steps of the other unknowns at every value.

    Raises:
        ValueError: if there is no such weight, the level is no probability, or a number is not positive.
    """
    _require(likelihood, place, step, reach, iterations)
    threshold = 0.5 * normal_factor(level) ** 2
    width = step * error if 0.0 < error < float("inf") else FREE_STEP
    least, start = likelihood.normal_equations().cost.item(), copy.deepcopy(likelihood.unknowns.state_dict())
    middle = _weight(likelihood, place)
    sides = []
    for step in (-width, width):
        sides.append(_march(likelihood, place, step, reach, iterations, least + threshold))
        likelihood.unknowns.load_state_dict(start)
    points = [*reversed(sides[0]), (middle, least), *sides[1]]
    values, costs = (torch.tensor(column, dtype=torch.float64) for column in zip(*points, strict=True))
    ends = [
        _crossing([(middle, least), *side], least, threshold, beyond)
        for side, beyond in zip(sides, (-float("inf"), float("inf")), strict=True)
    ]
    return Profile(values, costs - least, Interval(*ends))


def _require(likelihood: Likelihood, place: int, step: float, reach: int, iterations: int) -> None:
    if not 0 <= place < likelihood.weight_count:
        raise ValueError(f"place={place} of the profile: the closure has {likelihood.weight_count} trained weights.")
    if not step > 0.0 or reach < 1 or iterations < 1:
        raise ValueError(f"step={step}, reach={reach} and iterations={iterations} of the profile must be positive.")


def _march(
    likelihood: Likelihood, place: int, step: float, reach: int, iterations: int, stop: float
) -> list[tuple[float, float]]:
    """Values of the weight on one side with their costs, until the cost exceeds ``stop``."""
    found: list[tuple[float, float]] = []
    equations = _Held(likelihood, place)
    for _ in range(reach):
        _shift(likelihood, place, step)
        try:
            best = LevenbergMarquardt(likelihood.unknowns, tolerance=NOISE_TOLERANCE).run(equations, iterations).best
        except FloatingPointError:
            best = float("inf")  # the twin diverges under such weights
        found.append((_weight(likelihood, place), best))
        if not best < stop:
            break
    return found


def _crossing(points: list[tuple[float, float]], least: float, threshold: float, beyond: float) -> float:
    """Where the root of the rise crosses that of the threshold, which is linear for a parabola; else ``beyond``."""
    roots = [(value, max(cost - least, 0.0) ** 0.5) for value, cost in points]
    target = threshold**0.5
    for (first, before), (second, after) in zip(roots[:-1], roots[1:], strict=True):
        if after >= target:
            share = (target - before) / (after - before) if after < float("inf") else 1.0
            return first + share * (second - first)
    return beyond


def _weights(likelihood: Likelihood) -> list[tuple[Tensor, int]]:
    trained = [w for w in likelihood.twin.closure.parameters() if w.requires_grad]
    return [(w, k) for w in trained for k in range(w.numel())]


def _weight(likelihood: Likelihood, place: int) -> float:
    w, k = _weights(likelihood)[place]
    return w.detach().flatten()[k].item()


@torch.no_grad()
def _shift(likelihood: Likelihood, place: int, step: float) -> None:
    w, k = _weights(likelihood)[place]
    w.view(-1)[k] += step
