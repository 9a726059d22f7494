r"""The flapping-wing micro air vehicle as a plant: a point mass under two beating wings (paper, section 5.2)."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.flapping_wing import measurements as sensors
from rt_torchrl.envs.flapping_wing import memory
from rt_torchrl.envs.flapping_wing import merit as judgement
from rt_torchrl.envs.flapping_wing.costs import TrackingCost, needs_memory, require_rate
from rt_torchrl.envs.flapping_wing.disturbances import GaussianGust, GustModel
from rt_torchrl.envs.flapping_wing.models import QuasiSteadyPolar
from rt_torchrl.envs.flapping_wing.neural import drawn_neural_polar
from rt_torchrl.envs.flapping_wing.suspects import further_suspects, suspects
from rt_torchrl.envs.flapping_wing.wings import Wings
from rt_torchrl.options import require_range
from rt_torchrl.plants.plant import Plant, RunningCost
from rt_torchrl.plants.policies import SaturatedAffine
from rt_torchrl.plants.sampling import require_stable_step
from rt_torchrl.plants.signal import Signal

MASSES = (1e-5, 0.05)
"""Masses of which the lightest has a thousandth, and the heaviest ten times the weight that the wings carry [kg]."""


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

    The table shows the paper's observation e; ``observe`` chooses others.

    Note: the paper prints no number of wings; here there are two, which carry the weight at 77.2 deg, because a single
    wing cannot within the range of A_φ.

    Args:
        dt: control interval [s].
        horizon: length of an episode T_o [s].
        closure: closure for C_L and C_D of the real wings; None for the paper's polar.
        wind: source of the headwind.
        target: position x_f and z_f of the target [m].
        cost: running cost L_a, see ``costs.py``; None for the paper's.
        mass: mass m_b of the body [kg].
        stroke_plane_rate: greatest rate of the stroke plane angle [deg/s]; None for none, as in the paper, so that the
            angle may flip within a wing beat. With it the angle that was applied last is a fifth state.
        observe: names of measurements and observation sets in ``measurements.py``; by default the paper's errors. The
            low-passed positions are two more states, the last ones, if one of these needs them.

    Raises:
        ValueError: for a mass, rate or target that a drone of this kind cannot have, an unknown measurement, or a step
            that is unstable or does not resolve the wing beat.
    """

    name = "flapping_wing"

    gravity = 9.81  # g [m/s²]
    air_density = 1.225  # ρ [kg/m³]
    frequency = 20.0  # f [Hz]
    pitching_amplitude = 45.0  # A_α [deg]
    wing_root = 0.0225  # R_0 [m]
    wing_length = 0.05  # R [m]; the tip is at R_0 + R
    mean_chord = 0.01  # c̄ [m]
    span_nodes = 6  # positions after 2 s differ by 2e-6 m from those with forty nodes
    body_drag_area = 5e-4  # S_b C_D,b [m²]
    smallest_airspeed = 0.01  # ε [m/s], the floor of |U|
    strongest_wind = 2.554  # [m/s]; the trim in it needs β_w = −30 deg
    least_steps_per_beat = 20

    states: tuple[Signal, ...] = sensors.STATES
    actions = sensors.ACTIONS
    inputs = sensors.INPUTS
    measurements = sensors.MEASUREMENTS
    observation_sets = sensors.OBSERVATION_SETS

    target: Tensor
    mass: Tensor
    weight: Tensor

    def __init__(
        self,
        *,
        dt: float = 5e-4,
        horizon: float = 5.0,
        closure: nn.Module | None = None,
        wind: GustModel | None = None,
        target: tuple[float, float] = (5.0, 5.0),
        cost: RunningCost | None = None,
        mass: float = 3e-3,
        stroke_plane_rate: float | None = None,
        observe: Sequence[str] = (),
    ):
        polar = QuasiSteadyPolar.true() if closure is None else closure
        super().__init__(dt=dt, horizon=horizon, closure=polar, observe=observe)
        for coordinate in target:
            require_range("target", coordinate, -1e3, 1e3, unit="m", of="the drone")
        require_range("mass", mass, *MASSES, unit="kg", of="the drone")
        self.wind = GaussianGust() if wind is None else wind
        self.cost = TrackingCost() if cost is None else cost
        require_rate(stroke_plane_rate)
        self.stroke_plane_rate, self._greatest_turn = stroke_plane_rate, (stroke_plane_rate or 0.0) * dt
        turns = stroke_plane_rate or needs_memory(self.cost) or sensors.STROKE_PLANE in self.observed
        filters = any(measurement in sensors.OF_FILTERED for measurement in self.observed)
        self.remembered, self.filtered = 1 if turns else 0, 2 if filters else 0
        held = (*sensors.ACTIONS[1:][: self.remembered], *sensors.FILTERED[: self.filtered])
        self.states, self.controller_states = (*sensors.STATES, *held), tuple(signal.name for signal in held)
        x_f = torch.tensor(target, dtype=torch.float64)
        self.register_buffer("target", x_f)
        self.register_buffer("mass", torch.tensor(mass, dtype=torch.float64))
        self.register_buffer("weight", torch.tensor([0.0, -mass * self.gravity], dtype=torch.float64))
        self.wings = Wings(
            root=self.wing_root,
            length=self.wing_length,
            mean_chord=self.mean_chord,
            nodes=self.span_nodes,
            air_density=self.air_density,
            smallest_airspeed=self.smallest_airspeed,
        )
        self._require_resolved_step()

    def _require_resolved_step(self) -> None:
        longest = 1.0 / (self.least_steps_per_beat * self.frequency)
        if self.dt > longest * (1.0 + 1e-9):
            raise ValueError(
                f"dt={self.dt} s does not resolve the wing beat of plant {self.name!r} at {self.frequency:g} Hz; "
                f"use dt <= {longest:g} s, {self.least_steps_per_beat} steps per beat."
            )
        require_stable_step(
            self.name,
            self.dt,
            self.damping_rate(),
            mode="the body's velocity at full stroke",
            remedy="a closure with less drag",
        )

    def damping_rate(self) -> float:
        """Fastest decay rate [1/s] of the body's velocity over a beat at the largest stroke, from hover in calm air."""
        t = torch.arange(100, dtype=torch.float64, device=self.mass.device) / (100 * self.frequency)
        action = t.new_tensor([[self.actions[0].high, 0.0]]).expand(len(t), 2)

        def acceleration(velocity: Tensor) -> Tensor:
            return self.force(t, velocity, action, self.closure) / self.mass

        at_rest = t.new_zeros(len(t), 2)
        basis = torch.eye(2, dtype=t.dtype, device=t.device)
        columns = [torch.func.jvp(acceleration, (at_rest,), (e.expand_as(at_rest),))[1] for e in basis]
        return max(0.0, -torch.linalg.eigvals(torch.stack(columns, -1)).real.min().item())

    # The system

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        action: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch 1"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
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
        # The angle that was applied last is held, and the filters follow the position, or there are no such states.
        held = torch.zeros_like(state[..., 4 : 4 + self.remembered])
        filters = memory.filter_rates(state, self.filtered)
        return torch.cat([velocity, (force + self.weight) / self.mass, held, filters], -1)

    def force(
        self,
        t: Float[Tensor, "*#batch"],
        relative: Float[Tensor, "*batch 2"],
        action: Float[Tensor, "*batch 2"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch 2"]:
        r"""Forces F_x and F_z [N] of wings and body, which move at ``relative`` [m/s] to the air.

        R_2(β_w) turns the velocity into the stroke frame and R_3(φ) into the flapping frame; their transposes turn the
        force back. The lateral forces of the two :class:`Wings` cancel.

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
        F_x, F_z = self.wings.force(cos_phi * stroke_x, stroke_z, phi_dot, alpha, closure)
        wings = torch.stack([cos_beta * cos_phi * F_x - sin_beta * F_z, sin_beta * cos_phi * F_x + cos_beta * F_z], -1)
        speed = torch.sqrt(v_x**2 + v_z**2 + self.smallest_airspeed**2).unsqueeze(-1)
        return wings - 0.5 * self.air_density * self.body_drag_area * speed * relative

    def actuate(
        self, state: Float[Tensor, "*batch n_s"], command: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch 2"]:
        """The command, in which the stroke plane turns by at most its rate times dt."""
        if self.stroke_plane_rate is None:
            return command
        change = (command[..., 1] - state[..., 4]).clamp(-self._greatest_turn, self._greatest_turn)
        return torch.stack([command[..., 0], state[..., 4] + change], -1)

    # The control problem

    def running_cost(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch 1"],
    ) -> Float[Tensor, "*batch"]:
        """The cost of the task, see ``costs.py``."""
        return self.cost(self, t, state, applied, exogenous)

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Scales in which L_p is ½‖x − x̌‖² [m²] of the positions (paper, eq. drone_eq_Jp)."""
        return (1.0, 1.0, *(math.inf,) * (len(self.states) - 2))

    latch, controller_start, seen_velocity = memory.latch, memory.started, memory.seen_velocity
    merit, setpoints, categories, make_neural_closure, suspects, further_suspects = (
        judgement.merit,
        judgement.setpoints,
        judgement.categories,
        drawn_neural_polar,
        suspects,
        further_suspects,
    )

    def complete_states(self, measured: dict[str, Tensor], exogenous: Tensor, actions: Tensor) -> Tensor:
        """All states; what a controller remembers follows from the others."""
        found = memory.completed(self, measured, exogenous, actions)
        return super().complete_states(found, exogenous, actions)

    # Randomness

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        """Initial states at rest in the origin, with an upright stroke plane; nothing is drawn."""
        return torch.zeros(batch, len(self.states), dtype=torch.float64, device=generator.device)

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps 1"]:
        """Headwind u_∞ [m/s]."""
        return self.wind.draw(batch, self.n_steps, self.dt, generator).unsqueeze(-1)

    def make_closure(self, generator: torch.Generator) -> nn.Module:
        """The paper's polar with random coefficients within ±50 % of the true ones."""
        return QuasiSteadyPolar.draw(generator)

    def make_policy(self, generator: torch.Generator) -> nn.Module:
        """The paper's policy: one affine law with offset per action through the smooth clip, ten weights for errors."""
        return SaturatedAffine(len(self.observations), self.actions, weight_scale=0.2, generator=generator)
