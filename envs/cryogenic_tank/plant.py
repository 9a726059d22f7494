r"""The cryogenic tank as a plant: a wall, a saturated mixture and a thermodynamic vent (paper, section 5.3)."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.cryogenic_tank import unknown
from rt_torchrl.envs.cryogenic_tank.closures import ConstantCoefficients, CubicVentLaw, NeuralCoefficients
from rt_torchrl.envs.cryogenic_tank.disturbances import CyclicLoad
from rt_torchrl.envs.cryogenic_tank.saturation import Properties, Saturation
from rt_torchrl.options import NotNegative, configuration
from rt_torchrl.plants.plant import Plant, RunningCost
from rt_torchrl.plants.sampling import DisturbanceModel, require_stable_step
from rt_torchrl.plants.shapes import Action, Actions, Cost, Input, Inputs, Scalar, State, States, Time
from rt_torchrl.plants.signal import Measurement, Phase, Signal

EXCHANGER_AREA = 200 * math.pi * 0.005 * 2.0
"""A_HX = 6.28 m²: 200 tubes of 5 mm by 2 m."""
LAMINAR_DROP = 100.0
"""δ [Pa]: pressure drop below which the flow through the valve is laminar."""
ROUNDING_DROP = 1.0
"""Pressure drop [Pa] below which a difference of two temperatures is no more accurate than their slope."""
GREATEST_DROP = 200e3
"""Δp_max [Pa], the pressure drop of the open valve."""
SETTLED_SHARE = 0.6
"""Share of an episode after which the pressure should be held: three of five days."""
BAND = 5e3
"""Half width [Pa] of the band in which the pressure should be held."""
ERROR_SIZES = (0.05, 0.05, 1e3)
"""Errors of T_s [K], V_l [m³] and p [Pa] that weigh the same in J_p, α_3 = 0.05⁻² K⁻² and so on."""
STATES = (
    Signal(symbol="T_s", name="wall_temperature", unit="K", low=0.0),
    Signal(symbol="V_l", name="liquid_volume", unit="m³", low=0.0, high=60.0),
    Signal(symbol="p", name="pressure", unit="Pa", low=80e3, high=900e3),
)
LOAD = Signal(symbol="Q_h", name="heat_load", unit="W", low=0.0)
COMMANDS = {
    "drop": Signal(symbol=r"\Delta p_V", name="valve_drop", unit="Pa", low=0.0, high=GREATEST_DROP),
    "duty": Signal(symbol="d", name="duty_cycle", unit="-", low=0.0, high=1.0),
}
"""The drop of a valve that is held half open, and the duty cycle of a valve that is either shut or open."""
COSINE, SINE = Phase("cosine", CyclicLoad.period), Phase("sine", CyclicLoad.period)
"""Phase of the orbit; its cosine is −1 at the peak of the load."""
MEASURED = ("pressure_error", "superheat", "liquid_volume")


@runtime_checkable
class TankCost(RunningCost, Protocol):
    """A running and a terminal cost of the tank, of any batch dimensions; neither must be negative."""

    def terminal(self, plant: "CryogenicTank", state: State) -> Cost: ...


@configuration
class PressureCost:
    r"""The paper's cost α_1 e² + α_2 ṁ_c (paper, eq. cryo_J_a), and the cost T_e e² of the pressure at the end.

    Without the latter the optimum stops venting 12 h before the end, because nobody pays for the pressure that it
    leaves.

    Note: in the paper ṁ_c is that of the twin's own valve; here it is that of a valve with the rated K_JT, in the
    real plant and in the twin, because a cost is a function of state and action alone.

    Args:
        error: weight α1 [-] of the pressure error e in 10 kPa.
        vented: weight α2 [s/kg] of the vented mass. With 5000 s/kg it weighs a tenth of the tracking error under the
            random policies that a training starts from.
        end: weight T_e [s] of the pressure error at the end, which costs as much as if it lasted for that time.

    Raises:
        ValueError: if a weight is negative or not finite.
    """

    error: NotNegative = 1.0
    vented: NotNegative = 5000.0
    end: NotNegative = 0.0

    def __call__(self, plant: "CryogenicTank", t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        p, (open_drop, share) = state[..., 2], plant.opening(applied[..., 0])
        drop = p - plant.valve_outlet(p, open_drop)
        flow = share * drop * valve_conductance(drop, torch.full_like(drop, plant.rated_valve))
        e = (p - plant.set_point) / plant.error_unit
        return self.error * e**2 + self.vented * flow

    def terminal(self, plant: "CryogenicTank", state: State) -> Cost:
        return self.end * ((state[..., 2] - plant.set_point) / plant.error_unit) ** 2


class Vent(NamedTuple):
    """The flow and the heat that the vent takes from the tank."""

    flow: Tensor  # ṁ_c [kg/s]
    heat: Tensor  # Q_HX [W], positive: it cools the liquid


class Conditions(NamedTuple):
    """The quantities in one state from which the rates follow."""

    tank: Properties
    slope: Properties  # slopes of the tank's properties, per Pa
    wall_conductance: Tensor  # U_s A_s [W/K]
    vent: Vent


# What sensors and clock give; the wall's temperature is told by its superheat.


def pressure_error(plant: "CryogenicTank", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The error p − p̃ [Pa]."""
    return state[..., 2] - plant.set_point


