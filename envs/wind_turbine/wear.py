"""The closure of a worn rotor, for the real system."""

import dataclasses

import numpy as np

from rt_torchrl.envs.wind_turbine.blade_element import Rotor, power_coefficients
from rt_torchrl.envs.wind_turbine.power_coefficient import PowerCoefficientTable


def worn_table(
    table: PowerCoefficientTable, *, lift_factor: float = 0.9, drag_factor: float = 1.5
) -> PowerCoefficientTable:
    """The table of the NREL 5-MW rotor after its polars have lost lift and gained drag.

    The table is lowered by the difference that blade-element momentum theory finds between the clean and the worn
    blade, so that the theory's own error, RMS 0.004, does not count as wear.

    Args:
        table: table of the clean rotor.
        lift_factor: factor on the lift of every section.
        drag_factor: factor on the drag of every section.
    """
    clean = Rotor.nrel5mw()
    polars = {name: p.worn(lift_factor=lift_factor, drag_factor=drag_factor) for name, p in clean.polars.items()}
    axes = table.tip_speed_ratio.cpu().numpy(), table.pitch.cpu().numpy()
    worn, as_new = (power_coefficients(r, *axes) for r in (dataclasses.replace(clean, polars=polars), clean))
    return PowerCoefficientTable(*axes, np.asarray(table.values.cpu()) + worn - as_new)
