"""The worn rotor as a closure of the real turbine."""

import torch

from rt_torchrl.envs.wind_turbine.power_coefficient import PowerCoefficientTable
from rt_torchrl.envs.wind_turbine.wear import worn_table


def test_a_worn_rotor_takes_less_from_the_wind_and_an_unworn_one_the_same():
    table = PowerCoefficientTable.nrel5mw()
    worn, same = worn_table(table), worn_table(table, lift_factor=1.0, drag_factor=1.0)
    torch.testing.assert_close(same.values, table.values, rtol=0, atol=1e-12)
    best, _, _ = table.maximum()
    # Half again the drag costs a section of glide ratio 100 some λ_section/200 of its power, the lift is made up for by
    # induction: some hundredths of C_p in all, most at high tip-speed ratios.
    assert 0.01 < best - worn.maximum()[0] < 0.08
    row = int((table.tip_speed_ratio - 11.0).abs().argmin())
    pitch = int(table.pitch.abs().argmin())
    assert table.values[row, pitch] - worn.values[row, pitch] > best - worn.maximum()[0]
