"""Step 3 against the model's own moments, processes of known covariance and a slow sine."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from seeds_and_numbers import seeded
from small_plants import flown

from rt_torchrl import DigitalTwin, ExogenousConfig, Signal
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.steps.inputs import ExogenousProcess, VirtualEpisodes, mixed, set_points

FREE = (Signal(symbol="d", name="free", unit="m/s"),)
DT = 0.5


def autoregressive(n, rho, seed=0, std=1.0):
    """x_{k+1} = ρ x_k + noise with stationary deviation ``std``: covariance std² ρ^|lag|."""
    noise = np.random.default_rng(seed).standard_normal(n)
    x = np.empty(n)
    x[0] = noise[0]
    for k in range(1, n):
        x[k] = rho * x[k - 1] + math.sqrt(1 - rho**2) * noise[k]
    return std * x


def process(values, signals=FREE, **options):
    record = torch.as_tensor(values, dtype=torch.float64).reshape(len(values), -1)
    return ExogenousProcess.of(record, signals=signals, config=ExogenousConfig(**options))


def test_samples_have_the_mean_and_covariances_of_the_model():
    """Of two components, of which one follows the other four samples later."""
    found, count = process(bivariate(200, 0.8, 4, 0.8), FREE * 2), 10_000
    small = found.sample(count, seeded(1)) - found.mean
    size = found.covariance[0].diagonal().sqrt()
    # Five standard errors: of a mean √(C_0/N), of a mean of products at most √2 of the product of the deviations.
    assert (small.mean(0).abs() < 5 * size / count**0.5).all()
    for lag in (0, 1, 3, 10, 50, 99, 199):
        for at in (0, (199 - lag) // 2, 199 - lag):
            estimate = small[:, at + lag].T @ small[:, at] / count
            error = (estimate - found.covariance[lag]).abs()
            assert (error < 5 * math.sqrt(2 / count) * size[:, None] * size).all(), (lag, at)
    assert found.covariance[4, 1, 0] > 0.4 * size.prod() > 10.0 * math.sqrt(2.0 / count) * size.prod()


def test_large_scale_follows_a_slow_sine_and_leaves_fast_noise():
    n, period = 1200, 300.0
    t = DT * np.arange(n)
    slow = 11.0 + 2.0 * np.sin(2 * np.pi * t / period)
    found = process(slow + autoregressive(n, 0.0, std=0.2))
    # Tube 0.05 and noise of block means 0.2/√4 of which the kernel, two knots wide, averages about seven: 0.07 + 0.04.
    error = found.mean[:, 0].numpy() - slow
    assert np.sqrt(np.mean(error**2)) < 0.1
    # White noise remains. Blocks of four hold a quarter of its variance, which bounds what the regression can take;
    # the variance itself is known to √(2/1200) = 4 %, two of them.
    assert 0.75 - 0.08 < found.covariance[0, 0, 0].item() / 0.04 < 1.08
    # What is taken turns up, with its sign turned, at the neighbours: at most that quarter.
    assert found.covariance[1:4, 0, 0].abs().max() < (0.25 + 0.08) * 0.04


def test_samples_have_the_mean_of_the_record():
    """Gusts are skewed: the regression, which follows the median rather than the mean, leaves residuals of one sign."""
    gusts = [np.exp(autoregressive(600, rho, seed)) for seed, rho in enumerate((0.9, 0.98))]
    record = torch.as_tensor(10.0 + np.stack(gusts, -1))
    found = process(record, signals=FREE * 2)
    torch.testing.assert_close(found.mean.mean(0), record.mean(0), rtol=1e-12, atol=0)
    count = 4000
    means = found.sample(count, seeded(3)).mean((0, 1))
    # Five standard errors of the mean over all samples, by the sum of the covariances over all lags.
    spread = (found.covariance.diagonal(dim1=1, dim2=2).abs().sum(0) * 2.0 / (600 * count)).sqrt()
    assert ((means - record.mean(0)).abs() < 5.0 * spread).all()


def test_samples_are_held_within_the_physical_range():
    signals = (Signal(symbol="u", name="wind_speed", unit="m/s", low=3.0, high=5.0), *FREE)
    values = np.stack([4.0 + autoregressive(300, 0.3), autoregressive(300, 0.3, seed=1)], -1)
    drawn = process(values, signals).sample(20, seeded())
    assert drawn[..., 0].min() == 3.0 and drawn[..., 0].max() == 5.0
    assert drawn[..., 1].min() < -2.0 and drawn[..., 1].max() > 2.0


def bivariate(n, rho, lag, correlation, seed=0):
    """Two processes of covariance ρ^|h|, the second ``lag`` samples behind a process that correlates with the first."""
    first, other = autoregressive(n + lag, rho, seed), autoregressive(n + lag, rho, seed + 1)
    second = correlation * first + math.sqrt(1.0 - correlation**2) * other
    return np.stack([first[lag:], 3.0 * second[:n]], -1)


@pytest.mark.parametrize("correlation, lag", [(0.8, 0), (-0.5, 4)])
def test_components_keep_their_correlation(correlation, lag):
    """E ε_0(t + h) ε_1(t) of a known bivariate process; fast beside the knots."""
    found = process(bivariate(14_400, 0.5, lag, correlation), FREE * 2)
    # The block means that the large scale follows hold 3ish/48 of the variance; estimating adds 2 % (14 400 samples
    # with a correlation time of 3): 10 % of the variance, which is 1 and 9.
    for k, variance in enumerate((1.0, 9.0)):
        expected = variance * 0.5 ** torch.arange(6, dtype=torch.float64)
        torch.testing.assert_close(found.covariance[:6, k, k], expected, rtol=0, atol=0.1 * variance)
    size = found.covariance[0].diagonal().prod().sqrt().item()
    for h in (-8, -4, -1, 0, 1, 4, 8):  # the first component, h samples later, with the second
        covariance = found.covariance[abs(h)] if h >= 0 else found.covariance[abs(h)].T
        assert covariance[0, 1].item() / size == pytest.approx(correlation * 0.5 ** abs(h + lag), abs=0.1), h


def test_mixed_large_scales_have_the_mean_and_the_covariance_of_the_next_one():
    """Their mean is that of those met, and their covariance 1 + 1/m times that of the sample."""
    m, n, count = 9, 40, 100_000
    t = torch.linspace(0.0, 1.0, n, dtype=torch.float64)
    level, slope = torch.randn(2, m, 1, generator=seeded(3), dtype=torch.float64)
    met = torch.stack([8.0 + level + slope * t, 3.0 - 0.5 * level + (t > 0.5)], -1)
    found = mixed(list(met), count, seeded())
    assert found.shape == (count, n, 2)
    flat, own = found.flatten(1), met.flatten(1)
    deviation = own.std(0)
    assert ((flat.mean(0) - own.mean(0)).abs() / deviation).max() < 0.01
    scale = deviation[:, None] * deviation
    assert ((flat.T.cov() - (1 + 1 / m) * own.T.cov()).abs() / scale).max() < 0.01
    # A normal number is beyond 2.576 in one of a hundred draws.
    standard = (flat[:, 0] - own[:, 0].mean()) / (deviation[0] * (1 + 1 / m) ** 0.5)
    assert (standard.abs() > 2.576).double().mean().item() == pytest.approx(0.01, abs=5e-4)


def virtual_of(plant, large_scale="met"):
    config = ExogenousConfig(large_scale=large_scale)
    return VirtualEpisodes(DigitalTwin(plant, plant.closure), config, 3, generator=seeded())


def test_large_scales_are_mixed_from_the_third_episode_on():
    plant = WindTurbine(horizon=60.0)
    virtual, seen = virtual_of(plant, "mixed"), []
    for level in (8.0, 11.0, 14.0):
        record = torch.full((plant.n_steps, 1), level, dtype=torch.float64)
        virtual.processes.append(ExogenousProcess.of(record, signals=plant.inputs, config=virtual.config))
        seen.append(virtual.draw(200).exogenous[..., 0])
    assert {round(value, 6) for value in seen[1].mean(1).tolist()} == {8.0, 11.0}
    new = seen[2].mean(1)
    assert len(new.unique()) > 150 and new.min() < 8.0 and new.max() > 14.0
    low, high = plant.inputs[0].low, plant.inputs[0].high
    assert (seen[2] >= low).all() and (seen[2] <= high).all()


def test_drawn_inputs_are_those_of_the_plant_whatever_was_met():
    plant = WindTurbine(horizon=60.0, observe=("preview",))
    virtual = virtual_of(plant, "drawn")
    record = torch.full((plant.n_steps, 1), 5.0, dtype=torch.float64)
    virtual.processes.append(ExogenousProcess.of(record, signals=plant.acting_inputs, config=virtual.config))
    episodes, generator = virtual.draw(200), seeded()
    assert torch.equal(episodes.initial_state, plant.draw_initial_state(200, generator))
    assert torch.equal(episodes.exogenous, plant.draw_exogenous(200, generator))


class SetPoint(LinearQuadratic):
    """A wandering set point, on which only the cost depends, and a disturbance that acts on what moves."""

    inputs = (*LinearQuadratic.inputs, dataclasses.replace(LinearQuadratic.inputs[0], name="set_point"))

    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action, state[..., 1:] * exogenous[..., :1], closure)

    def running_cost(self, t, state, applied, exogenous):
        return (state[..., 0] - exogenous[..., 1]) ** 2

    def draw_initial_state(self, batch, generator):
        return torch.zeros(batch, 2, dtype=torch.float64)

    def draw_exogenous(self, batch, generator):
        steps = torch.randn(batch, self.n_steps, 2, generator=generator, dtype=torch.float64)
        return 1.0 + steps.cumsum(1) / self.n_steps**0.5


class Integrating(SetPoint):
    """The first state is an integral that the controller computes from the set point."""

    controller_states = (SetPoint.states[0].name,)

    def vector_field(self, t, state, action, exogenous, closure):
        disturbance, set_point = exogenous.unbind(-1)
        return torch.stack([set_point - state[..., 0], disturbance * state[..., 1]], -1)


def test_an_integral_of_the_controller_is_no_equation_of_the_plant():
    plant = Integrating(horizon=2.0)
    assert set_points(DigitalTwin(plant, plant.closure), torch.device("cpu")).tolist() == [False, True]
    plant.controller_states = ()
    assert not set_points(DigitalTwin(plant, plant.closure), torch.device("cpu")).any()


def test_set_points_are_drawn_by_the_plant_although_some_were_met():
    plant = SetPoint(horizon=2.0)
    virtual = virtual_of(plant)
    assert set_points(virtual.twin, torch.device("cpu")).tolist() == [False, True]
    (record,) = flown(plant, seeded(), (plant.n_steps,))
    virtual.learn(record)
    spread = (virtual.draw(200).exogenous[:, -1] - record.exogenous[-1]).std(0)
    assert spread[1] > 0.8 > 0.5 > spread[0]
    assert ((virtual.draw(200, recorded=True).exogenous[:, -1] - record.exogenous[-1]).std(0) < 0.5).all()
    virtual.processes.clear()
    virtual.learn(record.part(0, 12, plant.dt))  # of a log
    assert virtual.draw(2).exogenous.shape == (2, 12, 2)


@pytest.mark.parametrize("gain", [0.0, 0.1])
def test_an_input_whose_weight_is_not_yet_trained_is_no_set_point(gain):
    class Unknown(LinearQuadratic):
        def vector_field(self, t, state, action, exogenous, closure):
            return super().vector_field(t, state, action, 0.0 * exogenous, lambda state: state) + closure(exogenous)

    twin = DigitalTwin(Unknown(), LinearClosure([[gain], [gain]]))
    assert set_points(twin, torch.device("cpu")).tolist() == [False]
