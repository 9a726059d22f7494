"""Disturbances of the plants against their formulas, draws from records of wind, and TurbSim's files."""

import math
import struct

import numpy as np
import pytest
import torch
from seeds_and_numbers import seeded

from rt_torchrl.envs.cryogenic_tank.disturbances import CyclicLoad
from rt_torchrl.envs.flapping_wing.disturbances import GaussianGust
from rt_torchrl.envs.wind_turbine.disturbances import KaimalWind, RecordedWind
from rt_torchrl.envs.wind_turbine.turbsim import WindRecord, read_hh, read_wind

DT, N = 0.5, 1200
MEAN, SIGMA, LENGTH = 11.0, 1.76, 340.2


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


def test_record_accepts_times_printed_to_a_millisecond_and_is_read_only():
    time = np.round(np.arange(601) / 30.0, 3)
    record = WindRecord(time, np.ones(601), "r.hh")
    assert record.duration == 20.0 and record.step == pytest.approx(1 / 30.0, rel=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        record.speed[0] = 2.0


HH_HEADER = """! This hub-height wind-speed file was generated by TurbSim (v2.00.07a-bjj) on 01-Jan-2020 at 00:00:00.
!   Time  HorSpd  WndDir  VerSpd  HorShr  VerShr  LnVShr  GstSpd
!  (sec)   (m/s)   (deg)   (m/s)     (-)     (-)     (-)   (m/s)
"""


def hh_line(t, u, v=0.0):
    """A line of a wind file as TurbSim prints it, (F8.3,3F8.2,3F8.3,F8.2)."""
    direction = -math.degrees(math.atan2(v, u))
    return f"{t:8.3f}{math.hypot(u, v):8.2f}{direction:8.2f}{0.1:8.2f}{0:8.3f}{0.2:8.3f}{0:8.3f}{0:8.2f}\n"


def test_hh_gives_the_component_along_the_rotor_axis(tmp_path):
    rng = np.random.default_rng(0)
    t = np.arange(200) / 30.0
    u, v = 11 + 1.76 * rng.standard_normal(200), 1.4 * rng.standard_normal(200)
    (tmp_path / "wind.hh").write_text(HH_HEADER + "".join(map(hh_line, t, u, v)))
    record = read_wind(tmp_path / "wind.hh")
    # Printed to 0.01 m/s and 0.01 deg: errors of 0.005 m/s, and of |v|·0.005·π/180 < 5e-4 m/s.
    np.testing.assert_allclose(record.speed, u, rtol=0, atol=0.0056)
    np.testing.assert_allclose(record.time, t, rtol=0, atol=0.00051)
    assert record.source.endswith("wind.hh")


def test_hh_known_numbers_gust_ninth_column_commas_and_blank_lines(tmp_path):
    text = "! by hand\n\n0.0 8.0 0 0 0 0 0 0\n# remark\n 0.5, 9.0, 0, 0, 0, 0.2, 0, 1.5, 0\n1 6.0 60 0 0 0 0 0\n"
    (tmp_path / "wind.hh").write_text(text)
    record = read_hh(tmp_path / "wind.hh")
    np.testing.assert_array_equal(record.time, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(record.speed, [8.0, 10.5, 3.0], rtol=1e-14)


def test_a_comment_behind_numbers_drops_no_row(tmp_path):
    """A row that is dropped at the end of a file would leave no gap that tells of it."""
    text = "0.0 8.0 0 0 0 0 0 0 ! calm\n0.5 9.0 0 0 0 0 0 0\n1.0 10.0 0 0 0 0 0 0 # end\n"
    (tmp_path / "wind.hh").write_text(text)
    np.testing.assert_allclose(read_hh(tmp_path / "wind.hh").speed, [8.0, 9.0, 10.0], rtol=1e-14)


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda lines: [*lines[:3], *lines[5:]], r"wind\.hh: the step after t = 1 s is 1.5 s"),
        (
            lambda lines: [lines[0].replace("8.00", " NaN"), *lines[1:]],
            r"wind\.hh, line 4: value 'NaN' or 'inf' in .* is not finite",
        ),
        (lambda lines: [*lines[:4], "********" + lines[4][8:]], r"wind\.hh, line 8: could not convert"),
        (lambda lines: [*lines[:9], lines[9][:20]], r"wind\.hh, line 13: 3 columns, but 8 are needed"),
        (lambda lines: [], r"wind\.hh: holds 0 wind samples"),
    ],
)
def test_faulty_hh_files_are_refused(tmp_path, spoil, message):
    (tmp_path / "wind.hh").write_text(HH_HEADER + "".join(spoil([hh_line(0.5 * k, 8.0) for k in range(10)])))
    with pytest.raises(ValueError, match=message):
        read_wind(tmp_path / "wind.hh")


