"""What a policy observes: any choice of a plant's measurements, each scaled to order one; and previews of the wind."""

import json
import math

import pytest
import torch
from linear_quadratic import Constant, LinearQuadratic
from seeds_and_numbers import double, drawn, seeded
from test_export_recipe import RECIPES

import rt_torchrl as rt
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.runs.command_line import from_command_line, load_recipe
from rt_torchrl.steps.inputs import VirtualEpisodes
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy

TIME_ZERO = torch.zeros((), dtype=torch.float64)
PLANTS = rt.shipped_plants()
CHOICES = [(name, kind, which) for name, kind in PLANTS.items() for which in kind.observation_sets]
IDS = [f"{name}-{which}" for name, _, which in CHOICES]
RICHEST = {(name, list(kind.observation_sets)[-1]) for name, kind in PLANTS.items() if kind.observation_sets}


@pytest.mark.parametrize(
    ("name", "kind", "which"),
    [pytest.param(*c, marks=() if (c[0], c[2]) in RICHEST else pytest.mark.slow) for c in CHOICES],
    ids=IDS,
)
def test_a_plant_fulfils_its_contract_with_every_set(name, kind, which):
    dt = kind().dt
    plant = kind(dt=dt, horizon=50 * dt, observe=(which,))
    rt.check_plant(plant, episodes=2, steps=10, traced=False)
    assert [signal.name for signal in plant.observations] == list(kind.observation_sets[which])


@pytest.mark.parametrize(("name", "kind", "which"), CHOICES, ids=IDS)
def test_observations_are_of_order_one(name, kind, which):
    plant = kind(observe=(which,))
    state, exogenous = plant.draw_initial_state(3, seeded()), plant.draw_exogenous(3, seeded())
    policy = rt.SaturatedAffine(len(plant.observations), plant.actions, weight_scale=0.0, generator=seeded())
    with torch.no_grad():
        flown = rt.Rollout(plant, plant.closure, policy)(state, exogenous)
    t = plant.dt * torch.arange(plant.n_steps, dtype=torch.float64)
    seen = plant.observe(t, flown.states[:, :-1], exogenous)
    # Half-open actuators leave the target by far; that is an order of magnitude, not two.
    assert seen.abs().mean((0, 1)).max() < 15.0 and (seen.std((0, 1)) + seen.abs().mean((0, 1)) > 1e-3).all()


def test_the_turbine_observes_by_hand():
    plant = WindTurbine(observe=("rotor_speed", "blade_pitch", "wind_speed", "speed_error"))
    state = double(1.16711, 110.0, 9.0, 0.2, 3e4, 6.0)
    reference = 97.0 * plant.best_tip_speed_ratio * 9.0 / 63.0
    expected = double(-0.5, 0.2, 1.5, (110.0 - reference) / 20.0)
    torch.testing.assert_close(plant.observe(TIME_ZERO, state, double(15.5)), expected)


