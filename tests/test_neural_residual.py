"""Networks in closures and in the vector field: starts, bounds, closed forms, and as a hypothesis beside others."""

import copy

import pytest
import torch
from linear_quadratic import LinearClosure, LinearGain, LinearQuadratic
from scipy.linalg import expm
from seeds_and_numbers import drawn, seeded
from test_extensions import flight
from test_trajectory import recorded
from torch import nn
from torch.nn.utils import parameters_to_vector

import rt_torchrl as rt
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.steps.assimilate import Assimilation
from rt_torchrl.steps.hypotheses.assimilation import EnsembleAssimilation, Fit
from rt_torchrl.steps.hypotheses.ensemble import ALONE, make_twin

RANGES = {"position": (-3.0, 3.0), "velocity": (-3.0, 3.0)}
FORCE = "unknown force"


def pushed(base, **options):
    return rt.NeuralResidual(base, {"velocity": 4.0}, inputs=("position", "velocity"), ranges=RANGES, **options)


class Exact(LinearQuadratic):
    """The oscillator with the solution of its linear equations as a scheme of its own."""

    def advance(self, t, state, applied, exogenous, closure):
        joint = torch.zeros(4, 4, dtype=torch.float64)
        joint[:2] = torch.cat([self._A + closure.matrix.detach(), self._B, self._D], -1)
        held = torch.as_tensor(expm((joint * self.dt).numpy()))[:2]
        return torch.cat([state, applied, exogenous + torch.zeros_like(applied)], -1) @ held.T


def stirred(closure, scale=0.5):
    """The closure with other weights in its network, whose last layer is zero at first."""
    generator = torch.Generator().manual_seed(2)
    (network,) = (m for m in closure.modules() if isinstance(m, rt.BoundedPerceptron))
    with torch.no_grad():
        for weight in network.parameters():
            weight.add_(scale * torch.randn(weight.shape, generator=generator, dtype=torch.float64))
    return closure


def test_the_residual_is_the_bounded_network_in_the_units_of_the_plant():
    class Sized(LinearQuadratic):
        state_sizes = (1.0, 0.5)

    plant = rt.NeuralResidual(Sized(), {"velocity": 3.0}, inputs=("force", "position"), ranges={"position": (0.0, 4.0)})
    closure = stirred(plant.make_closure(torch.Generator().manual_seed(1)))
    first, last = (closure.own.network[k] for k in (0, 2))
    state = torch.tensor([[1.0, 0.2], [9.0, -3.0]], dtype=torch.float64)
    action = torch.tensor([[0.7], [-2.0]], dtype=torch.float64)
    hat = torch.cat([action / 2.0, (state[:, :1] - 2.0) / 2.0], -1)  # the force goes from −2 to 2 N
    expected = 1.5 * torch.tanh(torch.tanh(hat @ first.weight.T + first.bias) @ last.weight.T + last.bias)
    nothing = torch.zeros(2, 1, dtype=torch.float64)
    added = plant.vector_field(torch.zeros(2), state, action, nothing, closure) - Sized().vector_field(
        torch.zeros(2), state, action, nothing, closure.base
    )
    torch.testing.assert_close(added, torch.cat([nothing, expected], -1))


@pytest.mark.parametrize("base", [LinearQuadratic(), Exact(), rt.LaggedActuator(LinearQuadratic(), "force", 0.4)])
def test_it_begins_as_the_plant_itself(base):
    plant = pushed(base)
    state, exogenous, command = flight(base)
    flown = [rt.Rollout(p, p.closure, engine="autograd")(state, exogenous, command).states for p in (plant, base)]
    assert torch.equal(*flown)
    assert plant.states == base.states and plant.unread == base.unread and plant.own_scheme == base.own_scheme


