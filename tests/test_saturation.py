"""Saturation properties against CoolProp."""

import math

import CoolProp.CoolProp as CP
import numpy as np
import pytest
import torch
from saturation_tables import HIGH, LOW, table_of
from seeds_and_numbers import double

from rt_torchrl.envs.cryogenic_tank import saturation
from rt_torchrl.envs.cryogenic_tank.saturation import DATA, FLUIDS, Saturation

KEYS = (("T", 0), ("D", 0), ("D", 1), ("H", 0), ("H", 1))


def slopes_of_coolprop(fluid, p):
    """First derivatives of T, ρ and h along the saturation line by CoolProp itself."""
    state, columns = CP.AbstractState("HEOS", fluid), []
    for key, quality in ((CP.iT, 0), (CP.iDmass, 0), (CP.iDmass, 1), (CP.iHmass, 0), (CP.iHmass, 1)):
        column = []
        for each in p:
            state.update(CP.PQ_INPUTS, each, quality)
            column.append(state.first_saturation_deriv(key, CP.iP))
        columns.append(column)
    return np.array(columns)


# Properties


@pytest.mark.parametrize("fluid", FLUIDS)
def test_values_and_slopes_are_those_of_coolprop(fluid):
    p = np.linspace(LOW, HIGH, 301)  # no nodes of the fit, except for the two ends
    values, slopes = (
        np.stack([x.numpy() for x in part]) for part in Saturation(fluid).with_slopes(torch.from_numpy(p))
    )
    truth = np.array([CP.PropsSI(key, "P", p, "Q", quality, fluid) for key, quality in KEYS])
    assert (np.abs(values - truth).max(1) < 1e-6 * np.abs(truth).max(1)).all()
    truth, slopes = slopes_of_coolprop(fluid, p[1:-1]), slopes[:, 1:-1]
    assert (np.abs(slopes - truth).max(1) < 1e-4 * np.abs(truth).max(1)).all()


def test_the_tables_are_those_that_coolprop_makes():
    assert {file.stem for file in DATA.iterdir()} == {*FLUIDS}
    np.testing.assert_allclose(np.loadtxt(DATA / "Hydrogen.csv", delimiter=","), table_of("Hydrogen"), rtol=1e-9)


def test_derivatives_of_values_and_slopes():
    fit = Saturation()
    sizes = torch.stack(fit(double(HIGH)), -1).abs()

    def scaled(log_p):
        values, slopes = fit.with_slopes(log_p.exp())
        return torch.stack(values, -1) / sizes, torch.stack(slopes, -1) / sizes * HIGH

    log_p = torch.linspace(math.log(LOW) + 0.01, math.log(HIGH) - 0.01, 7, dtype=torch.float64)
    assert torch.autograd.gradcheck(scaled, log_p.requires_grad_())


def test_second_derivative_is_continuous_across_cells():
    fit = Saturation()
    knots = torch.exp(
        math.log(LOW) + (math.log(HIGH / LOW) / saturation.CELLS) * torch.arange(1, saturation.CELLS).double()
    )
    found = []
    for side in (1.0 - 1e-9, 1.0 + 1e-9):
        p = (knots * side).requires_grad_()
        slope = fit.with_slopes(p)[1]
        found.append(torch.stack([torch.autograd.grad(s.sum(), p, retain_graph=True)[0] for s in slope]))
    sizes = found[0].abs().amax(1, keepdim=True)
    # Rounding of the values, 1e-14 or so, over the square of a cell's width of 0.02.
    assert ((found[1] - found[0]).abs() < 1e-7 * sizes).all()


# Outside the range


@pytest.mark.parametrize("p", [79.9e3, 900.1e3, 0.0, -1.0, 1e9, math.inf, math.nan])
def test_outside_the_range_everything_is_nan_and_check_raises(p):
    fit = Saturation()
    values, slopes = fit.with_slopes(double(p, 500e3))
    assert all(x[0].isnan() and x[1].isfinite() for x in (*values, *slopes))
    with pytest.raises(ValueError, match="Hydrogen, 80 … 900 kPa"):
        fit.check(double(p, 500e3))


def test_check_names_the_worst_pressure_and_accepts_the_ends():
    fit = Saturation()
    with pytest.raises(ValueError, match="p=1200 kPa"):
        fit.check(double(79e3, 500e3, 1200e3))
    fit.check(double(LOW, HIGH))
    assert all(x.isfinite().all() for x in fit(double(LOW, HIGH)))


def test_modules_do_not_share_their_buffers():
    one, other = Saturation(), Saturation()
    one.table.zero_()
    assert other.table.abs().max() > 0
