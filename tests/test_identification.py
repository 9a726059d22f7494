"""Identification from a log: derivatives against backpropagation, fits against regression, recipes around logs."""

import dataclasses

import numpy as np
import pytest
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from seeds_and_numbers import seeded
from small_plants import Line, Slope, line_segment, noise_of
from test_export_recipe import recipe
from torch import nn

from rt_torchrl import AssimilationConfig, DigitalTwin, Measurement, Plant, PositiveCoefficients, Rollout, Signal
from rt_torchrl.fit.least_squares import Estimation, EstimationConfig, autocorrelation, identify, over_segments
from rt_torchrl.fit.log import SensorLog
from rt_torchrl.fit.resampling import hold_out, logged_readings, resample, sensors_in
from rt_torchrl.fit.sensors import sensor_record, sensor_records, sensors_of
from rt_torchrl.plants.closures import BoundedPerceptron
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.trajectories.trajectory import Trajectory, batch_of

record_log = recipe("record_log")

ROBUST = EstimationConfig(errors="robust")


def test_the_oracle_plant_is_identified_from_a_log_with_jitter_a_gap_and_noise():
    plant, generator = LinearQuadratic(dt=0.05, horizon=15.0, noise=0.5), torch.Generator().manual_seed(3)
    policy = plant.make_policy(generator)
    log = record_log.recorded(plant, record_log.policy_law(plant, policy), generator, jitter=0.4, noise=0.005)
    log = log.chosen((log.times < 5.0) | (log.times > 5.7))
    parts = resample(log, plant)
    sensors = sensors_in(plant, log)
    split = hold_out(parts.segments, plant.dt, 0.25)
    training, held_out = ([logged_readings(log, plant, sensors, part, parts.gap) for part in side] for side in split)
    task = Estimation(DigitalTwin(plant, plant.make_closure(generator)), sensors, config=ROBUST)
    found = identify(task, training, held_out)
    assert len(parts.gaps) == 1 and len(training) == 2 and len(held_out) == 1 and 0.1 < parts.jitter < 0.25
    true, errors = torch.tensor(plant.true_closure).flatten().tolist(), found.estimate.uncertainty.standard_errors()
    for (name, value), exact in zip(found.estimate.after.items(), true, strict=True):
        assert abs(found.estimate.before[name] - exact) > 0.02
        # Four standard errors, and what linear interpolation takes of a curve: h² times the rate of 1/s² or so.
        assert abs(value - exact) < 4.0 * errors[name] + 2.0 * plant.dt**2
    for side in (found.training, found.held_out):
        assert (side.rms < 0.01).all()  # what is left is the sensors' noise, 0.5 % of signals of some 0.5
    # Interpolation between two noisy samples shares them: about a quarter, here within ±0.25.
    assert ((alike := autocorrelation(found.estimate.likelihood)) > 0.0).all() and (alike < 0.5).all()


class Windy(Line):
    """A line of which a sensor reads the position and twice the wind."""

    measurements = (
        Measurement(symbol="y", name="both", unit="m", read=lambda p, t, s, z: s[..., 0] + 2.0 * z[..., 0]),
    )


@pytest.mark.parametrize("segment", [0, 3])
def test_a_sensor_of_an_input_reads_that_of_its_own_sample(segment):
    """At the ends of records, segments and parts that are held out, too: without noise the true weights stay."""
    plant, times, wind = Windy(), 0.1 * np.arange(41), np.random.default_rng(0).normal(size=41)
    position = 1.0 + np.append(0.0, np.cumsum(0.1 * (0.5 + 0.3 * wind[:-1])))
    log = SensorLog(
        times=times, columns={"position": position, "wind": wind, "nothing": 0.0 * times, "both": position + 2.0 * wind}
    )
    parts, sensors = resample(log, plant), sensors_in(plant, log, ["both"])
    sides = hold_out(parts.segments, plant.dt, 0.25)
    records = [[logged_readings(log, plant, sensors, part, parts.gap) for part in side] for side in sides]
    assert [record.exogenous[-1].item() for side in records for record in side] == pytest.approx([wind[30], wind[40]])
    closure = Slope()
    torch.nn.init.ones_(closure.w)
    found = identify(
        Estimation(DigitalTwin(plant, closure), sensors, config=EstimationConfig(segment=segment)), *records
    )
    assert closure.w.tolist() == pytest.approx([0.5, 0.3], abs=1e-6)
    assert max(found.training.rms.item(), found.held_out.rms.item()) < 1e-6


