r"""The cryogenic tank as a plant: a wall, a saturated mixture and a thermodynamic vent (paper, section 5.3)."""

import math
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.cryogenic_tank import measurements as sensors
from rt_torchrl.envs.cryogenic_tank import merit as judgement
from rt_torchrl.envs.cryogenic_tank.commands import COMMANDS, GREATEST_DROP
from rt_torchrl.envs.cryogenic_tank.costs import PressureCost, TankCost, require_sizes
from rt_torchrl.envs.cryogenic_tank.disturbances import CyclicLoad, LoadModel
from rt_torchrl.envs.cryogenic_tank.mixture import Conditions, evaporation_heat, mixture_rates
from rt_torchrl.envs.cryogenic_tank.models import ConstantCoefficients, CubicVentLaw
from rt_torchrl.envs.cryogenic_tank.neural import first_neural_guess
from rt_torchrl.envs.cryogenic_tank.saturation import Properties, Saturation
from rt_torchrl.envs.cryogenic_tank.suspects import further_suspects, suspects
from rt_torchrl.envs.cryogenic_tank.vent import Vent, vent
from rt_torchrl.envs.cryogenic_tank.wall import wall_rise
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sampling import require_stable_step, rk4_step
from rt_torchrl.plants.signal import Signal

Wall = Literal["explicit", "exponential"]


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
    (20 kJ/K) follows the load within 5 s: too fast for an explicit step of 30 s, but not for ``wall="exponential"``.
    Note: the paper prints U_s per area but no area; here A_s is 74.1 m², that of a sphere of 60 m³.

    With the explicit wall U_s must stay below 2.785 m_s c_s/(A_s dt) = 626 W/(m² K), see :meth:`wall_rate`. The plant
    checks the true closure; the twin starts far below the limit and diverges with an error if training exceeds it.

    Args:
        dt: control interval [s].
        horizon: length of an episode T_o [s].
        closure: closure of the real tank, from :meth:`features` to U_s, U_HX, K_JT; None for the paper's constants.
        load: source of the heat load.
        fluid: pure fluid in the tank, by its name in CoolProp; ``ParaHydrogen`` is what hydrogen becomes when stored.
        wall: ``explicit`` integrates the wall with the rest, ``exponential`` by its own solution, see :meth:`advance`.
        wall_heat_capacity: heat capacity m_s c_s of the wall [J/K].
        cost: running and terminal cost of J_a, see ``costs.py``; None for the paper's.
        command: action: the drop of a valve that is held half open, or the duty cycle of a valve that is either shut or
            open. A half-open valve takes less heat per mass that it vents.
        observe: names of measurements and observation sets in ``measurements.py``; by default the paper's error.
        error_sizes: errors of T_s [K], V_l [m³] and p [Pa] that weigh the same in J_p, α_3 = 0.05⁻² K⁻² and so on.

    Raises:
        ValueError: for an unknown fluid or wall, a size that is not positive, or a wall that makes the step unstable.
    """

    name = "cryogenic_tank"

    volume = 60.0  # V_t [m³]
    first_fill = 0.7  # V_l/V_t at the start
    set_point = sensors.SET_POINT
    first_pressure_spread = 25e3  # standard deviation of p(0) [Pa]
    error_unit = sensors.ERROR_UNIT
    orbit = 5400.0  # T_h, by which the phase of the orbit is observed [s]
    wall_area = 74.1  # A_s [m²]
    back_pressure = 80e3  # least p_1 [Pa], held by a regulator at the end of the vent line
    greatest_pressure = 900e3  # end of the saturation table [Pa]; a shut tank reaches 700 kPa in an episode
    superheat_unit = 0.05  # typical T_s − T [K]
    rated_valve = ConstantCoefficients.true_coefficients[2]  # K_JT of the valve's data sheet, for the cost [Pa s²/kg²]

    states = sensors.STATES
    actions: tuple[Signal, ...] = (COMMANDS["drop"].signal,)
    inputs = sensors.INPUTS
    measurements, observation_sets = sensors.MEASUREMENTS, sensors.OBSERVATION_SETS
    error_sizes: Tensor

    def __init__(
        self,
        *,
        dt: float = 30.0,
        horizon: float = 4.32e5,
        closure: nn.Module | None = None,
        load: LoadModel | None = None,
        fluid: str = "Hydrogen",
        wall: Wall = "explicit",
        wall_heat_capacity: float = 500e3,
        cost: TankCost | None = None,
        command: Literal["drop", "duty"] = "drop",
        error_sizes: tuple[float, float, float] = (0.05, 0.05, 1e3),
        observe: Sequence[str] = (),
    ):
        constants = ConstantCoefficients.true() if closure is None else closure
        super().__init__(dt=dt, horizon=horizon, closure=constants, observe=observe)
        if command not in COMMANDS:
            raise ValueError(f"command={command!r} does not exist; choose one of {', '.join(COMMANDS)}.")
        if wall not in get_args(Wall):
            raise ValueError(f"wall={wall!r} does not exist; choose one of {', '.join(get_args(Wall))}.")
        if not 0.0 < wall_heat_capacity < math.inf:
            raise ValueError(f"wall_heat_capacity={wall_heat_capacity} J/K must be positive and finite.")
        require_sizes(error_sizes)
        self.load = CyclicLoad() if load is None else load
        self.wall, self.wall_heat_capacity = wall, float(wall_heat_capacity)
        self.command, self.actions = COMMANDS[command], (COMMANDS[command].signal,)
        self.cost = PressureCost() if cost is None else cost
        self.saturation = Saturation(fluid, low=self.back_pressure, high=self.greatest_pressure)
        self.register_buffer("error_sizes", torch.tensor(error_sizes, dtype=torch.float64))
        if wall == "explicit":
            mode = f"the wall of heat capacity {wall_heat_capacity:.6g} J/K"
            rate = self.wall_rate(self.closure)
            require_stable_step(self.name, dt, rate, mode=mode, remedy="wall='exponential'")

    @torch.no_grad()
    def wall_rate(self, closure: nn.Module) -> float:
        """Decay rate U_s A_s/(m_s c_s) [1/s] of a closure's wall at the set point and at the fluid's temperature."""
        state = self.state_at(self.error_sizes.new_tensor(self.set_point))
        now = self._conditions(state, torch.zeros_like(state[:1]), closure)
        return now.wall_conductance.item() / self.wall_heat_capacity

    def state_at(self, p: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
        """The state at p [Pa] with the first fill and a wall as cold as the fluid; p must be within the table."""
        self.saturation.check(p)
        return torch.stack([self.saturation(p).T, torch.full_like(p, self.first_fill * self.volume), p], -1)

    # The system

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch 3"],
        action: Float[Tensor, "*batch 1"],
        exogenous: Float[Tensor, "*#batch 1"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch 3"]:
        r"""Rates of T_s, V_l and p, the differentiated balances of the class (paper, section 5.3).

        Args:
            t: time [s], unused; the load enters through ``exogenous``.
            state: states in the order of the class.
            action: pressure drop Δp_V [Pa].
            exogenous: heat load Q_h [W].
            closure: closure from :meth:`features` to U_s, U_HX, K_JT.
        """
        now = self._conditions(state, action, closure)
        Q_sf = now.wall_conductance * (state[..., 0] - now.tank.T)
        wall = (exogenous[..., 0] - Q_sf) / self.wall_heat_capacity
        return torch.stack([wall, *self._mixture_rates(state[..., 1], now, Q_sf)], -1)

    def advance(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch 3"],
        applied: Float[Tensor, "*batch 1"],
        exogenous: Float[Tensor, "*#batch 1"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch 3"]:
        r"""The state after Δt; with ``wall="exponential"`` the wall follows :func:`wall_rise`.

        T and U_s keep their values at the start, and the mixture receives the mean of Q_sf that closes the wall's
        balance, :math:`Q_h - m_sc_s\Delta T_s/\Delta t`. No energy is lost, and a wall of any heat capacity is stable.
        T_s then lags behind T by up to one interval, about 1e-4 K. The engine ``odeint_adjoint`` integrates the vector
        field itself with the wall, and therefore still needs a wall that is stable.
        """
        if self.wall == "explicit":
            return super().advance(t, state, applied, exogenous, closure)
        T_s, load = state[..., :1], exogenous[..., 0]
        start = self._conditions(state, applied, closure)
        superheat = T_s[..., 0] - start.tank.T
        rise = wall_rise(superheat, load, start.wall_conductance, self.wall_heat_capacity, self.dt)
        Q_sf = load - self.wall_heat_capacity * rise / self.dt

        def mixture(t: Tensor, s: Tensor) -> Tensor:
            now = self._conditions(torch.cat([T_s, s], -1), applied, closure)
            return torch.stack(self._mixture_rates(s[..., 0], now, Q_sf), -1)

        end = rk4_step(mixture, t, state[..., 1:], self.dt)
        return torch.cat([T_s + rise.unsqueeze(-1), end], -1)

    def features(
        self, state: Float[Tensor, "*batch 3"], action: Float[Tensor, "*batch 1"], T: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 4"]:
        """The features of a closure, all of order one: p/p̃, V_l/V_t, (T_s − T)/0.05 K and Δp_V/Δp_max."""
        T_s, V_l, p = state.unbind(-1)
        superheat, (drop, _) = (T_s - T) / self.superheat_unit, self.command.opening(action[..., 0])
        return torch.stack([p / self.set_point, V_l / self.volume, superheat, drop / GREATEST_DROP], -1)

    def _conditions(self, state: Tensor, action: Tensor, closure: nn.Module) -> Conditions:
        p = state[..., 2]
        drop, share = self.command.opening(action[..., 0])
        p_1 = self.valve_outlet(p, drop)
        # Both pressures stand side by side, so that one gather in the table serves both.
        values, slopes = self.saturation.with_slopes(torch.stack([p, p_1], -1))
        tank, line = (Properties(*(x[..., k] for x in values)) for k in (0, 1))
        slope = Properties(*(x[..., 0] for x in slopes))
        U_s, U_HX, K_JT = closure(self.features(state, action, tank.T)).unbind(-1)
        flow, heat, effectiveness, pumped = vent(p - p_1, tank, line, slope.T, U_HX, K_JT)
        vented = Vent(share * flow, share * heat, effectiveness, share * pumped)
        return Conditions(tank, slope, U_s * self.wall_area, vented)

    def _mixture_rates(self, V_l: Tensor, now: Conditions, Q_sf: Tensor) -> tuple[Tensor, Tensor]:
        """V̇_l and ṗ. Note: the paper adds ṁ_hΔh_h; here −Q_HX is added, because injected liquid comes back colder."""
        heating = Q_sf - now.vent.flow * now.tank.h_l - now.vent.heat
        return mixture_rates(V_l, self.volume, now.tank, now.slope, now.vent.flow, heating)

    def valve_outlet(self, p: Float[Tensor, "*batch"], drop: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """The pressure p_1 = p − Δp_V [Pa] behind the valve, not below the back pressure of the vent line."""
        return torch.where(p - drop < self.back_pressure, self.back_pressure, p - drop)

    # Quantities for figures

    def vent(self, state: Float[Tensor, "*batch 3"], action: Float[Tensor, "*batch 1"], closure: nn.Module) -> Vent:
        """Vented flow, heat taken and pump flow in a state, for a pressure drop Δp_V [Pa]."""
        return self._conditions(state, action, closure).vent

    def held_load(
        self, state: Float[Tensor, "*batch 3"], action: Float[Tensor, "*batch 1"], closure: nn.Module
    ) -> Float[Tensor, "*batch"]:
        """Load [W] at which the pressure stands still: Q_HX plus the heat that evaporates the refilling vapour."""
        now = self._conditions(state, action, closure)
        return now.vent.heat + evaporation_heat(now.tank, now.vent.flow)

    def vented_mass(
        self, states: Float[Tensor, "*batch n_plus_1 3"], actions: Float[Tensor, "*batch n 1"], closure: nn.Module
    ) -> Float[Tensor, "*batch n_plus_1"]:
        """Mass [kg] vented since the start of a trajectory, exact as long as p_1 stays above the back pressure."""
        flow = self.vent(states[..., :-1, :], actions, closure).flow
        return torch.nn.functional.pad((flow * self.dt).cumsum(-1), (1, 0))

    # The control problem

    def running_cost(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch 3"],
        applied: Float[Tensor, "*batch 1"],
        exogenous: Float[Tensor, "*#batch 1"],
    ) -> Float[Tensor, "*batch"]:
        """The cost of the task, see ``costs.py``."""
        return self.cost(self, t, state, applied, exogenous)

    def terminal_cost(self, state: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The cost of the pressure at the end, see ``costs.py``."""
        return self.cost.terminal(self, state)

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        r"""Scales in which J_p is the sum of the squared errors over their natural sizes, over T_o (eq. of J_p)."""
        return tuple((math.sqrt(0.5 * self.horizon) * self.error_sizes).tolist())

    merit, setpoints, make_neural_closure = judgement.merit, judgement.setpoints, first_neural_guess
    suspects, further_suspects = suspects, further_suspects

    # Randomness

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} 3"]:
        """Initial states with p ~ N(500, 25²) kPa, 70 % full, and the wall at the temperature of saturation."""
        spread = torch.randn(batch, generator=generator, dtype=torch.float64, device=generator.device)
        return self.state_at(self.set_point + self.first_pressure_spread * spread)

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps 1"]:
        """Heat load Q_h [W]."""
        return self.load.draw(batch, self.n_steps, self.dt, generator).unsqueeze(-1)

    def make_closure(self, generator: torch.Generator) -> nn.Module:
        """The paper's first guess, U_s = U_HX = 1 W/(m² K) and K_JT = 10 GPa s²/kg²; nothing is drawn."""
        return ConstantCoefficients.first_guess(generator.device)

    def make_policy(self, generator: torch.Generator) -> nn.Module:
        """The paper's policy with three weights; a saturated affine law if other signals are observed."""
        if [measurement.name for measurement in self.observed] == ["pressure_error"]:
            return CubicVentLaw(self.actions[0], generator=generator)
        return super().make_policy(generator)
