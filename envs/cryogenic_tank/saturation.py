"""Saturation properties of a pure fluid as differentiable functions of pressure."""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

CELLS = 128
"""Number of pieces of the spline: over 80 … 900 kPa of hydrogen values err by 1e-7 of their maximum, slopes by 2e-6."""
DEGREE = 5
TOLERANCE = 1e-6
"""Greatest error of a value between the nodes, over its maximum, at which a fit is accepted."""
CRITICAL_SHARE = 0.95
"""Share of the critical pressure up to which a fit is tried: above it, slopes grow without bound."""


class Properties(NamedTuple):
    """Properties of saturated liquid (l) and vapour (v) at one pressure, or their slopes per Pa."""

    T: Tensor  # [K]
    rho_l: Tensor  # [kg/m³]
    rho_v: Tensor  # [kg/m³]
    h_l: Tensor  # [J/kg]
    h_v: Tensor  # [J/kg]


class Saturation(nn.Module):
    r"""T, ρ_l, ρ_v, h_l and h_v of a pure fluid over its saturation pressure.

    The functions are quintic splines in ln p through the values of CoolProp on an even grid. A floor gives the cell of
    a pressure, one gather the coefficients of all properties, and Horner's rule their values and slopes,

    .. math:: f(p) = \sum_{m=0}^5 c_{im} u^m, \quad u = \frac{\ln(p/p_{lo})}{h} - i, \qquad
        \frac{df}{dp} = \frac{1}{hp}\sum_{m=1}^5 m\,c_{im} u^{m-1}.

    Four derivatives are continuous; the plant needs one, and its adjoint a second. The fit to CoolProp is made when a
    process first needs it, and takes about a second, most of it to load CoolProp.

    Outside the range of pressure a property is NaN, never its value at the nearest end. A trajectory that leaves the
    range therefore stops with the library's ``DivergenceError``. :meth:`check` refuses such pressures at once.

    Args:
        fluid: name of a pure fluid in CoolProp, such as ``Hydrogen`` (normal) or ``ParaHydrogen``.
        low: least pressure [Pa].
        high: greatest pressure [Pa].

    Raises:
        ValueError: if CoolProp is not installed or does not know the fluid, the fluid is a mixture, or it does not boil
            over the whole range.

    Source: C. de Boor, *A Practical Guide to Splines*, chapter IX; I. H. Bell et al., *Ind. Eng. Chem. Res.* 53 (2014)
    2498 (CoolProp).
    """

    table: Tensor

    def __init__(self, fluid: str = "Hydrogen", *, low: float = 80e3, high: float = 900e3):
        super().__init__()
        self.fluid, self.low, self.high = fluid, float(low), float(high)
        if not (math.isfinite(high) and 0.0 < low < high):
            raise ValueError(f"low={low} Pa and high={high} Pa must be positive, finite and increasing.")
        self.register_buffer("table", torch.tensor(coefficients(fluid, self.low, self.high)))
        self._width = math.log(high / low) / CELLS

    def forward(self, p: Float[Tensor, "*batch"]) -> Properties:
        """Properties at the pressure p [Pa]."""
        return self.with_slopes(p)[0]

    def with_slopes(self, p: Float[Tensor, "*batch"]) -> tuple[Properties, Properties]:
        """Properties at the pressure p [Pa] and their derivatives along the saturation line [unit/Pa]."""
        x = torch.log(p / self.low) / self._width
        x = torch.where(self._within(p), x, math.nan)
        # The integer is clamped, which loses no derivative, because a NaN has no defined value as an index.
        cell = x.floor().long().clamp(0, CELLS - 1)
        u = (x - cell).unsqueeze(-1)
        c = self.table[cell]
        value, slope = c[..., DEGREE, :], torch.zeros_like(c[..., DEGREE, :])
        for power in range(DEGREE - 1, -1, -1):
            slope = slope * u + value
            value = value * u + c[..., power, :]
        slope = slope / (self._width * p).unsqueeze(-1)
        return Properties(*value.unbind(-1)), Properties(*slope.unbind(-1))

    def check(self, p: Float[Tensor, "*batch"]) -> None:
        """Refuse pressures outside the range.

        Raises:
            ValueError: if there is one; the message holds the worst of them and the range.
        """
        outside = ~self._within(p)
        if outside.any():
            offenders = p[outside]
            worst = offenders[(offenders - 0.5 * (self.low + self.high)).abs().argmax()].item()
            raise ValueError(
                f"pressure p={worst / 1e3:g} kPa is outside the saturation table of {self.fluid}, "
                f"{self.low / 1e3:g} … {self.high / 1e3:g} kPa; build Saturation with a range that holds it."
            )

    def _within(self, p: Float[Tensor, "*batch"]) -> Bool[Tensor, "*batch"]:
        return (p >= self.low) & (p <= self.high)


