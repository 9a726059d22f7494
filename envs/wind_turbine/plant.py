r"""The NREL 5-MW rotor as a plant: one rotating mass, its speed filter and its actuators (paper, section 5.1).

Figures of the machine are those of J. Jonkman et al., *Definition of a 5-MW Reference Wind Turbine for Offshore System
Development*, NREL/TP-500-38060, 2009, where no other source is named.
"""

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine import unknown
from rt_torchrl.envs.wind_turbine.closures import NeuralPowerCoefficient, SaintDrenan
from rt_torchrl.envs.wind_turbine.disturbances import CUT_IN_WIND, KaimalWind, WindModel
from rt_torchrl.envs.wind_turbine.rotor import PowerCoefficientTable
from rt_torchrl.options import NotNegative, Positive, configuration
from rt_torchrl.plants.plant import Plant, RunningCost
from rt_torchrl.plants.policies import SaturatedAffine
from rt_torchrl.plants.sampling import between, lag, require_stable_step
from rt_torchrl.plants.shapes import Action, Actions, Cost, Input, Inputs, State, States, Time
from rt_torchrl.plants.signal import Measurement, Named, Preview, Signal

HUB_INERTIA = 115_926.0
"""Inertia of the hub alone, which the paper prints for J [kg m²]."""
DRIVETRAIN_INERTIA = 38_759_228.0 + 534.116 * 97.0**2
"""Inertia of rotor and generator on the low-speed shaft, 43 784 725 kg m²."""
RATED_ROTOR_SPEED = 1.26711
"""12.1 rpm [rad/s]."""
RATED_GENERATOR_SPEED = 122.9096
"""1173.7 rpm [rad/s]."""
RATED_TORQUE = 43_093.55
"""Rated torque of the generator, the greatest that is commanded [N m]."""
TORQUE_RATE = 15e3
"""Greatest rate of the torque [N m/s]; VS_MaxRat in NREL's ``DISCON.F90``."""
GREATEST_PITCH = 30.0
"""Greatest pitch, the limit of the closure; the machine's is 90 deg [deg]."""
GAMMA_1 = 20.0
"""γ_1, the speed error that counts as one [rad/s]; the paper does not print it."""
FAST_FILTER = 1.570796
"""Corner frequency ω_c of the fast speed filter, 0.25 Hz [rad/s]; CornerFreq in NREL's ``DISCON.F90``."""

# Signals

STATES = (
    Signal(symbol=r"\omega_r", name="rotor_speed", unit="rad/s", low=0.0),
    Signal(symbol=r"\hat\omega_g", name="filtered_generator_speed", unit="rad/s"),
    Signal(symbol=r"\hat u", name="filtered_wind_speed", unit="m/s"),
    Signal(symbol="e_2", name="speed_error_integral", unit="-"),
    Signal(symbol=r"\tau_g", name="generator_torque", unit="N m", low=0.0, high=RATED_TORQUE),
    Signal(symbol=r"\beta", name="blade_pitch", unit="deg", low=0.0, high=GREATEST_PITCH),
)
ERROR_INTEGRAL = Signal(symbol="e_2", name="speed_error_integral", unit="-", low=-1.0, high=1.0)
FAST_SPEED = Signal(symbol=r"\omega_F", name="fast_generator_speed", unit="rad/s")
"""Seventh state of a turbine whose policy observes the speed above rated or its rate."""
WIND = Signal(symbol="u", name="wind_speed", unit="m/s", low=CUT_IN_WIND)
LEADS = (2.0, 4.0, 8.0)
"""Times ahead [s] at which a lidar measures the wind."""