def test_a_filter_of_the_position_tells_the_speed_behind_it():
    """Of a ramp, the low-pass lags by 1/ω_F, and its difference from it is the speed: x − x_F → v/ω_F."""
    plant = FlappingWing(observe=("position",))
    assert plant.controller_states == ("filtered_position", "filtered_height")
    t = plant.dt * torch.arange(401, dtype=torch.float64)
    ramp = {"forward_position": 0.3 * t, "height": 1.0 - 0.2 * t}
    ramp |= {"forward_speed": torch.full_like(t, 0.3), "climb_speed": torch.full_like(t, -0.2)}
    states = plant.complete_states(ramp, torch.zeros(400, 1).double(), torch.full((400, 2), 5.0).double())
    seen = plant.observe(t[-1:], states[-1:], torch.zeros(1, 1).double())[0]
    # After 0.2 s, ten time constants, e⁻¹⁰ is left; samples are 0.5 ms apart.
    torch.testing.assert_close(seen[2:4], double(-0.3, 0.2), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(plant.seen_velocity(states[-1:])[0], -seen[2:4])
    start = plant.controller_start(double(0.3, 1.2, 0.0, 0.0), torch.zeros(1).double())
    assert start.tolist() == [0.3, 1.2]


# Previews


def test_a_preview_is_the_wind_to_come_in_every_episode():
    plant, plain = (WindTurbine(horizon=60.0, observe=(which,)) for which in ("preview", "measured+wind"))
    wind, base = plant.draw_exogenous(3, seeded(1)), plain.draw_exogenous(3, seeded(1))
    assert [signal.name for signal in plant.inputs[1:]] == [f"wind_speed_in_{lead}_s" for lead in (2, 4, 8)]
    assert torch.equal(wind[..., :1], base)
    for column, steps in ((1, 4), (2, 8), (3, 16)):
        assert torch.equal(wind[:, :-steps, column], base[:, steps:, 0])
        assert torch.equal(wind[:, -steps:, column], base[:, -1:, 0].expand(-1, steps))


def test_virtual_episodes_preview_their_own_wind():
    """The process is fitted to the wind alone; the preview of a realisation is its own future."""
    plant = WindTurbine(horizon=60.0, observe=("preview",))
    state, wind = plant.draw_initial_state(1, seeded()), plant.draw_exogenous(1, seeded())
    flown = rt.Rollout(plant, plant.closure)(state, wind, double(3e4, 2.0).expand(1, plant.n_steps, 2))
    virtual = VirtualEpisodes(rt.DigitalTwin(plant, plant.closure), rt.ExogenousConfig(), 1, generator=seeded())
    virtual.learn(rt.Trajectory(flown.states[0], flown.actions[0], wind[0]))
    assert virtual.processes[0].mean.shape == (plant.n_steps, 1)
    drawn = virtual.draw(4).exogenous
    assert torch.equal(drawn[:, :-8, 2], drawn[:, 8:, 0]) and not torch.equal(drawn[0], drawn[1])
    saved = virtual.state_dict()
    virtual.load_state_dict(saved)
    assert virtual.draw(2).exogenous.shape == (2, plant.n_steps, 4)


# What policies of some sensors see, and twins that trainings identify without noise.


SENSORS = {
    "wind_turbine": (("rotor_speed",), ()),
    "flapping_wing": (("forward_position", "height"), ("--observe", "position+wind")),
    "cryogenic_tank": (("pressure",), ()),
}
"""Sensors that are there, beside those of the inputs, and options by which policies observe nothing else."""


@pytest.mark.parametrize("name", SENSORS)
def test_policies_of_some_sensors_see_nothing_else(name):
    """No change of another state, which no controller holds, changes the observation."""
    sensors, options = SENSORS[name]
    config = from_command_line(load_recipe(RECIPES / f"{name}.py").Config, options)
    plant, time = config.plant(), torch.zeros(1).double()
    state, exogenous = drawn(plant)
    exogenous = exogenous[:, 0]
    seen = plant.observe(time, state, exogenous)
    for k, signal in enumerate(plant.states):
        if signal.name not in (*sensors, *plant.controller_states):
            moved = state.clone()
            moved[:, k] += 0.01
            assert torch.equal(plant.observe(time, moved, exogenous), seen), signal.name


# What a newcomer writes for a plant of their own, and what exploration adds to its policy.


class Turning(LinearQuadratic):
    name = "turning"
    states = (
        rt.Signal(symbol="x", name="position", unit="m"),
        rt.Signal(symbol="a", name="angle", unit="rad", low=-math.pi, high=math.pi, periodic=True),
    )
    state_sizes = (2.0, 0.5)


def test_a_discrepancy_counts_states_in_their_sizes_and_an_angle_the_short_way():
    one, other = torch.tensor([[1.0, 3.0]]).double(), torch.tensor([[5.0, -3.0]]).double()
    turned = 2.0 * math.pi - 6.0
    expected = 0.5 * ((4.0 / 2.0) ** 2 + (turned / 0.5) ** 2)
    assert Turning().discrepancy(one, other).tolist() == pytest.approx([expected], rel=1e-12)


class Clocked(LinearQuadratic):
    measurements = (
        rt.Measurement.of(LinearQuadratic.states[1], offset=1.0, scale=2.0),
        rt.Measurement.of(LinearQuadratic.inputs[0]),
        rt.Measurement(symbol="c", name="day", unit="-", read=rt.Phase("cosine", 4.0)),
        rt.Measurement(symbol="s", name="night", unit="-", read=rt.Phase("sine", 4.0)),
    )

    def observe(self, t, state, exogenous):
        return super(LinearQuadratic, self).observe(t, state, exogenous)


def test_measurements_read_the_signal_of_their_name_and_the_phase_of_the_day(unchecked):
    plant = Clocked(horizon=2.0)
    state, exogenous = torch.tensor([[7.0, 5.0]]).double(), torch.tensor([[0.25]]).double()
    seen = plant.observe(torch.tensor([1.0]).double(), state, exogenous)
    torch.testing.assert_close(seen, torch.tensor([[2.0, 0.25, 0.0, 1.0]]).double(), rtol=0, atol=1e-15)


def test_measurements_of_an_object_take_the_place_of_those_of_its_class():
    class Targeted(Clocked):
        def __init__(self, target):
            self.measurements = tuple(rt.Measurement.of(state, offset=target, scale=target) for state in self.states)
            super().__init__(horizon=2.0)

    at_target = torch.full((1, 2), 0.4, dtype=torch.float64)
    assert not Targeted(0.4).observe(torch.zeros(1), at_target, torch.zeros(1, 1)).any()


# Exploration noise: deviation and correlation of what reaches the actuators, and a fresh start at each episode.


@pytest.mark.parametrize("intervals", [0.0, 3.0])
def test_deviation_and_correlation_are_those_asked_for(intervals):
    plant = LinearQuadratic()
    config = ExplorationConfig(spread=0.1, correlation_time=intervals * plant.dt)
    actor = LivePolicy(plant, Constant(0.0), config, generator=seeded())  # the middle of ±2 N
    actor.begin(actor.policy, strength=0.5)
    found = torch.stack([actor(torch.zeros(100, 2, dtype=torch.float64)) for _ in range(400)]) / 2.0
    rho = math.exp(-1.0 / intervals) if intervals else 0.0
    # Standard error of a deviation over 40 000 samples of which some 1 + 2ρ/(1 − ρ) count as one: 2 % at most.
    assert found.std().item() == pytest.approx(0.05, rel=0.05)
    for lag in (1, 2, 5):
        correlation = (found[lag:] * found[:-lag]).mean() / found.square().mean()
        assert correlation.item() == pytest.approx(rho**lag, abs=0.04)


def test_an_episode_that_ended_early_keeps_the_previews_that_were_read():
    plant = WindTurbine(horizon=60.0, observe=("preview",))
    plant.end_cost = 5.0
    state, wind = plant.draw_initial_state(1, seeded()), plant.draw_exogenous(1, seeded())[0]
    actions = double(3e4, 2.0).expand(20, 2)
    record = rt.Trajectory(state.expand(21, -1), actions, wind[:20])
    virtual = VirtualEpisodes(rt.DigitalTwin(plant, plant.closure), rt.ExogenousConfig(), 1, generator=seeded())
    again = virtual.repeated(record).exogenous[0]
    assert torch.equal(again[:20], wind[:20])
    assert torch.equal(again[20:40, 0], wind[:20, 0].flip(0)) and torch.equal(again[20:-8, 2], again[28:, 0])


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "episodes", "words", "most"),
    [
        # Without noise the fit goes on until steps end in rounding.
        ("flapping_wing", 1, ("--twinning.assimilation.iterations", "60"), 1e-3),
        ("cryogenic_tank", 2, (), 1e-2),
    ],
)
def test_the_weights_are_those_of_the_real_system_after_two_and_three_episodes(tmp_path, name, episodes, words, most):
    """The classical controller flies the first of them; the twin has the true form, and sensors have no noise."""
    fitted = ["--twinning.assimilation.inputs", "record", "--twinning.assimilation.method", "levenberg_marquardt"]
    fitted += ["--twinning.arm", "model_based", "--twinning.hypotheses.which", "none", *words]
    short = ["--episodes", str(episodes), "--unseen", "2", "--no-figures", "--threads", "1"]
    recipe = load_recipe(RECIPES / f"{name}.py")
    recipe.main(from_command_line(recipe.Config, [*short, *fitted, "--log-dir", str(tmp_path)]))
    laws = json.loads((tmp_path / "metrics.json").read_text())["summary"]["closure"]
    assert max(abs(laws["found"][weight] / true - 1.0) for weight, true in laws["true"].items()) < most
