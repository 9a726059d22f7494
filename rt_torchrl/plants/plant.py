r"""The contract that a plant fulfils.

A plant is a sampled-data system. At :math:`t_k = k\,\Delta t` the agent sends a command, and the actuators turn it into
an applied action. This action and the exogenous input are held over :math:`[t_k, t_{k+1}]`, and one Runge-Kutta step
integrates the vector field over that interval. :meth:`Plant.step` is the map of the interval,

.. math:: s_{k+1} = \Phi(t_k, s_k, a_k, z_k; w_p).

The real system and its digital twin have the *same* map: they differ in the closure that they pass to it.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.discrepancy import Discrepancy
from rt_torchrl.plants.ending import Ending
from rt_torchrl.plants.episode_length import whole_steps
from rt_torchrl.plants.integrators import rk4_step
from rt_torchrl.plants.measurement import Measurement, Preview, chosen
from rt_torchrl.plants.merits import Merits
from rt_torchrl.plants.policies import SaturatedAffine
from rt_torchrl.plants.signal import Signal


class Transition(NamedTuple):
    """The outcome of one control interval: the state at its end and the action that was applied during it."""

    state: Tensor
    applied: Tensor


class Plant(nn.Module, Discrepancy, Ending, Merits, ABC):
    """Physics and control problem of one system; ``envs/`` holds examples.

    A subclass declares its signals in the four class attributes (``inputs`` may be empty), and defines
    :meth:`vector_field`, :meth:`observe`, :meth:`running_cost`, :meth:`draw_initial_state`, :meth:`draw_exogenous` and
    :meth:`make_closure`. If it declares ``measurements``, of which a policy may observe any
    choice, ``observations`` and :meth:`observe` follow from the choice. Every method is pure and takes any leading
    batch dimensions; the last dimension is that of the signals. A method must work when it is compiled, batched and
    differentiated: it contains no clamp, detach, random number, device choice or Python branch on a tensor.
    :func:`rt_torchrl.check_plant` finds where a subclass does not fulfil this.

    Args:
        dt: control interval and integration step Δt [s].
        horizon: length of an episode T_o [s], a whole number of steps.
        closure: the true closure, which the real system uses; it maps the features that :meth:`vector_field` passes to
            it to coefficients.
        observe: names of the ``measurements`` that the policies observe, and of ``observation_sets``; by default the
            first set.

    Raises:
        ValueError: if ``dt`` or ``horizon`` is not positive, ``horizon`` is no multiple of ``dt`` or exceeds
            ten million intervals, or ``observe`` names what the plant does not measure.
    """

    name: str
    states: tuple[Signal, ...]
    actions: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    observations: tuple[Signal, ...]
    measurements: tuple[Measurement, ...] = ()
    """What the sensors give; empty in a plant that defines ``observations`` and :meth:`observe` itself."""
    observation_sets: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    """Names of measurements that are observed together, by the name of the set."""
    own_scheme: bool = False
    """Whether :meth:`advance` has a scheme of its own, which a twin must follow to the last digit.

    The engine ``odeint_adjoint`` cannot follow it and is refused. A class that overrides :meth:`advance` has one,
    unless it says False itself.
    """
    controller_states: tuple[str, ...] = ()
    """Names of the states that a controller computes, such as filters, integrals and the actions applied last.

    All other states are measured. An exported controller holds these states and advances them by :meth:`step`.
    """
    unread: int = 0
    """Number of states, the last ones, that no sensor reads; twins and policies do not know of them."""

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        if "advance" in vars(cls) and "own_scheme" not in vars(cls):
            cls.own_scheme = cls.advance is not Plant.advance
        if "discrepancy" in vars(cls):
            raise ValueError(
                f"{cls.__name__}.discrepancy: L_p is a sum of squares, so that least squares fit it; give the scales "
                "of the states instead, discrepancy_scales, with math.inf for a state that is not compared."
            )

    def __init__(self, *, dt: float, horizon: float, closure: nn.Module, observe: Sequence[str] = ()):
        super().__init__()
        self.n_steps = whole_steps(self.name, dt, horizon)
        self.dt = float(dt)
        self.closure = closure
        self.observed = self.chosen(observe)
        self.previews = tuple(m.read for m in self.observed if isinstance(m.read, Preview))
        if self.observed:
            self.observations = tuple(measurement.observation for measurement in self.observed)
        if self.previews:
            self.inputs = (*self.inputs, *(m.signal for m in self.observed if m.read in self.previews))

    @classmethod
    def chosen(cls, observe: Sequence[str]) -> tuple[Measurement, ...]:
        """The measurements that ``observe`` names.

        Raises:
            ValueError: if there is no such measurement or set.
        """
        return chosen(cls.name, observe, cls.measurements, cls.observation_sets)

    @property
    def acting_inputs(self) -> tuple[Signal, ...]:
        """Inputs that act on the plant; previews of these stand after them in ``inputs``."""
        return self.inputs[: len(self.inputs) - len(self.previews)]

    @property
    def readings(self) -> tuple[Signal, ...]:
        """The states that sensors read, which are all that a record holds."""
        return self.states[: len(self.states) - self.unread]

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

    def advance(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        """The state after Δt under a held action, by one Runge-Kutta step of the vector field.

        A plant that overrides this method has a scheme of its own; see :attr:`own_scheme`.
        """
        return rk4_step(lambda t, s: self.vector_field(t, s, applied, exogenous, closure), t, state, self.dt)

    def step(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        command: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Transition:
        r"""One control interval from ``t`` on, :math:`\Phi`: actuate, advance under the held action, latch.

        The closure is the true one in the real system, and the learned one in the twin.
        """
        applied = self.actuate(state, command)
        return Transition(self.latch(self.advance(t, state, applied, exogenous, closure), applied), applied)

    def at_rest(self, read: Float[Tensor, "*batch n_r"]) -> Float[Tensor, "*batch n_s"]:
        """States at the start of an episode, from those that sensors read; the :attr:`unread` ones are at rest."""
        return read

    # The control problem

    def observe(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch n_o"]:
        """The observation of the policies, scaled to order one, such as tracking errors.

        Raises:
            NotImplementedError: if the plant has neither ``measurements`` nor a method of its own.
        """
        if not self.observed:
            raise NotImplementedError(f"plant {self.name!r} declares no measurements and defines no observe().")
        seen = [measurement.observed(self, t, state, exogenous) for measurement in self.observed]
        _, *seen = torch.broadcast_tensors(state[..., 0], *seen)
        return torch.stack(seen, -1)

    @abstractmethod
    def running_cost(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch"]:
        r"""Lagrangian L_a of the control problem; the reward is −L_a.

        .. math:: J_a = \frac1{T_o}\Big(\int L_a\,dt + \Phi_a(s(T_o))\Big)
        """

    def terminal_cost(self, state: Float[Tensor, "*batch n_s"]) -> Float[Tensor, "*batch"]:
        """Cost Φ_a of the state at the end of an episode, in the unit of L_a times seconds; by default zero."""
        return state.new_zeros(state.shape[:-1])

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
            exogenous, actions: inputs and applied actions of the n intervals between the samples.

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
        """The :attr:`controller_states` of a controller that is switched on, given the other ones; by default zeros."""
        return measured.new_zeros(*measured.shape[:-1], len(self.controller_states))

    def with_previews(self, exogenous: Float[Tensor, "*batch n n_b"]) -> Float[Tensor, "*batch n n_z"]:
        """All exogenous inputs of whole episodes, from the ``acting_inputs``: previews are their shifts.

        Raises:
            ValueError: if the time ahead of a preview is no whole number of control intervals.
        """
        ahead = [preview.shifted(exogenous, self.dt) for preview in self.previews]
        return torch.cat([exogenous, torch.stack(ahead, -1)], -1) if ahead else exogenous

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

    def suspects(self) -> Mapping[str, "Plant"]:
        """Plants that extend this one by what the real system may have beside it, by name; by default none."""
        return {}

    def further_suspects(self) -> Mapping[str, "Plant"]:
        """Suspects that hypotheses take only by name, such as a :class:`NeuralResidual`; by default none."""
        return {}

    def make_policy(self, generator: torch.Generator) -> nn.Module:
        """The policy that both controllers start from, w_a⁰; by default a saturated affine law of the observation."""
        return SaturatedAffine(len(self.observations), self.actions, generator=generator)

    def extra_repr(self) -> str:
        return f"name={self.name!r}, dt={self.dt} s, horizon={self.horizon} s"