class Joints(PositiveCoefficients):
    """Mass and length of the second rod over those of the first, and friction of both joints."""

    names = {"mass": "-", "length": "-", "joint": "1/s", "base": "1/s"}
    true_coefficients = (0.5, 1.0, 0.05, 0.1)


class DoublePendulum(Plant):
    """Two point masses on rods of which the first is 1 m long, with a torque at the base; angles are from upright."""

    name = "double_pendulum"
    states = tuple(
        Signal(symbol=name[:3], name=name, unit=unit)
        for name, unit in (("first", "rad"), ("second", "rad"), ("rate_first", "rad/s"), ("rate_second", "rad/s"))
    )
    actions = (Signal(symbol="a", name="torque", unit="N m", low=-5.0, high=5.0),)
    inputs = ()
    observations = states

    def __init__(self):
        super().__init__(dt=0.05, horizon=10.0, closure=Joints.true())

    def vector_field(self, t, state, action, exogenous, closure):
        a, b, u, v = state.unbind(-1)
        m, length, joint, base = closure(state).unbind(-1)
        c, s, g = torch.cos(a - b), torch.sin(a - b), 9.81
        first = (1.0 + m) * g * torch.sin(a) - m * length * s * v**2 + action[..., 0] - base * u - joint * (u - v)
        second = m * length * (g * torch.sin(b) + s * u**2) - joint * (v - u)
        cross, own = m * length * c, m * length**2
        det = (1.0 + m) * own - cross**2
        return torch.stack([u, v, (own * first - cross * second) / det, ((1.0 + m) * second - cross * first) / det], -1)

    def draw_initial_state(self, batch, generator):
        return 0.3 * torch.randn(batch, 4, generator=generator, dtype=torch.float64)

    observe = running_cost = draw_exogenous = make_closure = None


def test_an_unstable_system_is_identified_over_segments_that_the_data_choose():
    """Over whole records of a double pendulum no weights replay what was read; over segments the true ones do."""
    plant, generator = DoublePendulum(), torch.Generator().manual_seed(0)
    torque = torch.randn(3, 40, 1, generator=generator, dtype=torch.float64).repeat_interleave(5, 1)
    start, nothing = plant.draw_initial_state(3, generator), torch.zeros(3, 200, 0).double()
    with torch.no_grad():
        flown = Rollout(plant, plant.closure)(start, nothing, (2.0 * torque).clamp(-5.0, 5.0))
    noise = 0.005 * torch.randn(flown.states.shape, generator=generator, dtype=torch.float64)
    sensors = sensors_of(plant, [state.name for state in plant.states])
    noisy = flown._replace(states=flown.states + noise)
    records = sensor_records(plant, sensors, noisy)

    def estimation(segment):
        twin = DigitalTwin(plant, Joints(torch.tensor([1.0, 0.6, 0.5, 0.5])))
        return Estimation(twin, sensors, config=EstimationConfig(segment=segment))

    found = identify(estimation(None), records[:2], records[2:])
    errors, estimate = found.estimate.uncertainty.standard_errors(), found.estimate
    assert estimate.segment == 22 and "segments of 22 control intervals (1.1 s)" in estimate.warnings()[0]
    for name, true in zip(Joints.names, Joints.true_coefficients, strict=True):
        assert abs(estimate.after[name] - true) < 4.0 * errors[name] < 0.02 * true
    for side in (found.training, found.held_out):
        assert side.rms.tolist() == pytest.approx([0.005] * 4, rel=0.2)
    whole = estimation(0).run(records)
    assert whole.noise["first"] > 1.0 and any("does not explain first" in text for text in whole.warnings())
    # Step 4 does the same from the first samples as they are.
    for segment, close in ((None, True), (0, False)):
        closure = Joints(torch.tensor([1.0, 0.6, 0.5, 0.5]))
        config = AssimilationConfig(iterations=60, inputs="record", method="levenberg_marquardt", segment=segment)
        Assimilation(DigitalTwin(plant, closure), config).update(noisy.each())
        assert torch.allclose(closure.coefficients, plant.closure.coefficients, rtol=0.05) is close
    # A twin that explains the readings over whole records is fitted over these.
    calm = [record.part(0, 20, plant.dt) for record in records]
    assert estimation(None).run(calm).segment == 0