def bts_bytes(u, hub=85.0, n_tower=2):
    """A field as TurbSim writes it; u has the shape (time, z, y), v, w and the tower hold other numbers."""
    n_t, n_z, n_y = u.shape
    slope = np.float32(65535.0 / (u.max() - u.min()))
    offset = np.float32(-32768.0 - slope * u.min())
    header = struct.pack("<h4i6f", 7 + n_tower % 2, n_z, n_y, n_tower, n_t, 10.0, 8.0, 0.05, 11.0, hub, 60.0)
    header += struct.pack("<6f", slope, offset, 3.0, 1.0, 5.0, -2.0) + struct.pack("<i", 9) + b"synthetic"
    raw = np.full((n_t, n_z * n_y + n_tower, 3), -1234, dtype="<i2")
    raw[:, : n_z * n_y, 0] = np.clip(np.rint(slope * u + offset), -32768, 32767).reshape(n_t, -1)
    return header + raw.tobytes(), 1.0 / slope


def plane(n_y=4):
    """u = 11 + sin t + 0.05 (z − 85) + 0.1 y on the grid above, which bilinear interpolation reproduces."""
    t, z, y = 0.05 * np.arange(50), 60.0 + 10.0 * np.arange(5), 8.0 * (np.arange(n_y) - (n_y - 1) / 2)
    return t, 11 + np.sin(t)[:, None, None] + 0.05 * (z - 85.0)[:, None] + 0.1 * y


@pytest.mark.parametrize("n_y, n_tower, hub", [(4, 2, 85.0), (5, 0, 80.0), (1, 3, 100.0), (4, 1, 60.0)])
def test_bts_hub_is_interpolated_to_the_resolution_of_its_integers(tmp_path, n_y, n_tower, hub):
    t, u = plane(n_y)
    content, resolution = bts_bytes(u, hub=hub, n_tower=n_tower)
    (tmp_path / "field.bts").write_bytes(content)
    record = read_wind(tmp_path / "field.bts")
    # Half an integer step of rounding, the interpolation averages it; the offset in single precision adds
    # 2⁻²⁴ of about 1e5 integer steps, 0.01 of one.
    np.testing.assert_allclose(record.speed, 11 + np.sin(t) + 0.05 * (hub - 85.0), rtol=0, atol=0.55 * resolution)
    np.testing.assert_allclose(record.time, t, rtol=1e-15)


def patched(content, offset, form, value):
    return content[:offset] + struct.pack(form, value) + content[offset + struct.calcsize(form) :]


# 70 bytes of header, 9 of description, 50 steps of (20 + 2) points of 3 integers of 2 bytes: 6679.
@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda c: c[:-100], "is truncated, it holds 6579 bytes, but its header .* implies 6679 bytes"),
        (lambda c: c + b"\0", "is too long, it holds 6680 bytes, but its header .* implies 6679 bytes"),
        (lambda c: c[:30], "is truncated, it holds 30 bytes, but the header alone takes 70 bytes"),
        (lambda c: patched(c, 0, "<h", 4), "begins with the number 4, but a TurbSim full field begins with 7 or 8"),
        (lambda c: patched(c, 2, "<i", -5), "header is corrupt, .*n_z=-5"),
        (lambda c: patched(c, 42, "<f", 0.0), "header is corrupt, .*u_slope=0.0"),
        (lambda c: patched(c, 34, "<f", 101.0), r"the hub lies outside the height of the grid, 4\.1 spacings"),
    ],
)
def test_faulty_bts_files_are_refused(tmp_path, spoil, message):
    path = tmp_path / "field.bts"
    path.write_bytes(spoil(bts_bytes(plane()[1])[0]))
    with pytest.raises(ValueError, match=rf"field\.bts: {message}"):
        read_wind(path)


def test_wind_has_the_mean_and_covariance_of_the_process():
    draws, n, dt = 20_000, 26, 0.2
    gust = GaussianGust(mean=1.5, std=0.8, time_scale=0.9)
    wind = gust.draw(draws, n, dt, seeded()).numpy()
    lag = dt * (np.arange(n)[:, None] - np.arange(n)[None])
    # Standard errors are σ/√N = 0.0057 and at most σ²√(2/N) = 0.0064; four of them.
    np.testing.assert_allclose(wind.mean(0), 1.5, atol=0.023)
    np.testing.assert_allclose(np.cov(wind.T), 0.64 * np.exp(-0.5 * (lag / 0.9) ** 2), atol=0.026)


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
