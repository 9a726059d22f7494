"""The NREL 5-MW plant, its controllers and ROSCO's simulator: closed forms, a torque balance and published figures."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from linear_quadratic import Constant
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import brentq
from seeds_and_numbers import double, seeded, stepped

from rt_torchrl.contract.methods import random_commands
from rt_torchrl.envs.wind_turbine import plant as module
from rt_torchrl.envs.wind_turbine import rosco as adapter
from rt_torchrl.envs.wind_turbine.closures import SaintDrenan
from rt_torchrl.envs.wind_turbine.controllers import GainScheduled, JonkmanController
from rt_torchrl.envs.wind_turbine.disturbances import KaimalWind
from rt_torchrl.envs.wind_turbine.plant import PaperCost, WindTurbine
from rt_torchrl.envs.wind_turbine.rosco import RoscoController, nrel5mw, rosco_turbine
from rt_torchrl.envs.wind_turbine.rotor import PowerCoefficientTable
from rt_torchrl.evaluation.unseen import RealEpisodes
from rt_torchrl.systems.real_system import episode_seed
from rt_torchrl.trajectories.rollout import Rollout

R, RHO, N_G, J = 63.0, 1.225, 97.0, 38_759_228.0 + 534.116 * 97**2
OMEGA_RATED = 1.26711
FROZEN = 1e30  # inertia [kg m²] of a rotor whose speed does not change


@pytest.fixture(scope="module")
def c_p():
    """The table read and interpolated once more, by FITPACK."""
    path = Path(module.__file__).parent / "data" / "nrel5mw_Cp_table_rosco.csv"
    with path.open() as file:
        rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    table = np.array([[float(x) for x in row] for row in rows[1:]])
    spline = RectBivariateSpline(table[:, 0], [float(x) for x in rows[0][1:]], table[:, 1:], s=0)
    return lambda lam, beta: spline(lam, beta)[0, 0]


def torque(c_p, omega, beta, u):
    """½ρπR²C_p u³/ω [N m], the paper's form."""
    return 0.5 * RHO * math.pi * R**2 * c_p(omega * R / u, beta) * u**3 / omega


def start(omega, *, u, command=(0.0, 0.0)):
    """A state with settled filters and the actuators at the command."""
    return torch.tensor([[omega, N_G * omega, u, 0.0, *command]], dtype=torch.float64)


def fly(plant, state, u, command):
    wind = torch.as_tensor(u, dtype=torch.float64).reshape(1, -1, 1)
    wind = wind.expand(1, plant.n_steps, 1)
    held = torch.tensor(command, dtype=torch.float64).expand(1, plant.n_steps, 2)
    with torch.no_grad():
        return Rollout(plant, plant.closure)(state, wind, held).states[0]


def test_time_constant_of_the_drivetrain(c_p):
    with torch.no_grad():
        found = WindTurbine().time_constant(11.4)
    h = 1e-5
    slope = (torque(c_p, OMEGA_RATED + h, 0.0, 11.4) - torque(c_p, OMEGA_RATED - h, 0.0, 11.4)) / (2 * h)
    # Central difference of a spline: h² of its curvature, and rounding 1e-16/1e-5.
    assert found == pytest.approx(-J / slope, rel=1e-6)
    assert found == pytest.approx(16.5, rel=0.05)  # the expected figure, from the published inertia, to two digits


@pytest.mark.parametrize("u, beta, tau_g, bracket", [(12.0, 5.0, 30e3, (0.9, 2.0)), (15.0, 11.0, 40e3, (0.9, 2.0))])
def test_settles_where_the_torques_balance(c_p, u, beta, tau_g, bracket):
    root = brentq(lambda omega: torque(c_p, omega, beta, u) - N_G * tau_g, *bracket, xtol=1e-12)
    plant = WindTurbine(horizon=1200.0, wind=KaimalWind(mean=u, intensity=0.0))
    end = fly(plant, start(1.05 * root, u=u, command=(tau_g, beta)), u, (tau_g, beta))[-1]
    # 1200 s are above 40 time constants there; what is left is the agreement of the splines, 1e-11.
    assert end[0].item() == pytest.approx(root, rel=1e-8)
    assert end[1].item() == pytest.approx(N_G * root, rel=1e-8)


