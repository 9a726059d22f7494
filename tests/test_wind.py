"""Wind of the turbine: the Kaimal spectrum against its formula, and draws from records."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate, signal

from rt_torchrl.envs.wind_turbine.disturbances import KaimalWind, RecordedWind
from rt_torchrl.envs.wind_turbine.wind_record import WindRecord

DT, N = 0.5, 1200
MEAN, SIGMA, LENGTH = 11.0, 1.76, 340.2


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def kaimal(f):
    """The formula of IEC 61400-1, written once more, in numpy."""
    return 4 * SIGMA**2 * (LENGTH / MEAN) / (1 + 6 * f * LENGTH / MEAN) ** (5 / 3)


def periodogram(wind, dt):
    """One-sided; the Nyquist bin of an even record is not doubled."""
    n = wind.shape[-1]
    power = 2.0 * np.abs(np.fft.rfft(wind - wind.mean(-1, keepdims=True))) ** 2 * dt / n
    if n % 2 == 0:
        power[..., -1] /= 2.0
    return np.fft.rfftfreq(n, dt)[1:], power[..., 1:]


def test_spectrum_is_the_formula_and_integrates_to_the_variance():
    f = np.geomspace(1e-7, 1e5, 20001)
    S = KaimalWind().spectrum(torch.from_numpy(f)).numpy()
    np.testing.assert_allclose(S, kaimal(f), rtol=1e-13)
    # Left out below 1e-7 Hz and above 1e5 Hz: 1e-5 of the variance each; trapezium rule: 1e-6.
    assert integrate.trapezoid(S, f) == pytest.approx(SIGMA**2, rel=1e-4)


@pytest.mark.parametrize("n", [N, N - 1])
def test_every_periodogram_is_the_spectrum(n):
    """Only the phases are random, so each sample has the spectrum to rounding, but for the Nyquist bin."""
    winds = KaimalWind(floor=-math.inf, scale_to_target=False).draw(256, n, DT, seeded()).numpy()
    f, power = periodogram(winds, DT)
    interior = slice(None, -1) if n % 2 == 0 else slice(None)
    # Rounding of the FFT: a few 1e-16 of the largest amplitude, which is 60 times the smallest.
    np.testing.assert_allclose(power[:, interior], np.broadcast_to(kaimal(f), power.shape)[:, interior], rtol=1e-12)
    if n % 2 == 0:
        # There power = 2S cos²φ: mean S, standard deviation S/√2, over 256 samples 0.044 S; five of them.
        assert power[:, -1].mean() == pytest.approx(kaimal(f[-1]), rel=5 / math.sqrt(2 * 256))


def test_spectrum_seen_by_an_estimator_that_knows_no_bins():
    """Welch's estimate on pieces of 1/6 of the record, averaged over seeds, against the formula."""
    winds = KaimalWind(floor=-math.inf, scale_to_target=False).draw(200, 6 * N, DT, seeded(3)).numpy()
    f, power = signal.welch(winds, 1 / DT, window="hann", nperseg=N)
    # 200 records of 11 half-overlapping pieces: 3 % per bin for Gaussian noise, 0.9 % here, where the amplitudes are
    # fixed; five of them. Left out: the first bins, which lose power with each piece's mean, and the last, half a bin.
    np.testing.assert_allclose(power.mean(0)[4:-1], kaimal(f)[4:-1], rtol=0.05)
    # The mean over 596 bins scatters by 0.04 %; the window's leakage of the steep spectrum adds 0.1 %.
    assert np.mean(power.mean(0)[4:-1] / kaimal(f)[4:-1]) == pytest.approx(1.0, abs=3e-3)


