"""The NREL 5-MW plant against closed forms, an independent torque balance and published figures."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import brentq
from torch import nn

from rt_torchrl.envs.wind_turbine import plant as module
from rt_torchrl.envs.wind_turbine.closures import SaintDrenan
from rt_torchrl.envs.wind_turbine.disturbances import KaimalWind
from rt_torchrl.envs.wind_turbine.plant import HUB_INERTIA, PaperCost, WindTurbine
from rt_torchrl.envs.wind_turbine.rotor import PowerCoefficientTable
from rt_torchrl.plants.policies import SmoothClip
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


def steady(u):
    return KaimalWind(mean=u, intensity=0.0)


def start(plant, omega, *, u, command=(0.0, 0.0)):
    """A state with settled filters and the actuators at the command."""
    return torch.tensor([[omega, N_G * omega, u, 0.0, *command]], dtype=torch.float64)


def fly(plant, state, u, command):
    wind = torch.as_tensor(u, dtype=torch.float64).reshape(1, -1, 1)
    wind = wind.expand(1, plant.n_steps, 1)
    held = torch.tensor(command, dtype=torch.float64).expand(1, plant.n_steps, 2)
    with torch.no_grad():
        return Rollout(plant, plant.closure)(state, wind, held).states[0]


def test_time_constant_of_the_drivetrain(c_p):
    found = WindTurbine().time_constant(11.4)
    h = 1e-5
    slope = (torque(c_p, OMEGA_RATED + h, 0.0, 11.4) - torque(c_p, OMEGA_RATED - h, 0.0, 11.4)) / (2 * h)
    # Central difference of a spline: h² of its curvature, and rounding 1e-16/1e-5.
    assert found == pytest.approx(-J / slope, rel=1e-6)
    assert found == pytest.approx(16.5, rel=0.05)  # the expected figure, from the published inertia, to two digits


def test_hub_inertia_is_refused_at_the_papers_step_and_runs_at_a_tenth():
    message = (
        r"dt=0\.5 s makes plant 'wind_turbine' unstable: the rotor of inertia 115926 kg m² decays at .* 1/s, .*"
        r"Use dt <= 0\.12\d* s, or the inertia of the whole drivetrain, 4\.37847e\+07 kg m²"
    )
    with pytest.raises(ValueError, match=message):
        WindTurbine(inertia=HUB_INERTIA)
    plant = WindTurbine(inertia=HUB_INERTIA, dt=0.1, horizon=60.0)
    # The note in the class: the rotor would follow the wind within 44 ms.
    assert plant.time_constant(11.4) == pytest.approx(0.044, abs=5e-4)


@pytest.mark.parametrize("u, beta, tau_g, bracket", [(12.0, 5.0, 30e3, (0.9, 2.0)), (15.0, 11.0, 40e3, (0.9, 2.0))])
def test_settles_where_the_torques_balance(c_p, u, beta, tau_g, bracket):
    root = brentq(lambda omega: torque(c_p, omega, beta, u) - N_G * tau_g, *bracket, xtol=1e-12)
    plant = WindTurbine(horizon=1200.0, wind=steady(u))
    end = fly(plant, start(plant, 1.05 * root, u=u, command=(tau_g, beta)), u, (tau_g, beta))[-1]
    # 1200 s are above 40 time constants there; what is left is the agreement of the splines, 1e-11.
    assert end[0].item() == pytest.approx(root, rel=1e-8)
    assert end[1].item() == pytest.approx(N_G * root, rel=1e-8)


def test_optimal_gain_takes_the_greatest_power(c_p):
    """At λ* the law K ω_g² draws ½ρπR²C_p,max u³, and the rotor keeps its speed."""
    plant, u = WindTurbine(wind=steady(8.0)), 8.0
    lam = np.linspace(7.0, 8.2, 12_001)
    powers = np.array([c_p(x, 0.0) for x in lam])
    best, lam_best = powers.max(), lam[powers.argmax()]
    omega_g = N_G * lam_best * u / R
    # Grid spacing 1e-4 in λ: 1e-4/7.6 in λ³ three times over.
    assert plant.optimal_gain * omega_g**3 == pytest.approx(0.5 * RHO * math.pi * R**2 * best * u**3, rel=1e-4)
    command = (plant.optimal_gain * omega_g**2, 0.0)
    end = fly(plant, start(plant, omega_g / N_G, u=u, command=command), u, command)[-1]
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


def test_cost_counts_speed_and_power_errors():
    """e_1 = 0.1 and e_P = −0.2, put together by hand: ½(2·0.01 + 3·0.04)."""
    plant = WindTurbine(cost=PaperCost(speed=2.0, power=3.0))
    omega = OMEGA_RATED
    power = min(5e6, plant.optimal_gain * (N_G * omega) ** 3) - 0.2 * 5e6
    applied = torch.tensor([[power / (N_G * omega), 0.0]], dtype=torch.float64)
    state = start(plant, omega, u=15.0)
    state[0, 1] = 122.9096 + 0.1 * 20.0
    cost = plant.running_cost(torch.zeros(1).double(), state, applied, torch.full((1, 1), 15.0).double())
    assert cost.item() == pytest.approx(0.5 * (2.0 * 0.01 + 3.0 * 0.04), rel=1e-12)


def test_error_integral_is_an_exponential_window_of_one_revolution():
    """At constant e_1 the window gives e_2 = e_1(1 − e^{−t/T_r}), T_r = 2π/ω_rated."""
    plant = WindTurbine(horizon=60.0, inertia=FROZEN)
    states = fly(plant, start(plant, 1.1, u=11.0), 11.0, (0.0, 0.0))
    e_1 = (N_G * 1.1 - 122.9096) / 20.0
    t = 0.5 * torch.arange(plant.n_steps + 1, dtype=torch.float64)
    expected = e_1 * (1.0 - torch.exp(-t * OMEGA_RATED / (2 * math.pi)))
    # h = 0.5 s/4.96 s: the Runge-Kutta error h⁴/120 = 9e-7 of e_1 at most.
    torch.testing.assert_close(states[:, 3], expected, rtol=0, atol=1e-6)


def test_filters_are_the_exponential_recursion_for_held_inputs():
    """û_{k+1} = α û_k + (1 − α) u_k with α = exp(−2π·0.04·dt)."""
    plant = WindTurbine(horizon=100.0, inertia=FROZEN)
    wind = 8.0 + 6.0 * torch.rand(plant.n_steps, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    initial = start(plant, 1.2, u=9.0)
    initial[0, 1] = 80.0
    states = fly(plant, initial, wind, (0.0, 0.0)).numpy()
    alpha, u_hat, omega_hat = math.exp(-2 * math.pi * 0.04 * 0.5), 9.0, 80.0
    for k, u in enumerate(wind.tolist()):
        u_hat, omega_hat = alpha * u_hat + (1 - alpha) * u, alpha * omega_hat + (1 - alpha) * N_G * 1.2
        # h = 0.126: h⁵/120 = 2.6e-7 per step of differences up to 6 m/s and 36 rad/s, summed over 1/(1 − α) = 8 steps.
        assert states[k + 1, 2] == pytest.approx(u_hat, abs=1.3e-5)
        assert states[k + 1, 1] == pytest.approx(omega_hat, abs=8e-5)


class ManyAffine(nn.Module):
    """One random affine policy per row of the batch, through the smooth clip."""

    def __init__(self, count, scale, actions, generator):
        super().__init__()
        self.weight = scale * torch.randn(count, len(actions), 2, generator=generator, dtype=torch.float64)
        self.bias = scale * torch.randn(count, len(actions), generator=generator, dtype=torch.float64)
        self.clip = SmoothClip(actions)

    def forward(self, observation):
        return self.clip((self.weight * observation.unsqueeze(-2)).sum(-1) + self.bias)


def test_no_policy_breaks_the_simulation(unchecked):
    """1000 random policies over a whole episode: braked to standstill, stalled or racing, all stay finite."""
    plant, generator, count = WindTurbine(), torch.Generator().manual_seed(0), 1000
    policy = ManyAffine(count, 10.0, plant.actions, generator)
    with torch.no_grad():
        state, wind = plant.draw_initial_state(count, generator), plant.draw_exogenous(count, generator)
        states = Rollout(plant, plant.closure, policy)(state, wind).states
    assert states.isfinite().all()
    omega = states[..., 0]
    # Both ends have been visited: slower than a fifth of rated (cut-in of the generator), and overspeed.
    assert (omega.amin(1) < 0.2 * OMEGA_RATED).sum() > 20 and (omega.amax(1) > 1.2 * OMEGA_RATED).sum() > 20
    assert omega.min() >= 0
    # Beyond the λ where C_p is negative at every pitch, wind and generator both brake: no rotor gets there in its
    # strongest wind, whatever the policy does.
    lam, beta = torch.arange(10.0, 20.0, 0.01).double(), torch.arange(0.0, 30.1, 0.5).double()
    drives = (plant.closure(torch.cartesian_prod(lam, beta)).reshape(len(lam), -1) > 0).any(1)
    runaway = lam[drives].max() + 0.01
    assert (omega.amax(1) <= runaway * wind[..., 0].amax(1) / R).all()


def test_published_peak_of_dai_2016():
    lam = torch.linspace(3.0, 12.0, 9001, dtype=torch.float64)
    power = SaintDrenan.from_set("Dai2016")(torch.stack([lam, torch.zeros_like(lam)], -1)).detach()[:, 0]
    # The figures' digits.
    assert power.max().item() == pytest.approx(0.4615, abs=5e-5)
    assert lam[power.argmax()].item() == pytest.approx(6.4, abs=0.05)


@pytest.mark.parametrize("name, rms", [("Dai2016", 0.091), ("BestFitToROSCOTable", 0.0116)])
def test_distance_to_the_table_is_as_published(c_p, name, rms):
    """λ 3 ... 11 by 0.5 and β 0 ... 20 deg by 1, where the table's C_p is positive: where a turbine is run."""
    points = [(lam, beta) for lam in np.arange(3.0, 11.1, 0.5) for beta in range(21) if c_p(lam, beta) > 0]
    law = SaintDrenan.from_set(name)(torch.tensor(points, dtype=torch.float64)).detach()[:, 0].numpy()
    error = law - np.array([c_p(*point) for point in points])
    # The figures' last digit; the grid is ours, because theirs is not stated.
    assert np.sqrt(np.mean(error**2)) == pytest.approx(rms, abs=0.5 * 10.0 ** -(len(str(rms)) - 2))


