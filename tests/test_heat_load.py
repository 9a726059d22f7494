"""The cyclic heat load of the cryogenic tank."""

import math

import pytest
import torch
from seeds_and_numbers import seeded

from rt_torchrl.envs.cryogenic_tank.disturbances import CyclicLoad


def test_load_statistics():
    load = CyclicLoad()
    drawn = load.draw(20, 14_400, 30.0, seeded())
    assert load.mean == pytest.approx(128.3, abs=0.1)
    # One episode has 80 peaks and 14 400 samples of noise: 0.55 W, so 0.12 W over twenty.
    assert drawn.mean().item() == pytest.approx(load.mean, abs=0.5)
    by_phase = drawn.view(20, 80, 180).mean((0, 1))
    phase = 30.0 * torch.arange(180, dtype=torch.float64)
    profile = 50.0 + 250.0 * torch.exp(-0.5 * ((phase - 2700.0) / 675.0) ** 2)
    assert (by_phase - profile).abs().max() < 5.0  # 25 W over the root of 1600 samples is 0.6 W
    assert drawn.min() > 0.0 and 300.0 < drawn.max() < 50.0 + 275.0 + 44.0


def test_noise_and_peaks_of_the_load():
    noise = CyclicLoad(peak=0.0).draw(1, 20_000, 30.0, seeded()) - 50.0
    assert noise.std().item() == pytest.approx(25.0, rel=0.02)
    assert noise.abs().max().item() == pytest.approx(25.0 * math.sqrt(3.0), rel=1e-3)
    heights = CyclicLoad(noise=0.0, minimum=0.0).draw(50, 180, 30.0, seeded())[:, 90] / 250.0
    assert 0.9 < heights.min() < 0.93 and 1.07 < heights.max() < 1.1
    assert (CyclicLoad(minimum=0.0, peak=0.0).draw(1, 1000, 30.0, seeded()) == 0).sum() > 400  # the floor


def test_wide_peaks_overlap():
    load = CyclicLoad(noise=0.0, variation=0.0, width=10_800.0)
    # A train of peaks this wide is flat: its first harmonic is e^{−2π²(σ/T_h)²} = 5e-35.
    torch.testing.assert_close(
        load.draw(1, 500, 30.0, seeded()), torch.full((1, 500), load.mean).double(), rtol=1e-7, atol=0
    )


@pytest.mark.parametrize(
    "arguments", [{"minimum": -1.0}, {"peak": math.nan}, {"variation": 1.5}, {"period": 0.0}, {"width": -1.0}]
)
def test_bad_loads_raise(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        CyclicLoad(**arguments)


@pytest.mark.parametrize("batch, n_steps, dt", [(0, 10, 30.0), (1, 0, 30.0), (1, 10, 0.0), (1, 10, math.nan)])
def test_bad_draws_raise(batch, n_steps, dt):
    with pytest.raises(ValueError, match="must be"):
        CyclicLoad().draw(batch, n_steps, dt, seeded())
