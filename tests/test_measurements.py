"""What a policy observes: any choice of a plant's measurements, each scaled to order one; and previews of the wind."""

import pytest
import torch
from seeds_and_numbers import double, seeded

from rt_torchrl import DigitalTwin, ExogenousConfig, Rollout, SaturatedAffine, Trajectory, check_plant, shipped_plants
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.steps.inputs import VirtualEpisodes

TIME_ZERO = torch.zeros((), dtype=torch.float64)
CHOICES = [(name, kind, which) for name, kind in shipped_plants().items() for which in kind.observation_sets]
IDS = [f"{name}-{which}" for name, _, which in CHOICES]
RICHEST = {(name, list(kind.observation_sets)[-1]) for name, kind in shipped_plants().items() if kind.observation_sets}


def short(kind, **options):
    plant = kind(**options)
    return kind(dt=plant.dt, horizon=50 * plant.dt, **options)


def names(plant):
    return [signal.name for signal in plant.observations]


@pytest.mark.parametrize(
    ("name", "kind", "which"),
    [pytest.param(*c, marks=() if (c[0], c[2]) in RICHEST else pytest.mark.slow) for c in CHOICES],
    ids=IDS,
)
def test_a_plant_fulfils_its_contract_with_every_set(name, kind, which):
    plant = short(kind, observe=(which,))
    check_plant(plant, episodes=2, steps=10, traced=False)
    assert names(plant) == list(kind.observation_sets[which])


@pytest.mark.parametrize(("name", "kind", "which"), CHOICES, ids=IDS)
def test_observations_are_of_order_one(name, kind, which):
    plant = kind(observe=(which,))
    state, exogenous = plant.draw_initial_state(3, seeded()), plant.draw_exogenous(3, seeded())
    low, high = plant.actions[0].low, plant.actions[0].high
    policy = SaturatedAffine(len(plant.observations), plant.actions, weight_scale=0.0, generator=seeded())
    assert low < high
    with torch.no_grad():
        flown = Rollout(plant, plant.closure, policy)(state, exogenous)
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
    flown = Rollout(plant, plant.closure)(state, wind, double(3e4, 2.0).expand(1, plant.n_steps, 2))
    virtual = VirtualEpisodes(DigitalTwin(plant, plant.closure), ExogenousConfig(), 1, generator=seeded())
    virtual.learn(Trajectory(flown.states[0], flown.actions[0], wind[0]))
    assert virtual.processes[0].mean.shape == (plant.n_steps, 1)
    drawn = virtual.draw(4).exogenous
    assert torch.equal(drawn[:, :-8, 2], drawn[:, 8:, 0]) and not torch.equal(drawn[0], drawn[1])
    saved = virtual.state_dict()
    virtual.load_state_dict(saved)
    assert virtual.draw(2).exogenous.shape == (2, plant.n_steps, 4)
