"""Forecasts, and control under several futures: known processes, quadratic programs, certainty equivalence."""

import math

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic
from scipy.optimize import lsq_linear
from test_optimal_control import matrices

from rt_torchrl.control.forecasts import Decaying, Forecast, Foreseen, Held, Scattered
from rt_torchrl.control.predictive_control import PredictiveConfig, PredictiveControl, RecedingHorizon

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
    torch.testing.assert_close(Held()(7.0, NOW, 3)[:, 0], torch.stack([NOW] * 3, 1), rtol=0.0, atol=0.0)


def test_a_decaying_forecast_goes_to_the_mean():
    mean, time = torch.tensor([1.0, 1.0], dtype=torch.float64), torch.tensor([2.0, 0.5], dtype=torch.float64)
    found = Decaying(mean, time, dt=0.5)(0.0, NOW, 40)[:, 0]
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
        return sum(
            ((forecast(0.0, records[:, k], lags + 1)[:, 0] - records[:, k : k + lags + 1]) ** 2).sum() for k in starts
        )

    assert error(float(fitted.time)) < 1.01 * min(error(time) for time in (2.0, 4.0, 6.0, 8.0, 12.0, 40.0))
    assert error(float(fitted.time)) < 0.9 * error(1e6)


def test_a_preview_knows_the_record_and_holds_its_end():
    record = torch.arange(20.0).double().reshape(1, 20, 1)
    every = Foreseen(record, dt=0.5)
    assert every(2.0, record[:, 4], 5).flatten().tolist() == [4.0, 5.0, 6.0, 7.0, 8.0]
    assert every(9.0, record[:, 18], 4).flatten().tolist() == [18.0, 19.0, 19.0, 19.0]


def test_impossible_forecasts_are_refused():
    record = torch.zeros(1, 20, 1).double()
    with pytest.raises(ValueError, match="must be positive"):
        Decaying(torch.zeros(1).double(), torch.zeros(1).double(), dt=0.5)
    with pytest.raises(ValueError, match="horizon=10"):
        Decaying.fitted(record, dt=0.5, horizon=10.0)


PLANT = LinearQuadratic(horizon=2.0, noise=0.5)
N = 10


def scattered(size, pairs=2):
    """Futures about a held input whose deviations grow with time."""
    steps = torch.arange(N, dtype=torch.float64)
    rows = [size * steps / N, size * torch.sin(steps)]
    deviations = torch.stack(rows[:pairs]).unsqueeze(-1)
    ends = torch.full((1,), 100.0, dtype=torch.float64)
    return Scattered(Held(), deviations, -ends, ends)


def controller(forecast, **options):
    config = PredictiveConfig(horizon=N * PLANT.dt, tolerance=0.0, iterations=500, **options)
    return RecedingHorizon(PLANT, PLANT.closure, config, forecast=forecast)


def program(s_0, futures, shared):
    """The optimal variables of all futures, which share their first commands, as a bounded least-squares problem."""
    A, B, D, Q, R = matrices(PLANT)
    root, count = np.linalg.cholesky(Q).T, len(futures)
    variables = shared + count * (N - shared)
    rows, rest = [], []
    for i, z in enumerate(futures):
        gain, free = np.zeros((2, variables)), s_0.copy()
        for k in range(N):
            column = k if k < shared else shared + i * (N - shared) + k - shared
            rows += [root @ gain, np.sqrt(R[0, 0]) * np.eye(variables)[column : column + 1]]
            rest += [root @ free, np.zeros(1)]
            gain, free = A @ gain, A @ free + D[:, 0] * z[k]
            gain[:, column] += B[:, 0]
    return lsq_linear(np.concatenate(rows), -np.concatenate(rest), bounds=(-2.0, 2.0), tol=1e-14).x


@pytest.mark.parametrize("shared", [1, 3])
def test_plans_are_those_of_a_quadratic_program(shared):
    state, now = torch.tensor([[3.0, -1.0], [0.2, 0.1]]).double(), torch.tensor([[0.3], [-0.4]]).double()
    forecast = scattered(4.0)
    found = controller(forecast, period=shared * PLANT.dt).plan(0.0, state, now)
    bounded = 0
    for episode in range(2):
        futures = forecast(0.0, now, N)[episode, :, :, 0].numpy()
        wanted = program(state[episode].numpy(), futures, shared)
        np.testing.assert_allclose(found[episode, :shared, 0].numpy(), wanted[:shared], atol=2e-4)
        later = wanted[shared:].reshape(len(futures), -1)
        np.testing.assert_allclose(found[episode, shared:, 0].numpy(), later.mean(0), atol=2e-4)
        bounded += (np.abs(wanted) > 2.0 - 1e-9).sum()
    assert bounded > 0


def test_without_bounds_the_first_command_is_that_of_the_forecast_alone():
    """Certainty equivalence; where commands reach their bounds, it no longer holds."""
    now = torch.tensor([[0.3]]).double()
    for position, equal in ((0.1, True), (0.5, False)):
        state = torch.tensor([[position, 0.0]]).double()
        alone = controller(Held()).plan(0.0, state, now)[0, 0, 0].item()
        futures = controller(scattered(1.0 if equal else 20.0)).plan(0.0, state, now)[0, 0, 0].item()
        assert (abs(alone - futures) < 1e-4) == equal


