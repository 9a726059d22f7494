r"""The contract that a plant fulfils.

A plant is a sampled-data system. At :math:`t_k = k\,\Delta t` the agent sends a command, and the actuators turn it into
an applied action. This action and the exogenous input are held over :math:`[t_k, t_{k+1}]`, and one Runge-Kutta step
integrates the vector field over that interval. :meth:`Plant.step` is the map of the interval,

.. math:: s_{k+1} = \Phi(t_k, s_k, a_k, z_k; w_p).

The real system and its digital twin have the *same* map: they differ in the closure that they pass to it.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from rt_torchrl.plants.integrators import RK4_REAL_STABILITY, rk4_step
from rt_torchrl.plants.policies import SaturatedAffine
from rt_torchrl.plants.signal import Signal

MOST_STEPS = 10_000_000
"""Control intervals of the longest episode; a hundred numbers for each interval take 8 GB."""


class Transition(NamedTuple):
    """The outcome of one control interval: the state at its end and the action that was applied during it."""

    state: Tensor
    applied: Tensor


class Plant(nn.Module, ABC):
    """Physics and control problem of one system; ``envs/`` holds examples.

    A subclass declares its signals in the four class attributes (``inputs`` may be empty), and defines
    :meth:`vector_field`, :meth:`observe`, :meth:`running_cost`, :meth:`discrepancy`, :meth:`draw_initial_state`,
    :meth:`draw_exogenous` and :meth:`make_closure`. Every method is pure and takes any leading batch dimensions; the
    last dimension is that of the signals. A method must work when it is compiled, batched and differentiated: it
    contains no clamp, detach, random number, device choice or Python branch on a tensor.
    :func:`rt_torchrl.check_plant` finds where a subclass does not fulfil this.

    Args:
        dt: control interval and integration step Δt [s].
        horizon: length of an episode T_o [s], a whole number of steps.
        closure: the true closure, which the real system uses; it maps the features that :meth:`vector_field` passes to
            it to coefficients.

    Raises:
        ValueError: if ``dt`` or ``horizon`` is not positive, or ``horizon`` is no multiple of ``dt`` or exceeds
            ``MOST_STEPS`` intervals.
    """

    name: str
    states: tuple[Signal, ...]
    actions: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    observations: tuple[Signal, ...]
    own_scheme: bool = False
    """Whether :meth:`step` has a scheme of its own, which a twin must follow to the last digit.

    The engine ``odeint_adjoint`` cannot follow it and is refused.
    """
    controller_states: tuple[str, ...] = ()
    """Names of the states that a controller computes, such as filters, integrals and the actions applied last.

    All other states are measured. An exported controller holds these states and advances them by :meth:`step`.
    """

    def __init__(self, *, dt: float, horizon: float, closure: nn.Module):
        super().__init__()
        for argument, value in (("dt", dt), ("horizon", horizon)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{argument}={value} s of plant {self.name!r} must be positive and finite.")
        if not horizon / dt <= MOST_STEPS:
            raise ValueError(
                f"horizon={horizon} s of plant {self.name!r} is {horizon / dt:.3g} steps dt={dt} s; it must be at most "
                f"{MOST_STEPS:.0e}, because an episode is kept in memory."
            )
        self.dt = float(dt)
        self.n_steps = round(horizon / dt)
        if self.n_steps < 1 or abs(self.n_steps * dt - horizon) > 1e-6 * dt:
            raise ValueError(
                f"horizon={horizon} s of plant {self.name!r} must be a whole number of steps dt={dt} s; "
                f"try {max(1, self.n_steps) * dt} s."
            )
        self.closure = closure

    @property
    def horizon(self) -> float:
        """Length of an episode T_o [s]."""
        return self.n_steps * self.dt

    # The system

    @abstractmethod
    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        action: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        """Time derivative of the state, ds/dt = f(t, s, a, z, g(s; w_p)), for a held action and exogenous input."""

    def actuate(
        self, state: Float[Tensor, "*batch n_s"], command: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_a"]:
        """The action that the actuators make of a command, for example under a rate limit; by default the command."""
        return command

    def latch(
        self, state: Float[Tensor, "*batch n_s"], applied: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_s"]:
        """The end state, into which sampled-data parts write what they remember of the interval; by default nothing."""
        return state

    def step(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        command: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Transition:
        r"""One control interval, :math:`\Phi`: actuate, hold, integrate, latch.

        Args:
            t: start of the interval [s].
            state: state at ``t``.
            command: action that the policy asks for.
            exogenous: exogenous input, held over the interval.
            closure: the true closure in the real system, the learned one in the twin.
        """
        applied = self.actuate(state, command)
        end = rk4_step(lambda t, s: self.vector_field(t, s, applied, exogenous, closure), t, state, self.dt)
        return Transition(self.latch(end, applied), applied)

    # The control problem

    @abstractmethod
    def observe(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch n_o"]:
        """The observation of the policies: the tracking errors e, scaled to order one."""

    @abstractmethod
    def running_cost(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch"]:
        r"""Lagrangian L_a of the control problem; :math:`J_a = \frac1{T_o}\int L_a\,dt`, the reward is −L_a."""

    @abstractmethod
    def discrepancy(
        self, state: Float[Tensor, "*#batch n_s"], measured: Float[Tensor, "*#batch n_s"]
    ) -> Float[Tensor, "*batch"]:
        r"""Lagrangian L_p of the identification problem; :math:`J_p = \int L_p(s, \check s)\,dt`."""

    def merit(
        self,
        states: Float[Tensor, "batch samples n_s"],
        applied: Float[Tensor, "batch n n_a"],
        exogenous: Float[Tensor, "batch n n_z"],
    ) -> dict[str, Float[Tensor, " batch"]]:
        """Physical quantities by which an engineer judges whole episodes, named with their units; by default none."""
        return {}

    def categories(self, exogenous: Float[Tensor, "batch n n_z"]) -> dict[str, Bool[Tensor, " batch"]]:
        """Kinds of episodes, by name, for which results are also shown separately; by default none."""
        return {}

    def complete_states(
        self,
        measured: dict[str, Float[Tensor, " samples"]],
        exogenous: Float[Tensor, "n n_z"],
        actions: Float[Tensor, "n n_a"],
    ) -> Float[Tensor, "samples n_s"]:
        """All states at n + 1 samples, completed from the states in a log; by default the log must hold all states.

        A plant overrides this method if some states have no sensor but follow from the others, such as filters.

        Args:
            measured: states that were logged, by name.
            exogenous: exogenous inputs of the n intervals between the samples.
            actions: applied actions of the n intervals between the samples.

        Raises:
            ValueError: if states are missing; the message names them.
        """
        missing = [state.name for state in self.states if state.name not in measured]
        if missing:
            raise ValueError(
                f"log of plant {self.name!r} holds no {', '.join(missing)}, and the plant does not say how to complete "
                "its states; log them, name their columns, or override Plant.complete_states."
            )
        return torch.stack([measured[state.name] for state in self.states], -1)

    def controller_start(
        self, measured: Float[Tensor, "*batch n_y"], exogenous: Float[Tensor, "*batch n_z"]
    ) -> Float[Tensor, "*batch n_c"]:
        """The :attr:`controller_states` of a controller that is switched on; by default zeros.

        Args:
            measured: the other states, in their order.
            exogenous: exogenous inputs.
        """
        return measured.new_zeros(*measured.shape[:-1], len(self.controller_states))

    # Randomness, always from the generator that is passed in

    @abstractmethod
    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        """Initial states of ``batch`` episodes."""

    @abstractmethod
    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps n_z"]:
        """Exogenous inputs of ``batch`` episodes, one sample per control interval."""

    @abstractmethod
    def make_closure(self, generator: torch.Generator) -> nn.Module:
        """The closure that a twin of this plant starts from, with the weights w_p⁰."""

    def make_neural_closure(self, generator: torch.Generator, hidden: Sequence[int]) -> nn.Module:
        """A closure with a perceptron that starts with the values of :meth:`make_closure`; by default there is none.

        Raises:
            ValueError: if the plant has no such closure.
        """
        raise ValueError(
            f"plant {self.name!r} has no neural closure; define its make_neural_closure, or use that of make_closure."
        )

    def make_policy(self, generator: torch.Generator) -> nn.Module:
        """The policy that both controllers start from, w_a⁰; by default a saturated affine law of the observation."""
        return SaturatedAffine(len(self.observations), self.actions, generator=generator)

    def extra_repr(self) -> str:
        return f"name={self.name!r}, dt={self.dt} s, horizon={self.horizon} s"


def require_stable_step(plant: str, dt: float, rate: float, *, mode: str, remedy: str) -> None:
    """Refuse a step that makes an explicit Runge-Kutta step unstable.

    Args:
        plant: name of the plant, for the message.
        dt: step [s].
        rate: fastest decay rate |Re μ| of the linearised plant [1/s].
        mode: name of the state that decays at that rate, for the message.
        remedy: another remedy than a smaller step, for the message.

    Raises:
        ValueError: if dt·rate exceeds the stability limit of RK4 on the negative real axis, 2.785.
    """
    if dt * rate > RK4_REAL_STABILITY:
        raise ValueError(
            f"dt={dt} s makes plant {plant!r} unstable: {mode} decays at {rate:.4g} 1/s, so dt·rate = {dt * rate:.3g} "
            f"exceeds the limit {RK4_REAL_STABILITY} of an explicit fourth-order Runge-Kutta step. "
            # The share keeps the rounded advice below the limit.
            f"Use dt <= {0.995 * RK4_REAL_STABILITY / rate:.3g} s, or {remedy}."
        )