@cache
def coefficients(fluid: str, low: float, high: float) -> Float[np.ndarray, "cells 6 5"]:
    """Spline coefficients [cell, power, property], which are compared with CoolProp between the nodes.

    Raises:
        ValueError: as in :class:`Saturation`, or if the fit misses ``TOLERANCE``.
    """
    from scipy.interpolate import make_interp_spline  # here, because it takes a second to load

    fluid_state = _open_fluid(fluid, low, high)
    nodes = np.linspace(math.log(low), math.log(high), CELLS + 1)
    pressures = np.exp(nodes)
    pressures[[0, -1]] = low, high
    spline = make_interp_spline(nodes, _from_coolprop(fluid_state, pressures), k=DEGREE)
    width = (nodes[-1] - nodes[0]) / CELLS
    powers = [spline(nodes[:-1], nu=m) * width**m / math.factorial(m) for m in range(DEGREE + 1)]
    between = 0.5 * (nodes[1:] + nodes[:-1])
    truth = _from_coolprop(fluid_state, np.exp(between))
    error = np.abs(spline(between) - truth).max(0) / np.abs(truth).max(0)
    if error.max() > TOLERANCE:
        raise ValueError(
            f"the fit of {Properties._fields[error.argmax()]} of {fluid} over {low / 1e3:g} … {high / 1e3:g} kPa errs "
            f"by {error.max():.1e} of its maximum, more than {TOLERANCE:.0e}; narrow the range, above all at its top."
        )
    table = np.stack(powers, 1)
    table.flags.writeable = False  # every user of a fluid shares it
    return table


def _open_fluid(fluid: str, low: float, high: float) -> Any:
    """CoolProp's state of a pure fluid, after a check that the range lies between its triple and critical points."""
    try:
        import CoolProp.CoolProp as CP  # here, because it takes a second to load
    except ImportError as error:
        raise ValueError(
            "fluids need CoolProp: install the extra, pip install 'rt_torchrl[tank]', or run uv run --extra tank."
        ) from error
    try:
        fluid_state = CP.AbstractState("HEOS", fluid)
        pure = CP.get_fluid_param_string(fluid, "pure") == "true"
    except ValueError as error:
        raise ValueError(
            f"fluid={fluid!r} is not known to CoolProp; choose a pure fluid such as Hydrogen, ParaHydrogen, Nitrogen, "
            "Oxygen or Methane."
        ) from error
    if not pure:
        raise ValueError(
            f"fluid={fluid!r} is a mixture, which boils over a range of temperatures; choose a pure fluid."
        )
    least, greatest = fluid_state.trivial_keyed_output(CP.iP_triple), CRITICAL_SHARE * fluid_state.p_critical()
    if not (least <= low and high <= greatest):
        raise ValueError(
            f"low={low / 1e3:g} and high={high / 1e3:g} kPa of {fluid} must lie between its triple point, "
            f"{least / 1e3:.4g} kPa, and {CRITICAL_SHARE:.0%} of its critical pressure, {greatest / 1e3:.4g} kPa."
        )
    return fluid_state


def _from_coolprop(fluid_state: Any, pressures: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 5"]:
    import CoolProp.CoolProp as CP

    rows = []
    for p in pressures:
        fluid_state.update(CP.PQ_INPUTS, float(p), 0.0)
        liquid, vapour = fluid_state.saturated_liquid_keyed_output, fluid_state.saturated_vapor_keyed_output
        densities, enthalpies = ((liquid(key), vapour(key)) for key in (CP.iDmass, CP.iHmass))
        rows.append((fluid_state.T(), *densities, *enthalpies))
    return np.array(rows)