def test_optimal_gain_takes_the_greatest_power(c_p):
    """At λ* the law K ω_g² draws ½ρπR²C_p,max u³, and the rotor keeps its speed."""
    plant, u = WindTurbine(wind=KaimalWind(mean=8.0, intensity=0.0)), 8.0
    lam = np.linspace(7.0, 8.2, 12_001)
    powers = np.array([c_p(x, 0.0) for x in lam])
    best, lam_best = powers.max(), lam[powers.argmax()]
    omega_g = N_G * lam_best * u / R
    # Grid spacing 1e-4 in λ: 1e-4/7.6 in λ³ three times over.
    assert plant.optimal_gain * omega_g**3 == pytest.approx(0.5 * RHO * math.pi * R**2 * best * u**3, rel=1e-4)
    command = (plant.optimal_gain * omega_g**2, 0.0)
    end = fly(plant, start(omega_g / N_G, u=u, command=command), u, command)[-1]
    # The same 1e-4 in torque, over the slope of the balance, ∂ln τ/∂ln ω = −1 at the optimum.
    assert end[0].item() == pytest.approx(omega_g / N_G, rel=3e-4)


@pytest.mark.parametrize(
    "u, expected", [(3.0, 70.16), (5.5, 70.16), (8.0, None), (10.0, None), (11.4, 122.9096), (25.0, 122.9096)]
)
def test_reference_speed_in_its_three_regions(u, expected):
    found = WindTurbine().reference_speed(torch.tensor(u).double()).item()
    if expected is None:
        # λ* = 7.64 of the published table, to its digits; the optimum is flat.
        assert found == pytest.approx(97 * 7.64 * u / 63.0, rel=0.02 / 7.64)
    else:
        assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("dt", [0.5, 0.25])
def test_actuators_move_by_no_more_than_their_rates_times_the_interval(dt):
    plant = WindTurbine(dt=dt)
    state = start(1.2, u=11.0, command=(20e3, 10.0))
    assert plant.actuate(state, double(43e3, 0.0)).tolist() == [[20e3 + 15e3 * dt, 10.0 - 8.0 * dt]]
    assert plant.actuate(state, double(20.1e3, 9.9)).tolist() == [[20.1e3, 9.9]]


def test_the_torque_fades_where_the_rotor_hardly_turns():
    """Of a C_p that does not: τ_a = ½ρπR³(C_p/λ)u² from λ = 1 on, half of it at 0.5, and nothing at standstill."""
    lam, u = double(0.0, 0.5, 1.0, 4.0), 10.0
    closure = torch.nn.Linear(2, 1, dtype=torch.float64).requires_grad_(False)
    closure.weight.fill_(0.0), closure.bias.fill_(0.1)
    found = WindTurbine().aerodynamic_torque(lam * u / R, double(0.0), double(u), closure)
    expected = 0.5 * RHO * math.pi * R**3 * u**2 * 0.1 * double(0.0, 0.5 / 0.5, 1.0, 1.0 / 4.0)
    torch.testing.assert_close(found, expected)


def test_cost_counts_speed_and_power_errors():
    """e_1 = 0.1 and e_P = −0.2, put together by hand: ½(2·0.01 + 3·0.04)."""
    plant = WindTurbine(cost=PaperCost(speed=2.0, power=3.0))
    omega = OMEGA_RATED
    power = min(5e6, plant.optimal_gain * (N_G * omega) ** 3) - 0.2 * 5e6
    applied = torch.tensor([[power / (N_G * omega), 0.0]], dtype=torch.float64)
    state = start(omega, u=15.0)
    state[0, 1] = 122.9096 + 0.1 * 20.0
    cost = plant.running_cost(torch.zeros(1).double(), state, applied, torch.full((1, 1), 15.0).double())
    assert cost.item() == pytest.approx(0.5 * (2.0 * 0.01 + 3.0 * 0.04), rel=1e-12)


def test_a_turbine_with_other_constants_has_what_follows_from_them():
    class Slower(WindTurbine):
        rated_rotor_speed, standstill_tip_speed_ratio = 1.0, 3.0

    assert Slower().revolution == 2.0 * math.pi and Slower().least_tip_speed_ratio == 1.5


def test_error_integral_is_an_exponential_window_of_one_revolution():
    """At constant e_1 the window gives e_2 = e_1(1 − e^{−t/T_r}), T_r = 2π/ω_rated."""
    plant = WindTurbine(horizon=60.0, inertia=FROZEN)
    states = fly(plant, start(1.1, u=11.0), 11.0, (0.0, 0.0))
    e_1 = (N_G * 1.1 - 122.9096) / 20.0
    t = 0.5 * torch.arange(plant.n_steps + 1, dtype=torch.float64)
    expected = e_1 * (1.0 - torch.exp(-t * OMEGA_RATED / (2 * math.pi)))
    # h = 0.5 s/4.96 s: the Runge-Kutta error h⁴/120 = 9e-7 of e_1 at most.
    torch.testing.assert_close(states[:, 3], expected, rtol=0, atol=1e-6)


