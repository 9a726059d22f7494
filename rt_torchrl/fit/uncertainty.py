r"""What an estimate is worth: errors, correlations, confidence regions, and what the data cannot tell.

At the minimum of J (:mod:`likelihood`) the Gauss-Newton matrix H is the Fisher information, and the unknowns scatter by

.. math:: \mathrm{Cov} = H^{-1}\ \text{(fisher)}, \qquad \mathrm{Cov} = H^{-1}MH^{-1}\ \text{(robust)}

where M, the Newey-West sum of the scores :math:`g_k` of each record, allows residuals that depend on their neighbours,
and noise that differs between samples. Noise that drives the system makes residuals that last as long as the system
remembers; what scores inherit from the sample before, by the correlation ρ of all records, is therefore taken off
first (:math:`u_k = g_k - \rho g_{k-1}`, :math:`u_1 = \sqrt{1 - \rho^2}\,g_1`), and given back to the sum of n samples:

.. math::
    M = \frac{1 + 2\sum_{l=1}^{n-1}(1 - l/n)\rho^l}{1 - \rho^2}
    \Big[\Gamma_0 + \sum_{l=1}^{L}\Big(1 - \frac l{L+1}\Big)(\Gamma_l + \Gamma_l^\top)\Big], \qquad
    \Gamma_l = \sum_ku_ku_{k+l}^\top

Residuals are orthogonal to their derivatives, so that M of a short record is too small: it is multiplied by n/(n − p),
for n samples and p unknowns, and no combination of the unknowns is told better than by white noise of their size.

Named values of the closure take their errors from those of the weights to first order. Where a fit has not arrived, the
change Δ by a Newton step counts as well, :math:`\sqrt{\sigma^2 + \Delta^2}`. Both formulas assume that the physics is
right: an error that no weights can remove is bias, and no record shows its size.

Source: Newey and West, Econometrica 55 (1987) 703; for L, Rev. Econ. Stud. 61 (1994) 631; for ρ, Andrews and Monahan,
Econometrica 60 (1992) 953.
"""

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import pad

from rt_torchrl.fit.likelihood import Likelihood, Offsets

Errors = Literal["fisher", "robust"]
BAD_SHARE = 0.5
"""Standard error of a value, as a share of the value, above which the data do not tell it from zero."""
HIGH_CORRELATION = 0.99
"""Correlation of two values above which the data tell only one combination of them."""
GREATEST_CORRELATION = 0.97
"""Of neighbouring scores; the formula diverges at 1."""
LEAST_EIGENVALUE = 1e-12
"""Eigenvalue of H, scaled to unit diagonal, below which the record says nothing of that direction of the weights."""


