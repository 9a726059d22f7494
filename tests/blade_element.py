r"""Blade-element momentum theory, which gives the map C_p(λ, β) of a rotor from its blade and its aerofoil polars.

It made the table of the worn rotor that the wind turbine ships, see :func:`worn_values`.

Each blade element sees the wind :math:`V_x` along the rotor axis and :math:`V_y` in the plane of rotation. Its inflow
angle φ balances the loads of the section against the momentum of the annulus (Ning 2014),

.. math::
    R(\phi) = \frac{\sin\phi}{1-a} - \frac{V_x}{V_y}\,\cos\phi\,(1-\kappa') = 0, \quad
    \kappa = \frac{\sigma' c_n}{4F\sin^2\phi}, \quad \kappa' = \frac{\sigma' c_t}{4F\sin\phi\cos\phi}

with :math:`a = \kappa/(1+\kappa)` in the momentum region, Buhl's parabola above κ = 2/3, and Prandtl's tip and hub loss
factor F. Each element has one unknown in a known bracket, so that bisection cannot fail; it takes all elements at once.

Sources: S. A. Ning, *A simple solution method for the blade element momentum equations with guaranteed convergence*,
Wind Energy 17 (2014) 1327-1345; M. L. Buhl, *A new empirical relationship between thrust coefficient and induction
factor for the turbulent windmill state*, NREL/TP-500-36834, 2005.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from rt_torchrl.envs.wind_turbine.rotor import PowerCoefficientTable, csv_rows

DATA = Path(__file__).parent / "data"
EDGE = 1e-6
"""Distance of the brackets from φ = 0 and φ = π, where the residual is singular [rad]."""
BISECTIONS = 48
"""Number of halvings of a bracket of at most π/2, which give φ to 6e-15 rad."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Polar:
    """Lift and drag coefficients of a section, interpolated by monotone cubics (PCHIP), which do not overshoot.

    Args:
        alpha: angles of attack [deg], increasing from -180 to 180.
        cl: lift coefficients [-].
        cd: drag coefficients [-].

    Source: F. N. Fritsch, J. Butland, SIAM J. Sci. Stat. Comput. 5 (1984) 300-304.
    """

    alpha: np.ndarray
    cl: np.ndarray
    cd: np.ndarray

    @classmethod
    def nrel5mw(cls, name: str) -> "Polar":
        """A section of the NREL 5-MW blade."""
        alpha, cl, cd = columns(f"nrel5mw_polar_{name}.csv", "alpha_deg", "cl", "cd")
        return cls(alpha=alpha, cl=cl, cd=cd)

    @cached_property
    def _curve(self) -> PchipInterpolator:
        return PchipInterpolator(self.alpha, np.stack([self.cl, self.cd], axis=-1))

    def __call__(self, alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lift and drag coefficient [-] at angles of attack [deg], of any number of turns."""
        both = self._curve((alpha + 180.0) % 360.0 - 180.0)
        return both[..., 0], both[..., 1]

    def worn(self, *, lift_factor: float, drag_factor: float) -> "Polar":
        """The section after erosion, soiling or icing: lift and drag multiplied by the two factors [-]."""
        return replace(self, cl=lift_factor * self.cl, cd=drag_factor * self.cd)


@dataclass(frozen=True, kw_only=True, eq=False)
class Blade:
    """The elements of a blade; each carries the loads of its mid-point.

    Args:
        r: distances of the mid-points from the rotor axis along the blade [m].
        dr: lengths of the elements [m].
        chord: chords of the sections [m].
        twist: angles of the sections to the plane of rotation, positive towards feather [deg].
        airfoil: names of the elements' polars.
    """

    r: np.ndarray
    dr: np.ndarray
    chord: np.ndarray
    twist: np.ndarray
    airfoil: Sequence[str]

    @classmethod
    def nrel5mw(cls) -> "Blade":
        """The blade of the NREL 5-MW rotor."""
        file = "nrel5mw_blade_17nodes.csv"
        r, dr, chord, twist = columns(file, "r_m", "dr_m", "chord_m", "twist_deg")
        header, *rows = csv_rows(DATA / file)
        return cls(r=r, dr=dr, chord=chord, twist=twist, airfoil=[row[header.index("airfoil")] for row in rows])


def columns(file: str, *names: str) -> list[np.ndarray]:
    """Columns of numbers by the names in the file's header."""
    header, *rows = csv_rows(DATA / file)
    return [np.array([float(row[header.index(name)]) for row in rows]) for name in names]


@dataclass(frozen=True, kw_only=True)
class Rotor:
    """A rotor in a sheared wind; the defaults are those of the NREL 5-MW reference turbine.

    Args:
        blade: elements of the blade.
        polars: polars by the names that the blade uses.
        n_blades: number of blades.
        hub_radius, tip_radius: distances of the blade's ends from the rotor axis, along the blade [m].
        precone: cone angle, tips upwind positive [deg].
        tilt: shaft angle, upwind end up positive [deg].
        hub_height: height of the hub above ground [m].
        shear: exponent of the wind profile, u(h) = U (h/hub_height)^shear [-].
        n_sectors: number of azimuth positions in the average.
    """

    blade: Blade
    polars: Mapping[str, Polar]
    n_blades: int = 3
    hub_radius: float = 1.5
    tip_radius: float = 63.0
    precone: float = 2.5
    tilt: float = 5.0
    hub_height: float = 90.0
    shear: float = 0.2
    n_sectors: int = 8

    @classmethod
    def nrel5mw(cls) -> "Rotor":
        """The NREL 5-MW reference rotor, Jonkman et al., NREL/TP-500-38060, 2009."""
        blade = Blade.nrel5mw()
        return cls(blade=blade, polars={name: Polar.nrel5mw(name) for name in set(blade.airfoil)})


class Inflow(NamedTuple):
    """Solution for each tip-speed ratio, pitch, sector and element, at a unit wind at hub height."""

    phi: Float[np.ndarray, "lam beta sector r"]  # inflow angle [rad]
    a: Float[np.ndarray, "lam beta sector r"]  # axial induction [-]
    a_tangential: Float[np.ndarray, "lam beta sector r"]  # tangential induction a' [-]
    loss: Float[np.ndarray, "lam beta sector r"]  # Prandtl's factor F [-]
    normal: Float[np.ndarray, "lam beta sector r"]  # force along the rotor axis, per ½ρ and unit length, one blade
    tangential: Float[np.ndarray, "lam beta sector r"]  # same unit, in the direction of rotation


class _Sections(NamedTuple):
    """A rotor in a given wind and pitch, with arrays that broadcast to [lam, beta, sector, r]."""

    rotor: Rotor
    v_x: Float[np.ndarray, "*axial"]
    v_y: Float[np.ndarray, "*rotational"]
    beta: Float[np.ndarray, "beta 1 1"]

    def balance(self, phi: Float[np.ndarray, "lam beta sector r"]) -> tuple[np.ndarray, ...]:
        """Induction a, loads κ', loss F, force coefficients c_n, c_t and the residual at inflow angles φ [rad]."""
        rotor, r = self.rotor, self.rotor.blade.r
        sin, cos = np.sin(phi), np.cos(phi)
        cl, cd = self._section(np.degrees(phi) - rotor.blade.twist - self.beta)
        c_n, c_t = cl * cos + cd * sin, cl * sin - cd * cos
        half = 0.5 * rotor.n_blades / np.abs(sin)
        loss = _prandtl(half * (rotor.tip_radius - r) / r) * _prandtl(half * (r - rotor.hub_radius) / rotor.hub_radius)
        solidity = rotor.n_blades * rotor.blade.chord / (2 * np.pi * r)
        kappa = solidity * c_n / (4 * loss * sin**2)
        kappa_t = solidity * c_t / (4 * loss * sin * cos)
        a = _axial_induction(kappa, loss, phi > 0)
        rotation = self.v_x / self.v_y * cos * (1 - kappa_t)
        # For φ < 0 (propeller brake, a > 1) the division by 1 - a would blow up inside the bracket: there a = κ/(κ-1)
        # and Ning writes 1/(1 - a) = 1 - κ.
        residual = np.where(phi > 0, sin / (1 - a), sin * (1 - kappa)) - rotation
        return a, kappa_t, loss, c_n, c_t, residual

    def _section(self, alpha: Float[np.ndarray, "lam beta sector r"]) -> tuple[np.ndarray, np.ndarray]:
        """Lift and drag coefficient of every element at its angle of attack [deg]."""
        cl, cd = np.empty_like(alpha), np.empty_like(alpha)
        names = np.array(self.rotor.blade.airfoil)
        for name in np.unique(names):
            at = names == name
            cl[..., at], cd[..., at] = self.rotor.polars[str(name)](alpha[..., at])
        return cl, cd


def solve_inflow(rotor: Rotor, tip_speed_ratio: Sequence[float], pitch: Sequence[float]) -> Inflow:
    """Balance every element of the rotor at every pair of tip-speed ratio [-] and pitch [deg]."""
    lam, beta = np.asarray(tip_speed_ratio, dtype=np.float64), np.asarray(pitch, dtype=np.float64)
    v_x, v_y = _wind(rotor, lam)
    sections = _Sections(rotor, v_x, v_y, beta[:, None, None])
    low, high = _bracket(sections, (lam.size, beta.size, rotor.n_sectors, rotor.blade.r.size))
    sign = np.sign(sections.balance(low)[-1])
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        left = np.sign(sections.balance(middle)[-1]) == sign
        low, high = np.where(left, middle, low), np.where(left, high, middle)
    phi = 0.5 * (low + high)
    a, kappa_t, loss, c_n, c_t, _ = sections.balance(phi)
    a_tangential = kappa_t / (1 - kappa_t)
    force = rotor.blade.chord * ((v_x * (1 - a)) ** 2 + (v_y * (1 + a_tangential)) ** 2)
    return Inflow(phi, a, a_tangential, loss, force * c_n, force * c_t)


def power_coefficients(
    rotor: Rotor, tip_speed_ratio: Sequence[float], pitch: Sequence[float]
) -> Float[np.ndarray, "lam beta"]:
    r"""Map of the rotor, :math:`C_p = \lambda\,Q / (\tfrac12\rho\pi R^3 U^2)` [-], with the mean torque Q over azimuth.

    R is the radius of the swept disc, tip_radius·cos(precone), both in C_p and in λ. The loads of an element are
    constant over its length dr.
    """
    lam, cone = np.asarray(tip_speed_ratio, dtype=np.float64), np.radians(rotor.precone)
    tangential = solve_inflow(rotor, lam, pitch).tangential.mean(axis=2)
    torque = rotor.n_blades * (tangential * rotor.blade.r * np.cos(cone) * rotor.blade.dr).sum(axis=-1)
    return lam[:, None] * torque / (np.pi * (rotor.tip_radius * np.cos(cone)) ** 3)


def worn_values() -> Float[np.ndarray, "lam beta"]:
    """The shipped table of the NREL 5-MW rotor after its polars have lost 10 % of their lift and gained 50 % of drag.

    The clean rotor's table is lowered by the difference that the theory finds between the clean and the worn blade, so
    that the theory's own error, RMS 0.004, does not count as wear.
    """
    table, clean = PowerCoefficientTable.nrel5mw(), Rotor.nrel5mw()
    polars = {name: polar.worn(lift_factor=0.9, drag_factor=1.5) for name, polar in clean.polars.items()}
    axes = table.tip_speed_ratio.numpy(), table.pitch.numpy()
    worn, new = (power_coefficients(rotor, *axes) for rotor in (replace(clean, polars=polars), clean))
    return table.values.numpy() + worn - new


def _wind(
    rotor: Rotor, lam: Float[np.ndarray, " n_lam"]
) -> tuple[Float[np.ndarray, "1 1 sector r"], Float[np.ndarray, "lam 1 sector r"]]:
    """Undisturbed wind along the rotor axis and in the direction of rotation, over the wind speed at hub height.

    The element is at azimuth ψ (0: blade up) of a coned and tilted rotor, as in Ning's CCBlade without yaw.
    """
    cone, tilt = np.radians(rotor.precone), np.radians(rotor.tilt)
    psi = (2 * np.pi / rotor.n_sectors * np.arange(rotor.n_sectors))[:, None]
    along, outward = -rotor.blade.r * np.sin(cone), rotor.blade.r * np.cos(cone)
    height = outward * np.cos(psi) * np.cos(tilt) - along * np.sin(tilt)
    speed = (1 + height / rotor.hub_height) ** rotor.shear
    v_x = speed * (np.sin(tilt) * np.cos(psi) * np.sin(cone) + np.cos(tilt) * np.cos(cone))
    omega = lam[:, None, None, None] / (rotor.tip_radius * np.cos(cone))
    return v_x[None, None], omega * outward + speed * np.sin(tilt) * np.sin(psi)


def _bracket(sections: _Sections, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Interval of φ [rad] in which the residual changes sign, per element (Ning 2014, section 3.4).

    The bracket is the windmill range (0, π/2] if the sign changes there, else the propeller brake [-π/4, 0) if it
    changes there, else (π/2, π).
    """

    def residual(phi: float) -> Float[np.ndarray, "lam beta sector r"]:
        return sections.balance(np.full(shape, phi))[-1]

    windmill = residual(EDGE) * residual(np.pi / 2) <= 0
    brake = (residual(-np.pi / 4) < 0) & (residual(-EDGE) > 0)
    low = np.where(windmill, EDGE, np.where(brake, -np.pi / 4, np.pi / 2))
    high = np.where(windmill, np.pi / 2, np.where(brake, -EDGE, np.pi - EDGE))
    return low, high


def _prandtl(factor: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Loss factor of one end of the blade, (2/π) arccos e^{-f}."""
    return 2 / np.pi * np.arccos(np.exp(-factor))


def _axial_induction(
    kappa: Float[np.ndarray, "*batch"], loss: Float[np.ndarray, "*batch"], windmill: np.ndarray
) -> Float[np.ndarray, "*batch"]:
    r"""Axial induction a from κ: momentum theory up to κ = 2/3, Buhl's parabola above, propeller brake for φ < 0.

    Buhl's parabola is :math:`C_T = \tfrac89 + (4F - \tfrac{40}9)a + (\tfrac{50}9 - 4F)a^2`, and the blade gives
    :math:`C_T = 4F\kappa(1-a)^2`.
    """
    g1, g2, g3 = (
        2 * loss * kappa - (10 / 9 - loss),
        loss * (2 * kappa - (4 / 3 - loss)),
        2 * loss * kappa - (25 / 9 - 2 * loss),
    )
    root = np.sqrt(np.maximum(g2, 0.0))
    near = np.abs(g3) < 1e-6  # the quadratic equation becomes linear: its limit is taken
    buhl = np.where(near, 1 - 0.5 / np.where(near, root, 1.0), (g1 - root) / np.where(near, 1.0, g3))
    momentum = kappa / (1 + np.where(kappa == -1, EDGE, kappa))
    brake = np.where(kappa > 1, kappa / np.where(kappa == 1, EDGE, kappa - 1), 0.0)
    return np.where(windmill, np.where(kappa <= 2 / 3, momentum, buhl), brake)