def speed_error(plant: "WindTurbine", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The error e_1 of the filtered generator speed."""
    return plant.speed_error(state[..., 1], state[..., 2])


def speed_rate(plant: "WindTurbine", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The difference ω_g − ω_F [rad/s], which is the rate of ω_F over ω_c."""
    return plant.gear_ratio * state[..., 0] - state[..., 6]


def _of_wind(signal: Signal, read: Preview | None = None) -> Measurement:
    return Measurement.of(signal, read, offset=11.0, scale=3.0)


def _ahead(lead: float) -> Measurement:
    name = f"wind_speed_in_{lead:g}_s"
    return _of_wind(Signal(symbol=rf"u_{{+{lead:g}}}", name=name, unit="m/s", low=CUT_IN_WIND), Preview(0, lead))


LEAST_SPEED, GREATEST_SPEED = RATED_GENERATOR_SPEED - 2.0 * GAMMA_1, RATED_GENERATOR_SPEED + GAMMA_1
ABOVE_RATED = Signal(symbol=r"e_\omega", name="speed_above_rated", unit="rad/s", low=LEAST_SPEED, high=GREATEST_SPEED)
SPEED_RATE = Signal(symbol=r"e_{\dot\omega}", name="speed_rate", unit="rad/s", low=-0.2 * GAMMA_1, high=0.2 * GAMMA_1)
OF_FAST_SPEED = (
    Measurement.of(ABOVE_RATED, Named(FAST_SPEED.name), offset=RATED_GENERATOR_SPEED, scale=GAMMA_1),
    Measurement.of(SPEED_RATE, speed_rate, scale=GAMMA_1),
)
ERRORS = ("speed_error", "speed_error_integral")
INSTRUMENTS = ("rotor_speed", "filtered_generator_speed", "filtered_wind_speed", "generator_torque", "blade_pitch")


def smoothstep(x: Tensor) -> Tensor:
    """A step from 0 at x ≤ 0 to 1 at x ≥ 1 with a continuous slope, x²(3 − 2x) in between."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


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

    The table shows the paper's observation e; ``observe`` chooses others. A policy has no memory, so that the plant
    holds that of a PI law: the pitch that was applied last is its integral, and a faster low-pass of the generator
    speed, :math:`\dot\omega_F = \omega_c(\omega_g - \omega_F)`, gives the rate. This seventh state is there if one of
    ``OF_FAST_SPEED`` is observed.

    Note: the paper prints J = 115 926 kg m²; here J is that of rotor and generator, because 115 926 is the hub alone,
    with which the rotor would follow the wind within 44 ms. ``inertia=HUB_INERTIA`` with a step below 0.12 s shows it.
    Note: the paper prints τ_a with C_p/ω_r; here it has C_p/λ, which is equal where both exist, because a braked rotor
    reaches λ = 0. Note: the paper lets the pitch reach 90 deg; here it reaches 30 deg, the limit of the closure.

    Args:
        dt: control interval [s], 0.5 or 0.25; the paper prints both 0.5 s and 4 Hz.
        horizon: length of an episode T_o [s].
        closure: closure for C_p(λ, β [deg]) of the real rotor; None for the table of the NREL 5-MW rotor. A table gives
            the set-points ω̃_g and P̃ of its own optimum; with any other closure they are those of the NREL 5-MW rotor.
        wind: source of the wind speed.
        inertia: inertia J of the drivetrain on the low-speed shaft [kg m²].
        cost: running cost L_a; None for the paper's.
        observe: names of ``measurements`` and of ``observation_sets``; by default the paper's errors.

    Raises:
        ValueError: for a non-positive inertia, an unknown measurement, or a step that is unstable.
    """

    name = "wind_turbine"
    radius = 63.0  # R [m]
    air_density = 1.225  # ρ [kg/m³]
    gear_ratio = 97.0  # N_g [-]
    rated_power = 5e6  # P_N [W], electrical; at the shaft the rated torque and speed make 5.297 MW
    generator_efficiency = rated_power / (RATED_TORQUE * RATED_GENERATOR_SPEED)  # 94.4 %
    rated_rotor_speed = RATED_ROTOR_SPEED
    rated_wind_speed = 11.4  # [m/s]
    rated_generator_speed = RATED_GENERATOR_SPEED
    minimum_generator_speed = 70.16  # 670 rpm [rad/s]
    filter_frequency = 0.04  # f_c [Hz] (paper, eq. etilde)
    speed_error_scale = GAMMA_1
    cut_in_generator_speed = 20.0  # middle of the band in which the torque sets in [rad/s]; ours, the paper has none
    cut_in_band = 10.0  # half width of that band [rad/s]
    standstill_tip_speed_ratio = 1.0  # λ below which the blades are taken out of the flow [-]; ours
    rate_limits = (TORQUE_RATE, 8.0)  # greatest |dτ_g/dt| [N m/s] and |dβ/dt| [deg/s] of the actuators

    states: tuple[Signal, ...] = STATES
    actions = STATES[4:]
    inputs = (WIND,)
    closure_inputs, closure_outputs = ("tip speed ratio [-]", "blade pitch [deg]"), ("power coefficient [-]",)
    measurements = (
        Measurement(symbol="e_1", name="speed_error", unit="-", low=-1.0, high=1.0, read=speed_error),
        Measurement.of(ERROR_INTEGRAL, Named(ERROR_INTEGRAL.name)),
        Measurement.of(STATES[0], offset=RATED_ROTOR_SPEED, scale=0.2),
        Measurement.of(STATES[1], offset=RATED_GENERATOR_SPEED, scale=GAMMA_1),
        Measurement.of(STATES[2], offset=11.0, scale=3.0),
        Measurement.of(STATES[4], offset=0.5 * RATED_TORQUE, scale=0.5 * RATED_TORQUE),
        Measurement.of(STATES[5], scale=GREATEST_PITCH),
        *OF_FAST_SPEED,
        _of_wind(WIND),
        *map(_ahead, LEADS),
    )
    observation_sets = {
        "paper": ERRORS,
        "errors": (*ERRORS, "rotor_speed"),
        "scheduled": (*ERRORS, "speed_above_rated", "speed_rate", "blade_pitch"),
        "measured": (*ERRORS, *INSTRUMENTS),
        "measured+wind": (*ERRORS, *INSTRUMENTS, "wind_speed"),
        "preview": (*ERRORS, *INSTRUMENTS, "wind_speed", *(f"wind_speed_in_{lead:g}_s" for lead in LEADS)),
    }
    controller_states: tuple[str, ...] = tuple(signal.name for signal in STATES[1:])

    def __init__(
        self,
        *,
        dt: float = 0.5,
        horizon: float = 600.0,
        closure: nn.Module | None = None,
        wind: WindModel | None = None,
        inertia: float = DRIVETRAIN_INERTIA,
        cost: RunningCost | None = None,
        observe: Sequence[str] = (),
    ):
        closure = PowerCoefficientTable.nrel5mw() if closure is None else closure
        super().__init__(dt=dt, horizon=horizon, closure=closure, observe=observe)
        if any(measurement in OF_FAST_SPEED for measurement in self.observed):
            self.states = (*STATES, FAST_SPEED)
            self.controller_states = tuple(signal.name for signal in self.states[1:])
        else:
            self.measurements = tuple(m for m in self.measurements if m not in OF_FAST_SPEED)
        if not inertia > 0:
            raise ValueError(f"inertia={inertia} kg m² must be positive.")
        self.wind = KaimalWind() if wind is None else wind
        self.inertia, self.cost = inertia, PaperCost() if cost is None else cost
        table = closure if isinstance(closure, PowerCoefficientTable) else PowerCoefficientTable.nrel5mw()
        self.best_power_coefficient, self.best_tip_speed_ratio = table.optimum()
        # Gain K [N m s²] of the law τ_g = K ω_g² that holds λ* (paper, eq. tau_g_squared).
        power = 0.5 * self.air_density * math.pi * self.radius**5 * self.best_power_coefficient
        self.optimal_gain = power / (self.best_tip_speed_ratio * self.gear_ratio) ** 3
        self.greatest_increment = nn.Buffer(dt * torch.tensor(self.rate_limits, dtype=torch.float64))
        require_stable_step(
            self.name,
            dt,
            1.0 / self.time_constant(self.rated_wind_speed),
            mode=f"the rotor of inertia {inertia:.6g} kg m²",
            remedy=f"the inertia of the whole drivetrain, {DRIVETRAIN_INERTIA:.6g} kg m²",
        )

    def time_constant(self, wind_speed: float) -> float:
        r"""Time constant −1/(∂ω̇_r/∂ω_r) [s] of the rotor at rated speed, a wind speed [m/s] and fine pitch."""
        omega_r, beta, u = self.greatest_increment.new_tensor([self.rated_rotor_speed, 0.0, wind_speed])
        with torch.enable_grad():
            torque = self.aerodynamic_torque(omega_r.requires_grad_(), beta, u, self.closure)
        (slope,) = torch.autograd.grad(torque, omega_r)
        return -self.inertia / slope.item()

    # The system

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        r"""Rotor acceleration, paper eqs. (first_order_wt) and (tau_a), with the filters of eq. (etilde) as states.

        .. math::
            J\dot\omega_r = \tau_a - N_g\,\tau_g\,\sigma(\omega_g), \quad
            \dot{\hat\omega}_g = 2\pi f_c(N_g\omega_r - \hat\omega_g), \quad
            \dot{\hat u} = 2\pi f_c(u - \hat u), \quad \dot e_2 = (e_1 - e_2)/T_r

        Note: the paper's recursion uses the unfiltered y(t_{k−1}) and α̂ = 0.98; this is the continuous form of that
        with ŷ(t_{k−1}) and α̂ = exp(−2π f_c dt), because the printed one is no low-pass, and 0.98 fits no printed dt.
        Note: the paper integrates e_1 over exactly one revolution; here e_2 integrates it over an exponential window of
        one revolution T_r, because an adjoint can only see states of finite memory.
        """
        omega_r, omega_hat, u_hat, e2 = state[..., :4].unbind(-1)
        (tau_g, beta), u = action.unbind(-1), exogenous[..., 0]  # previews of the wind do not act
        omega_g = self.gear_ratio * omega_r
        tau_a = self.aerodynamic_torque(omega_r, beta, u, closure)
        acceleration = (tau_a - self.gear_ratio * tau_g * self.cut_in(omega_g)) / self.inertia
        cutoff = 2.0 * math.pi * self.filter_frequency
        filters = (cutoff * (omega_g - omega_hat), cutoff * (u - u_hat))
        integral = (self.speed_error(omega_hat, u_hat) - e2) / self.revolution
        held = torch.zeros_like(acceleration)
        rates = torch.stack([acceleration, *filters, integral, held, held], -1)
        # The fast filter is the seventh state, or there is none.
        return torch.cat([rates, FAST_FILTER * (omega_g.unsqueeze(-1) - state[..., 6:])], -1)

    # Computed of other constants, so that a turbine with others of these has its own.
    @property
    def revolution(self) -> float:
        """Time T_r of a revolution at rated speed [s]."""
        return 2.0 * math.pi / self.rated_rotor_speed

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

    def actuate(self, state: State, command: Action) -> Action:
        """The command under rate limits: torque and pitch change from the last action by at most limit times dt."""
        last = state[..., 4:6]
        change = torch.maximum(torch.minimum(command - last, self.greatest_increment), -self.greatest_increment)
        return last + change

    def latch(self, state: State, applied: Action) -> State:
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

    def optimal_torque(self, omega_g: Tensor) -> Tensor:
        """Torque K ω_g² [N m] up to the rated one."""
        return (self.optimal_gain * omega_g**2).clamp(max=RATED_TORQUE)

    def generator_power(self, state: State, applied: Action) -> Tensor:
        """Power at the generator shaft, τ_g ω_g [W]."""
        omega_g = self.gear_ratio * state[..., 0]
        return applied[..., 0] * self.cut_in(omega_g) * omega_g

    def running_cost(self, t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        """The cost of the task: :class:`PaperCost`, :class:`EngineeringCost` or one of the user's."""
        return self.cost(self, t, state, applied, exogenous)

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Scales in which L_p is ½(ω_g − ω̌_g)² [rad²/s²] (paper, eq. assimilation_functional)."""
        return (1.0 / self.gear_ratio, *(math.inf,) * (len(self.states) - 1))

    def merit(self, states: States, applied: Actions, exogenous: Inputs) -> dict[str, Tensor]:
        """Mean and deviation of generator power, RMS of the speed above rated, top speed, and travel of the pitch."""
        speed = self.gear_ratio * states[..., 0]
        power = self.generator_power(states[:, :-1], applied)
        return {
            "mean power [MW]": 1e-6 * power.mean(-1),
            "power deviation [MW]": 1e-6 * power.std(-1),
            "speed above rated [rad/s]": (speed - self.rated_generator_speed).clamp(min=0.0).square().mean(-1).sqrt(),
            "top generator speed [rad/s]": speed.amax(-1),
            "pitch travel [deg/s]": applied[..., 1].diff(dim=-1).abs().mean(-1) / self.dt,
        }

    def setpoints(self, states: State, applied: Action, exogenous: Input) -> dict[str, tuple[Tensor, Tensor]]:
        """Generator speed and power with the references of the paper's cost (paper, eqs. omega_ref and P_ref)."""
        omega_g = self.gear_ratio * states[..., 0]
        return {
            "generator speed [rad/s]": (omega_g, self.reference_speed(states[..., 2])),
            "power [MW]": (1e-6 * self.generator_power(states, applied), 1e-6 * self.reference_power(omega_g)),
        }

    # States that follow from the rotor speed, the actions and the wind

    def complete_states(self, measured: dict[str, Tensor], exogenous: Tensor, actions: Tensor) -> Tensor:
        """All states of a log: its filters, if it has them, else settled at its start; its actions were the last ones.

        A filter is a lag of the held wind, or of the mean of the speeds at both ends of an interval.
        """
        if "rotor_speed" not in measured:
            return super().complete_states(measured, exogenous, actions)
        omega_g, wind = self.gear_ratio * measured["rotor_speed"], exogenous[:, 0]
        constant = 1.0 / (2.0 * math.pi * self.filter_frequency)

        def filtered(name: str, start: Tensor, driving: Tensor, time_constant: float) -> Tensor:
            return measured[name] if name in measured else lag(start, driving, self.dt / time_constant)

        omega_hat = filtered("filtered_generator_speed", omega_g[0], between(omega_g), constant)
        u_hat = filtered("filtered_wind_speed", wind[0], wind, constant)
        e1 = self.speed_error(omega_hat, u_hat)
        e2 = filtered("speed_error_integral", e1[0], between(e1), self.revolution)
        # The action before the record is not known; the first action of the record never meets a rate limit.
        last = torch.cat([actions[:1], actions])
        states = torch.cat([torch.stack([measured["rotor_speed"], omega_hat, u_hat, e2], -1), last], -1)
        if len(self.states) == len(STATES):
            return states
        fast = filtered(FAST_SPEED.name, omega_g[0], between(omega_g), 1.0 / FAST_FILTER)
        return torch.cat([states, fast.unsqueeze(-1)], -1)

    def controller_start(self, measured: Tensor, exogenous: Tensor) -> Tensor:
        """Settled filters, a torque by K ω_g² and blades at 0 deg, in the order of the states."""
        omega_g, wind = self.gear_ratio * measured[..., 0], exogenous[..., 0]
        fast = [omega_g] * (len(self.states) - len(STATES))
        error, torque = self.speed_error(omega_g, wind), self.optimal_torque(omega_g)
        return torch.stack([omega_g, wind, error, torque, torch.zeros_like(wind), *fast], -1)

    # Randomness

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> State:
        """Rotor at 70 % to 100 % of rated speed on the torque law K ω_g², blades at 0 deg, and settled filters."""
        share = 0.7 + 0.3 * torch.rand(batch, generator=generator, dtype=torch.float64, device=generator.device)
        omega_r = share * self.rated_rotor_speed
        omega_g = self.gear_ratio * omega_r
        wind, zero = torch.full_like(omega_r, self.wind.mean), torch.zeros_like(omega_r)
        fast = [omega_g] * (len(self.states) - len(STATES))
        return torch.stack([omega_r, omega_g, wind, zero, self.optimal_torque(omega_g), zero, *fast], -1)

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Inputs:
        """Hub-height wind speed u [m/s], and previews of it."""
        return self.with_previews(self.wind.draw(batch, self.n_steps, self.dt, generator).unsqueeze(-1))

    # What a training begins with

    def make_closure(self, generator: torch.Generator) -> nn.Module:
        """Saint-Drenan's C_p with the coefficients of Dai 2016; nothing is drawn."""
        return SaintDrenan.from_set("Dai2016")

    def make_neural_closure(self, generator: torch.Generator, hidden: Sequence[int]) -> nn.Module:
        """Saint-Drenan's C_p with the coefficients of Dai 2016, plus a perceptron of (λ, β)."""
        return NeuralPowerCoefficient(SaintDrenan.from_set("Dai2016"), hidden=hidden, generator=generator)

    def make_policy(self, generator: torch.Generator, *, bias: bool = False) -> nn.Module:
        """The paper's policy: one affine law per action through the smooth clip, by default without bias."""
        return SaturatedAffine(len(self.observations), self.actions, bias=bias, weight_scale=0.5, generator=generator)

    suspects, further_suspects = unknown.suspects, unknown.further_suspects


@configuration
class PaperCost:
    r"""The cost ½(α_1 e_1² + α_2 e_P²) with e_P = (τ_g ω_g − P̃)/P_N (paper, eq. control_functional_mb).

    Its reference P̃ = min(P_N, K ω_g³) is 4.06 MW at rated speed, so that its optimum gives away some 15 % of the energy
    that Jonkman's controller makes.

    Args:
        speed: weight α1 of the speed error.
        power: weight α2 of the power error.

    Raises:
        ValueError: if a weight is negative.
    """

    speed: NotNegative = 1.0
    power: NotNegative = 1.0

    def __call__(self, plant: WindTurbine, t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        e1 = plant.speed_error(state[..., 1], state[..., 2])
        reference = plant.reference_power(plant.gear_ratio * state[..., 0])
        e_P = (plant.generator_power(state, applied) - reference) / plant.rated_power
        return 0.5 * (self.speed * e1**2 + self.power * e_P**2)


@configuration
class EngineeringCost:
    r"""What the operator of a turbine pays for: energy that is not made, overspeed, and wear of the actuators.

    .. math::
        L_a = 1 - \frac{\min(P, P_d)}{P_d} + \Big(\frac{(P - P_d)_+}{P_d}\Big)^2
        + \Big(\frac{(\omega_g - \omega_{rated})_+}{\gamma_1}\Big)^2
        + w_O\Big(\frac{(\omega_g - \omega_{max})_+}{\gamma_1}\Big)^2
        + w_U\,\sigma\Big(\frac{u - u_{rated}}{0.5\,\mathrm{m/s}}\Big)
            \Big(\frac{(\omega_{rated} - \omega_g)_+}{\gamma_1}\Big)^2
        + w_\beta\Big(\frac{\dot\beta}{1\,\mathrm{deg/s}}\Big)^2
        + w_\tau\Big(\frac{\dot\tau_g}{15\,\mathrm{kN\,m/s}}\Big)^2

    with the power P at the generator shaft, the demanded power P_d, by default the drivetrain's rated 5.297 MW, ω_max =
    1.1 ω_rated, the wind u, and the rates of the actions that are applied. Power above P_d earns nothing. Without w_U a
    policy lets the rotor give its energy where the wind falls short.

    Args:
        underspeed: weight w_U of speed below rated in wind above rated.
        pitch_rate: weight w_β of the blades' rate.
        torque_rate: weight w_τ of the torque's rate.
        power_demand: P_d as a share of rated power [-]. Less than one derates the turbine.

    Raises:
        ValueError: if a weight is negative, or no power is demanded.
    """

    underspeed: NotNegative = 0.0
    pitch_rate: NotNegative = 0.01
    torque_rate: NotNegative = 0.01
    power_demand: Positive = 1.0
    overshoot: ClassVar[float] = 10.0
    """Weight w_O of speed above 110 % of rated, a soft constraint."""

    def __call__(self, plant: WindTurbine, t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        demand = self.power_demand * plant.actions[0].high * plant.rated_generator_speed
        share = plant.generator_power(state, applied) / demand
        above = (plant.gear_ratio * state[..., 0] - plant.rated_generator_speed) / plant.speed_error_scale
        beyond = above - 0.1 * plant.rated_generator_speed / plant.speed_error_scale
        windy = torch.sigmoid((exogenous[..., 0] - plant.rated_wind_speed) / 0.5)
        torque_rate, pitch_rate = ((applied - state[..., 4:6]) / plant.dt).unbind(-1)
        return (
            (1.0 - share.clamp(max=1.0))
            + (share - 1.0).clamp(min=0.0) ** 2
            + above.clamp(min=0.0) ** 2
            + self.overshoot * beyond.clamp(min=0.0) ** 2
            + self.underspeed * windy * above.clamp(max=0.0) ** 2
            + self.pitch_rate * pitch_rate**2
            + self.torque_rate * (torque_rate / TORQUE_RATE) ** 2
        )