class Uncertainty:
    """The scatter of an estimate.

    Args:
        likelihood: the likelihood at its minimum.
        errors: formula of the covariance: ``fisher`` for white noise, or ``robust`` for residuals with memory.

    Attributes:
        covariance: covariance of all unknowns in their order; zero in directions of which nothing is known.
        names: names of the closure's values.
        values: these values.
        named_covariance: their covariance.
    """

    @torch.no_grad()
    def __init__(self, likelihood: Likelihood, *, errors: Errors = "fisher"):
        self.likelihood = likelihood
        blocks = likelihood.residuals()
        equations = likelihood.normal_equations(blocks)
        self._inverse = inverse_information(equations.matrix)
        self.covariance = self._inverse.matrix
        ahead = -(self.covariance @ equations.gradient)[: likelihood.weight_count]  # the Newton step
        if errors == "robust":
            M, segments = torch.zeros_like(equations.matrix), []
            for block in blocks:
                all_scores = torch.einsum("bkr,bkrp->bkp", block.values, block.jacobian)
                for scores, seen, places in zip(all_scores, block.group.seen.any(-1), block.group.places, strict=True):
                    segments.append((scores[seen], places))
            samples, diagonal = sum(len(scores) for scores, _ in segments), equations.matrix.diagonal()
            correlation = neighbours(
                [scores / diagonal[places].clamp_min(1e-300).sqrt() for scores, places in segments]
            )
            for scores, places in segments:
                M[places[:, None], places] += newey_west(scores, correlation)
            root = self._inverse.root
            ratios, vectors = torch.linalg.eigh(root.T @ M @ root * (samples / max(samples - root.shape[1], 1)))
            root, squares = root @ vectors, sum(float(block.values.square().sum()) for block in blocks)
            white = squares / max(int(likelihood.samples.sum()) - root.shape[1], 1)
            self.covariance = (root * ratios.clamp_min(white)) @ root.T
        self._ahead, n = ahead, likelihood.weight_count
        named = self._named()
        self.names, slopes = list(named), self._slopes(list(named.values()))
        self.named_covariance = slopes @ self.covariance[:n, :n] @ slopes.T
        self._undetermined = self._inverse.unknown(pad(slopes, (0, len(self.covariance) - n)))
        self.values = torch.stack(list(named.values())).detach() if named else torch.empty(0)

    @torch.enable_grad()
    def _named(self) -> dict[str, Tensor]:
        return named_values(self.likelihood.twin.closure)

    def _slopes(self, values: Sequence[Tensor]) -> Float[Tensor, "values n_w"]:
        """Derivatives of numbers by the trained weights of the closure."""
        weights = [w for w in self.likelihood.twin.closure.parameters() if w.requires_grad]
        rows = [self.covariance.new_zeros(0, sum(w.numel() for w in weights))]
        for value in values:
            slopes = tuple(torch.zeros_like(w) for w in weights)
            if value.requires_grad:  # one that is fixed does not
                slopes = torch.autograd.grad(value, weights, retain_graph=True, materialize_grads=True)
            rows.append(torch.cat([slope.flatten() for slope in slopes])[None])
        return torch.cat(rows)

    def unknown(self) -> list[str]:
        """Names of the values that take part in a direction of which the data say nothing."""
        return [name for name, free in zip(self.names, self._undetermined.tolist(), strict=True) if free]

    def standard_errors(self) -> dict[str, float]:
        """Standard error of every named value; infinite for one of which the data say nothing, zero for a fixed one."""
        errors = self.errors_of(lambda: torch.stack(list(self._named().values()))) if self.names else self.values
        return dict(zip(self.names, errors.tolist(), strict=True))

    @torch.enable_grad()
    def errors_of(self, law: Callable[[], Float[Tensor, "*batch"]]) -> Float[Tensor, "*batch"]:
        """Standard errors of values that the closure's weights give, to first order, such as those of a law.

        One of which the data say nothing is infinite, a fixed one zero. They do not hold what a prior bends.

        Args:
            law: function that computes the values by the estimated closure, ``lambda: twin.closure(features)``.
        """
        values = law()
        slopes = self._slopes(list(values.flatten()))
        n = slopes.shape[1]
        variance = ((slopes @ self.covariance[:n, :n]) * slopes).sum(-1).clamp_min(0.0)
        errors = (variance + (slopes @ self._ahead).square()).sqrt()
        errors[self._inverse.unknown(pad(slopes, (0, len(self.covariance) - n)))] = math.inf
        return errors.view(values.shape)

    def correlations(self) -> Float[Tensor, "n_named n_named"]:
        """Correlations of the named values; nan for one of which the data say nothing."""
        C = self.named_covariance
        scale = torch.where(self._undetermined, math.nan, C.diagonal().sqrt())
        return C / torch.outer(scale, scale)

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Ends of the confidence interval of every named value.

        Raises:
            ValueError: if the level does not lie between 0 and 1.
        """
        if not 0.0 < level < 1.0:
            raise ValueError(f"level={level} of a confidence interval must lie between 0 and 1.")
        factor = NormalDist().inv_cdf(0.5 + 0.5 * level)
        pairs = zip(self.standard_errors().items(), self.values.tolist(), strict=True)
        return {name: (value - factor * error, value + factor * error) for (name, error), value in pairs}

    def initial_errors(self) -> Float[Tensor, "records n_s"]:
        """Standard errors of the initial states; zero for those that are known, infinite where nothing is known."""
        return self._offset_errors(self.likelihood.initial, self.likelihood.weight_count)

    def bias_errors(self) -> dict[str, float]:
        """Standard error of every sensor's bias, in its unit; zero for one without, infinite where nothing is known."""
        biases, names = self.likelihood.biases, [sensor.name for sensor in self.likelihood.sensors]
        errors = self._offset_errors(biases, self.likelihood.count - biases.offsets.numel())
        return dict(zip(names, errors.tolist(), strict=True))

    def _offset_errors(self, values: Offsets, first: int) -> Float[Tensor, "*records n"]:
        """Standard errors of values whose offsets begin at the place ``first`` among the unknowns."""
        shape = values.offsets.shape
        places = slice(first, first + shape.numel())
        variance = self.covariance.diagonal()[places].clone()
        axes = torch.eye(len(self.covariance), dtype=variance.dtype, device=variance.device)[places]
        variance[self._inverse.unknown(axes)] = math.inf
        errors = torch.zeros_like(values.guess)
        errors[..., list(values.free)] = variance.sqrt().view(shape) * values.unit.sum(-1)
        return errors

    def warnings(self) -> list[str]:
        """What the data cannot tell, in plain words; empty if they tell every value."""
        errors, nothing = self.standard_errors(), self.unknown()
        warnings = []
        if nothing:
            warnings.append(f"the data do not tell {', '.join(nothing)}: measure more, or fix some of them")
        for (name, error), value in zip(errors.items(), self.values.tolist(), strict=True):
            if not math.isinf(error) and error > BAD_SHARE * abs(value):
                warnings.append(
                    f"the data do not tell {name} from zero: {value:.3g} with a standard error of {error:.2g}"
                )
        R = self.correlations()
        for i, j in (R.abs() > HIGH_CORRELATION).triu(1).nonzero().tolist():  # nan for those that are not told
            warnings.append(
                f"the data tell a combination of {self.names[i]} and {self.names[j]}, such as their ratio or product, "
                f"better than each of them (correlation {R[i, j].item():.4f})"
            )
        return warnings