def test_a_plant_that_wraps_a_runge_kutta_step_takes_one_of_the_sum():
    class Wrapping(LinearQuadratic):
        own_scheme = False

        def advance(self, *given):
            return super().advance(*given)

    plant = pushed(Wrapping())
    closure = stirred(plant.make_closure(torch.Generator()))
    (state, exogenous, command), t = flight(plant), torch.zeros(1).double()
    arguments = t, state, command[:, 0], exogenous[:, 0], closure
    torch.testing.assert_close(plant.advance(*arguments), rt.Plant.advance(plant, *arguments), rtol=1e-14, atol=0.0)


def test_around_another_scheme_it_is_of_second_order():
    def end(kind, dt):
        plant = pushed(kind(dt=dt, horizon=4.0))
        closure = stirred(plant.extended(LinearClosure(LinearQuadratic.true_closure)))
        state, (n, steps) = torch.tensor([[1.0, -0.5]], dtype=torch.float64), (1, plant.n_steps)
        held = torch.full((n, steps, 1), 0.3, dtype=torch.float64)
        return rt.Rollout(plant, closure, engine="autograd")(state, 0.0 * held, held).states[0, -1]

    with torch.no_grad():
        reference = end(LinearQuadratic, 0.01)
        coarse, fine = ((end(Exact, dt) - reference).norm().item() for dt in (0.2, 0.1))
    assert coarse / fine == pytest.approx(4.0, rel=0.15) and fine < 5e-3


def test_an_angle_turns_without_a_jump():
    plant = rt.NeuralResidual(Pendulum(), {"angular_speed": 1.0}, inputs=("angle", "torque"))
    rt.check_plant(plant, steps=20, traced=False)
    closure = stirred(plant.make_closure(torch.Generator().manual_seed(1)))
    low, high = (torch.tensor([[sign * torch.pi, 1.0]], dtype=torch.float64) for sign in (-1.0, 1.0))
    action, nothing = torch.zeros(1, 1, dtype=torch.float64), torch.zeros(1, 0, dtype=torch.float64)
    found = [plant.residual(state, action, nothing, closure) for state in (low, high)]
    torch.testing.assert_close(*found, rtol=0.0, atol=1e-12)
    assert found[0][0, 1] != 0.0


# As a hypothesis


class Suspecting(LinearQuadratic):
    def suspects(self):
        return {
            "lags": rt.LaggedActuator(self, "force", 0.2),
            "late, twice": rt.DelayedActuator(self, "force", 0.2),
            "position sensor": rt.BiasedSensor(self, "position", 0.0, scale=0.2),
        }

    def further_suspects(self):
        return {FORCE: pushed(self)}


class Real(Suspecting):
    """The oscillator with a force that its twin does not know."""

    def __init__(self, force, **options):
        super().__init__(**options)
        self.force = force

    def vector_field(self, t, state, action, exogenous, closure):
        field = super().vector_field(t, state, action, exogenous, closure)
        return torch.stack([field[..., 0], field[..., 1] + self.force(*state.unbind(-1))], -1)


MAGNETS = "magnets, −2 sin 2x"
FORCES = {
    MAGNETS: lambda x, v: -2.0 * torch.sin(2.0 * x),
    "strong magnets, −3 sin 2x": lambda x, v: -3.0 * torch.sin(2.0 * x),
    "flutter, 0.8 v − 0.3 v³": lambda x, v: 0.8 * v - 0.3 * v**3,
    "cubic damping, −0.3 v³": lambda x, v: -0.3 * v**3,
    "dry friction, −0.8 tanh 5v": lambda x, v: -0.8 * torch.tanh(5.0 * v),
    "none": lambda x, v: 0.0 * x,
}
ASSIMILATION = rt.AssimilationConfig(iterations=8, method="levenberg_marquardt", inputs="record")
NAMES = ("lags", "late, twice", "position sensor")