@pytest.mark.parametrize(("angle", "unstable"), [(0.0, True), (np.pi, False)])
def test_instability_is_sought_where_the_record_is_and_not_where_a_replay_comes_to_rest(angle, unstable):
    """Held upright with noise; replays with much friction fall, and hang like those of a record that hangs."""
    plant, noise = DoublePendulum(), 0.01 * torch.randn(201, 4, generator=torch.Generator().manual_seed(0)).double()
    states = noise + torch.tensor([angle, angle, 0.0, 0.0])
    record = Trajectory(states, torch.zeros(200, 1).double(), torch.zeros(200, 0).double())
    sensors = sensors_of(plant, [state.name for state in plant.states])
    twin = DigitalTwin(plant, Joints(torch.tensor([0.5, 1.0, 2.0, 2.0])))
    fallen = twin.replay(states[:1], record.exogenous[None], record.actions[None]).states[0, -1]
    assert (fallen[:2].cos() < -0.9).all()
    read = sensor_record(plant, sensors, record)
    dead = torch.where(torch.tensor([True, True, True, False]), read.readings, torch.nan)  # in this record alone
    assert Estimation(twin, sensors).unstable([read._replace(readings=dead), read]) is unstable


@pytest.mark.parametrize(
    ("noise", "bias", "held_out", "size"), [(None, 0.5, -0.5, 1.0), (0.01, 2.0, 2.0, 1.0), (None, 0.5, 0.5, 0.01)]
)
def test_a_bias_of_many_times_the_noise_is_found_and_held_out_readings_have_it_too(noise, bias, held_out, size):
    """Also one that is far more than the readings move, as in a system that is held."""
    plant, generator = LinearQuadratic(horizon=20.0), torch.Generator().manual_seed(0)
    command = 4.0 * torch.rand(3, plant.n_steps, 1, generator=generator, dtype=torch.float64) - 2.0
    episodes = plant.draw_initial_state(3, generator), plant.draw_exogenous(3, generator), command
    with torch.no_grad():
        flown = Rollout(plant, plant.closure)(*(size * part for part in episodes))
    shift = 0.01 * size * torch.randn(flown.states.shape, generator=generator, dtype=torch.float64)
    sensors = sensors_of(plant, ["position", "velocity"], biased=["velocity"])
    sensors = [dataclasses.replace(sensor, noise=noise) for sensor in sensors]
    shift[:2, :, 1] += bias
    shift[2, :, 1] += held_out
    records = sensor_records(plant, sensors, flown._replace(states=flown.states + shift))
    task = Estimation(DigitalTwin(plant, plant.make_closure(generator)), sensors, config=EstimationConfig(segment=0))
    found = identify(task, records[:2], records[2:])
    assert found.estimate.biases == pytest.approx({"position": 0.0, "velocity": bias}, abs=0.003 * size)
    assert found.training.rms.tolist() == pytest.approx([0.01 * size] * 2, rel=0.2)
    assert found.held_out.rms[1].item() == pytest.approx(max(0.01 * size, bias - held_out), rel=0.2)


