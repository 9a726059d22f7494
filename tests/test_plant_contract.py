"""The contract of every plant: of each folder under rt_torchrl.envs, found by itself, and of the oracle plant."""

import importlib
import math
import re
import warnings

import pytest
import torch
from broken_plants import BROKEN, UNTRACEABLE, partly_detached
from linear_quadratic import LinearQuadratic
from seeds_and_numbers import drawn, seeded
from tensordict.nn import TensorDictModule
from test_export_recipe import leave_run
from torchrl.envs.utils import check_env_specs

import rt_torchrl as rt
from rt_torchrl.envs.cryogenic_tank import unknown as tanks
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing import unknown as drones
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine import unknown as turbines
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.envs.wind_turbine.unknown import LaggedInflow, MisreadWind
from rt_torchrl.runs.command_line import from_command_line

CLASSES = {"linear_quadratic": LinearQuadratic} | rt.shipped_plants()


def shortened(kind, steps):
    """A plant whose episode has at most this number of steps."""
    plant = kind()
    return plant if plant.n_steps <= steps else kind(dt=plant.dt, horizon=steps * plant.dt)


@pytest.fixture(params=CLASSES)
def kind(request):
    return CLASSES[request.param]


@pytest.fixture
def plant(kind):
    """The plant with a short episode, for tests in which the length does not matter."""
    return shortened(kind, 50)


def test_a_scheme_of_its_own_is_one_that_a_plant_defines():
    class Own(LinearQuadratic):
        def advance(self, t, state, applied, exogenous, closure):
            return state + self.dt * self.vector_field(t, state, applied, exogenous, closure)

    class Back(Own):
        advance = LinearQuadratic.advance

    class Wrapping(LinearQuadratic):
        own_scheme = False

        def advance(self, *given):
            return super().advance(*given)

    class Stepping(LinearQuadratic):
        def step(self, t, state, command, exogenous, closure):
            return rt.Transition(state + self.dt * self.vector_field(t, state, command, exogenous, closure), command)

    found = {kind: kind().own_scheme for kind in (LinearQuadratic, Own, Back, Wrapping, Stepping)}
    assert found == {LinearQuadratic: False, Own: True, Back: False, Wrapping: False, Stepping: True}


def test_an_extension_has_the_scheme_of_its_plant_unless_hidden_states_have_their_own_solution():
    found = [
        rt.ScaledActuator(CryogenicTank(), "valve_drop", 0.9),
        rt.ScaledActuator(Pendulum(), "torque", 0.9),
        rt.DelayedActuator(LinearQuadratic(), "force", 0.3),
        rt.ScaledActuator(rt.DelayedActuator(LinearQuadratic(), "force", 0.3), "force", 0.9),
    ]
    assert [plant.own_scheme for plant in found] == [False, True, True, True]


def test_fulfils_the_contract(kind, plant):
    assert rt.check_plant(plant, episodes=2, steps=10).untraceable is None
    assert CLASSES[plant.name] is kind
    check_env_specs(rt.PlantEnv(plant, seed=3), seed=3)


def test_twin_with_the_true_closure_is_the_real_system(kind, unchecked):
    plant = shortened(kind, 200)
    policy = plant.make_policy(seeded(5))
    with torch.no_grad():
        acting = TensorDictModule(policy, ["observation"], ["action"])
        episode = rt.PlantEnv(plant, seed=0).rollout(plant.n_steps + 10, acting)
    assert episode["next", "truncated"].flatten().tolist() == [False] * (plant.n_steps - 1) + [True]
    assert not episode["next", "terminated"].any()
    twin = rt.DigitalTwin(plant, plant.closure)
    exogenous, states = episode["exogenous"], torch.cat([episode["state"], episode["next", "state"][:, -1:]], 1)
    scale = states.abs().amax((0, 1))
    with torch.no_grad():
        flights = {
            "commands": rt.Rollout(plant, plant.closure)(states[:, 0], exogenous, episode["action"]),
            "applied actions": twin.replay(states[:, 0], exogenous, episode["next", "applied"]),
            "policy": twin.control(policy, states[:, 0], exogenous),
        }
        for name, flown in flights.items():
            # The same operations on other batch shapes: rounding, damped by stable plants.
            assert ((flown.states - states).abs() / scale).max() < 1e-12, name
            torch.testing.assert_close(flown.actions, episode["next", "applied"], rtol=1e-12, atol=1e-12)
        cost = rt.control_cost(plant, flights["policy"])
    torch.testing.assert_close(cost, -episode["next", "reward"][..., 0].mean(-1), rtol=1e-12, atol=0)


# Every plant, policy, closure and extension that is shipped becomes machine code: nothing in it is refused.