def test_filters_are_the_exponential_recursion_for_held_inputs():
    """û_{k+1} = α û_k + (1 − α) u_k with α = exp(−2π·0.04·dt)."""
    plant = WindTurbine(horizon=100.0, inertia=FROZEN)
    wind = 8.0 + 6.0 * torch.rand(plant.n_steps, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    initial = start(1.2, u=9.0)
    initial[0, 1] = 80.0
    states = fly(plant, initial, wind, (0.0, 0.0)).numpy()
    alpha, u_hat, omega_hat = math.exp(-2 * math.pi * 0.04 * 0.5), 9.0, 80.0
    for k, u in enumerate(wind.tolist()):
        u_hat, omega_hat = alpha * u_hat + (1 - alpha) * u, alpha * omega_hat + (1 - alpha) * N_G * 1.2
        # h = 0.126: h⁵/120 = 2.6e-7 per step of differences up to 6 m/s and 36 rad/s, summed over 1/(1 − α) = 8 steps.
        assert states[k + 1, 2] == pytest.approx(u_hat, abs=1.3e-5)
        assert states[k + 1, 1] == pytest.approx(omega_hat, abs=8e-5)


def test_no_command_breaks_the_simulation():
    """1000 held commands over a whole episode: braked to standstill, stalled or racing, all stay finite."""
    plant, generator, count = WindTurbine(), seeded(), 1000
    state, wind = plant.draw_initial_state(count, generator), plant.draw_exogenous(count, generator)
    held = random_commands(plant, (count, 1), generator).expand(-1, plant.n_steps, -1)
    with torch.no_grad():
        states = Rollout(plant, plant.closure)(state, wind, held).states
    assert states.isfinite().all()
    omega = states[..., 0]
    # Both ends have been visited: slower than a fifth of rated (cut-in of the generator), and overspeed.
    assert (omega.amin(1) < 0.2 * OMEGA_RATED).sum() > 20 and (omega.amax(1) > 1.2 * OMEGA_RATED).sum() > 20
    assert omega.min() >= 0
    # Beyond the λ where C_p is negative at every pitch, wind and generator both brake: no rotor gets there in its
    # strongest wind, whatever is commanded.
    lam, beta = torch.arange(10.0, 20.0, 0.01).double(), torch.arange(0.0, 30.1, 0.5).double()
    drives = (plant.closure(torch.cartesian_prod(lam, beta)).reshape(len(lam), -1) > 0).any(1)
    runaway = lam[drives].max() + 0.01
    assert (omega.amax(1) <= runaway * wind[..., 0].amax(1) / R).all()


@pytest.mark.parametrize("name, rms", [("Dai2016", 0.091), ("BestFitToROSCOTable", 0.0116)])
def test_distance_to_the_table_is_as_published(c_p, name, rms):
    """λ 3 ... 11 by 0.5 and β 0 ... 20 deg by 1, where the table's C_p is positive: where a turbine is run."""
    points = [(lam, beta) for lam in np.arange(3.0, 11.1, 0.5) for beta in range(21) if c_p(lam, beta) > 0]
    law = SaintDrenan.from_set(name)(torch.tensor(points, dtype=torch.float64)).detach()[:, 0].numpy()
    error = law - np.array([c_p(*point) for point in points])
    # The figures' last digit; the grid is ours, because theirs is not stated.
    assert np.sqrt(np.mean(error**2)) == pytest.approx(rms, abs=0.5 * 10.0 ** -(len(str(rms)) - 2))


def test_law_is_the_published_formula():
    """With the regularised β and all terms active, written once more in numpy."""
    c1, c2, c3, c4, c5, c6, c7, c8, c9, c10, x = c = (0.5, 110.0, 0.4, 0.01, 0.02, 5.0, 20.0, 0.006, 0.08, 0.03, 1.7)
    lam, beta = np.array([5.0, 7.5, 9.0]), np.array([1.0, 4.0, 12.0])
    xi = 1 / (1 / (lam + c9 * beta) - c10 / (beta**3 + 1))
    expected = c1 * (c2 / xi - c3 * beta - c4 * xi * beta - c5 * beta**x - c6) * np.exp(-c7 / xi) + c8 * lam
    found = SaintDrenan(torch.tensor(c, dtype=torch.float64))(torch.tensor(np.stack([lam, beta], -1)))
    # (β² + 1e-4)^{x/2} for β^x: relative x/2·1e-4/β², times c1 c5.
    np.testing.assert_allclose(found.detach().numpy()[:, 0], expected, rtol=0, atol=1e-6)


def test_a_rotor_given_by_its_table_is_judged_by_its_own_optimum():
    """A rotor with 3 % less power, whose optimum lies at 1.25 times the tip-speed ratio."""
    nominal = WindTurbine()
    table = nominal.closure
    own = PowerCoefficientTable(1.25 * table.tip_speed_ratio.numpy(), table.pitch.numpy(), 0.97 * table.values.numpy())
    plant = WindTurbine(closure=own)
    assert plant.best_tip_speed_ratio == pytest.approx(1.25 * nominal.best_tip_speed_ratio, rel=1e-6)
    assert plant.optimal_gain == pytest.approx(nominal.optimal_gain * 0.97 / 1.25**3, rel=1e-6)
    # A law that has no optimum to look up is judged by the NREL rotor's.
    law = WindTurbine(closure=SaintDrenan.from_set("Heier2014"))
    assert (law.optimal_gain, law.best_tip_speed_ratio) == (nominal.optimal_gain, nominal.best_tip_speed_ratio)


# Jonkman's controller against the figures known for it on this rotor, and the gain-scheduled policy against both.


@pytest.fixture(scope="module")
def controller():
    return JonkmanController(WindTurbine())


def test_mean_power_its_deviation_and_top_speed(controller):
    plant, generator = controller.plant, torch.Generator().manual_seed(0)
    winds = plant.draw_exogenous(12, generator)
    flown = controller.fly(plant.draw_initial_state(12, generator), winds)
    merit = plant.merit(flown.states, flown.actions, winds)
    # Known from three other winds of 600 s: 4.20 MW, 1.09 MW and 135 rad/s. Between winds the mean power has a standard
    # deviation of about 0.08 MW and its deviation one of 0.1 MW, so 5 % and 15 % hold means over twelve and three.
    assert merit["mean power [MW]"].mean().item() == pytest.approx(4.20, rel=0.05)
    assert merit["power deviation [MW]"].mean().item() == pytest.approx(1.09, rel=0.15)
    assert merit["top generator speed [rad/s]"].amax().item() == pytest.approx(135.0, rel=0.08)


def test_the_torque_joins_its_regions_continuously(controller):
    calm = torch.zeros(2, dtype=torch.float64)
    for name in ("cut_in_speed", "square_speed", "slip_speed", "constant_power_speed"):
        speed = getattr(controller, name)
        below, above = controller.torque(torch.tensor([speed - 1e-7, speed + 1e-7], dtype=torch.float64), calm)
        # The steepest region has 3e3 N m per rad/s; 2e-7 rad/s are 1e-3 N m.
        assert abs(above - below) < 1e-2
    assert controller.torque(torch.tensor([60.0, 60.0], dtype=torch.float64), calm).tolist() == [0.0, 0.0]


def test_the_pitch_is_the_scheduled_pi_law_by_hand(controller):
    speed, integral, pitch = 130.0, 3.0, math.radians(5.0)
    state = start(speed / N_G, u=15.0, command=(43e3, 5.0))
    command, memory = controller.law(state, double(speed, integral).unsqueeze(0), torch.zeros(1, 1).double())
    integral += 0.5 * (speed - 122.9096)
    expected = (0.01882681 * (speed - 122.9096) + 0.008068634 * integral) / (1.0 + pitch / 0.1099965)
    assert command[0, 1].item() == pytest.approx(math.degrees(expected), rel=1e-6)
    assert memory[0].tolist() == pytest.approx([speed, integral], rel=1e-6)


def nominal(plant):
    policy = GainScheduled(plant, generator=seeded())
    torch.nn.init.zeros_(policy.weights)
    return policy


def observed(plant, omega, beta, rate=0.0):
    """Observation at a fast-filtered speed [rad/s], a pitch [deg] and a speed above the filtered one [rad/s]."""
    state = double(0.0, 0.0, 11.0, 0.0, 0.0, beta, omega)
    state[0] = (omega + rate) / plant.gear_ratio
    return plant.observe(torch.zeros(()).double(), state, double(11.0))


def test_torque_is_the_square_law_far_below_and_constant_power_far_above():
    plant = WindTurbine(observe=("scheduled",))
    policy = nominal(plant)
    # The logistic blend leaves e^-20 of the other region.
    below, above = (policy(observed(plant, omega, 0.0))[0].item() for omega in (100.0, 140.0))
    assert below == pytest.approx(2.332287 * 100.0**2, rel=1e-6)
    assert above == pytest.approx(43_093.55 * 122.9096 / 140.0, rel=1e-6)
    # A pitched blade keeps region 3: at 20 deg the switch lies 20 rad/s lower.
    assert policy(observed(plant, 115.0, 20.0))[0].item() == pytest.approx(43_093.55, rel=1e-6)


@pytest.mark.parametrize(("omega", "rate", "beta"), [(126.0, 0.0, 5.0), (124.5, 0.7, 12.0), (123.0, -0.4, 8.0)])
def test_pitch_moves_by_the_increment_of_the_scheduled_law(omega, rate, beta):
    plant = WindTurbine(observe=("scheduled",))
    push = 1.0787 * 1.570796 * rate + 0.462299 * (omega - 124.5)  # K_P and K_I in degrees
    expected = beta + 0.5 * push / (1.0 + beta / 6.302335)
    # The constants above have seven digits.
    assert nominal(plant)(observed(plant, omega, beta, rate))[1].item() == pytest.approx(expected, rel=1e-5)


# ROSCO's simulator of the same turbine: against our plant, as a real system, and under ROSCO's own controller.


@pytest.fixture(scope="module")
def rosco():
    return pytest.importorskip("rosco")


def flown(plant, command, seed=0):
    """An episode of ROSCO's simulator under a constant command."""
    system = rosco_turbine(plant, seed=seed)
    held = torch.tensor([command], dtype=torch.float64)
    return system.rollout(plant.n_steps, lambda td: td.set("action", held))[0]


@pytest.mark.parametrize("observe", ["paper", "scheduled"])
def test_our_plant_goes_where_rosco_goes(rosco, observe, monkeypatch):
    """Two codes, one turbine: they part by the error of ROSCO's Euler steps, which is of first order."""
    plant = WindTurbine(horizon=60.0, inertia=float(nrel5mw().J), observe=(observe,))
    errors = []
    for step in (0.1, 0.05):
        monkeypatch.setattr(adapter, "STEP", step)
        real = flown(plant, [35e3, 4.0])
        commanded = lambda k, *_, real=real: real["action"][k]  # noqa: E731
        states, *_ = stepped(plant, plant.closure, real["state"][0], real["exogenous"], commanded)
        errors.append(states[-1] - real["next", "state"][-1])
    moved = (real["next", "state"][-1] - real["state"][0]).abs()
    coarse, fine = errors
    assert moved[0] > 0.2 and abs(fine[0]) < 1e-3
    held = [0, 1, 3] if observe == "paper" else [0, 1, 3, 6]
    assert torch.allclose(coarse[held] / fine[held], torch.tensor(2.0).double(), atol=0.1)
    # What is left where the step is taken to zero.
    assert ((2.0 * fine - coarse)[held].abs() < 0.02 * coarse[held].abs()).all()
    assert fine[2].abs() < 1e-4 and (fine[4:6] == 0.0).all()


def test_an_episode_is_known_by_its_seed_and_has_the_plants_wind(rosco):
    plant = WindTurbine(horizon=5.0)
    first, again, other = (flown(plant, [20e3, 0.0], seed) for seed in (1, 1, 2))
    assert torch.equal(first["state"], again["state"]) and not torch.equal(first["state"], other["state"])
    generator = torch.Generator().manual_seed(episode_seed(1, 0))
    plant.draw_initial_state(1, generator)
    assert torch.equal(first["exogenous"], plant.draw_exogenous(1, generator)[0])


@pytest.mark.slow
def test_roscos_controller_holds_the_speed_and_the_power(rosco, capfd):
    """600 s of 11 m/s with 16 % turbulence: some 4.2 MW, as Jonkman's controller, with the speed held at rated."""
    plant = WindTurbine()
    unseen = RealEpisodes(rosco_turbine(plant), 2)
    found = unseen.fly(RoscoController(plant))
    assert not capfd.readouterr().out  # a banner for every episode would push the progress bar off the terminal
    power = plant.generator_power(found.states[:, :-1], found.actions)
    assert found.states.shape == (2, plant.n_steps + 1, 6)
    assert 3.8e6 < power.mean() < 4.6e6
    speed = plant.gear_ratio * found.states[..., 0]
    assert 100.0 < speed.mean() < 125.0 and speed.max() < 1.2 * plant.rated_generator_speed
    # The same winds as a policy gets.
    other = unseen.fly(Constant(35e3, 2.0))
    assert torch.equal(other.exogenous, found.exogenous)
    assert torch.equal(other.states[:, 0, 0], found.states[:, 0, 0])


# The C_p(λ, β) map against scipy's splines, finite differences and the published optimum.


LAM = np.array([2.0, 3.0, 3.5, 5.0, 7.5, 8.0])
BETA = np.array([-2.0, 0.0, 0.5, 4.0, 9.0])


@pytest.fixture(scope="module")
def table() -> PowerCoefficientTable:
    return PowerCoefficientTable.nrel5mw()


def uneven() -> PowerCoefficientTable:
    values = 0.4 - 0.02 * (LAM[:, None] - 6.0) ** 2 - 0.003 * (BETA - 1.0) ** 2 + 0.01 * np.sin(3 * LAM[:, None] + BETA)
    return PowerCoefficientTable(LAM, BETA, values)


def grid(lam, beta) -> torch.Tensor:
    pairs = np.meshgrid(lam, beta, indexing="ij")
    return torch.tensor(np.stack(pairs, axis=-1))


@pytest.mark.parametrize("make", [PowerCoefficientTable.nrel5mw, uneven])
def test_agrees_with_fitpack_between_nodes(make):
    table = make()
    lam, beta = table.tip_speed_ratio.numpy(), table.pitch.numpy()
    oracle = RectBivariateSpline(lam, beta, table.values.numpy(), s=0)  # not-a-knot, by B-splines
    x, y = np.linspace(lam[0], lam[-1], 67), np.linspace(beta[0], beta[-1], 71)
    points = grid(x, y)
    # The same spline in another basis: rounding only, on values up to 12.
    np.testing.assert_allclose(table(points).squeeze(-1).numpy(), oracle(x, y), rtol=0, atol=1e-11)
    points.requires_grad_()
    slopes = torch.autograd.grad(table(points).sum(), points)[0].numpy()
    np.testing.assert_allclose(slopes[..., 0], oracle(x, y, dx=1), rtol=0, atol=1e-10)
    np.testing.assert_allclose(slopes[..., 1], oracle(x, y, dy=1), rtol=0, atol=1e-10)


def test_gradient_in_every_zone_and_across_edges(table):
    """Standstill, stall, the table, overspeed, and pitches on both sides of the table, and the seams between them."""
    lam = torch.tensor([0.0, 0.3, 1.0, 1.4, 2.0, 6.0, 7.3, 14.5, 21.0, 30.0], dtype=torch.float64)
    beta = torch.tensor([-9.0, -5.0, 0.1, 3.2, 5.0, 12.2, 30.0, 45.0, 60.0], dtype=torch.float64)
    # Central differences over a step of 1e-6 straddle the edges; C¹ leaves an error of step times the jump of the
    # second derivative (largest at the last row), below 1e-5.
    for x in torch.cartesian_prod(lam, beta):
        x.requires_grad_()
        assert torch.autograd.gradcheck(table, x, eps=1e-6, atol=1e-5, rtol=1e-5, check_forward_ad=True)


def test_torque_vanishes_at_standstill(table):
    lam = torch.logspace(-1, -8, 8, dtype=torch.float64)
    beta = torch.linspace(-5, 40, 10, dtype=torch.float64)
    torque = table(torch.cartesian_prod(lam, beta)).reshape(8, 10) / lam[:, None]
    # C_p = kλ² there with k = 0.2 C_p(2, β) <= 0.016, so C_p/λ = kλ.
    assert (torque.abs() <= 0.02 * lam[:, None]).all()
    torch.testing.assert_close(torque[-1] * 1e8, torque[0] * 10, rtol=1e-12, atol=0)
    assert (table(double((-0.5, 3.0), (0.0, 3.0), (-40.0, 20.0))) == 0).all()


def test_stall_never_holds_the_rotor_back(table):
    # Within the table's pitch range, C_p > 0 on its first row and so must be all the way down to standstill.
    lam = torch.linspace(0.01, 2.0, 200, dtype=torch.float64)
    beta = torch.linspace(-5, 30, 211, dtype=torch.float64)
    assert table(torch.cartesian_prod(lam, beta)).min() > 0
