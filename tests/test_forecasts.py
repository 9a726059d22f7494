"""Forecasts of the exogenous inputs: against first-order processes of known decay."""

import math

import pytest
import torch

from rt_torchrl.control.forecasts import Decaying, Forecast, Foreseen, Held

NOW = torch.tensor([[3.0, -1.0], [5.0, 2.0]], dtype=torch.float64)


def first_order(time, dt, *, episodes=40, n=4000):
    """Records of an Ornstein-Uhlenbeck process of unit variance around 2."""
    generator = torch.Generator().manual_seed(0)
    q, noise = math.exp(-dt / time), torch.randn(episodes, n, generator=generator, dtype=torch.float64)
    values = [noise[:, 0]]
    for k in range(1, n):
        values.append(q * values[-1] + math.sqrt(1.0 - q * q) * noise[:, k])
    return 2.0 + torch.stack(values, 1)


def test_a_held_forecast_is_what_is_measured():
    assert isinstance(Held(), Forecast)
    torch.testing.assert_close(Held()(7.0, NOW, 3), torch.stack([NOW] * 3, 1), rtol=0.0, atol=0.0)


def test_a_decaying_forecast_goes_to_the_mean():
    mean, time = torch.tensor([1.0, 1.0], dtype=torch.float64), torch.tensor([2.0, 0.5], dtype=torch.float64)
    found = Decaying(mean, time, dt=0.5)(0.0, NOW, 40)
    torch.testing.assert_close(found[:, 0], NOW, rtol=0.0, atol=0.0)
    torch.testing.assert_close(found[0, 4], torch.tensor([1.0 + 2.0 / math.e, 1.0 - 2.0 * math.exp(-4.0)]).double())
    torch.testing.assert_close(found[:, -1], mean.expand(2, 2), rtol=1e-3, atol=1e-3)


def test_the_decay_of_a_first_order_process_is_found():
    records = torch.stack([first_order(6.0, 0.5), first_order(30.0, 0.5)], -1)
    found = Decaying.fitted(records, dt=0.5, horizon=20.0)
    torch.testing.assert_close(found.mean, torch.full((2,), 2.0).double(), rtol=0.05, atol=0.05)
    torch.testing.assert_close(found.time, torch.tensor([6.0, 30.0]).double(), rtol=0.1, atol=0.0)


def test_the_fitted_decay_has_the_least_error_of_all_on_the_records():
    records, lags = first_order(6.0, 0.5, episodes=5, n=1000).unsqueeze(-1), 30
    fitted = Decaying.fitted(records, dt=0.5, horizon=lags * 0.5)

    def error(time):
        forecast = Decaying(fitted.mean, torch.tensor([time]).double(), dt=0.5)
        starts = range(0, records.shape[1] - lags, 3)
        return sum(((forecast(0.0, records[:, k], lags + 1) - records[:, k : k + lags + 1]) ** 2).sum() for k in starts)

    assert error(float(fitted.time)) < 1.01 * min(error(time) for time in (2.0, 4.0, 6.0, 8.0, 12.0, 40.0))
    assert error(float(fitted.time)) < 0.9 * error(1e6)


def test_a_preview_knows_the_record_as_far_as_it_reaches():
    record = torch.arange(20.0).double().reshape(1, 20, 1)
    every, near = Foreseen(record, dt=0.5), Foreseen(record, dt=0.5, reach=1.0)
    assert every(2.0, record[:, 4], 5).flatten().tolist() == [4.0, 5.0, 6.0, 7.0, 8.0]
    assert every(9.0, record[:, 18], 4).flatten().tolist() == [18.0, 19.0, 19.0, 19.0]
    assert near(2.0, record[:, 4], 5).flatten().tolist() == [4.0, 5.0, 6.0, 6.0, 6.0]
    to_zero = Decaying(torch.zeros(1).double(), torch.tensor([0.5]).double(), dt=0.5)
    beyond = Foreseen(record, dt=0.5, reach=0.5, beyond=to_zero)(2.0, record[:, 4], 4)
    torch.testing.assert_close(beyond.flatten(), torch.tensor([4.0, 5.0, 5.0 / math.e, 5.0 / math.e**2]).double())


def test_impossible_forecasts_are_refused():
    record = torch.zeros(1, 20, 1).double()
    with pytest.raises(ValueError, match="reach=-1"):
        Foreseen(record, dt=0.5, reach=-1.0)
    with pytest.raises(ValueError, match="must be positive"):
        Decaying(torch.zeros(1).double(), torch.zeros(1).double(), dt=0.5)
    with pytest.raises(ValueError, match="horizon=10"):
        Decaying.fitted(record, dt=0.5, horizon=10.0)
