"""Closures of general use: any ``closure(features) -> coefficients`` can replace a plant's own."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.policies import mlp

FACTOR = 30.0
"""Factor within which coefficients of an extension are identified: records do not show what lies beyond."""


class PositiveCoefficients(nn.Module):
    r"""A few positive coefficients, named by a subclass or the arguments: a closure, or parameters of an extension.

    By default the closure gives these coefficients whatever the features are. A law that depends on its features, such
    as a polynomial of the speed, overrides ``forward``.

    The trained weights w are the logarithms of the coefficients. The coefficients therefore stay positive, and a step
    changes each of them by the same percentage, whatever its size and unit. With a ``factor`` they also stay within it
    of the first values, :math:`c = c_0\,f^{\tanh w}` with w = 0 at first, so that an identification cannot lose a
    coefficient that a record no longer shows.

    Args:
        coefficients: values of the coefficients, in the order and the units of ``names``.
        names: unit of each coefficient, by name; None for those of the class.
        meanings: what each coefficient is, by name; None for those of the class.
        factor: greatest factor f by which a coefficient differs from its first value; None for no bound.

    Raises:
        ValueError: if the number of coefficients is wrong, or one of them is not positive and finite.
    """

    names: dict[str, str] = {}
    """Unit of each coefficient, by name."""
    meanings: dict[str, str] = {}
    """What each coefficient is, in a few words, by name; tables of results show it."""
    true_coefficients: tuple[float, ...] = ()
    """Coefficients of the real system."""

    def __init__(
        self,
        coefficients: Float[Tensor, " n"] | Sequence[float],
        *,
        names: dict[str, str] | None = None,
        meanings: dict[str, str] | None = None,
        factor: float | None = None,
    ):
        super().__init__()
        self.names = dict(self.names if names is None else names)
        self.meanings = dict(self.meanings if meanings is None else meanings)
        coefficients = torch.as_tensor(coefficients, dtype=torch.float64)
        shape = (len(self.names),)
        if coefficients.shape != shape or not (coefficients.isfinite() & (coefficients > 0.0)).all():
            expected = ", ".join(f"{name} [{unit}]" for name, unit in self.names.items())
            raise ValueError(
                f"coefficients={coefficients.tolist()} of {type(self).__name__} must be {expected}, each positive "
                "and finite."
            )
        self.factor = factor
        if factor is None:
            self.log_coefficients = nn.Parameter(coefficients.log())
        else:
            self.first = nn.Buffer(coefficients.clone())
            self.weights = nn.Parameter(torch.zeros_like(coefficients))

    @classmethod
    def true(cls) -> "PositiveCoefficients":
        """A closure with the coefficients of the real system; its weights are frozen, because they are not learned."""
        return cls(torch.tensor(cls.true_coefficients, dtype=torch.float64)).requires_grad_(False)

    @property
    def coefficients(self) -> Float[Tensor, " n"]:
        """The coefficients in the units of ``names``."""
        if self.factor is None:
            return self.log_coefficients.exp()
        return self.first * torch.exp(math.log(self.factor) * torch.tanh(self.weights))

    def forward(self, features: Float[Tensor, "*batch f"]) -> Float[Tensor, "*batch n"]:
        """The coefficients for every row of features, in the order of ``names``."""
        return self.coefficients.expand(*features.shape[:-1], len(self.names))

    def named_coefficients(self) -> dict[str, Tensor]:
        """The coefficients by name."""
        return dict(zip(self.names, self.coefficients.unbind(), strict=True))


class BoundedPerceptron(nn.Module):
    r"""A perceptron of scaled features with bounded outputs, all zero at the start.

    .. math:: y = b\,\tanh N(\hat x), \qquad \hat x_i = \frac{2x_i - x_{i,hi} - x_{i,lo}}{x_{i,hi} - x_{i,lo}}

    A neural closure adds these outputs to the law that it starts from. They are zero at first and never exceed b,
    wherever the states go.

    Args:
        ranges: low and high end of a physical range of each feature, which is scaled to [−1, 1] and does not limit it.
        bounds: greatest absolute value b of each output.
        hidden: width of each hidden layer.
        generator: source of the initial weights; the weights of the last layer are zero.

    Raises:
        ValueError: if a range is empty or a bound is not positive.
    """

    def __init__(
        self,
        ranges: Sequence[tuple[float, float]],
        bounds: Sequence[float],
        *,
        hidden: Sequence[int],
        generator: torch.Generator,
    ):
        super().__init__()
        low, high = torch.tensor(ranges, dtype=torch.float64, device=generator.device).unbind(-1)
        bound = torch.tensor(bounds, dtype=torch.float64, device=generator.device)
        if not (low < high).all() or not ((bound > 0.0) & bound.isfinite()).all():
            raise ValueError(
                f"ranges={ranges} must each go from low to high, and bounds={bounds} be positive and finite."
            )
        self.network = mlp(len(ranges), hidden, len(bounds), generator=generator)
        nn.init.zeros_(self.network[-1].get_parameter("weight"))
        self.middle = nn.Buffer(0.5 * (low + high))
        self.half_range = nn.Buffer(0.5 * (high - low))
        self.bound = nn.Buffer(bound)

    def forward(self, features: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch m"]:
        return self.bound * torch.tanh(self.network((features - self.middle) / self.half_range))


class CorrectedLaw(nn.Module):
    """A law and a perceptron that corrects it, both of which are trained; a subclass says how they go together.

    The perceptron is a :class:`BoundedPerceptron`, so that the closure begins as the law.

    Args:
        law: the law that the closure starts from.
        hidden: width of each hidden layer.
        generator: source of the perceptron's initial weights.
    """

    ranges: tuple[tuple[float, float], ...]
    bounds: tuple[float, ...]

    def __init__(self, law: nn.Module, *, hidden: Sequence[int], generator: torch.Generator):
        super().__init__()
        self.law = law
        self.correction = BoundedPerceptron(self.ranges, self.bounds, hidden=hidden, generator=generator)


def described_weights(closure: nn.Module) -> dict[str, dict[str, str]]:
    """``unit`` and ``meaning`` of each coefficient, by name; none of a closure that does not say what they are."""
    names, meanings = getattr(closure, "names", {}), getattr(closure, "meanings", {})
    return {name: {"unit": unit, "meaning": meanings.get(name, "")} for name, unit in names.items()}


@torch.no_grad()
def named_weights(closure: nn.Module) -> dict[str, Any] | None:
    """Weights of a closure, in physical units where it has ``named_coefficients``; None if it has no weights."""
    named_coefficients = getattr(closure, "named_coefficients", None)
    if named_coefficients is not None:
        return {name: float(value) for name, value in named_coefficients().items()}
    return {name: weight.tolist() for name, weight in closure.named_parameters()} or None
