"""A column of a recorded log: the signal that it holds, and its unit."""

import re
from dataclasses import dataclass

import numpy as np

from rt_torchrl.options import check_options

NUMBER = r"(?:[0-9.]+(?:[eE][+-]?[0-9]+)?|inf|nan)"
COLUMN = re.compile(
    rf"(?P<header>.+)=(?P<signal>\w+)(?:\[(?P<unit>[^][=]+)\]|(?:\*(?P<factor>[+-]?{NUMBER}))?(?P<offset>[+-]{NUMBER})?)",
    re.DOTALL,
)


@dataclass(frozen=True, kw_only=True)
class Column:
    r"""A column of a file, the signal that it holds, and its unit: a name, or value = factor·number + offset.

    Args:
        header: header of the column in the file.
        signal: name of the plant's signal, or ``time``.
        factor: factor from the column's numbers to the signal's unit.
        offset: value of the signal where the column holds zero, in the signal's unit.
        unit: unit of the column's numbers, see :func:`converted`; None if they have the unit of the signal, or if
            factor and offset convert them.

    Raises:
        ValueError: if the factor is zero, factor or offset is not finite, or there is a unit beside them.
    """

    header: str
    signal: str
    factor: float = 1.0
    offset: float = 0.0
    unit: str | None = None

    def __post_init__(self) -> None:
        check_options(self)
        if self.unit is not None and (self.factor, self.offset) != (1.0, 0.0):
            raise ValueError(
                f"column {self.header!r} has unit={self.unit!r}, and factor={self.factor} and offset={self.offset} "
                "beside it; give one or the other."
            )
        if not (np.isfinite(self.factor) and self.factor != 0.0 and np.isfinite(self.offset)):
            raise ValueError(
                f"column {self.header!r} has factor={self.factor} and offset={self.offset}; both must be finite and "
                "the factor not zero."
            )

    @classmethod
    def parse(cls, text: str) -> "Column":
        """The column that ``HEADER=SIGNAL``, ``HEADER=SIGNAL[UNIT]`` or ``HEADER=SIGNAL*FACTOR+OFFSET`` describes.

        Raises:
            ValueError: if the text has another form.
        """
        match = COLUMN.fullmatch(text.strip())
        found = match.groupdict() if match else {}
        try:
            factor, offset = (float(found[key] or default) for key, default in (("factor", 1.0), ("offset", 0.0)))
        except (KeyError, ValueError):
            raise ValueError(
                f"column {text!r} is not understood; write HEADER=SIGNAL, HEADER=SIGNAL[UNIT] or "
                "HEADER=SIGNAL*FACTOR+OFFSET, such as n=rotor_speed[rpm] or T=wall_temperature*0.5556+255.37."
            ) from None
        return cls(
            header=found["header"], signal=found["signal"], factor=factor, offset=offset, unit=found["unit"] or None
        )
