r"""Gymnasium's ``Pendulum-v1`` as a plant: a rod that its weak motor can only swing up."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.closures import PositiveCoefficients
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.policies import SaturatedMLP
from rt_torchrl.plants.shapes import Action, Actions, Cost, Input, Inputs, Observation, State, States, Time
from rt_torchrl.plants.signal import Signal

UPRIGHT = 0.25
"""Angle within which the rod counts as upright [rad]."""


class UniformRod(PositiveCoefficients):
    r"""Mass and length of a uniform rod that turns about its end, with moment of inertia ml²/3.

    .. math:: c_g = \frac{mgl/2}{ml^2/3}\,\frac1g = \frac{3}{2l}, \qquad c_u = \frac{1}{ml^2/3} = \frac{3}{ml^2}

    The coefficients do not depend on the features. Another law for c_g and c_u, such as a perceptron that also learns
    friction, can replace this closure.

    Args:
        coefficients: mass m [kg] and length l [m], both positive.

    Raises:
        ValueError: if there are not two positive, finite coefficients.
    """

    names = {"mass": "kg", "length": "m"}
    meanings = {"mass": "mass of the rod", "length": "length of the rod"}
    true_coefficients = (1.0, 1.0)

    def forward(self, features: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """c_g [1/m] and c_u [1/(kg m²)], the same at every (cos θ, sin θ, dθ/dt)."""
        mass, length = self.coefficients.unbind()
        coefficients = torch.stack([1.5 / length, 3.0 / (mass * length**2)])
        return coefficients.expand(*features.shape[:-1], 2)


class Pendulum(Plant):
    r"""A rod on a pivot with a motor that is too weak to lift it straight up.

    .. math:: \ddot\theta = c_g\,g\sin\theta + c_u\,u, \qquad c_g = \frac{3}{2l}, \quad c_u = \frac{3}{ml^2}

    ====  ===============  =========================================  =======  ==============================
    kind  name             symbol                                     unit     range
    ====  ===============  =========================================  =======  ==============================
    s     angle            :math:`\theta`, zero upright               rad      ±π
    s     angular_speed    :math:`\dot\theta`                         rad/s    ±8, where Gymnasium stops it
    a     torque           :math:`u`                                  N m      ±2
    e     cosine           :math:`\cos\theta`                         -        ±1
    e     sine             :math:`\sin\theta`                         -        ±1
    e     scaled_speed     :math:`\dot\theta/8`                       -        ±1
    ====  ===============  =========================================  =======  ==============================

    There is no exogenous input.

    Args:
        dt: control interval [s]; Gymnasium's is 0.05.
        horizon: length of an episode T_o [s]; Gymnasium's is 200 intervals.
        closure: closure for c_g and c_u of the real rod; None for Gymnasium's rod of 1 kg and 1 m.

    Source: gymnasium, ``classic_control/pendulum.py``.
    """

    name = "pendulum"

    gravity = 10.0  # g [m/s²]
    greatest_torque, greatest_speed = 2.0, 8.0  # [N m], [rad/s]
    greatest_initial_speed = 1.0  # [rad/s]
    hidden = (32, 32)

    states = (
        Signal(symbol=r"\theta", name="angle", unit="rad", low=-math.pi, high=math.pi, periodic=True),
        Signal(symbol=r"\dot\theta", name="angular_speed", unit="rad/s", low=-greatest_speed, high=greatest_speed),
    )
    actions = (Signal(symbol="u", name="torque", unit="N m", low=-greatest_torque, high=greatest_torque),)
    observations = (
        Signal(symbol=r"\cos\theta", name="cosine", unit="-", low=-1.0, high=1.0),
        Signal(symbol=r"\sin\theta", name="sine", unit="-", low=-1.0, high=1.0),
        Signal(symbol=r"\dot\theta/8", name="scaled_speed", unit="-", low=-1.0, high=1.0),
    )

    def __init__(self, *, dt: float = 0.05, horizon: float = 10.0, closure: nn.Module | None = None):
        super().__init__(dt=dt, horizon=horizon, closure=UniformRod.true() if closure is None else closure)

    # The system

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        r"""The rates dθ/dt and d²θ/dt² = c_g g sin θ + c_u u.

        Args:
            t: time [s], unused.
            state: angle θ [rad] and speed dθ/dt [rad/s].
            action: torque u [N m].
            exogenous: empty tensor.
            closure: closure from (cos θ, sin θ, dθ/dt) to c_g [1/m] and c_u [1/(kg m²)].
        """
        (theta, rate), (u,) = state.unbind(-1), action.unbind(-1)
        sine = theta.sin()
        c_g, c_u = closure(torch.stack([theta.cos(), sine, rate], -1)).unbind(-1)
        return torch.stack([rate, c_g * self.gravity * sine + c_u * u], -1)

    def actuate(self, state: State, command: Action) -> Action:
        """The torque of the motor, at most ±2 N m."""
        return command.clamp(-self.greatest_torque, self.greatest_torque)

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        r"""Gymnasium's own step, semi-implicit Euler with a stop at ±8 rad/s, because it is the real system here.

        .. math:: \dot\theta' = \mathrm{stop}(\dot\theta + \ddot\theta\,\Delta t), \qquad
            \theta' = \theta + \dot\theta'\,\Delta t

        The angle is kept in [−π, π), which its sine and cosine determine, as by Gymnasium's ``angle_normalize``.
        """
        theta, rate = state.unbind(-1)
        acceleration = self.vector_field(t, state, applied, exogenous, closure)[..., 1]
        rate = (rate + acceleration * self.dt).clamp(-self.greatest_speed, self.greatest_speed)
        return torch.stack([self.states[0].wrapped(theta + rate * self.dt), rate], -1)

    # The control problem

    def observe(self, t: Time, state: State, exogenous: Input) -> Observation:
        """Gymnasium's observation cos θ, sin θ and dθ/dt, with the speed scaled to order one."""
        theta, rate = state.unbind(-1)
        return torch.stack([theta.cos(), theta.sin(), rate / self.greatest_speed], -1)

    def running_cost(self, t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        """The cost θ² + 0.1 (dθ/dt)² + 0.001 u² with θ within ±π, the negative of Gymnasium's reward."""
        theta, rate = state.unbind(-1)
        return self.states[0].wrapped(theta) ** 2 + 0.1 * rate**2 + 0.001 * applied[..., 0] ** 2

    discrepancy_scales = (1.0, math.sqrt(15.0))
    """L_p is ½(Δθ² + Δ(dθ/dt)²/ω²) [rad²], with Δθ the short way round and ω² = 15/s² of a hanging rod."""

    def merit(self, states: States, applied: Actions, exogenous: Inputs) -> dict[str, Float[Tensor, " batch"]]:
        """Gymnasium's return, and the share of the episode's last quarter in which the rod is upright."""
        t = self.dt * torch.arange(applied.shape[1], dtype=states.dtype, device=states.device)
        cost = self.running_cost(t, states[:, :-1], applied, exogenous)
        last = states[:, -(applied.shape[1] // 4) :, 0]
        upright = (self.states[0].wrapped(last).abs() < UPRIGHT).to(states.dtype)
        return {"return [-]": -cost.sum(-1), "upright in the last quarter [%]": 100.0 * upright.mean(-1)}

    # Randomness

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} 2"]:
        """Initial states as in Gymnasium: any angle, and a speed of at most 1 rad/s."""
        share = 2.0 * torch.rand(batch, 2, generator=generator, dtype=torch.float64, device=generator.device) - 1.0
        return torch.stack([math.pi * share[:, 0], self.greatest_initial_speed * share[:, 1]], -1)

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps 0"]:
        """Empty exogenous inputs: nothing acts on the pendulum from outside."""
        return torch.zeros(batch, self.n_steps, 0, dtype=torch.float64, device=generator.device)

    def make_closure(self, generator: torch.Generator) -> nn.Module:
        """A rod with half of the true mass and length; nothing is drawn."""
        return UniformRod([0.5 * value for value in UniformRod.true_coefficients])

    def make_policy(self, generator: torch.Generator) -> nn.Module:
        """A perceptron, because no affine law of cos θ, sin θ and dθ/dt swings the rod up and also holds it there."""
        return SaturatedMLP(len(self.observations), self.actions, hidden=self.hidden, generator=generator)