def superheat(plant: "CryogenicTank", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The wall's temperature above that of the fluid, T_s − T(p) [K]."""
    return state[..., 0] - plant.saturation(state[..., 2]).T


def clock(plant: "CryogenicTank", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The share of the episode that has passed."""
    return t / plant.horizon


class CryogenicTank(Plant):
    r"""A tank of liquid hydrogen in orbit, held at pressure by venting as little of it as possible.

    The wall and the saturated mixture have these balances; H = ρh, and all properties are functions of p alone:

    .. math::
        m_sc_s\dot T_s = Q_h - Q_{sf}, \qquad Q_{sf} = U_sA_s\,(T_s - T),

        \frac{d}{dt}\big[\rho_v(V_t - V_l) + \rho_lV_l\big] = -\dot m_c, \qquad
        \frac{d}{dt}\big[H_v(V_t - V_l) + H_lV_l\big] = Q_{sf} + V_t\dot p - \dot m_ch_l - Q_{HX}

    ====  =================  =============================================  =====  =========================
    kind  name               symbol                                         unit   range
    ====  =================  =============================================  =====  =========================
    s     wall_temperature   :math:`T_s`                                    K      about T … T + 0.1
    s     liquid_volume      :math:`V_l`                                    m³     0 … 60
    s     pressure           :math:`p`                                      Pa     80e3 … 900e3
    a     valve_drop         :math:`\Delta p_V = p - p_1`                   Pa     0 … 200e3
    z     heat_load          :math:`Q_h`                                    W      about 0 … 370
    e     pressure_error     :math:`e = (p - \tilde p)/10\,\mathrm{kPa}`    -      about ±15
    ====  =================  =============================================  =====  =========================

    The table shows the paper's action a and observation e; ``command`` and ``observe`` choose others.

    A pressure outside the range makes the rates NaN, which the library reports as a ``DivergenceError``.

    Note: the paper prints no mass of the wall; here m_s c_s is 500 kJ/K, because a bare shell of aluminium at 27 K
    (20 kJ/K) follows the load within 5 s, too fast for an explicit step of 30 s.
    Note: the paper prints U_s per area but no area; here A_s is 74.1 m², that of a sphere of 60 m³.

    U_s must stay below 2.785 m_s c_s/(A_s dt) = 626 W/(m² K), see :meth:`wall_rate`. The plant
    checks the true closure; the twin starts far below the limit and diverges with an error if training exceeds it.

    Args:
        dt: control interval [s].
        horizon: length of an episode T_o [s].
        closure: closure of the real tank, from :meth:`features` to U_s, U_HX, K_JT; None for the paper's constants.
        load: source of the heat load.
        fluid: pure fluid in the tank, one of those of :mod:`saturation`.
        cost: running and terminal cost of J_a; None for the paper's.
        command: action: the drop of a valve that is held half open, or the duty cycle of a valve that is either shut or
            open. A half-open valve takes less heat per mass that it vents.
        observe: names of ``measurements`` and ``observation_sets``; by default the paper's error.

    Raises:
        ValueError: for an unknown fluid or command, or a wall that is too fast for the step.
    """

    name = "cryogenic_tank"

    volume = 60.0  # V_t [m³]
    first_fill = 0.7  # V_l/V_t at the start
    set_point = 500e3  # p̃ [Pa]
    first_pressure_spread = 25e3  # standard deviation of p(0) [Pa]
    error_unit = 10e3  # [Pa]
    wall_area = 74.1  # A_s [m²]
    wall_heat_capacity = 500e3  # m_s c_s [J/K]
    back_pressure = STATES[2].low  # least p_1 [Pa], held by a regulator at the end of the vent line
    superheat_unit = 0.05  # typical T_s − T [K]
    rated_valve = ConstantCoefficients.true_coefficients[2]  # K_JT of the valve's data sheet, for the cost [Pa s²/kg²]

    states = STATES
    actions: tuple[Signal, ...] = (COMMANDS["drop"],)
    inputs = (LOAD,)
    closure_inputs = ("p over the set point [-]", "V_l over V_t [-]", "T_s - T [0.05 K]", "drop over the greatest [-]")
    closure_outputs = tuple(f"{name} [{unit}]" for name, unit in ConstantCoefficients.names.items())
    measurements = (
        Measurement(symbol="e", name="pressure_error", unit="Pa", read=pressure_error, scale=error_unit),
        Measurement(symbol="T_s - T", name="superheat", unit="K", read=superheat, scale=superheat_unit),
        Measurement.of(STATES[1], offset=42.0, scale=6.0),
        Measurement(symbol="t/T_o", name="clock", unit="-", low=0.0, high=1.0, read=clock, offset=0.5, scale=0.5),
        Measurement(symbol=r"\cos 2\pi t/T_h", name="orbit_cosine", unit="-", low=-1.0, high=1.0, read=COSINE),
        Measurement(symbol=r"\sin 2\pi t/T_h", name="orbit_sine", unit="-", low=-1.0, high=1.0, read=SINE),
        Measurement.of(LOAD, offset=130.0, scale=100.0),
    )
    observation_sets = {
        "paper": ("pressure_error",),
        "errors": ("pressure_error",),
        "clock": ("pressure_error", "clock"),
        "phase": ("pressure_error", "orbit_cosine", "orbit_sine"),
        "measured": MEASURED,
        "measured+load": (*MEASURED, "clock", "orbit_cosine", "orbit_sine", "heat_load"),
    }
    """The paper's error; this with the time of the episode; with the phase of the orbit; all states; and all states
    with both times and the load."""

    def __init__(
        self,
        *,
        dt: float = 30.0,
        horizon: float = 4.32e5,
        closure: nn.Module | None = None,
        load: DisturbanceModel | None = None,
        fluid: str = "Hydrogen",
        cost: TankCost | None = None,
        command: Literal["drop", "duty"] = "drop",
        observe: Sequence[str] = (),
    ):
        constants = ConstantCoefficients.true() if closure is None else closure
        super().__init__(dt=dt, horizon=horizon, closure=constants, observe=observe)
        if command not in COMMANDS:
            raise ValueError(f"command={command!r} does not exist; choose one of {', '.join(COMMANDS)}.")
        self.load = CyclicLoad() if load is None else load
        self.command, self.actions = command, (COMMANDS[command],)
        self.cost = PressureCost() if cost is None else cost
        self.saturation = Saturation(fluid)
        rate = self.wall_rate(self.closure)
        require_stable_step(self.name, dt, rate, mode="the wall", remedy="a closure with a smaller U_s")

    @torch.no_grad()
    def wall_rate(self, closure: nn.Module) -> float:
        """Decay rate U_s A_s/(m_s c_s) [1/s] of a closure's wall at the set point and at the fluid's temperature."""
        state = self.state_at(self.saturation.table.new_tensor(self.set_point))
        now = self.conditions(state, torch.zeros_like(state[:1]), closure)
        return now.wall_conductance.item() / self.wall_heat_capacity

    def state_at(self, p: Scalar) -> State:
        """The state at p [Pa] with the first fill and a wall as cold as the fluid; p must be within the table."""
        self.saturation.check(p)
        return torch.stack([self.saturation(p).T, torch.full_like(p, self.first_fill * self.volume), p], -1)

    # The valve

    def opening(self, action: Scalar) -> tuple[Scalar, Scalar]:
        """Pressure drop [Pa] of the valve while it is open, and the share of the interval in which it is open."""
        if self.command == "duty":
            return torch.full_like(action, GREATEST_DROP), action
        return action, torch.ones_like(action)

    def action_of(self, drop: Tensor) -> Tensor:
        """The action that a controller of the pressure drop [Pa] asks for."""
        return drop / GREATEST_DROP if self.command == "duty" else drop

    def valve_outlet(self, p: Scalar, drop: Scalar) -> Scalar:
        """The pressure p_1 = p − Δp_V [Pa] behind the valve, not below the back pressure of the vent line."""
        return torch.where(p - drop < self.back_pressure, self.back_pressure, p - drop)

    # The system

    def features(self, state: State, action: Action, T: Scalar) -> Float[Tensor, "*batch 4"]:
        """The features of a closure, all of order one: p/p̃, V_l/V_t, (T_s − T)/0.05 K and Δp_V/Δp_max."""
        T_s, V_l, p = state.unbind(-1)
        superheat, (drop, _) = (T_s - T) / self.superheat_unit, self.opening(action[..., 0])
        return torch.stack([p / self.set_point, V_l / self.volume, superheat, drop / GREATEST_DROP], -1)

    def conditions(self, state: State, action: Action, closure: nn.Module) -> Conditions:
        """Properties, wall and vent in a state under an action."""
        p = state[..., 2]
        drop, share = self.opening(action[..., 0])
        p_1 = self.valve_outlet(p, drop)
        # Both pressures stand side by side, so that one gather in the table serves both.
        values, slopes = self.saturation.with_slopes(torch.stack([p, p_1], -1))
        tank, line = (Properties(*(x[..., k] for x in values)) for k in (0, 1))
        slope = Properties(*(x[..., 0] for x in slopes))
        U_s, U_HX, K_JT = closure(self.features(state, action, tank.T)).unbind(-1)
        flow, heat = open_vent(p - p_1, tank, line, slope.T, U_HX, K_JT)
        return Conditions(tank, slope, U_s * self.wall_area, Vent(share * flow, share * heat))

    def vent(self, state: State, action: Action, closure: nn.Module) -> Vent:
        """Vented flow and heat taken in a state, for a pressure drop Δp_V [Pa] or a duty cycle."""
        return self.conditions(state, action, closure).vent

    def mixture_rates(self, V_l: Scalar, now: Conditions, Q_sf: Scalar) -> tuple[Scalar, Scalar]:
        r"""V̇_l [m³/s] and ṗ [Pa/s] from the balances of mass and enthalpy, two linear equations:

        .. math::
            (\rho_l - \rho_v)\dot V_l + M_p\,\dot p = -\dot m_c, \qquad (H_l - H_v)\dot V_l + E_p\,\dot p = Q,

            M_p = \rho_v'(V_t - V_l) + \rho_l'V_l, \qquad E_p = H_v'(V_t - V_l) + H_l'V_l - V_t, \qquad
            Q = Q_{sf} - \dot m_ch_l - Q_{HX}

        M_p and E_p are the derivatives of mass and internal energy by p at constant V_l. The determinant
        (ρ_l − ρ_v)E_p − (H_l − H_v)M_p is positive: in a closed tank heat raises the pressure.

        Note: the paper adds ṁ_hΔh_h; here −Q_HX is added, because injected liquid comes back colder.
        """
        tank, slope, m_c = now.tank, now.slope, now.vent.flow
        Q = Q_sf - m_c * tank.h_l - now.vent.heat
        V_v = self.volume - V_l
        M_V = tank.rho_l - tank.rho_v
        M_p = slope.rho_v * V_v + slope.rho_l * V_l
        E_V = tank.rho_l * tank.h_l - tank.rho_v * tank.h_v
        H_l_slope = slope.rho_l * tank.h_l + tank.rho_l * slope.h_l
        H_v_slope = slope.rho_v * tank.h_v + tank.rho_v * slope.h_v
        E_p = H_v_slope * V_v + H_l_slope * V_l - self.volume
        p_dot = (M_V * Q + E_V * m_c) / (M_V * E_p - E_V * M_p)
        return (-m_c - M_p * p_dot) / M_V, p_dot

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        r"""Rates of T_s, V_l and p, the differentiated balances of the class (paper, section 5.3).

        Args:
            t: time [s], unused; the load enters through ``exogenous``.
            state: states in the order of the class.
            action: pressure drop Δp_V [Pa], or duty cycle.
            exogenous: heat load Q_h [W].
            closure: closure from :meth:`features` to U_s, U_HX, K_JT.
        """
        now = self.conditions(state, action, closure)
        Q_sf = now.wall_conductance * (state[..., 0] - now.tank.T)
        wall = (exogenous[..., 0] - Q_sf) / self.wall_heat_capacity
        return torch.stack([wall, *self.mixture_rates(state[..., 1], now, Q_sf)], -1)

    # The control problem

    def running_cost(self, t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        """The cost of the task, such as :class:`PressureCost`."""
        return self.cost(self, t, state, applied, exogenous)

    def terminal_cost(self, state: State) -> Cost:
        """The cost of the pressure at the end."""
        return self.cost.terminal(self, state)

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        r"""Scales in which J_p is the sum of the squared errors over their natural sizes, over T_o (eq. of J_p)."""
        return tuple(math.sqrt(0.5 * self.horizon) * size for size in ERROR_SIZES)

    def held_load(self, state: State, action: Action, closure: nn.Module) -> Scalar:
        r"""Load [W] at which the pressure stands still: Q_HX plus the heat that evaporates the refilling vapour.

        The latter is :math:`\dot m_c(h_v - h_l)\rho_v/(\rho_l - \rho_v)`.
        """
        tank, _, _, vent = self.conditions(state, action, closure)
        return vent.heat + vent.flow * (tank.h_v - tank.h_l) * tank.rho_v / (tank.rho_l - tank.rho_v)

    def vented_mass(self, states: Tensor, actions: Tensor, closure: nn.Module) -> Tensor:
        """Mass [kg] vented since the start of a trajectory, exact as long as p_1 stays above the back pressure."""
        flow = self.vent(states[..., :-1, :], actions, closure).flow
        return nn.functional.pad((flow * self.dt).cumsum(-1), (1, 0))

    def merit(self, states: States, applied: Actions, exogenous: Inputs) -> dict[str, Float[Tensor, " batch"]]:
        """Largest pressure error after three of five days, whether it is within the band, and the mass vented."""
        settled = states[:, round(SETTLED_SHARE * applied.shape[1]) :, 2]
        error = (settled - self.set_point).abs().amax(-1)
        return {
            "late pressure error [kPa]": 1e-3 * error,
            "held within 5 kPa [-]": (error <= BAND).double(),
            "vented mass [kg]": self.vented_mass(states, applied, self.closure)[:, -1],
        }

    def setpoints(self, states: State, applied: Action, exogenous: Input) -> dict[str, tuple[Scalar, Scalar]]:
        """Pressure, which should be held at the set point."""
        pressure = 1e-3 * states[..., 2]
        return {"pressure [kPa]": (pressure, torch.full_like(pressure, 1e-3 * self.set_point))}

    suspects, further_suspects = unknown.suspects, unknown.further_suspects

    # Randomness

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        """Initial states with p ~ N(500, 25²) kPa, 70 % full, and the wall at the temperature of saturation."""
        spread = torch.randn(batch, generator=generator, dtype=torch.float64, device=generator.device)
        return self.state_at(self.set_point + self.first_pressure_spread * spread)

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps 1"]:
        """Heat load Q_h [W]."""
        return self.load.draw(batch, self.n_steps, self.dt, generator).unsqueeze(-1)

    def make_closure(self, generator: torch.Generator) -> ConstantCoefficients:
        """The paper's first guess, U_s = U_HX = 1 W/(m² K) and K_JT = 10 GPa s²/kg²; nothing is drawn."""
        guess = ConstantCoefficients.guessed_coefficients
        return ConstantCoefficients(torch.tensor(guess, dtype=torch.float64, device=generator.device))

    def make_neural_closure(self, generator: torch.Generator, hidden: Sequence[int]) -> nn.Module:
        """A neural closure that starts at the paper's first guess."""
        return NeuralCoefficients(self.make_closure(generator), hidden=hidden, generator=generator)

    def make_policy(self, generator: torch.Generator) -> nn.Module:
        """The paper's policy with three weights; a saturated affine law if other signals are observed."""
        if [measurement.name for measurement in self.observed] == ["pressure_error"]:
            return CubicVentLaw(self.actions[0], generator=generator)
        return super().make_policy(generator)


def open_vent(drop: Scalar, tank: Properties, line: Properties, T_slope: Scalar, U_HX: Scalar, K_JT: Scalar) -> Vent:
    r"""The open vent, a Joule-Thomson valve and a heat exchanger: its flow, and the heat taken from the liquid.

    .. math::
        \dot m_c = \sqrt{\Delta p_V/K_{JT}}, \quad Q_{HX} = \varepsilon\,\dot m_c\,\Delta h_c, \quad
        \varepsilon = 1 - e^{-NTU}, \quad NTU = \frac{U_{HX}A_{HX}\,\Delta T}{\dot m_c\,\Delta h_c}

    with :math:`\Delta h_c = h_v(p_1) - h_l(p)` and :math:`\Delta T = T(p) - T(p_1)`. The ratio ΔT/ṁ_c is taken as
    (ΔT/Δp_V)/(ṁ_c/Δp_V), both of which have a limit when the valve shuts.

    Note: the paper prints the exchanged heat as ε c_p ΔT; here it is ε ṁ_c Δh_c, which equals ε ṁ_h c_p ΔT with the
    missing flow ṁ_h of the pump, because this form stays finite when the valve shuts.

    Args:
        drop: pressure drop p − p_1 [Pa], not negative.
        tank: properties at the tank's pressure p.
        line: properties behind the valve, at p_1.
        T_slope: slope dT/dp at p [K/Pa], the limit of ΔT/Δp_V.
        U_HX: heat transfer coefficient of the exchanger [W/(m² K)].
        K_JT: constant of the valve [Pa s²/kg²].
    """
    conductance = valve_conductance(drop, K_JT)
    measurable = drop > ROUNDING_DROP
    secant = torch.where(measurable, (tank.T - line.T) / torch.where(measurable, drop, ROUNDING_DROP), T_slope)
    latent = line.h_v - tank.h_l
    flow = conductance * drop
    effectiveness = -torch.expm1(-U_HX * EXCHANGER_AREA * secant / (conductance * latent))
    return Vent(flow, effectiveness * flow * latent)


def valve_conductance(drop: Scalar, K_JT: Float[Tensor, "*#batch"]) -> Scalar:
    r"""Conductance ṁ_c/Δp_V [kg/(s Pa)] of the valve, :math:`\big(K_{JT}\sqrt{\Delta p_V^2 + \delta^2}\big)^{-1/2}`.

    Note: the paper prints ṁ_c = √(Δp_V/K_JT), the case δ = 0; here δ is 100 Pa, because the root has an infinite slope
    at zero. The flow is then proportional to the drop far below δ, as laminar flow is, and 8e-6 less than the root at
    18 kPa.
    """
    return (K_JT * (drop**2 + LAMINAR_DROP**2) ** 0.5) ** -0.5