RECIPES = ("wind_turbine", "flapping_wing", "cryogenic_tank")
OPTIONS = {
    "wind_turbine": ("mlp", "paper", "bias", "scheduled", "mlp --task engineering", "mlp --observe preview"),
    "flapping_wing": ("mlp", "paper", "mlp --task hop", "mlp --observe phase"),
    "cryogenic_tank": ("mlp", "paper", "mlp --command drop --end-weight 0", "mlp --observe phase"),
}
"""Policies of each plant, and options that change what it computes."""
SYSTEMS = {recipe: importlib.import_module(f"rt_torchrl.envs.{recipe}.unknown").SYSTEMS for recipe in RECIPES}


def configured(recipe, options):
    return from_command_line(importlib.import_module(recipe).Config, options.split())


def require_traced(plant, closure, policy):
    """Fly four intervals by machine code; a warning says that another engine takes its place."""
    generator = torch.Generator().manual_seed(0)
    read = plant.draw_initial_state(2, generator)[..., : len(plant.readings)]
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="engine .* takes the place")
        rt.Rollout(plant, closure, policy)(plant.at_rest(read), plant.draw_exogenous(2, generator)[:, :4])


@pytest.mark.parametrize(("recipe", "options"), [(recipe, text) for recipe in RECIPES for text in OPTIONS[recipe]])
def test_policies_closures_costs_and_observations(recipe, options):
    """All closures with the perceptron, and the true one with the other policies."""
    config, generator = configured(recipe, f"--policy {options}"), torch.Generator().manual_seed(0)
    plant = config.plant()
    closures = [plant.closure, plant.make_closure(generator), plant.make_neural_closure(generator, (4,))]
    for closure in closures if options == "mlp" else closures[:1]:
        require_traced(plant, closure, config.make_policy(plant, generator))


@pytest.mark.parametrize("recipe", ["cryogenic_tank", *(pytest.param(x, marks=pytest.mark.slow) for x in RECIPES[:2])])
def test_hypotheses(recipe):
    config, generator = configured(recipe, ""), torch.Generator().manual_seed(0)
    plant = config.plant()
    policy = config.make_policy(plant, generator)
    for extended in (dict(plant.suspects()) | dict(plant.further_suspects())).values():
        require_traced(extended, extended.make_closure(generator), policy)


@pytest.mark.slow
@pytest.mark.parametrize(("recipe", "name"), [(recipe, name) for recipe, names in SYSTEMS.items() for name in names])
def test_systems_that_twins_do_not_know(recipe, name):
    config = configured(recipe, f"--unknown {name} --policy {'scheduled' if recipe == 'wind_turbine' else 'paper'}")
    plant = config.plant()
    require_traced(plant, plant.closure, config.make_policy(config.believed(), torch.Generator().manual_seed(0)))


# Every kind of violation of a plant's contract is found, in plants broken on purpose, and told with its remedy.


def violations(plant, **options):
    """Violations that the check finds."""
    with pytest.raises(rt.PlantContractError) as raised:
        rt.check_plant(plant, traced=False, **options)
    return raised.value.violations


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_plant_is_found(kind):
    broken, message = BROKEN[kind]
    found = violations(broken(horizon=20.0 if "diverged" in message else 5.0))
    assert any(re.match(message, text) for text in found), found


def test_every_violation_is_told_at_once():
    class Broken(LinearQuadratic):
        running_cost = partly_detached

        def observe(self, t, state, exogenous):
            return state.detach()

        def terminal_cost(self, state):
            return -1.0 + super().terminal_cost(state)

    assert {text.split(":")[0] for text in violations(Broken())} == {"observe", "terminal_cost", "running_cost"}


def test_a_sound_plant_is_told_what_was_checked():
    found = rt.check_plant(LinearQuadratic(dt=0.1), steps=10, traced=False)
    assert re.search("fulfils its contract.*; a step errs by .* %", str(found))
    # The step is of fourth order: twice as many err by a sixteenth, and by that of a move of half the length.
    finer = rt.check_plant(LinearQuadratic(dt=0.05), steps=10, traced=False)
    assert found.step_error / finer.step_error == pytest.approx(16.0, rel=0.15)


def test_the_check_leaves_no_trace():
    """The check changes neither the plant's weights nor torch's global random numbers."""
    plant = LinearQuadratic()
    before, numbers = plant.closure.matrix.clone(), torch.random.get_rng_state()
    rt.check_plant(plant, traced=False)
    assert torch.equal(plant.closure.matrix, before)
    assert torch.equal(torch.random.get_rng_state(), numbers)


@pytest.mark.parametrize("kind", UNTRACEABLE)
def test_what_machine_code_cannot_take_is_told_with_its_line(kind):
    """Such a plant fulfils its contract."""
    found = rt.check_plant(kind(), steps=5)
    assert re.search(UNTRACEABLE[kind], found.untraceable), found.untraceable
    assert "fulfils its contract" in str(found) and "'autograd' takes the place of 'native'" in str(found)