def records(real, noise, count=3):
    """Flights under random commands, which hold for ten intervals, as noisy sensors read them."""
    generator = torch.Generator().manual_seed(5)
    for _ in range(count):
        state, exogenous = real.draw_initial_state(1, generator), torch.zeros(1, real.n_steps, 1, dtype=torch.float64)
        held = 4.0 * torch.rand(1, real.n_steps // 10, 1, generator=generator, dtype=torch.float64) - 2.0
        flown = rt.Rollout(real, real.closure)(state, exogenous, held.repeat_interleave(10, 1))
        drawn = torch.randn(flown.states[0].shape, generator=generator, dtype=torch.float64)
        yield rt.Trajectory(flown.states[0] + noise * drawn, flown.actions[0], exogenous[0])


def learned(real, names, noise=0.0):
    plant, config = Suspecting(horizon=real.horizon), rt.HypothesesConfig(call=0.0, which=names)
    twin = make_twin(plant, LinearClosure([[0.0, 0.0], [0.0, 0.0]]), config)
    assimilation = EnsembleAssimilation(twin, ASSIMILATION, config)
    assimilation.update(list(records(real, noise)))
    return twin, assimilation.misfits


def planned(twin, episodes):
    policy = LinearGain([[1.0, 1.0]])
    descent = torch.optim.LBFGS(policy.parameters(), max_iter=30, line_search_fn="strong_wolfe")

    def cost():
        descent.zero_grad()
        found = twin.cost(policy, *episodes)
        found.backward()
        return found

    descent.step(cost)
    return policy


def test_it_explains_a_force_that_no_other_hypothesis_explains():
    twin, misfits = learned(Real(FORCES[MAGNETS], horizon=10.0), (*NAMES, FORCE))
    assert twin.weights == {FORCE: 1.0}
    assert misfits[FORCE] < 0.1 * min(value for name, value in misfits.items() if name != FORCE)


@pytest.mark.slow
@pytest.mark.parametrize("force", FORCES)
def test_a_plan_on_what_it_explains_is_the_optimum(force):
    real = Real(FORCES[force], horizon=10.0)
    truth, episodes, unseen = rt.DigitalTwin(real, real.closure), drawn(real, 40, seed=1), drawn(real, 200, seed=2)
    few, all_ = (learned(real, names)[0] for names in (NAMES, (*NAMES, FORCE)))
    twins = (truth, few.twins[ALONE], few, all_)
    optimum, alone, others, with_it = (truth.cost(planned(twin, episodes), *unseen).item() for twin in twins)
    print(f"| {force} | {optimum:.4f} | {alone:.4f} | {others:.4f} | {with_it:.4f} |")
    assert with_it < 1.02 * optimum
    assert force != MAGNETS or (with_it / optimum < 1.005 and others / optimum > 1.02 and alone / optimum > 1.1)


def test_a_fit_goes_on_as_without_a_resumption_where_the_last_weights_diverge():
    """What holds the weights of a residual is a share of a misfit, and that of weights that diverge says nothing."""
    (record,) = records(Real(FORCES[MAGNETS], horizon=5.0), 0.05, count=1)
    plant, fits = pushed(LinearQuadratic(horizon=5.0)), []
    for _ in range(2):
        closure = plant.extended(LinearClosure([[0.0, 0.0], [0.0, 0.0]]))
        fits.append(Fit(rt.DigitalTwin(plant, closure), ASSIMILATION, 25))
    fits[0].update([record])
    fits[1].load_state_dict(copy.deepcopy(fits[0].state_dict()))
    for fit in fits:
        fit.twin.closure.base.matrix.data.fill_(1e9)
        fit.update([record])
    one, other = (fit.twin.closure.state_dict() for fit in fits)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_noise_does_not_call_for_it_where_the_plant_is_right():
    twin, misfits = learned(Real(FORCES["none"], horizon=10.0), (FORCE,), noise=0.03)
    assert twin.weights == {ALONE: 1.0} and misfits[FORCE] == pytest.approx(misfits[ALONE], rel=0.05)


# Closures with a perceptron in them: their start, the bounds that keep their physics, their identification.


PLANTS = [WindTurbine(horizon=20.0), FlappingWing(horizon=0.01), CryogenicTank(horizon=1200.0)]
FEATURES = {
    "wind_turbine": ((3.0, 12.0), (0.0, 20.0)),
    "flapping_wing": ((-1.0, 1.0), (-1.0, 1.0)),
    "cryogenic_tank": ((0.9, 1.1), (0.6, 0.7), (0.0, 2.0), (0.0, 1.0)),
}


def points(plant):
    low, high = torch.tensor(FEATURES[plant.name], dtype=torch.float64).unbind(-1)
    return low + (high - low) * torch.rand(200, len(low), generator=seeded(1), dtype=torch.float64)


def disturbed(plant, scale=1.0):
    """A neural closure whose perceptron is not zero."""
    closure = plant.make_neural_closure(seeded(), (8, 8))
    with torch.no_grad():
        closure.correction.network[-1].weight.normal_(0.0, scale, generator=seeded(2))
    return closure


@pytest.fixture(params=PLANTS, ids=lambda plant: plant.name)
def plant(request):
    return request.param


def test_it_starts_where_the_papers_does(plant):
    features = points(plant)
    assert torch.equal(plant.make_neural_closure(seeded(3), (8,))(features), plant.make_closure(seeded(3))(features))
    assert not torch.allclose(disturbed(plant)(features), plant.make_closure(seeded())(features), rtol=1e-2)


def test_both_sides_of_a_wing_are_alike_and_its_drag_is_positive():
    closure, angle = disturbed(PLANTS[1], 5.0), torch.linspace(0.1, 3.0, 50, dtype=torch.float64)
    one, other = (closure(torch.stack([a.sin(), a.cos()], -1)) for a in (angle, -angle))
    torch.testing.assert_close(one[:, 0], -other[:, 0], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(one[:, 1], other[:, 1], rtol=1e-12, atol=1e-14)
    assert (one[:, 1] > 0.0).all()
    along = closure(torch.tensor([[0.0, 1.0]], dtype=torch.float64))
    assert along[0, 0] == 0.0


def test_the_tanks_coefficients_stay_within_a_factor_of_two():
    tank = PLANTS[2]
    ratio = disturbed(tank, 20.0)(points(tank)) / tank.make_closure(seeded())(points(tank))
    assert ratio.min() >= 0.5 and ratio.max() <= 2.0 and ratio.max() > 1.5


class Corrected(nn.Module):
    """The law that a twin starts from and a perceptron of one layer."""

    def __init__(self, law):
        super().__init__()
        self.law = law
        ranges = [(-3.0, 3.0)] * 2
        self.correction = rt.BoundedPerceptron(ranges, [1.0, 1.0], hidden=(), generator=seeded())

    def forward(self, features):
        return self.law(features) + self.correction(features)


def test_a_prior_pulls_the_perceptron_against_the_record():
    plant, moved = LinearQuadratic(horizon=4.0, noise=0.0), []
    for prior in (0.01, 0.1, 1.0):
        twin, flown, exogenous = recorded(plant, batch=1)
        twin = rt.DigitalTwin(plant, Corrected(twin.closure.requires_grad_(False)))
        start = parameters_to_vector(twin.closure.correction.parameters()).detach()
        config = rt.AssimilationConfig(prior=prior, inputs="record", method="levenberg_marquardt", iterations=40)
        assimilation = Assimilation(twin, config)
        assimilation.update([flown.each()[0]])
        away = parameters_to_vector(twin.closure.correction.parameters()).detach() - start
        moved.append(away.norm().item())
        found = assimilation.likelihood(flown).normal_equations()
        # At the minimum of both the gradient of J_p is the pull of the prior; the steps end where 1e-4 of the cost is
        # left to gain, some hundredths of the gradient.
        assert (found.gradient + prior * away).norm() <= 0.1 * found.gradient.norm()
    assert moved[0] > moved[1] > moved[2] > 0.0
