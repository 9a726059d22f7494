"""The data of a blade: its elements, and lift and drag of their sections over all angles of attack."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rt_torchrl.envs.wind_turbine.power_coefficient import csv_rows
from rt_torchrl.options import array_of


@dataclass(frozen=True, kw_only=True, eq=False)
class Polar:
    """Lift and drag coefficients of a section, interpolated by monotone cubics (PCHIP), which do not overshoot.

    Args:
        alpha: array of angles of attack [deg], increasing from -180 to 180: a rotor at standstill or at a large pitch
            angle sees all of them.
        cl: lift coefficients [-].
        cd: drag coefficients [-], not negative.

    Raises:
        ValueError: if the columns differ in length, are not finite, the angles do not increase from -180 to 180 deg, or
            a drag is negative.

    Source: F. N. Fritsch, J. Butland, SIAM J. Sci. Stat. Comput. 5 (1984) 300-304.
    """

    alpha: np.ndarray
    cl: np.ndarray
    cd: np.ndarray
    _curve: Callable[..., np.ndarray] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        from scipy.interpolate import PchipInterpolator  # here, because it takes a second to load

        columns = {name: array_of(f"{name} of a polar", getattr(self, name)) for name in ("alpha", "cl", "cd")}
        shapes = {name: column.shape for name, column in columns.items()}
        if len(set(shapes.values())) > 1 or columns["alpha"].ndim != 1 or columns["alpha"].size < 2:
            raise ValueError(
                f"polar columns have shapes {shapes}; give one value of each per angle, two angles or more."
            )
        for name, column in columns.items():
            if not np.isfinite(column).all():
                at = int(np.argmin(np.isfinite(column)))
                raise ValueError(f"{name}[{at}]={column[at]} of a polar must be finite; correct or remove the row.")
        self._check_values(columns["alpha"], columns["cd"])
        curve = PchipInterpolator(columns["alpha"], np.stack([columns["cl"], columns["cd"]], axis=-1))
        for name, column in (*columns.items(), ("_curve", curve)):
            object.__setattr__(self, name, column)

    @staticmethod
    def _check_values(alpha: Float[np.ndarray, " n"], cd: Float[np.ndarray, " n"]) -> None:
        if (np.diff(alpha) <= 0).any():
            at = int(np.argmax(np.diff(alpha) <= 0))
            raise ValueError(
                f"alpha goes from {alpha[at]} to {alpha[at + 1]} deg at entry {at + 1}; it must increase strictly. "
                "Sort the polar by angle and drop duplicates."
            )
        if not np.allclose((alpha[0], alpha[-1]), (-180.0, 180.0)):
            radians = " These look like radians: convert them." if np.abs(alpha).max() < 3.2 else ""
            raise ValueError(
                f"alpha covers {alpha[0]}…{alpha[-1]} deg; a rotor needs -180…180 deg. Extend the polar, for instance "
                f"by Viterna's method.{radians}"
            )
        if cd.min() < 0:
            raise ValueError(f"cd reaches {cd.min()}; drag cannot be negative. Check the columns' order and sign.")

    @classmethod
    def from_csv(cls, path: str | Path) -> "Polar":
        """Read columns ``alpha_deg``, ``cl``, ``cd`` of a file with a header; other columns are skipped.

        Raises:
            ValueError: if a column is missing or an entry is no number.
        """
        columns = csv_columns(path, ("alpha_deg", "cl", "cd"))
        return cls(
            alpha=numbers(path, columns, "alpha_deg"), cl=numbers(path, columns, "cl"), cd=numbers(path, columns, "cd")
        )

    def __call__(
        self, alpha: Float[np.ndarray, "*batch"]
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """Lift and drag coefficient [-] at angles of attack [deg], of any number of turns."""
        both = self._curve((alpha + 180.0) % 360.0 - 180.0)
        return both[..., 0], both[..., 1]

    def worn(self, *, lift_factor: float, drag_factor: float) -> "Polar":
        """The section after erosion, soiling or icing: lift and drag multiplied by the two factors [-].

        Raises:
            ValueError: if a factor is not positive and finite.
        """
        for name, factor in (("lift_factor", lift_factor), ("drag_factor", drag_factor)):
            if not 0 < factor < np.inf:
                raise ValueError(f"{name}={factor} must be positive and finite; 1 leaves the polar as it is.")
        return replace(self, cl=lift_factor * self.cl, cd=drag_factor * self.cd)


@dataclass(frozen=True, kw_only=True, eq=False)
class Blade:
    """The elements of a blade; each carries the loads of its mid-point.

    Args:
        r: array of distances of the mid-points from the rotor axis along the blade [m], increasing.
        dr: lengths of the elements [m].
        chord: chords of the sections [m].
        twist: angles of the sections to the plane of rotation, positive towards feather [deg].
        airfoil: names of the elements' polars.

    Raises:
        ValueError: if the columns differ in length, are not finite, not positive (r, dr, chord) or not increasing (r),
            or look like another unit.
    """

    r: np.ndarray
    dr: np.ndarray
    chord: np.ndarray
    twist: np.ndarray
    airfoil: Sequence[str]

    def __post_init__(self) -> None:
        for name in ("r", "dr", "chord", "twist"):
            column = np.asarray(getattr(self, name), dtype=np.float64)
            if column.shape != (len(self.airfoil),) or len(self.airfoil) < 2:
                raise ValueError(
                    f"{name} has shape {column.shape}, airfoil {len(self.airfoil)} names; give one of each per "
                    "element, two elements or more."
                )
            bad = ~np.isfinite(column) | ((column <= 0) & (name != "twist"))
            if bad.any():
                at = int(np.argmax(bad))
                raise ValueError(
                    f"{name}[{at}]={column[at]} of a blade must be finite{'' if name == 'twist' else ' and positive'}; "
                    "correct the blade file."
                )
            object.__setattr__(self, name, column)
        self._check_geometry()

    def _check_geometry(self) -> None:
        if (np.diff(self.r) <= 0).any():
            at = int(np.argmax(np.diff(self.r) <= 0))
            raise ValueError(
                f"r goes from {self.r[at]} to {self.r[at + 1]} m at element {at + 1}; it must increase from root to "
                "tip. Sort the elements by radius."
            )
        largest = np.abs(self.twist).max()
        if 0 < largest < 0.6:
            raise ValueError(
                f"twist reaches {largest:.3g} deg only, which looks like radians; convert it to degrees. For a blade "
                "without twist give exactly 0."
            )
        if self.chord.max() > self.r[-1]:
            raise ValueError(
                f"chord reaches {self.chord.max():.4g} m on a blade of {self.r[-1]:.4g} m; give both in metres."
            )

    @classmethod
    def from_csv(cls, path: str | Path) -> "Blade":
        """Read columns ``r_m``, ``dr_m``, ``chord_m``, ``twist_deg``, ``airfoil`` of a file with a header.

        Raises:
            ValueError: if a column is missing or an entry is no number.
        """
        columns = csv_columns(path, ("r_m", "dr_m", "chord_m", "twist_deg", "airfoil"))
        r, dr, chord, twist = (numbers(path, columns, name) for name in ("r_m", "dr_m", "chord_m", "twist_deg"))
        return cls(r=r, dr=dr, chord=chord, twist=twist, airfoil=tuple(columns["airfoil"]))


def csv_columns(path: str | Path, required: tuple[str, ...]) -> dict[str, list[str]]:
    """The columns of a file by the names in its header.

    Raises:
        ValueError: if a required column is missing or a row is shorter or longer than the header.
    """
    header, *rows = csv_rows(path)
    missing = [name for name in required if name not in header]
    if missing:
        raise ValueError(f"path={str(path)!r} has columns {header}; add {missing}.")
    if any(len(row) != len(header) for row in rows):
        raise ValueError(f"path={str(path)!r} has rows that differ in length from its header {header}; complete them.")
    return {name: list(column) for name, column in zip(header, zip(*rows, strict=True), strict=True)}


def numbers(path: str | Path, columns: dict[str, list[str]], name: str) -> Float[np.ndarray, " n"]:
    """One column as numbers.

    Raises:
        ValueError: if an entry is no number; the message names the path and the column.
    """
    try:
        return np.array([float(entry) for entry in columns[name]])
    except ValueError as error:
        raise ValueError(f"path={str(path)!r}, column {name!r}: {error}; every entry must be a number.") from error