class Cornered(LinearQuadratic):
    """A plant without chance, whose episodes begin in corners of its laws, where torch has a slope in between."""

    def draw_initial_state(self, batch, generator):
        return torch.zeros(batch, 2, dtype=torch.float64)

    def draw_exogenous(self, batch, generator):
        return torch.zeros(batch, self.n_steps, 1, dtype=torch.float64)

    def vector_field(self, t, state, action, exogenous, closure):
        friction = 0.1 * state[..., 1:].abs() + 0.3 * state[..., 1:].clamp(min=0.0)
        return super().vector_field(t, state, action, exogenous, closure) - torch.cat([0.0 * friction, friction], -1)


def test_a_corner_is_no_wrong_derivative_and_no_chance_no_mistake():
    rt.check_plant(Cornered())


# Real systems that their twin does not know: their names, their parts, and how recipes take them.


KNOWN = {
    "wind_turbine": (turbines, lambda: WindTurbine(horizon=20.0, observe=("scheduled",))),
    "flapping_wing": (drones, lambda: FlappingWing(horizon=0.1, target=(1.0, 1.0))),
    "cryogenic_tank": (tanks, lambda: CryogenicTank(horizon=3000.0, command="duty")),
}


def flown(plant, state, exogenous, command):
    return rt.Rollout(plant, plant.closure)(state, exogenous, command).states


def systems_of(plant):
    """All names, of which those that hold no part that an earlier one has not are slow."""
    seen, systems = set(), KNOWN[plant][0].SYSTEMS
    for name, parts in systems.items():
        yield pytest.param(plant, name, marks=pytest.mark.slow if seen.issuperset(parts) else ())
        seen.update(parts)


@pytest.mark.parametrize(("plant", "name"), [system for plant in KNOWN for system in systems_of(plant)])
def test_every_system_fulfils_the_contract_and_reads_what_its_twin_knows(plant, name):
    systems, make = KNOWN[plant]
    base = make()
    system = systems.unknown(base, (name,))
    rt.check_plant(system, steps=5, traced=False, trained=False)
    assert system.readings == base.states and system.name == plant
    assert set(systems.SYSTEMS[name]) <= set(systems.PARTS)


def test_the_power_of_a_rotor_that_keeps_its_speed_follows_exponentially():
    base = WindTurbine(inertia=1e15, observe=("scheduled",))
    plant = LaggedInflow(base, 10.0)
    rt.check_plant(LaggedInflow(WindTurbine(horizon=20.0), 10.0), steps=5, traced=False, trained=False)
    read, n, wind = base.draw_initial_state(1, seeded()), 60, 13.0
    state, exogenous = plant.at_rest(read), torch.full((1, n, 1), wind, dtype=torch.float64)
    power = 1e6 * flown(plant, state, exogenous, read[:, None, 4:6].expand(1, n, 2))[0, :, -1]
    steady = read[:, 0] * base.aerodynamic_torque(read[:, 0], read[:, 5], torch.tensor([wind]).double(), base.closure)
    t = base.dt * torch.arange(n + 1, dtype=torch.float64)
    torch.testing.assert_close(power, steady + (power[0] - steady) * torch.exp(-t / 10.0), rtol=1e-6, atol=0.0)
    # C_p is 0.4 at the start, in the filtered wind.
    assert power[0].item() == pytest.approx(0.2 * 1.225 * math.pi * 63.0**2 * read[0, 2].item() ** 3, rel=1e-9)


def test_a_rotor_turns_in_the_wind_and_its_filter_in_what_the_anemometer_reads():
    base = WindTurbine()
    plant = MisreadWind(base, 0.9)
    (state, read), (true, wind) = drawn(plant, 2, 2), drawn(base, 2, 2)
    read, wind = read[:, :40], wind[:, :40]
    torch.testing.assert_close(read, 0.9 * wind)
    command = true[:, None, 4:6].expand(2, 40, 2)
    found, expected = flown(plant, state, read, command), flown(base, true, wind, command)
    torch.testing.assert_close(found[..., :2], expected[..., :2], rtol=1e-12, atol=0.0)
    torch.testing.assert_close(found[..., 2], 0.9 * expected[..., 2], rtol=1e-12, atol=0.0)


def test_several_systems_combine_in_the_order_of_their_parts():
    config = configured("wind_turbine", "--unknown pitch inflow --policy scheduled")
    hidden = [state.name for state in config.plant().states if state not in config.plant().readings]
    assert hidden[0] == "lagged_torque" and hidden[1] == "resonant_blade_pitch"
    assert config.believed().states == config.plant().readings


def test_the_policies_of_an_unknown_system_are_made_for_what_the_twin_knows(tmp_path):
    config, parts = leave_run(tmp_path, "wind_turbine", policy="scheduled", unknown=("pitch",))
    run = rt.load_run(tmp_path)
    assert run.physics.states == run.plant.readings and run.plant.unread == 4
    assert type(run.closure) is type(config.believed().make_closure(torch.Generator()))
    assert torch.equal(run.policy("model_based").weights, parts["model_based"].weights)
