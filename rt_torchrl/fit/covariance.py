r"""Standard errors of identified weights.

With the scores :math:`g_k = \Delta t\,S_k^\top\partial L_p/\partial s` of every sample and the Gauss-Newton matrix H,
the estimate scatters by

.. math::
    \mathrm{Cov} = H^{-1}MH^{-1}, \qquad
    M = \Gamma_0 + \sum_{l=1}^{L}\Big(1 - \frac l{L+1}\Big)(\Gamma_l + \Gamma_l^\top), \quad
    \Gamma_l = \sum_kg_kg_{k+l}^\top

This formula does not need the variance of the noise. The noise may differ between samples and sensors, and
neighbouring samples may depend on each other, as they do after interpolation. The formula does assume that the physics
is right: an error that no weights of the closure can remove is bias, and no record shows its size.

Source: Newey and West, Econometrica 55 (1987) 703; for L, Rev. Econ. Stud. 61 (1994) 631.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import pad

from rt_torchrl.fit.output_error import OutputError

LEAST_EIGENVALUE = 1e-12
"""Eigenvalue of H, scaled to unit diagonal, below which the record says nothing of that direction of the weights."""


@torch.no_grad()
def covariance(output_error: OutputError) -> Float[Tensor, "n_w n_w"]:
    """Covariance of the closure's weights at a minimum of J_p.

    It is infinite on the diagonal for a weight of which the segments say nothing.
    """
    found, inverse = _scatter(output_error)
    each = torch.eye(len(inverse.matrix), dtype=found.dtype, device=found.device)
    found.diagonal()[inverse.unknown(each)] = math.inf
    n = output_error.weight_count
    return found[:n, :n]


class InverseInformation(NamedTuple):
    """The pseudo-inverse of an information matrix, and the directions of which the matrix says nothing, in columns.

    The pseudo-inverse is that of the matrix scaled to unit diagonal, so that it does not depend on the units of the
    unknowns. A direction is one long in these scales. ``silent`` marks unknowns of which the matrix says nothing
    whatever the others are; they have no scale.
    """

    matrix: Float[Tensor, "n n"]
    null: Float[Tensor, "n n_null"]
    silent: Bool[Tensor, " n"]

    def unknown(self, slopes: Float[Tensor, "*quantities n"]) -> Bool[Tensor, "*quantities"]:
        """Whether quantities change in a direction of which the matrix says nothing.

        Along such a direction the unknowns scatter by more than LEAST_EIGENVALUE^(-1/2). A quantity is unknown if this
        scatter is more, in the quantity, than that of all other directions. No unit has a part in this.

        Args:
            slopes: derivatives of each quantity by the unknowns.
        """
        told = ((slopes @ self.matrix) * slopes).sum(-1).clamp_min(0.0)
        free = (slopes @ self.null).square().sum(-1)
        return (free > LEAST_EIGENVALUE * told) | (slopes[..., self.silent] != 0.0).any(-1)


def inverse_information(H: Float[Tensor, "n n"]) -> InverseInformation:
    """The inverse of an information matrix in the directions that it shows."""
    diagonal = H.diagonal()
    seen = diagonal > 0.0
    unit = diagonal[seen].sqrt()
    values, vectors = torch.linalg.eigh(H[seen][:, seen] / unit / unit[:, None])
    shown = values > LEAST_EIGENVALUE
    every = torch.eye(len(H), dtype=H.dtype, device=H.device)
    directions = every[:, seen] @ (vectors / unit[:, None])
    inverse = (directions[:, shown] / values[shown]) @ directions[:, shown].T
    return InverseInformation(inverse, torch.cat([directions[:, ~shown], every[:, ~seen]], -1), ~seen)


def _scatter(output_error: OutputError) -> tuple[Float[Tensor, "n n"], InverseInformation]:
    """Covariance of all unknowns in the directions that the segments show, and the inverse of their information."""
    replays = output_error.replays()
    H = output_error.normal_equations(replays).matrix
    M, samples = torch.zeros_like(H), 0
    for replayed in replays:
        scores = output_error.plant.dt * torch.einsum("ki,kiw->kw", replayed.gradient, replayed.sensitivity)
        places = replayed.places
        M[places[:, None], places] += newey_west(scores)
        samples += len(scores)
    inverse = inverse_information(H)
    freedom = samples / max(samples - len(H), 1)
    return freedom * inverse.matrix @ M @ inverse.matrix, inverse


def newey_west(scores: Float[Tensor, "samples n"]) -> Float[Tensor, "n n"]:
    """The matrix M of one segment of n samples, with L = ⌈4 (n/100)^{2/9}⌉."""
    lags = min(math.ceil(4.0 * (len(scores) / 100.0) ** (2.0 / 9.0)), len(scores) - 1)
    found = scores.T @ scores
    for lag in range(1, lags + 1):
        product = scores[:-lag].T @ scores[lag:]
        found = found + (1.0 - lag / (lags + 1.0)) * (product + product.T)
    return found


def standard_errors(output_error: OutputError) -> dict[str, float]:
    """Standard error of every named value of the closure, to first order.

    It is infinite for a value of which the segments say nothing.
    """
    with torch.no_grad():
        found, inverse = _scatter(output_error)
    names, slopes = named_slopes(output_error.twin.closure)
    slopes = pad(slopes, (0, len(found) - slopes.shape[-1]))
    errors = (slopes @ found * slopes).sum(-1).clamp_min(0.0).sqrt()
    return dict(zip(names, torch.where(inverse.unknown(slopes), math.inf, errors).tolist(), strict=True))


def named_slopes(closure: nn.Module) -> tuple[list[str], Float[Tensor, "n_named n_w"]]:
    """Names of the closure's values, and their derivatives by its trained weights."""
    weights, rows = [w for w in closure.parameters() if w.requires_grad], []
    with torch.enable_grad():
        named = named_values(closure)
        for value in named.values():
            slopes = torch.autograd.grad(value, weights, retain_graph=True, allow_unused=True, materialize_grads=True)
            rows.append(torch.cat([slope.flatten() for slope in slopes]))
    count = sum(w.numel() for w in weights)
    return list(named), torch.stack(rows) if rows else torch.empty(0, count, dtype=torch.float64)


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