def scaled_gradcheck(closure, *points):
    features = torch.tensor(points, dtype=torch.float64, requires_grad=True)
    # Differences of a function of order one: rounding 1e-10; its third derivative is below 1e3 away from β = 0.
    return torch.autograd.gradcheck(
        lambda x, w: torch.func.functional_call(closure, {"scaled": w}, (x,)),
        (features, closure.scaled.detach().clone().requires_grad_()),
        eps=1e-6,
        atol=1e-5,
        rtol=1e-5,
        check_forward_ad=True,
    )


@pytest.mark.parametrize("name", ["Dai2016", "Slootweg2003", "Heier2014"])
def test_law_is_differentiable_down_to_fine_pitch(name):
    closure = SaintDrenan.from_set(name)
    assert scaled_gradcheck(closure, (6.0, 0.0), (8.0, 0.5), (4.0, 12.0), (11.0, 30.0))


def test_law_is_the_published_formula():
    """With the regularised β and all terms active, written once more in numpy."""
    c1, c2, c3, c4, c5, c6, c7, c8, c9, c10, x = c = (0.5, 110.0, 0.4, 0.01, 0.02, 5.0, 20.0, 0.006, 0.08, 0.03, 1.7)
    lam, beta = np.array([5.0, 7.5, 9.0]), np.array([1.0, 4.0, 12.0])
    xi = 1 / (1 / (lam + c9 * beta) - c10 / (beta**3 + 1))
    expected = c1 * (c2 / xi - c3 * beta - c4 * xi * beta - c5 * beta**x - c6) * np.exp(-c7 / xi) + c8 * lam
    found = SaintDrenan(torch.tensor(c, dtype=torch.float64))(torch.tensor(np.stack([lam, beta], -1)))
    # (β² + 1e-4)^{x/2} for β^x: relative x/2·1e-4/β², times c1 c5.
    np.testing.assert_allclose(found.detach().numpy()[:, 0], expected, rtol=0, atol=1e-6)


def test_exponent_stays_above_one_whatever_the_weight():
    closure = SaintDrenan.from_set("Dai2016")
    for weight in (-30.0, -5.0, 3.0):
        with torch.no_grad():
            closure.scaled[-1] = weight
        assert closure.coefficients[-1].item() > 1.0
        assert closure(torch.tensor([[7.0, 0.0]], dtype=torch.float64)).isfinite().all()
    with pytest.raises(ValueError, match=r"x=1\.0 must be above 1"):
        SaintDrenan(torch.ones(11, dtype=torch.float64))
    with pytest.raises(ValueError, match="set 'Nobody2000' of coefficients does not exist; choose one of Slootweg2003"):
        SaintDrenan.from_set("Nobody2000")


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