def test_the_rest_of_the_last_plans_goes_on_when_a_solve_is_late():
    state, exogenous = torch.tensor([[1.0, 0.0]]).double(), torch.zeros(1, 1).double()
    config = PredictiveConfig(horizon=N * PLANT.dt, period=2 * PLANT.dt, deadline=1e-9)
    late = RecedingHorizon(PLANT, PLANT.closure, config, forecast=scattered(1.0))
    first, second = (late.plan(t, state, exogenous) for t in (0.0, 2 * PLANT.dt))
    assert [solve.late for solve in late.solves] == [False, True]
    torch.testing.assert_close(second[:, :-2], first[:, 2:])


def test_futures_have_the_moments_of_the_errors():
    """With as many pairs as intervals are forecast, all second moments of the errors on the records."""
    records = PLANT.draw_exogenous(4, torch.Generator().manual_seed(0)).cumsum(1)
    decaying = Decaying.fitted(records, dt=PLANT.dt, horizon=0.5)
    found = Scattered.fitted(decaying, records, dt=PLANT.dt, horizon=0.5, pairs=5)
    middle = decaying(0.0, records[:, 3], 6)[:, 0]
    starts = range(records.shape[1] - 5)
    errors = torch.cat([records[:, k : k + 6] - decaying(0.0, records[:, k], 6)[:, 0] for k in starts])
    moments = (errors[..., 0].T @ errors[..., 0] / len(errors)).numpy()
    spread = torch.cat([found.deviations, -found.deviations])[..., 0]
    np.testing.assert_allclose((spread.T @ spread / len(spread)).numpy(), moments, atol=1e-12)
    found.low, found.high = (torch.full((1,), end).double() for end in (-1e3, 1e3))
    futures = found(0.0, records[:, 3], 6)
    assert futures.shape == (4, 10, 6, 1)
    torch.testing.assert_close(futures.mean(1), middle)
    torch.testing.assert_close(futures[:, :5] - middle.unsqueeze(1), spread[:5, :, None].expand(4, -1, -1, -1))
    one = Scattered.fitted(decaying, records, dt=PLANT.dt, horizon=0.5, pairs=1).deviations[0, :, 0].numpy()
    assert one @ moments @ one / (one @ one) == pytest.approx(np.linalg.eigvalsh(moments)[-1])


def test_futures_stay_in_the_range_of_the_records_and_begin_with_what_is_measured():
    records = PLANT.draw_exogenous(3, torch.Generator().manual_seed(0)).cumsum(1)
    found = Scattered.fitted(Held(), records, dt=PLANT.dt, horizon=1.0, pairs=2)
    futures = found(0.0, records.amax().reshape(1, 1), 30)
    assert futures.amax() == records.amax() and futures.amin() >= records.amin()
    assert (futures[:, :, 0] == records.amax()).all() and (futures[:, :, 11:] == futures[:, :, 10:11]).all()


def test_it_acts_as_a_policy_whose_scatter_is_learned_and_kept():
    generator = torch.Generator().manual_seed(2)
    state, exogenous = PLANT.draw_initial_state(2, generator), PLANT.draw_exogenous(2, generator)
    config = PredictiveConfig(horizon=1.0, forecast="scattered", pairs=2)
    certain = PredictiveControl(PLANT, PLANT.closure, PredictiveConfig(horizon=1.0, forecast="held"))
    policy, again = (PredictiveControl(PLANT, PLANT.closure, config) for _ in range(2))
    held = certain.fly(state, exogenous).actions
    torch.testing.assert_close(policy.fly(state, exogenous).actions, held, rtol=1e-2, atol=1e-2)  # nothing is met yet
    records = PLANT.draw_exogenous(9, generator).cumsum(1)
    policy.learn(records[:, :6])  # shorter than the window
    found = policy.forecast
    assert found.deviations.shape == (2, 10, 1) and (found.deviations[:, 5:] == found.deviations[:, 5:6]).all()
    policy.learn(records)
    fitted = Decaying.fitted(records, dt=PLANT.dt, horizon=1.0)
    scatter = Scattered.fitted(fitted, records, dt=PLANT.dt, horizon=1.0, pairs=2)
    assert torch.equal(found.deviations, scatter.deviations[:, :10])
    assert torch.equal(found.low, records.amin((0, 1))) and torch.equal(found.high, records.amax((0, 1)))
    again.load_state_dict(policy.state_dict())
    assert torch.equal(again.fly(state, exogenous).actions, policy.fly(state, exogenous).actions)


@pytest.mark.parametrize("pairs", [0, 11])
def test_impossible_numbers_of_futures_are_refused(pairs):
    records = PLANT.draw_exogenous(3, torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=f"pairs={pairs}"):
        Scattered.fitted(Held(), records, dt=PLANT.dt, horizon=1.0, pairs=pairs)
    if not pairs:
        with pytest.raises(ValueError, match="pairs=0"):
            PredictiveConfig(pairs=pairs)
