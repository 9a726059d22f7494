"""Step 4 from some sensors: the closure is that of the whole state, and plans cost the same."""

from pathlib import Path

import numpy as np
import pytest
import torch
from linear_quadratic import LinearQuadratic
from straight_line import Line, Slope, line_segment, noise_of

from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.fit.least_squares import Estimation, EstimationConfig, usual_sizes
from rt_torchrl.fit.prior import BeliefPrior
from rt_torchrl.fit.record import chained, sensor_record
from rt_torchrl.fit.sensors import sensors_of
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.trajectories.rollout import Rollout
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.assimilation import AssimilationConfig
from rt_torchrl.twinning.config import TwinningConfig
from rt_torchrl.twinning.hypotheses.choice import make_assimilation, make_twin
from rt_torchrl.twinning.hypotheses.config import HypothesesConfig
from rt_torchrl.twinning.sensor_assimilation import FirstStates, SensorAssimilation

NONE = HypothesesConfig()


def config(*sensors, **options):
    given = {"method": "levenberg_marquardt", "inputs": "record", "initial": "estimated", "iterations": 30}
    return AssimilationConfig(sensors=sensors, **given | options)


def episodes(plant, count, seed=0):
    """Real episodes under random commands, each held for some intervals."""
    generator, found = torch.Generator().manual_seed(seed), []
    for _ in range(count):
        start, inputs = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
        n, low = plant.n_steps, torch.tensor([a.low for a in plant.actions]).double()
        high = torch.tensor([a.high for a in plant.actions]).double()
        held = torch.rand(1, n // 20 + 1, len(low), generator=generator, dtype=torch.float64)
        share = 0.3 + 0.4 * held.repeat_interleave(20, 1)[:, :n]
        with torch.no_grad():
            found.append(Rollout(plant, plant.closure)(start, inputs, low + share * (high - low)).each()[0])
    return found


def blinded(plant, record, names):
    """The record with NaN in every state that no sensor reads."""
    hidden = [k for k, state in enumerate(plant.states) if state.name not in names]
    states = record.states.clone()
    states[:, hidden] = torch.nan
    return record._replace(states=states)


@pytest.mark.slow
def test_the_tank_is_identified_from_its_pressure_alone():
    plant = CryogenicTank(horizon=21600.0)
    records = [blinded(plant, record, ["pressure"]) for record in episodes(plant, 2)]
    closure = plant.make_closure(torch.Generator())
    step = make_assimilation(DigitalTwin(plant, closure), config("pressure"), NONE)
    found = step.update(records, [], 1, torch.Generator())
    # From [1, 1, 10]: without noise only the wall's start, which follows p to 1e-5 K or so, is uncertain.
    true = plant.closure.coefficients
    assert ((closure.coefficients / true - 1.0).abs() < 1e-4).all()
    assert found.best < 1e-3 * found.start
    report = step.report()
    assert report["noise/pressure"] < 100.0 and set(report) > {"standard_error/U_s", "standard_error/K_JT"}


def test_first_states_follow_from_what_is_read():
    """The tank's wall is as cold as the fluid, whose temperature follows from the pressure; its fill is always 70 %."""
    plant = CryogenicTank(horizon=3600.0)
    (record,) = episodes(plant, 1, seed=3)
    sensors = sensors_of(plant, ["pressure"])
    first = FirstStates(plant, sensors)
    guess = first.guess(sensor_record(plant, sensors, blinded(plant, record, ["pressure"])))
    # The saturation curve is straight to some mK over ±50 kPa.
    assert guess[0].item() == pytest.approx(record.states[0, 0].item(), abs=0.02)
    assert guess[1:].tolist() == pytest.approx(record.states[0, 1:].tolist())
    assert first.spread[1] == 0.0 and 0.0 < first.spread[0] < 0.02 and first.spread[2] == torch.inf


def test_a_turbine_needs_its_rotor_speed_alone():
    plant = WindTurbine(horizon=60.0)
    spread = FirstStates(plant, sensors_of(plant, ["rotor_speed"])).spread
    # The wind's filter and the integral begin with the same value; the torque is a kinked function of the speed.
    assert spread[[1, 2, 3, 5]].tolist() == [0.0] * 4


def test_nothing_is_fitted_in_no_iteration_and_a_start_from_nonsense_begins_anew():
    plant = LinearQuadratic()
    records = episodes(plant, 1)
    closure = plant.make_closure(torch.Generator().manual_seed(0))
    before = closure.matrix.detach().clone()
    step = SensorAssimilation(DigitalTwin(plant, closure), config("position", "velocity", iterations=0))
    step.update(records, [], 1, torch.Generator())
    assert torch.equal(closure.matrix, before) and step.report() == {}
    step = SensorAssimilation(DigitalTwin(plant, closure), config("position", "velocity"))
    with torch.no_grad():
        closure.matrix.fill_(1e9)
    found = step.update(records, [], 1, torch.Generator())
    assert found.start == float("inf")
    torch.testing.assert_close(closure.matrix, plant.closure.matrix, rtol=0, atol=1e-6)


def test_what_does_not_go_with_sensors_is_refused():
    for options in ({"initial": "measured"}, {"segment": 5}):
        with pytest.raises(ValueError, match=r"sensors=\('position',\) .* need initial='estimated' and segment=0"):
            config("position", **options)
    plant = WindTurbine(horizon=60.0)
    closure = plant.make_closure(torch.Generator())
    twin = make_twin(plant, closure, HypothesesConfig(which="automatic"))
    with pytest.raises(ValueError, match="do not go with hypotheses"):
        make_assimilation(twin, config("rotor_speed"), NONE)
    with pytest.raises(ValueError, match="roof cannot be measured"):
        make_assimilation(DigitalTwin(plant, closure), config("roof"), NONE)


def test_a_recipe_that_fits_sensors_leaves_the_hypotheses_out():
    recipe = load_recipe(Path(__file__).parent.parent / "recipes" / "cryogenic_tank.py").Config
    asked = ["--twinning.assimilation.sensors", "pressure", "--twinning.assimilation.initial", "estimated"]
    asked += ["--twinning.assimilation.method", "levenberg_marquardt", "--twinning.assimilation.inputs", "record"]
    assert from_command_line(recipe, asked).twinning.hypotheses.which == "none"
    assert from_command_line(recipe, []).twinning.hypotheses.which == "automatic"


class DriftingLine(Line):
    """The line with the methods that step 4 asks for."""

    def draw_initial_state(self, batch, generator):
        return 0.1 * torch.randn(batch, 1, generator=generator, dtype=torch.float64)


def line_step(**options):
    closure = Slope()
    return SensorAssimilation(DigitalTwin(DriftingLine(), closure), config("position", **options)), closure


TIMES = 0.1 * np.arange(61)


def line_records(slopes, *, pushes=0.0):
    """A record in each of two winds; something pushes the states in the middle by ``pushes``."""
    jump = pushes * (np.arange(61) > 30)
    return [
        line_segment(0.05 + (slopes[0] + slopes[1] * z) * TIMES + jump + 0.02 * noise_of(61, k), wind=z)
        for k, z in enumerate((1.0, -2.0))
    ]


def test_pushes_in_step_4_are_those_of_an_estimation():
    """And they keep the weights from bending: a push of 1 in 6 s would be taken for a slope."""
    bent, plain = line_step()
    bent.update(line_records((0.8, 0.1), pushes=1.0), [], 1, torch.Generator())
    step, closure = line_step(pushes=2, push=2.0)
    step.update(line_records((0.8, 0.1), pushes=1.0), [], 1, torch.Generator())
    assert abs(plain.w[0].item() - 0.8) > 0.1 and closure.w.tolist() == pytest.approx([0.8, 0.1], abs=0.02)
    plant, own = DriftingLine(), Slope()
    sensors = sensors_of(plant, ["position"])
    records = [sensor_record(plant, sensors, one) for one in line_records((0.8, 0.1), pushes=1.0)]
    first = FirstStates(plant, sensors)
    records = [one._replace(guess=first.guess(one)) for one in records]
    size = usual_sizes(plant, torch.stack([one.guess for one in records]), sensors, records)
    parts = [part for one in records for part in chained(one, 30, plant.dt)]
    found = Estimation(DigitalTwin(plant, own), sensors, spread=first.spread, process=2.0 * size).run(parts)
    assert closure.w.tolist() == pytest.approx(own.w.tolist(), abs=1e-6)
    assert step.report()["noise/position"] == pytest.approx(found.noise["position"], rel=1e-3)


def test_weights_that_drift_are_followed_from_episode_to_episode():
    """As an estimation with the belief of the one before; without the belief, each episode stands alone."""
    step, closure = line_step(drift=0.05)
    plant, own = DriftingLine(), Slope()
    sensors, belief = sensors_of(plant, ["position"]), None
    for k in range(3):
        (storm, other), first = line_records((0.5 + 0.1 * k, 0.3)), FirstStates(plant, sensors)
        records = [(storm, other)[k % 2]]  # each episode has one wind, which alone cannot tell the slopes apart
        step.update(records, [], 1, torch.Generator())
        read = [sensor_record(plant, sensors, one) for one in records]
        read = [one._replace(guess=first.guess(one)) for one in read]
        prior = None if belief is None else BeliefPrior(own, belief, 0.05)
        options = EstimationConfig(rounds=4, starts=10 if prior is None else 1)
        task = Estimation(DigitalTwin(plant, own), sensors, spread=first.spread, config=options)
        belief = task.run(read, prior).uncertainty.belief()
        assert closure.w.tolist() == pytest.approx(own.w.tolist(), abs=1e-6)
    again, _ = line_step(drift=0.05)
    again.load_state_dict(step.state_dict())
    assert torch.equal(again.belief.covariance, step.belief.covariance)
    assert closure.w.tolist() == pytest.approx([0.7, 0.3], abs=0.1)


def test_a_biased_sensor_is_found_in_step_4():
    plant = LinearQuadratic()
    records = episodes(plant, 1)
    states = records[0].states.clone()
    states[:, 0] += 0.4
    closure = plant.make_closure(torch.Generator().manual_seed(0))
    step = SensorAssimilation(DigitalTwin(plant, closure), config("position", "velocity", biased=("position",)))
    step.begun = True  # one start is enough
    step.update([records[0]._replace(states=states)], [], 1, torch.Generator())
    assert step.report()["bias/position"] == pytest.approx(0.4, abs=1e-6)
    torch.testing.assert_close(closure.matrix, plant.closure.matrix, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match=r"biased=\('roof',\): roof is none of the sensors"):
        SensorAssimilation(DigitalTwin(plant, closure), config("position", biased=("roof",)))


def test_what_only_a_fit_to_sensors_takes_is_refused_without_sensors():
    for options, message in (
        ({"biased": ("pressure",)}, "give sensors, too"),
        ({"pushes": 3}, "give sensors, too"),
        ({"drift": 0.1}, "give sensors, too"),
        ({"pushes": 0}, "pushes=0 must be at least 1"),
        ({"drift": -1.0}, "drift=-1.0"),
    ):
        with pytest.raises(ValueError, match=message):
            config(**options)
    with pytest.raises(ValueError, match="would count them twice"):
        TwinningConfig(records=2, assimilation=config("position", drift=0.1))
