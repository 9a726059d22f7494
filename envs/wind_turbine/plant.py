r"""The NREL 5-MW rotor as a plant: one rotating mass, its speed filter and its actuators (paper, section 5.1)."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine import measurements as sensors
from rt_torchrl.envs.wind_turbine import merit as judgement
from rt_torchrl.envs.wind_turbine.actuators import require_rates
from rt_torchrl.envs.wind_turbine.completion import completed, started
from rt_torchrl.envs.wind_turbine.costs import PaperCost
from rt_torchrl.envs.wind_turbine.disturbances import KaimalWind, WindModel
from rt_torchrl.envs.wind_turbine.models import SaintDrenan
from rt_torchrl.envs.wind_turbine.neural import NeuralPowerCoefficient
from rt_torchrl.envs.wind_turbine.power_coefficient import PowerCoefficientTable
from rt_torchrl.envs.wind_turbine.smoothstep import smoothstep
from rt_torchrl.envs.wind_turbine.suspects import further_suspects, suspects
from rt_torchrl.plants.plant import Plant, RunningCost
from rt_torchrl.plants.policies import SaturatedAffine
from rt_torchrl.plants.sampling import require_stable_step
from rt_torchrl.plants.signal import Signal

DRIVETRAIN_INERTIA = 38_759_228.0 + 534.116 * 97.0**2
"""Inertia of rotor and generator on the low-speed shaft, 43 784 725 kg m² (NREL/TP-500-38060)."""
HUB_INERTIA = 115_926.0
"""Inertia of the hub alone, which the paper prints for J [kg m²]."""


class WindTurbine(Plant):
    r"""Variable-speed, variable-pitch turbine around rated wind speed.

    .. math::
        J\dot\omega_r = \tau_a - N_g\tau_g, \quad
        \tau_a = \tfrac12\rho\pi R^3\,\frac{C_p(\lambda, \beta)}{\lambda}\,u^2, \quad \lambda = \omega_rR/u

    ====  =========================  ==============================================  =======  ======================
    kind  name                       symbol                                          unit     range
    ====  =========================  ==============================================  =======  ======================
    s     rotor_speed                :math:`\omega_r`                                rad/s    positive
    s     filtered_generator_speed   :math:`\hat\omega_g`                            rad/s    positive
    s     filtered_wind_speed        :math:`\hat u`                                  m/s      positive
    s     speed_error_integral       :math:`e_2`                                     -        about [-1, 1]
    s     generator_torque           :math:`\tau_g`, applied in the last interval    N m      0 ... 43 093.55
    s     blade_pitch                :math:`\beta`, applied in the last interval     deg      0 ... 30
    a     generator_torque           :math:`\tau_g`                                  N m      0 ... 43 093.55
    a     blade_pitch                :math:`\beta`                                   deg      0 ... 30
    z     wind_speed                 :math:`u`                                       m/s      at least 3
    e     speed_error                :math:`e_1`                                     -        about [-1, 1]
    e     speed_error_integral       :math:`e_2`                                     -        about [-1, 1]
    ====  =========================  ==============================================  =======  ======================

    The table shows the paper's observation e; ``observe`` chooses others.

    Note: the paper prints J = 115 926 kg m²; here J is that of rotor and generator, because 115 926 is the hub alone,
    with which the rotor would follow the wind within 44 ms. ``inertia=HUB_INERTIA`` with a step below 0.12 s shows it.
    Note: the paper prints τ_a with C_p/ω_r; here it has C_p/λ, which is equal where both exist, because a braked rotor
    reaches λ = 0. Note: the paper lets the pitch reach 90 deg; here it reaches 30 deg, the limit of the closure.

    Args:
        dt: control interval [s], 0.5 or 0.25; the paper prints both 0.5 s and 4 Hz.
        horizon: length of an episode T_o [s].
        closure: closure for C_p(λ, β [deg]) of the real rotor; None for the table of the NREL 5-MW rotor.
        wind: source of the wind speed.
        inertia: inertia J of the drivetrain on the low-speed shaft [kg m²].
        rate_limits: greatest |dτ_g/dt| [N m/s] and |dβ/dt| [deg/s] of the actuators; None for ideal ones.
        cost: running cost L_a, see ``costs.py``; None for the paper's.
        observe: names of measurements and observation sets in ``measurements.py``; by default the paper's errors. A
            seventh state, the fast filter, is there if one of these needs it.

    Raises:
        ValueError: for a non-positive inertia or rate limit, an unknown measurement, or a step
            that is unstable.
    """

    name = "wind_turbine"
    radius = 63.0  # R [m]
    air_density = 1.225  # ρ [kg/m³]
    gear_ratio = 97.0  # N_g [-]
    rated_power = 5e6  # P_N [W]; τ_max·ω_rated = 5.297 MW is mechanical, 5 MW is the electrical target of the paper
    rated_rotor_speed = 1.26711  # [rad/s]
    rated_wind_speed = 11.4  # [m/s]
    rated_generator_speed = sensors.RATED_SPEED
    minimum_generator_speed = 70.16  # [rad/s]
    filter_frequency = 0.04  # f_c [Hz]
    speed_error_scale = sensors.SPEED_SCALE
    cut_in_generator_speed = 20.0  # middle of the band in which the generator torque sets in [rad/s]
    cut_in_band = 10.0  # half width of that band [rad/s]
    standstill_tip_speed_ratio = 1.0  # λ below which the blades are taken out of the flow [-]

    states: tuple[Signal, ...] = sensors.STATES
    actions = sensors.STATES[4:]
    inputs = sensors.INPUTS
    measurements = sensors.MEASUREMENTS
    observation_sets = sensors.OBSERVATION_SETS
    controller_states: tuple[str, ...] = tuple(signal.name for signal in sensors.STATES[1:])
    greatest_increment: Tensor

    def __init__(
        self,
        *,
        dt: float = 0.5,
        horizon: float = 600.0,
        closure: nn.Module | None = None,
        wind: WindModel | None = None,
        inertia: float = DRIVETRAIN_INERTIA,
        rate_limits: tuple[float, float] | None = (15e3, 8.0),
        cost: RunningCost | None = None,
        observe: Sequence[str] = (),
    ):
        table = PowerCoefficientTable.nrel5mw()
        super().__init__(dt=dt, horizon=horizon, closure=table if closure is None else closure, observe=observe)
        if any(measurement in sensors.OF_FAST_SPEED for measurement in self.observed):
            self.states = (*sensors.STATES, sensors.FAST_SPEED)
            self.controller_states = tuple(signal.name for signal in self.states[1:])
        if not inertia > 0:
            raise ValueError(f"inertia={inertia} kg m² must be positive.")
        require_rates(self.actions, rate_limits)
        self.wind = KaimalWind() if wind is None else wind
        self.inertia, self.cost = inertia, PaperCost() if cost is None else cost
        self.best_power_coefficient, self.best_tip_speed_ratio, _ = table.maximum()
        self.optimal_gain = self._optimal_gain()
        limits = (math.inf, math.inf) if rate_limits is None else rate_limits
        self.register_buffer("greatest_increment", torch.tensor(limits, dtype=torch.float64) * dt)
        require_stable_step(
            self.name,
            dt,
            1.0 / self.time_constant(self.rated_wind_speed),
            mode=f"the rotor of inertia {inertia:.6g} kg m²",
            remedy=f"the inertia of the whole drivetrain, {DRIVETRAIN_INERTIA:.6g} kg m²",
        )

    def _optimal_gain(self) -> float:
        r"""Gain K [N m s²] of the law τ_g = K ω_g² that holds λ* (paper, eq. tau_g_squared)."""
        power = 0.5 * self.air_density * math.pi * self.radius**5 * self.best_power_coefficient
        return power / (self.best_tip_speed_ratio * self.gear_ratio) ** 3

    def time_constant(self, wind_speed: float, pitch: float = 0.0) -> float:
        r"""Time constant −1/(∂ω̇_r/∂ω_r) [s] of the rotor at rated speed, a wind speed [m/s] and a pitch [deg]."""
        given = self.greatest_increment.new_tensor([self.rated_rotor_speed, pitch, wind_speed])
        omega_r, beta, u = given.requires_grad_().unbind()
        torque = self.aerodynamic_torque(omega_r, beta, u, self.closure)
        (slope,) = torch.autograd.grad(torque, omega_r)
        return -self.inertia / slope.item()

    # The system

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        action: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        r"""Rotor acceleration, paper eqs. (first_order_wt) and (tau_a), with the filters of eq. (etilde) as states.

        .. math::
            J\dot\omega_r = \tau_a - N_g\,\tau_g\,\sigma(\omega_g), \quad
            \dot{\hat\omega}_g = 2\pi f_c(N_g\omega_r - \hat\omega_g), \quad
            \dot{\hat u} = 2\pi f_c(u - \hat u), \quad \dot e_2 = (e_1 - e_2)/T_r

        Note: the paper's recursion uses the unfiltered y(t_{k−1}) and α̂ = 0.98; this is the continuous form of that
        with ŷ(t_{k−1}) and α̂ = exp(−2π f_c dt), because the printed one is no low-pass, and 0.98 fits no printed dt.
        Note: the paper integrates e_1 over exactly one revolution; here e_2 integrates it over an exponential window of
        one revolution T_r, because an adjoint can only see states of finite memory.

        Args:
            t: time [s], unused; the wind enters through ``exogenous``.
            state: states in the order of the class.
            action: applied generator torque τ_g [N m] and pitch β [deg].
            exogenous: wind speed u [m/s], and previews of it, which do not act.
            closure: closure for C_p(λ, β) [-]: the table in the real plant, the learned law in the twin.
        """
        omega_r, omega_hat, u_hat, e2 = state[..., :4].unbind(-1)
        (tau_g, beta), u = action.unbind(-1), exogenous[..., 0]
        omega_g = self.gear_ratio * omega_r
        tau_a = self.aerodynamic_torque(omega_r, beta, u, closure)
        acceleration = (tau_a - self.gear_ratio * tau_g * self.cut_in(omega_g)) / self.inertia
        cutoff = 2.0 * math.pi * self.filter_frequency
        window = 2.0 * math.pi / self.rated_rotor_speed
        held = torch.zeros_like(acceleration)
        filters = (cutoff * (omega_g - omega_hat), cutoff * (u - u_hat))
        integral = (self.speed_error(omega_hat, u_hat) - e2) / window
        rates = torch.stack([acceleration, *filters, integral, held, held], -1)
        # The fast filter is the seventh state, or there is none.
        return torch.cat([rates, sensors.FAST_FILTER * (omega_g.unsqueeze(-1) - state[..., 6:])], -1)

    @property
    def least_tip_speed_ratio(self) -> float:
        """λ below which the torque divides by this one [-]; it has faded there."""
        return 0.5 * self.standstill_tip_speed_ratio

    def aerodynamic_torque(self, omega_r: Tensor, beta: Tensor, u: Tensor, closure: nn.Module) -> Tensor:
        r"""Torque τ_a = ½ρπR³(C_p/λ)u² [N m], which fades to zero over λ < 1 (standstill), where no closure is defined.

        The fade belongs to the plant, not to the closure: a rotor that hardly turns is in deep stall in the twin too.
        """
        lam = omega_r * self.radius / u
        fade = smoothstep(lam / self.standstill_tip_speed_ratio)
        lam = torch.where(lam > self.least_tip_speed_ratio, lam, self.least_tip_speed_ratio)
        C_p = closure(torch.stack(torch.broadcast_tensors(lam, beta), -1)).squeeze(-1)
        return 0.5 * self.air_density * math.pi * self.radius**3 * fade * C_p / lam * u**2

    def cut_in(self, omega_g: Tensor) -> Tensor:
        """Share of the torque that the generator delivers; it rises over 10 ... 30 rad/s: a generator only brakes."""
        start = self.cut_in_generator_speed - self.cut_in_band
        return smoothstep((omega_g - start) / (2.0 * self.cut_in_band))

    def actuate(
        self, state: Float[Tensor, "*batch n_s"], command: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch 2"]:
        """The command under rate limits: torque and pitch change from the last action by at most limit times dt."""
        last = state[..., 4:6]
        change = torch.maximum(torch.minimum(command - last, self.greatest_increment), -self.greatest_increment)
        return last + change

    def latch(
        self, state: Float[Tensor, "*batch n_s"], applied: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch n_s"]:
        """Remember the applied action for the rate limits of the next interval."""
        return torch.cat([state[..., :4], applied, state[..., 6:]], -1)

    # The control problem

    def speed_error(self, omega_hat: Tensor, u_hat: Tensor) -> Tensor:
        r"""The error e_1 = (ω̂_g − ω̃_g)/γ_1 with ω̃_g = N_g λ* û/R between its limits (paper, eq. omega_ref)."""
        return (omega_hat - self.reference_speed(u_hat)) / self.speed_error_scale

    def reference_speed(self, u_hat: Tensor) -> Tensor:
        """Reference ω̃_g of the generator speed [rad/s] at a filtered wind speed û [m/s]."""
        best = self.gear_ratio * self.best_tip_speed_ratio * u_hat / self.radius
        return best.clamp(self.minimum_generator_speed, self.rated_generator_speed)

    def reference_power(self, omega_g: Tensor) -> Tensor:
        """Reference P̃ = min(P_N, K ω_g³) of the power [W] (paper, eq. P_ref)."""
        return (self.optimal_gain * omega_g**3).clamp(max=self.rated_power)

    def generator_power(self, state: Float[Tensor, "*batch n_s"], applied: Float[Tensor, "*batch 2"]) -> Tensor:
        """Power at the generator shaft, τ_g ω_g [W]."""
        omega_g = self.gear_ratio * state[..., 0]
        return applied[..., 0] * self.cut_in(omega_g) * omega_g

    def running_cost(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch"]:
        """The cost of the task, see ``costs.py``."""
        return self.cost(self, t, state, applied, exogenous)

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Scales in which L_p is ½(ω_g − ω̌_g)² [rad²/s²] (paper, eq. assimilation_functional)."""
        return (1.0 / self.gear_ratio, *(math.inf,) * (len(self.states) - 1))

    merit, setpoints, controller_start = judgement.merit, judgement.setpoints, started
    suspects, further_suspects = suspects, further_suspects

    def complete_states(self, measured: dict[str, Tensor], exogenous: Tensor, actions: Tensor) -> Tensor:
        """All states from the rotor speed: the filters start settled, and the last actions are those of the record."""
        if "rotor_speed" not in measured:
            return super().complete_states(measured, exogenous, actions)
        return completed(self, measured, exogenous, actions)

    # Randomness

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        """Rotor at 70 % to 100 % of rated speed on the torque law K ω_g², blades at 0 deg, and settled filters."""
        share = 0.7 + 0.3 * torch.rand(batch, generator=generator, dtype=torch.float64, device=generator.device)
        omega_r = share * self.rated_rotor_speed
        omega_g = self.gear_ratio * omega_r
        wind = torch.full_like(omega_r, self.wind.mean)
        zero = torch.zeros_like(omega_r)
        torque = (self.optimal_gain * omega_g**2).clamp(max=self.actions[0].high)
        fast = [omega_g] * (len(self.states) - len(sensors.STATES))
        return torch.stack([omega_r, omega_g, wind, zero, torque, zero, *fast], -1)

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps n_z"]:
        """Hub-height wind speed u [m/s], and previews of it."""
        return self.with_previews(self.wind.draw(batch, self.n_steps, self.dt, generator).unsqueeze(-1))

    def make_closure(self, generator: torch.Generator) -> nn.Module:
        """Saint-Drenan's C_p with the coefficients of Dai 2016; nothing is drawn."""
        return SaintDrenan.from_set("Dai2016")

    def make_neural_closure(self, generator: torch.Generator, hidden: Sequence[int]) -> nn.Module:
        """Saint-Drenan's C_p with the coefficients of Dai 2016, plus a perceptron of (λ, β)."""
        return NeuralPowerCoefficient(SaintDrenan.from_set("Dai2016"), hidden=hidden, generator=generator)

    def make_policy(self, generator: torch.Generator, *, bias: bool = False) -> nn.Module:
        """The paper's policy: one affine law per action through the smooth clip, by default without bias."""
        return SaturatedAffine(len(self.observations), self.actions, bias=bias, weight_scale=0.5, generator=generator)