class InverseInformation(NamedTuple):
    """The pseudo-inverse RRᵀ of an information matrix, and the directions of which the matrix says nothing, in columns.

    The pseudo-inverse is that of the matrix scaled to unit diagonal, so that it does not depend on the units of the
    unknowns. A direction is one long in these scales. ``silent`` marks unknowns of which the matrix says nothing
    whatever the others are; they have no scale.
    """

    root: Float[Tensor, "n n_shown"]
    null: Float[Tensor, "n n_null"]
    silent: Bool[Tensor, " n"]

    @property
    def matrix(self) -> Float[Tensor, "n n"]:
        """The pseudo-inverse itself."""
        return self.root @ self.root.T

    def unknown(self, slopes: Float[Tensor, "*quantities n"]) -> Bool[Tensor, "*quantities"]:
        """Whether quantities change in a direction of which the matrix says nothing.

        Along such a direction the unknowns scatter by more than LEAST_EIGENVALUE^(-1/2). A quantity is unknown if this
        scatter is more, in the quantity, than that of all other directions. No unit has a part in this.

        Args:
            slopes: derivatives of each quantity by the unknowns.
        """
        determined = ((slopes @ self.matrix) * slopes).sum(-1).clamp_min(0.0)
        free = (slopes @ self.null).square().sum(-1)
        return (free > LEAST_EIGENVALUE * determined) | (slopes[..., self.silent] != 0.0).any(-1)


def inverse_information(H: Float[Tensor, "n n"]) -> InverseInformation:
    """The inverse of an information matrix in the directions that it shows."""
    diagonal = H.diagonal()
    informed = diagonal > 0.0
    unit = diagonal[informed].sqrt()
    values, vectors = torch.linalg.eigh(H[informed][:, informed] / unit / unit[:, None])
    significant = values > LEAST_EIGENVALUE
    identity = torch.eye(len(H), dtype=H.dtype, device=H.device)
    directions = identity[:, informed] @ (vectors / unit[:, None])
    root = directions[:, significant] / values[significant].sqrt()
    return InverseInformation(root, torch.cat([directions[:, ~significant], identity[:, ~informed]], -1), ~informed)


def neighbours(segments: Sequence[Float[Tensor, "samples n"]]) -> float:
    """The correlation ρ of neighbouring scores in all segments together, at most GREATEST_CORRELATION."""
    product = sum(float((scores[1:] * scores[:-1]).sum()) for scores in segments)
    square = sum(float(scores.square().sum()) * (1.0 - 1.0 / len(scores)) for scores in segments if len(scores))
    return max(-GREATEST_CORRELATION, min(GREATEST_CORRELATION, product / square)) if square else 0.0


def newey_west(scores: Float[Tensor, "samples n"], correlation: float) -> Float[Tensor, "n n"]:
    """The matrix M of one segment of n samples with the correlation ρ, with L = ⌈4 (n/100)^{2/9}⌉."""
    count = len(scores)
    lags = min(math.ceil(4.0 * (count / 100.0) ** (2.0 / 9.0)), count - 1)
    innovations = torch.cat([math.sqrt(1.0 - correlation**2) * scores[:1], scores[1:] - correlation * scores[:-1]])
    M = innovations.T @ innovations
    for lag in range(1, lags + 1):
        product = innovations[:-lag].T @ innovations[lag:]
        M = M + (1.0 - lag / (lags + 1.0)) * (product + product.T)
    inherited = 1.0 + 2.0 * sum((1.0 - lag / count) * correlation**lag for lag in range(1, count))
    return M * (inherited / (1.0 - correlation**2))


def named_values(closure: nn.Module) -> dict[str, Tensor]:
    """``named_coefficients`` of a closure that has them; otherwise every trainable weight by parameter and place."""
    named_coefficients = getattr(closure, "named_coefficients", None)
    if named_coefficients is not None:
        return named_coefficients()
    return {
        f"{name}[{','.join(map(str, place))}]": weight[place]
        for name, weight in closure.named_parameters()
        if weight.requires_grad
        for place in np.ndindex(*weight.shape)
    }