@pytest.mark.parametrize("n", [7, 8])
def test_inverse_fft_is_the_sum_of_cosines(n):
    """The definition, summed term by term with the same phases; at even n the last term is the Nyquist frequency."""
    wind = KaimalWind(floor=-math.inf, scale_to_target=False).draw(5, n, DT, seeded(4)).numpy()
    f = np.arange(1, n // 2 + 1) / (n * DT)
    phase = 2 * np.pi * torch.rand(5, len(f), generator=seeded(4), dtype=torch.float64).numpy()
    cosines = np.cos(2 * np.pi * f[:, None] * DT * np.arange(n) + phase[..., None])
    expected = MEAN + (np.sqrt(2 * kaimal(f) / (n * DT))[:, None] * cosines).sum(1)
    np.testing.assert_allclose(wind, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("scale", [True, False])
def test_each_sample_has_its_mean_and_deviation(scale):
    winds = KaimalWind(floor=-math.inf, scale_to_target=scale).draw(64, N, DT, seeded(6))
    assert winds.shape == (64, N) and winds.dtype == torch.float64
    np.testing.assert_allclose(winds.mean(-1), MEAN, rtol=1e-13)
    f, power = periodogram(winds.numpy(), DT)
    band = kaimal(f).sum() / (N * DT)
    assert math.sqrt(band) / SIGMA == pytest.approx(0.9354, abs=1e-4)
    factor = SIGMA**2 / band if scale else 1.0
    # The Nyquist bin, with 3.4e-5 of σ², is random, S Δf (1 + cos 2φ), and moves variance and factor that little.
    np.testing.assert_allclose(winds.var(-1, correction=0), factor * band, rtol=2e-12 if scale else 5e-5)
    np.testing.assert_allclose(power[:, :-1], np.broadcast_to(factor * kaimal(f)[:-1], (64, N // 2 - 1)), rtol=5e-5)


def test_wind_comes_from_the_generator_alone():
    wind = KaimalWind()
    first = wind.draw(2, N, DT, seeded(8))
    torch.manual_seed(99)
    assert torch.equal(first, wind.draw(2, N, DT, seeded(8)))
    assert not torch.equal(first, wind.draw(2, N, DT, seeded(9))) and not torch.equal(first[0], first[1])


def test_marginal_is_nearly_gaussian():
    """A sum of m cosines with random phases has no skewness and an excess kurtosis of −1.5 Σa⁴/(Σa²)²."""
    n_seeds, n = 20_000, 300
    sample = KaimalWind(floor=-math.inf, scale_to_target=False).draw(n_seeds, n, DT, seeded(10))[:, 0].numpy()
    power = kaimal(np.arange(1, n // 2 + 1) / (n * DT))
    excess = -1.5 * (power**2).sum() / power.sum() ** 2
    z = (sample - MEAN) / sample.std()
    # Five standard errors, √(6/N) and √(24/N) for independent near-Gaussian samples.
    assert (z**3).mean() == pytest.approx(0.0, abs=5 * math.sqrt(6 / n_seeds))
    assert (z**4).mean() - 3.0 == pytest.approx(excess, abs=5 * math.sqrt(24 / n_seeds))


def test_floor_cuts_what_lies_below_it_and_no_turbulence_is_steady():
    free = KaimalWind(intensity=0.5, floor=-math.inf).draw(4, N, DT, seeded(11))
    floored = KaimalWind(intensity=0.5).draw(4, N, DT, seeded(11))
    assert free.min() < 3.0
    assert floored.min() == 3.0
    assert torch.equal(floored, torch.where(free < 3.0, torch.full_like(free, 3.0), free))
    steady = KaimalWind(intensity=0.0).draw(2, N, DT, seeded())
    assert torch.equal(steady, torch.full_like(steady, MEAN))


def ramp(duration, step, slope, source):
    time = step * np.arange(round(duration / step) + 1)
    return WindRecord(time, 5.0 + slope * time, source)


def test_recorded_wind_is_the_record_from_a_random_start():
    """Ramps are reproduced exactly by linear interpolation, and their slopes tell the records apart."""
    wind = RecordedWind(records=[ramp(100.0, 0.3, 0.01, "a"), ramp(60.0, 0.07, 0.05, "b")])
    draws = wind.draw(400, 101, DT, seeded(12)).numpy()
    assert draws.shape == (400, 101) and draws.dtype == np.float64
    slopes = (draws[:, -1] - draws[:, 0]) / 50.0
    chosen_b = slopes > 0.03
    np.testing.assert_allclose(slopes, np.where(chosen_b, 0.05, 0.01), rtol=1e-10)
    np.testing.assert_allclose(np.diff(draws), np.broadcast_to((slopes * DT)[:, None], (400, 100)), rtol=1e-9)
    start_a = (draws[~chosen_b, 0] - 5.0) / 0.01
    # About 200 starts, uniform over the 50 s to spare: the ends are met within 5 s but for one in 1e9.
    assert -1e-9 <= start_a.min() < 5.0 and 45.0 < start_a.max() <= 50.0 + 1e-9
    assert 140 < chosen_b.sum() < 260  # six standard deviations of a fair coin
    np.testing.assert_array_equal(draws, wind.draw(400, 101, DT, seeded(12)))
    exact = RecordedWind(records=[ramp(10.0, 0.1, -0.3, "of the length needed, and falling below the floor")])
    expected = np.maximum(5.0 - 0.3 * 0.5 * np.arange(21), 3.0)
    np.testing.assert_allclose(exact.draw(1, 21, 0.5, seeded())[0], expected, rtol=1e-12)


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: KaimalWind(mean=0.0), "mean=0.0"),
        (lambda: KaimalWind(length_scale=math.nan), "length_scale=nan"),
        (lambda: KaimalWind(intensity=-0.1), "intensity=-0.1"),
        (lambda: KaimalWind(floor=12.0), "floor=12.0 m/s .* must be below the mean"),
        (lambda: KaimalWind().draw(0, N, DT, seeded()), "batch=0"),
        (lambda: KaimalWind().draw(1, 1, DT, seeded()), "n_steps=1"),
        (lambda: KaimalWind().draw(1, N, 0.0, seeded()), "dt=0.0"),
        (
            lambda: RecordedWind(records=[ramp(99, 1, 0, "a"), ramp(30, 1, 0, "b.hh")]).draw(1, 101, DT, seeded()),
            r"b\.hh is 30 s long, but n_steps=101 of dt=0.5 s need 50 s",
        ),
        (lambda: RecordedWind(records=[]), "records of RecordedWind is empty"),
        (lambda: RecordedWind(records=[ramp(9.0, 1.0, 0.0, "a")], floor=math.nan), "floor=nan"),
    ],
)
def test_wrong_arguments_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
