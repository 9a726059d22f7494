r"""The flapping-wing micro air vehicle as a plant: a point mass under two beating wings (paper, section 5.2)."""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.flapping_wing import unknown
from rt_torchrl.envs.flapping_wing.closures import NeuralPolar, QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.disturbances import GaussianGust
from rt_torchrl.options import NotNegative, configuration, require_range
from rt_torchrl.plants.plant import Plant, RunningCost
from rt_torchrl.plants.policies import SaturatedAffine
from rt_torchrl.plants.sampling import DisturbanceModel, between, lag
from rt_torchrl.plants.shapes import Action, Actions, Cost, Input, Inputs, Scalar, State, States, Time
from rt_torchrl.plants.signal import Measurement, Phase, Signal

MASSES = (1e-5, 0.05)
"""Masses of which the lightest has a thousandth, and the heaviest ten times the weight that the wings carry [kg]."""
FREQUENCY = 20.0
"""f of the wing beat [Hz]."""
POSITION_FILTER = 50.0
"""ω_F [rad/s]; its lag of 20 ms is short for a flight of seconds."""
WINDOW_WIDTH = 0.71
"""σ of the cost's window h [m]."""
HOVER_AMPLITUDE = 77.2
"""Flapping amplitude A_0 that carries the weight in calm air [deg]."""

POSITIONS = (Signal(symbol="x", name="forward_position", unit="m"), Signal(symbol="z", name="height", unit="m"))
SPEEDS = (
    Signal(symbol=r"\dot x", name="forward_speed", unit="m/s"),
    Signal(symbol=r"\dot z", name="climb_speed", unit="m/s"),
)
FILTERED = (
    Signal(symbol="x_F", name="filtered_position", unit="m"),
    Signal(symbol="z_F", name="filtered_height", unit="m"),
)
"""States that a drone has if one of ``OF_FILTERED`` is observed."""
ACTIONS = (
    Signal(symbol=r"A_\phi", name="flapping_amplitude", unit="deg", low=50.0, high=88.0),
    Signal(symbol=r"\beta_w", name="stroke_plane_angle", unit="deg", low=-30.0, high=30.0),
)
HEADWIND = Signal(symbol=r"u_\infty", name="headwind", unit="m/s")


# What the sensors give: the way to the target along an axis, its rate, and the rate that a filter of the position tells


