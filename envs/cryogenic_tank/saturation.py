"""Saturation properties of a pure fluid as differentiable functions of pressure."""

import math
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

DATA = Path(__file__).parent / "data"
FLUIDS = ("Hydrogen", "ParaHydrogen", "Nitrogen", "Oxygen", "Methane")
"""Fluids of which there is a table; hydrogen is normal, and becomes parahydrogen when it is stored."""
CELLS, DEGREE = 128, 5
"""Number of pieces of the spline, and their degree: values of hydrogen err by 1e-7, slopes by 2e-6."""


class Properties(NamedTuple):
    """Properties of saturated liquid (l) and vapour (v) at one pressure, or their slopes per Pa."""

    T: Tensor  # [K]
    rho_l: Tensor  # [kg/m³]
    rho_v: Tensor  # [kg/m³]
    h_l: Tensor  # [J/kg]
    h_v: Tensor  # [J/kg]


class Saturation(nn.Module):
    r"""T, ρ_l, ρ_v, h_l and h_v of a pure fluid over its saturation pressure, 80 … 900 kPa.

    The functions are quintic splines in ln p through values of CoolProp on an even grid. A floor gives the cell of
    a pressure, one gather the coefficients of all properties, and Horner's rule their values and slopes,

    .. math:: f(p) = \sum_{m=0}^5 c_{im} u^m, \quad u = \frac{\ln(p/p_{lo})}{h} - i, \qquad
        \frac{df}{dp} = \frac{1}{hp}\sum_{m=1}^5 m\,c_{im} u^{m-1}.

    Four derivatives are continuous; the plant needs one, and its adjoint a second.

    Outside the range of pressure a property is NaN, never its value at the nearest end. A trajectory that leaves the
    range therefore stops with the library's ``DivergenceError``. :meth:`check` refuses such pressures at once.

    Args:
        fluid: name of the fluid, one of ``FLUIDS``.

    Raises:
        ValueError: if there is no table of the fluid.

    Source: C. de Boor, *A Practical Guide to Splines*, chapter IX; I. H. Bell et al., *Ind. Eng. Chem. Res.* 53 (2014)
    2498 (CoolProp).
    """

    def __init__(self, fluid: str = "Hydrogen"):
        super().__init__()
        if fluid not in FLUIDS:
            raise ValueError(f"fluid={fluid!r} has no table; choose one of {', '.join(FLUIDS)}.")
        self.fluid, (self.low, self.high, table) = fluid, coefficients(fluid)
        self.table = nn.Buffer(torch.tensor(table))
        self._width = math.log(self.high / self.low) / CELLS

    def forward(self, p: Float[Tensor, "*batch"]) -> Properties:
        """Properties at the pressure p [Pa]."""
        return self.with_slopes(p)[0]

    def with_slopes(self, p: Float[Tensor, "*batch"]) -> tuple[Properties, Properties]:
        """Properties at the pressure p [Pa] and their derivatives along the saturation line [unit/Pa]."""
        x = torch.log(p / self.low) / self._width
        # An index of no dimension is a number of Python, which Jacobians of one state do not have.
        x = torch.where(self._within(p), x, math.nan).unsqueeze(-1)
        # The integer is clamped, which loses no derivative, because a NaN has no defined value as an index.
        cell = x.floor().long().clamp(0, CELLS - 1)
        u = x - cell
        c = self.table[cell].squeeze(-3)
        value, slope = c[..., DEGREE, :], torch.zeros_like(c[..., DEGREE, :])
        for power in range(DEGREE - 1, -1, -1):
            slope = slope * u + value
            value = value * u + c[..., power, :]
        slope = slope / (self._width * p).unsqueeze(-1)
        return Properties(*value.unbind(-1)), Properties(*slope.unbind(-1))

    def check(self, p: Float[Tensor, "*batch"]) -> None:
        """Refuse pressures outside the range.

        Raises:
            ValueError: if there is one.
        """
        outside = p[~self._within(p)]
        if len(outside):
            raise ValueError(
                f"pressure p={outside[0].item() / 1e3:g} kPa is outside the saturation table of {self.fluid}, "
                f"{self.low / 1e3:g} … {self.high / 1e3:g} kPa."
            )

    def _within(self, p: Float[Tensor, "*batch"]) -> Bool[Tensor, "*batch"]:
        return (p >= self.low) & (p <= self.high)


@cache
def coefficients(fluid: str) -> tuple[float, float, Float[np.ndarray, "cells 6 5"]]:
    """Least and greatest pressure [Pa], and the coefficients of the spline by cell, power and property."""
    from scipy.interpolate import make_interp_spline  # here, because it takes a second to load

    pressures, *properties = np.loadtxt(DATA / f"{fluid}.csv", delimiter=",").T
    low, high = float(pressures[0]), float(pressures[-1])
    nodes = np.linspace(math.log(low), math.log(high), CELLS + 1)
    spline = make_interp_spline(nodes, np.stack(properties, -1), k=DEGREE)
    width = (nodes[-1] - nodes[0]) / CELLS
    powers = [spline(nodes[:-1], nu=m) * width**m / math.factorial(m) for m in range(DEGREE + 1)]
    table = np.stack(powers, 1)
    table.flags.writeable = False  # every tank of this fluid shares it
    return low, high, table
