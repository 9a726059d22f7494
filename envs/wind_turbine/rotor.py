"""The power coefficient C_p(λ, β) of a rotor from a table: the closure of the real wind turbine."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.options import array_of

Axis = Sequence[float] | np.ndarray
Rows = Sequence[Sequence[float]] | np.ndarray
Knots = Float[np.ndarray, " _"]
"""Places along an axis, in increasing order."""
Cells = Float[np.ndarray, "_ 4 ..."]
"""Coefficients of cubics between knots, lowest power first."""
DATA = Path(__file__).parent / "data"
STALL_KNOT = 0.5
"""Knot between the two pieces of the stall element, as a fraction of the table's least λ."""
STALL_SHARE = 0.2
"""C_p at that knot, as a fraction of C_p at the table's least λ; it keeps C_p positive on the rotors of this folder."""


class PowerCoefficientTable(nn.Module):
    r"""C_p(λ, β) as one piecewise bicubic polynomial, defined for every λ and β.

    .. math:: C_p(\lambda, \beta) = \sum_{m,n=0}^{3} c_{ij,mn} (\lambda-\lambda_i)^m (\beta-\beta_j)^n

    - *Table*: within the table C_p is the not-a-knot tensor-product cubic spline through the values, which is twice
      continuously differentiable.
    - *Stall*: below the first row λ_1, C_p goes to zero like λ², so that the torque ½ρπR³(C_p/λ)u² vanishes at
      standstill. With :math:`\lambda_0 = \lambda_1/2`, it is
      :math:`C_p = 0.2\,C_p(\lambda_1,\beta)(\lambda/\lambda_0)^2` up to λ_0, then the cubic that meets value and slope
      at both ends. One cubic :math:`\lambda^2(a + b\lambda)` would take one cell less. On a steep table, however, with
      a slope above three times C_p/λ_1 as on the NREL 5-MW at fine pitch, it has a < 0: the wind would brake a slow
      rotor and hold it at standstill for good, which blade-element momentum theory contradicts. Below λ = 0, C_p is 0.
    - *Extrapolation*: for λ above the last row and for β outside the columns, C_p is linear, with value and slope of
      the table's edge. An overspeeding rotor is braked (C_p falls below zero); no value is clipped.

    C_p is continuously differentiable everywhere. The extensions are cells of the same polynomial, so that an
    evaluation is a search, a gather and Horner's rule, without case distinction.

    Args:
        tip_speed_ratio: rows λ = ω_r R/u [-], positive and increasing, at least four.
        pitch: columns β [deg], increasing, at least four.
        values: C_p [-], one row per tip-speed ratio, one column per pitch.

    Raises:
        ValueError: if an axis is too short, not finite, not increasing or (λ) not positive, or if the values do not
            match the axes or are not finite.

    Source: C. de Boor, *A Practical Guide to Splines*, chapters IV and XVII.
    """

    def __init__(self, tip_speed_ratio: Axis, pitch: Axis, values: Rows):
        super().__init__()
        lam, beta, cp = _checked(tip_speed_ratio, pitch, values)
        rows, lam_knots = _add_stall(_spline_cells(lam, cp), lam)
        cells = _spline_cells(beta, np.moveaxis(rows, -1, 0))  # [cell of β, power of β, cell of λ, power of λ]
        self.tip_speed_ratio, self.pitch, self.values = map(_buffer, (lam, beta, cp))
        self._lam_knots = _buffer(lam_knots)
        # Origin of the local coordinate in each cell, including the outer cells.
        self._lam_origins = _buffer(np.concatenate([lam_knots[:1], lam_knots]))
        self._beta_origins = _buffer(np.concatenate([beta[:1], beta]))
        self._coefficients = _buffer(cells.transpose(2, 0, 3, 1))

    @classmethod
    def from_csv(cls, path: str | Path) -> "PowerCoefficientTable":
        """Read a table with a header of a label and the pitch angles [deg], rows of λ and C_p, and ``#`` comments.

        Raises:
            ValueError: if an entry is no number or the rows differ in length; the message names the path.
        """
        header, *rows = csv_rows(path)
        try:
            pitch, body = np.array(header[1:], dtype=np.float64), np.array(rows, dtype=np.float64)
        except ValueError as error:
            raise ValueError(
                f"path={str(path)!r}: {error}; under a header of {len(header)} entries every row must hold as many "
                "numbers, λ and one C_p per pitch angle. Complete or remove the others."
            ) from error
        return cls(body[:, 0], pitch, body[:, 1:])

    @classmethod
    def nrel5mw(cls) -> "PowerCoefficientTable":
        """The NREL 5-MW rotor by blade-element momentum, λ 2…14.5, β -5…30 deg; ``data/NOTICE.md`` names the source."""
        return cls.from_csv(DATA / "nrel5mw_Cp_table_rosco.csv")

    def forward(self, features: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 1"]:
        """C_p [-] at the features, tip-speed ratio λ [-] and pitch β [deg], in the module's dtype (float64)."""
        # The search needs contiguous memory; Tensor.contiguous does not see the batch dimension of torch.func.vmap.
        lam, beta = (x.clone(memory_format=torch.contiguous_format) for x in features.split(1, -1))
        i = torch.bucketize(lam, self._lam_knots, right=True)
        j = torch.bucketize(beta, self.pitch, right=True)
        c = self._coefficients[i, j]
        x, y = lam - self._lam_origins[i], (beta - self._beta_origins[j]).unsqueeze(-1)
        in_lam = ((c[..., 3] * y + c[..., 2]) * y + c[..., 1]) * y + c[..., 0]
        c0, c1, c2, c3 = in_lam.unbind(-1)
        return ((c3 * x + c2) * x + c1) * x + c0

    @torch.no_grad()
    def optimum(self) -> tuple[float, float]:
        """The highest C_p [-] at fine pitch in the table's range, and its λ* [-].

        λ* errs by about 1e-7, the square root of the rounding error.
        """
        axis = _subdivided(self.tip_speed_ratio, 8)
        for _ in range(9):  # each pass narrows the axis to a tenth, in the end to 1e-8 of a table cell
            values = self(torch.stack([axis, torch.zeros_like(axis)], -1)).squeeze(-1)
            best = int(values.argmax())
            power, lam = values[best].item(), axis[best].item()
            axis = _subdivided(axis[max(best - 3, 0) : best + 4], 10)
        return power, lam


def csv_rows(path: str | Path) -> list[list[str]]:
    """The rows of a comma-separated file from the header on, without blank lines and ``#`` comments.

    Raises:
        ValueError: if the file cannot be read as such a text, or there is no row below the header.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(line for line in file if line.strip() and not line.startswith("#")))
    except (OSError, csv.Error, UnicodeError) as error:
        raise ValueError(f"path={str(path)!r} is no comma-separated text: {error}") from error
    if len(rows) < 2:
        raise ValueError(
            f"path={str(path)!r} holds {len(rows)} rows; it needs a header and at least one row of numbers."
        )
    return rows


def _spline_cells(knots: Knots, values: np.ndarray) -> Cells:
    """Coefficients, lowest power first, of the n − 1 cells of a not-a-knot spline and of a linear cell on either side.

    Each cell's origin is its left knot; the cell to the left of all knots takes the first knot.
    """
    from scipy.interpolate import CubicSpline  # here, because it takes a second to load

    spline = CubicSpline(knots, values, axis=0, bc_type="not-a-knot")
    inner = np.moveaxis(spline.c[::-1], 0, 1)
    ends = [np.stack([spline(k), spline(k, 1), 0 * spline(k), 0 * spline(k)]) for k in (knots[0], knots[-1])]
    return np.concatenate([ends[:1], inner, ends[1:]])


def _add_stall(rows: Cells, lam: Knots) -> tuple[Cells, Knots]:
    """Replace the linear cell below the first row by zero (λ < 0), a parabola and a cubic; return cells and knots."""
    value, slope, zero = rows[0, 0], rows[0, 1], 0 * rows[0, 0]
    lam_0 = STALL_KNOT * lam[0]
    curvature = STALL_SHARE * value / lam_0**2
    low, low_slope, h = STALL_SHARE * value, 2 * curvature * lam_0, lam[0] - lam_0
    secant = (value - low) / h
    quadratic = (3 * secant - 2 * low_slope - slope) / h
    cubic = (low_slope + slope - 2 * secant) / h**2
    stall = [[zero] * 4, [zero, zero, curvature, zero], [low, low_slope, quadratic, cubic]]
    return np.concatenate([np.array(stall), rows[1:]]), np.concatenate([[0.0, lam_0], lam])


def _buffer(array: np.ndarray) -> nn.Buffer:
    return nn.Buffer(torch.tensor(array, dtype=torch.float64))


def _subdivided(axis: Float[Tensor, " n"], parts: int) -> Float[Tensor, " m"]:
    """The axis with each interval cut into equal parts."""
    steps = torch.arange(parts, dtype=axis.dtype, device=axis.device) / parts
    return torch.cat([(axis[:-1, None] + steps * axis.diff()[:, None]).flatten(), axis[-1:]])


def _checked(
    tip_speed_ratio: Axis, pitch: Axis, values: Rows
) -> tuple[Knots, Knots, Float[np.ndarray, "rows columns"]]:
    axes = {"tip_speed_ratio": array_of("tip_speed_ratio", tip_speed_ratio), "pitch": array_of("pitch", pitch)}
    for name, axis in axes.items():
        if axis.ndim != 1 or len(axis) < 4 or not np.isfinite(axis).all() or (np.diff(axis) <= 0).any():
            raise ValueError(
                f"{name}={axis.tolist()} must be at least 4 finite numbers that increase strictly, without duplicates."
            )
    lam, beta = axes.values()
    if lam[0] <= 0:
        raise ValueError(f"tip_speed_ratio starts at {lam[0]}, but must be positive; drop the rows with λ <= 0.")
    cp = array_of("values", values)
    if cp.shape != (len(lam), len(beta)) or not (np.isfinite(cp) & (cp <= 16 / 27)).all():
        raise ValueError(
            f"values of shape {cp.shape} up to {cp.max()} must be finite C_p, at most Betz's 16/27, not in per cent, "
            f"a row per tip-speed ratio and a column per pitch angle, ({len(lam)}, {len(beta)})."
        )
    return lam, beta, cp