@pytest.mark.parametrize(
    "errors, chosen",
    [
        # Over thirds not small, but less than three times the least.
        ({0: (10.0,), 2: (0.5,), 30: (1.2,), 10: (0.6,)}, 30),
        # Different sensors prefer different segments.
        ({0: (2.0, 9.0), 2: (9.0, 2.0), 30: (8.0, 2.0)}, 30),
        # Whole records are fitted again from what short segments tell, which lead out of a poor minimum.
        ({0: (10.0,), 2: (0.5,), "again": (0.5,)}, 0),
    ],
)
def test_of_segments_that_are_followed_alike_the_longest_of_the_least_misfit_stay(errors, chosen):
    closure, starts = LinearClosure(torch.zeros(2, 2)), []

    def fit(length):
        starts.append((length, closure.matrix[0, 0].item()))
        again = length == 0 and starts[-1][1] == 2.0
        torch.nn.init.constant_(closure.matrix, 12.0 if again else length)
        return length, torch.tensor(errors.get("again" if again else length, errors[0] if again else (9.0, 2.0)))

    assert over_segments(closure, 90, fit, torch.ones(len(errors[0])), lambda: True) == chosen
    assert starts[:3] == [(0, 0.0), (2, 0.0), (0, 2.0)] and (closure.matrix == (chosen or 12.0)).all()


class Runaway(Line):
    """ẏ = a y³ − y, which is infinite after 0.73 s for a = 1.3 and y(0) = 1, and decays for a = 0.5."""

    def vector_field(self, t, state, action, exogenous, closure):
        return closure(state) * state**3 - state


def test_a_twin_that_diverges_over_whole_records_begins_with_what_short_segments_tell():
    plant, t = Runaway(), 0.1 * np.arange(101)
    closure = PositiveCoefficients([1.3], names={"a": "1/s"})
    record = line_segment((0.5 + 0.5 * np.exp(2.0 * t)) ** -0.5)
    twin = DigitalTwin(plant, closure)
    config = AssimilationConfig(iterations=20, inputs="record", method="levenberg_marquardt")
    fit = Assimilation(twin, config)
    assert fit.cost_of(batch_of([record])) == np.inf
    found = fit.update([record])
    assert fit.length == 0 and found.start == np.inf and found.best < 1e-10
    assert closure.coefficients.item() == pytest.approx(0.5, rel=1e-4)


class Bent(nn.Module):
    """a and a perceptron beside a y³."""

    def __init__(self):
        super().__init__()
        self.a = PositiveCoefficients([1.3], names={"a": "1/s"})
        self.correction = BoundedPerceptron([(-2.0, 2.0)], [0.1], hidden=(3,), generator=seeded())

    def forward(self, state):
        return self.a(state) + self.correction(state)


def test_a_prior_holds_perceptrons_at_their_first_values_whatever_short_segments_told():
    """The twin diverges over whole records, so that these are fitted from what short segments tell."""
    t, closure = 0.1 * np.arange(101), Bent()
    first = [w.detach().clone() for w in closure.correction.parameters()]
    record = line_segment((0.5 + 0.5 * np.exp(2.0 * t)) ** -0.5 + 0.02 * noise_of(101, 0))
    sensors, config = sensors_of(Runaway(), ["position"]), EstimationConfig(prior=10.0)
    found = Estimation(DigitalTwin(Runaway(), closure), sensors, config=config).run(
        [sensor_record(Runaway(), sensors, record)]
    )
    moved = sum((w - w0).square().sum().item() for w, w0 in zip(closure.correction.parameters(), first, strict=True))
    assert (
        found.segment == 0
        and found.likelihood.prior.cost().item() == pytest.approx(5.0 * moved, rel=1e-9)
        and moved > 1e-6
    )