def error(axis: int, plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The way x_{f,i} − x_i to the target [m]."""
    return plant.target[axis] - state[..., axis]


def error_rate(axis: int, plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The rate −ẋ_i of the way [m/s]."""
    return -state[..., 2 + axis]


def filtered_rate(axis: int, plant: "FlappingWing", t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The rate ω_F (x_{F,i} − x_i) of the way [m/s]."""
    return POSITION_FILTER * (state[..., axis - 2] - state[..., axis])


OF_FILTERED = (
    Measurement(symbol=r"\dot e_{x,F}", name="filtered_rate_x", unit="m/s", read=partial(filtered_rate, 0)),
    Measurement(symbol=r"\dot e_{z,F}", name="filtered_rate_z", unit="m/s", read=partial(filtered_rate, 1)),
)
COSINE, SINE = Phase("cosine", 1.0 / FREQUENCY), Phase("sine", 1.0 / FREQUENCY)
"""Phase of the wing beat; the wings are furthest forwards at its cosine, and pitch as its sine."""
ERRORS = ("error_x", "error_z", "error_rate_x", "error_rate_z")
POSITION = ("error_x", "error_z", "filtered_rate_x", "filtered_rate_z")
PHASE = ("phase_cosine", "phase_sine")


@configuration
class TrackingCost:
    r"""The paper's cost of the way to the target.

    .. math::
        L_a = \tfrac12\big(\|e\|^2 + \alpha_1\|\dot e\circ h\|^2\big), \qquad
        h_i = \exp\Big[-\frac12\Big(\frac{x_i - x_{f,i}}{\sigma}\Big)^2\Big]

    with the position error e (paper, eq. drone_eq_rewardCont).

    Note: the paper prints a peak ĥ of x_f²/2; here it is 1, because its text calls the function unitary.

    Args:
        velocity: weight α1 of the speed near the target.

    Raises:
        ValueError: if the weight is negative.
    """

    velocity: NotNegative = 1.0

    def __call__(self, plant: "FlappingWing", t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        e = plant.target - state[..., :2]
        h = torch.exp(-0.5 * (e / WINDOW_WIDTH) ** 2)
        return 0.5 * ((e**2).sum(-1) + self.velocity * ((state[..., 2:4] * h) ** 2).sum(-1))


class FlappingWing(Plant):
    r"""A drone of 3 g that flies in the vertical plane to a target and hovers there, in a gusty headwind.

    .. math::
        m_b\ddot x = F_{x,w} + F_{x,b}, \qquad m_b\ddot z = F_{z,w} + F_{z,b} - m_bg, \qquad z \text{ upwards}

    The wings beat with :math:`\phi = A_\phi\cos2\pi ft` in a plane pitched by :math:`\beta_w`, and pitch about their
    span with :math:`\alpha = A_\alpha\sin2\pi ft`.

    ====  ===================  =================================================  ====  =============
    kind  name                 symbol                                             unit  range
    ====  ===================  =================================================  ====  =============
    s     forward_position     :math:`x`, forwards                                m     about 0 ... 5
    s     height               :math:`z`, upwards                                 m     about 0 ... 5
    s     forward_speed        :math:`\dot x`                                     m/s   about ±5
    s     climb_speed          :math:`\dot z`                                     m/s   about ±5
    a     flapping_amplitude   :math:`A_\phi`                                     deg   50 ... 88
    a     stroke_plane_angle   :math:`\beta_w`, negative pushes towards +x        deg   −30 ... 30
    z     headwind             :math:`u_\infty`, positive blows towards −x        m/s   about −2 ... 4
    e     error_x              :math:`e_x = (x_f - x)/\ell`                       -     about ±2.5
    e     error_z              :math:`e_z = (z_f - z)/\ell`                       -     about ±2.5
    e     error_rate_x         :math:`\dot e_x = -\dot x/v`                       -     about ±5
    e     error_rate_z         :math:`\dot e_z = -\dot z/v`                       -     about ±5
    ====  ===================  =================================================  ====  =============

    The table shows the paper's observation e; ``observe`` chooses others. A controller may remember low-passed
    positions, which are further states: a sensor of the position alone tells the speed by a filter, whose difference
    from the position is the speed behind it,

    .. math:: \dot x_F = \omega_F(x - x_F), \qquad \hat{\dot x} = \omega_F(x - x_F)

    The chord of the wings is a quarter ellipse along the span. With r = R_0 + R sin θ it is c(r) = (4c̄/π)√(1 − ((r −
    R_0)/R)²) = (4c̄/π) cos θ, and c dr is (4c̄R/π) cos²θ dθ. This is smooth up to the tip, where c(r) itself has an
    infinite slope: six Gauss nodes suffice.

    Note: the paper prints no number of wings; here there are two, which carry the weight at 77.2 deg, because a single
    wing cannot within the range of A_φ.

    Args:
        dt: control interval [s].
        horizon: length of an episode T_o [s].
        closure: closure for C_L and C_D of the real wings; None for the paper's polar.
        wind: source of the headwind.
        target: position x_f and z_f of the target [m].
        cost: running cost L_a, such as :class:`TrackingCost`; None for the paper's.
        mass: mass m_b of the body [kg].
        observe: names of ``measurements`` and ``observation_sets``; by default the paper's errors. The low-passed
            positions are two more states, the last ones, if one of these needs them.

    Raises:
        ValueError: for a mass or target that a drone of this kind cannot have, an unknown measurement, or a step
            that does not resolve the wing beat.
    """

    name = "flapping_wing"

    gravity = 9.81  # g [m/s²]
    air_density = 1.225  # ρ [kg/m³]
    frequency = FREQUENCY
    pitching_amplitude = 45.0  # A_α [deg]
    wing_root = 0.0225  # R_0 [m]
    wing_length = 0.05  # R [m]; the tip is at R_0 + R
    mean_chord = 0.01  # c̄ [m]
    span_nodes = 6  # positions after 2 s differ by 2e-6 m from those with forty nodes
    body_drag_area = 5e-4  # S_b C_D,b [m²]
    smallest_airspeed = 0.01  # ε [m/s], the floor of |U|
    least_steps_per_beat = 20

    states: tuple[Signal, ...] = POSITIONS + SPEEDS
    actions = ACTIONS
    inputs = (HEADWIND,)
    closure_inputs, closure_outputs = ("sin α_e [-]", "cos α_e [-]"), ("lift coefficient [-]", "drag coefficient [-]")
    # ℓ = 2 m and v = 1 m/s: with these, good policies have weights of 1 to 2, which suit one learning rate.
    measurements: tuple[Measurement, ...] = (
        Measurement(symbol="e_x", name="error_x", unit="m", read=partial(error, 0), scale=2.0),
        Measurement(symbol="e_z", name="error_z", unit="m", read=partial(error, 1), scale=2.0),
        Measurement(symbol=r"\dot e_x", name="error_rate_x", unit="m/s", read=partial(error_rate, 0)),
        Measurement(symbol=r"\dot e_z", name="error_rate_z", unit="m/s", read=partial(error_rate, 1)),
        Measurement.of(HEADWIND, offset=1.0),
        Measurement(symbol=r"\cos 2\pi ft", name="phase_cosine", unit="-", low=-1.0, high=1.0, read=COSINE),
        Measurement(symbol=r"\sin 2\pi ft", name="phase_sine", unit="-", low=-1.0, high=1.0, read=SINE),
        *OF_FILTERED,
    )
    observation_sets = {
        "paper": ERRORS,
        "errors": ERRORS,
        "wind": (*ERRORS, "headwind"),
        "phase": (*ERRORS, *PHASE),
        "measured": (*ERRORS, *PHASE),
        "measured+wind": (*ERRORS, *PHASE, "headwind"),
        "position": (*POSITION, *PHASE),
        "position+wind": (*POSITION, *PHASE, "headwind"),
    }
    """The paper's errors of position and speed; these with the wind; with the phase of the wing beat; with both; and
    what a sensor of the position alone tells, with the phase, and with the wind."""

    def __init__(
        self,
        *,
        dt: float = 5e-4,
        horizon: float = 5.0,
        closure: nn.Module | None = None,
        wind: DisturbanceModel | None = None,
        target: tuple[float, float] = (5.0, 5.0),
        cost: RunningCost | None = None,
        mass: float = 3e-3,
        observe: Sequence[str] = (),
    ):
        polar = QuasiSteadyPolar.true() if closure is None else closure
        super().__init__(dt=dt, horizon=horizon, closure=polar, observe=observe)
        for coordinate in target:
            require_range("target", coordinate, -1e3, 1e3, unit="m", of="the drone")
        require_range("mass", mass, *MASSES, unit="kg", of="the drone")
        self.wind = GaussianGust() if wind is None else wind
        self.cost = TrackingCost() if cost is None else cost
        held = FILTERED if any(measurement in OF_FILTERED for measurement in self.observed) else ()
        self.filtered = len(held)
        if not held:
            self.measurements = tuple(m for m in self.measurements if m not in OF_FILTERED)
        self.states, self.controller_states = (*POSITIONS, *SPEEDS, *held), tuple(signal.name for signal in held)
        self.target = nn.Buffer(torch.tensor(target, dtype=torch.float64))
        self.mass = nn.Buffer(torch.tensor(mass, dtype=torch.float64))
        self.weight = nn.Buffer(torch.tensor([0.0, -mass * self.gravity], dtype=torch.float64))
        places, weights = np.polynomial.legendre.leggauss(self.span_nodes)
        theta = torch.from_numpy(0.25 * math.pi * (places + 1.0))
        area = 4.0 * self.mean_chord * self.wing_length / math.pi * theta.cos() ** 2
        # Distances r_j of the blade elements from the flapping axis [m].
        self.radius = nn.Buffer(self.wing_root + self.wing_length * theta.sin())
        # Weights ρ c(r_j) dr_j of the elements of both wings [kg/m], of which each has half.
        self.strip_mass = nn.Buffer(self.air_density * area * 0.25 * math.pi * torch.from_numpy(weights))
        longest = 1.0 / (self.least_steps_per_beat * self.frequency)
        if dt > longest * (1.0 + 1e-9):
            raise ValueError(
                f"dt={dt} s does not resolve the wing beat of plant {self.name!r} at {self.frequency:g} Hz; "
                f"use dt <= {longest:g} s, {self.least_steps_per_beat} steps per beat."
            )

    # The system

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        r"""Velocity and acceleration of the body, paper eqs. (drone_eq_x) and (drone_eq_y).

        Args:
            t: time [s], which gives the phase of the wing beat.
            state: position x, z [m] and velocity ẋ, ż [m/s].
            action: flapping amplitude A_φ and stroke plane angle β_w [deg].
            exogenous: headwind u_∞ [m/s].
            closure: closure from (sin α_e, cos α_e) to C_L and C_D [-] of a blade element.
        """
        velocity = state[..., 2:4]
        # The air comes with −u_∞ along x, so the body moves with ẋ + u_∞ relative to it.
        relative = torch.cat([velocity[..., :1] + exogenous, velocity[..., 1:]], -1)
        force = self.force(t, relative, action, closure)
        # The filters follow the position, or there are no such states.
        return torch.cat([velocity, (force + self.weight) / self.mass, self._filter_rates(state)], -1)

    def force(
        self, t: Time, relative: Float[Tensor, "*batch 2"], action: Action, closure: nn.Module
    ) -> Float[Tensor, "*batch 2"]:
        r"""Forces F_x and F_z [N] of wings and body, which move at ``relative`` [m/s] to the air.

        R_2(β_w) turns the velocity into the stroke frame and R_3(φ) into the flapping frame; their transposes turn the
        force back. The lateral forces of the two wings cancel.

        Note: the paper turns [ẋ, ẏ, 0]; here it is [ẋ + u_∞, 0, ż], because the motion is in the plane (x, z).
        """
        A_phi, beta_w = torch.deg2rad(action).unbind(-1)
        rate = 2.0 * math.pi * self.frequency
        sine, cosine = torch.sin(rate * t), torch.cos(rate * t)
        alpha = math.radians(self.pitching_amplitude) * sine
        # A_φ is held over the control interval, so that φ̇ has no Ȧ_φ term.
        cos_phi, phi_dot = torch.cos(A_phi * cosine), -rate * A_phi * sine
        sin_beta, cos_beta = torch.sin(beta_w), torch.cos(beta_w)
        v_x, v_z = relative.unbind(-1)
        stroke_x, stroke_z = cos_beta * v_x + sin_beta * v_z, cos_beta * v_z - sin_beta * v_x
        F_x, F_z = self.wing_force(cos_phi * stroke_x, stroke_z, phi_dot, alpha, closure)
        wings = torch.stack([cos_beta * cos_phi * F_x - sin_beta * F_z, sin_beta * cos_phi * F_x + cos_beta * F_z], -1)
        speed = torch.sqrt(v_x**2 + v_z**2 + self.smallest_airspeed**2).unsqueeze(-1)
        return wings - 0.5 * self.air_density * self.body_drag_area * speed * relative

    def wing_force(
        self, v_x: Tensor, v_z: Tensor, phi_dot: Tensor, alpha: Tensor, closure: nn.Module
    ) -> tuple[Tensor, Tensor]:
        r"""Forces F_x and F_z [N] of both wings in the flapping frame, paper eqs. (drone_eq_lift) to (drone_eq_Cdrag).

        .. math::
            \begin{pmatrix}F_x\\F_z\end{pmatrix} = \int\rho\,c(r)\,|U|\left[-C_D\begin{pmatrix}U_x\\U_z\end{pmatrix}
            + C_L\begin{pmatrix}-U_z\\U_x\end{pmatrix}\right]dr, \quad U_x = v_x - \dot\phi r,\; U_z = v_z

        Only the coefficients need the wing frame, (U_ξ, U_ζ) = R_2(α)(U_x, U_z): in every frame drag lies along the
        velocity and lift a quarter turn ahead of it. The flow along the span carries no force and is dropped.

        Note: the paper prints R_2(α) with the sign of R_2(β_w); here it has the opposite sign, [[cos, −sin], [sin,
        cos]] in (x, z), because with the printed sign the lift points downwards on both half-strokes.
        Note: |U| is √(U_x² + U_z² + ε²), which keeps direction and slope finite where the wing meets still air.

        Args:
            v_x: velocity of the root to the air along x of the flapping frame [m/s].
            v_z: velocity of the root to the air along z of the flapping frame [m/s].
            phi_dot: flapping rate φ̇ [rad/s].
            alpha: pitch α of the wings about their span [rad].
            closure: closure from (sin α_e, cos α_e) to C_L and C_D [-] of a blade element.
        """
        U_x, U_z = v_x.unsqueeze(-1) - phi_dot.unsqueeze(-1) * self.radius, v_z.unsqueeze(-1)
        sin_alpha, cos_alpha = torch.sin(alpha).unsqueeze(-1), torch.cos(alpha).unsqueeze(-1)
        U_xi, U_zeta = cos_alpha * U_x - sin_alpha * U_z, sin_alpha * U_x + cos_alpha * U_z
        speed = torch.sqrt(U_x**2 + U_z**2 + self.smallest_airspeed**2)
        C_L, C_D = closure(torch.stack([U_xi / speed, U_zeta / speed], -1)).unbind(-1)
        pressure = self.strip_mass * speed
        return -(pressure * (C_D * U_x + C_L * U_z)).sum(-1), (pressure * (C_L * U_x - C_D * U_z)).sum(-1)

    # What a controller remembers

    def _filter_rates(self, state: State) -> Tensor:
        """Rates of the low-passed positions [m/s], the last states; these rates are the speeds that they tell."""
        count = self.filtered
        return POSITION_FILTER * (state[..., :count] - state[..., state.shape[-1] - count :])

    def seen_velocity(self, state: State) -> Float[Tensor, "*batch 2"]:
        """Speed [m/s] as a controller knows it: by the filters of the position if there are any, or as measured."""
        return self._filter_rates(state) if self.filtered else state[..., 2:4]

    def controller_start(self, measured: Float[Tensor, "*batch n_y"], exogenous: Input) -> Float[Tensor, "*batch n_c"]:
        """The memory of a controller that is switched on: settled filters."""
        return measured[..., : self.filtered]

    def complete_states(self, measured: dict[str, Tensor], exogenous: Tensor, actions: Tensor) -> Tensor:
        """All states along a log; what a controller would have remembered follows from the others."""
        completed = {}
        for position, signal in zip(POSITIONS, FILTERED[: self.filtered], strict=False):
            if position.name in measured:
                place = measured[position.name]
                completed[signal.name] = lag(place[0], between(place), self.dt * POSITION_FILTER)
        return super().complete_states(completed | measured, exogenous, actions)

    # The control problem

    def running_cost(self, t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        """The cost of the task, such as :class:`TrackingCost`."""
        return self.cost(self, t, state, applied, exogenous)

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Scales in which L_p is ½‖x − x̌‖² [m²] of the positions (paper, eq. drone_eq_Jp)."""
        return (1.0, 1.0, *(math.inf,) * (len(self.states) - 2))

    def merit(self, states: States, applied: Actions, exogenous: Inputs) -> dict[str, Float[Tensor, " batch"]]:
        """Distance to the target at the end and its least value, mean power of the wings, and travel of the plane.

        The power is that of the amplitude cubed, as a share of the power that carries the weight.
        """
        distance = (self.target - states[..., :2]).norm(dim=-1)
        return {
            "final distance [m]": distance[:, -1],
            "least distance [m]": distance.amin(-1),
            "wing power [-]": ((applied[..., 0] / HOVER_AMPLITUDE) ** 3).mean(-1),
            "stroke plane travel [deg/s]": applied[..., 1].diff(dim=-1).abs().mean(-1) / self.dt,
        }

    def setpoints(self, states: State, applied: Action, exogenous: Input) -> dict[str, tuple[Scalar, Scalar]]:
        """Both coordinates, with those of the target."""
        place, target = states[..., :2], self.target.expand_as(states[..., :2])
        return {f"{axis} [m]": (place[..., k], target[..., k]) for k, axis in enumerate(("x", "z"))}

    suspects, further_suspects = unknown.suspects, unknown.further_suspects

    # Randomness

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        """Initial states at rest in the origin; nothing is drawn."""
        return torch.zeros(batch, len(self.states), dtype=torch.float64, device=generator.device)

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps 1"]:
        """Headwind u_∞ [m/s]."""
        return self.wind.draw(batch, self.n_steps, self.dt, generator).unsqueeze(-1)

    def make_closure(self, generator: torch.Generator) -> QuasiSteadyPolar:
        """The paper's polar with random coefficients within ±50 % of the true ones."""
        return QuasiSteadyPolar.draw(generator)

    def make_neural_closure(self, generator: torch.Generator, hidden: Sequence[int]) -> nn.Module:
        """A neural closure that starts at a draw of the paper's."""
        return NeuralPolar(self.make_closure(generator), hidden=hidden, generator=generator)

    def make_policy(self, generator: torch.Generator) -> nn.Module:
        """The paper's policy: one affine law with offset per action through the smooth clip, ten weights for errors."""
        return SaturatedAffine(len(self.observations), self.actions, weight_scale=0.2, generator=generator)
