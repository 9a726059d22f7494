"""The tables of saturated fluids in ``envs/cryogenic_tank/data``, as CoolProp makes them."""

import math

import CoolProp
import CoolProp.CoolProp as CP
import numpy as np

from rt_torchrl.envs.cryogenic_tank.saturation import CELLS, DATA, FLUIDS

LOW, HIGH = 80e3, 900e3
HEADER = (
    f"Saturated fluid by CoolProp {CoolProp.__version__}, even in ln p\n"
    "p [Pa], T [K], rho_l [kg/m3], rho_v [kg/m3], h_l [J/kg], h_v [J/kg]"
)


def table_of(fluid):
    """Pressure, temperature, densities and enthalpies at the ends of all pieces of the spline."""
    pressures = np.exp(np.linspace(math.log(LOW), math.log(HIGH), CELLS + 1))
    pressures[[0, -1]] = LOW, HIGH
    state, rows = CP.AbstractState("HEOS", fluid), []
    for p in pressures.tolist():
        state.update(CP.PQ_INPUTS, p, 0.0)
        liquid, vapour = state.saturated_liquid_keyed_output, state.saturated_vapor_keyed_output
        rows.append((p, state.T(), *(phase(key) for key in (CP.iDmass, CP.iHmass) for phase in (liquid, vapour))))
    return np.array(rows)


if __name__ == "__main__":
    for name in FLUIDS:
        np.savetxt(DATA / f"{name}.csv", table_of(name), fmt="%.17g", delimiter=",", header=HEADER)
