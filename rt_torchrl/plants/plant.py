r"""The contract that a plant fulfils.

A plant is a sampled-data system. At :math:`t_k = k\,\Delta t` the agent sends a command, and the actuators turn it into
an applied action. This action and the exogenous input are held over :math:`[t_k, t_{k+1}]`, and one Runge-Kutta step
integrates the vector field over that interval. :meth:`Plant.step` is the map of the interval,

.. math:: s_{k+1} = \Phi(t_k, s_k, a_k, z_k; w_p).

The real system and its digital twin have the *same* map: they differ in the closure that they pass to it.

An episode may end early, such as by overspeed or ground contact. A system that has ended stays in the state in which it
ended, and each moment after the end t_e costs L_e:

.. math:: J_a = \frac1{T_o}\Big(\int_0^{t_e} L_a\,dt + \Phi_a(s(t_e)) + (T_o - t_e) L_e\Big)

With an absorbing state the cost of an episode is one number, however long the
episode lasts, and the value of what comes after the end is known: a learner with the discount γ per interval counts
:math:`-L_e/(1 - \gamma)`.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.policies import SaturatedAffine
from rt_torchrl.plants.sampling import rk4_step, whole_steps
from rt_torchrl.plants.shapes import Action, Actions, Cost, Ended, Input, Inputs, Observation, State, States, Time
from rt_torchrl.plants.signal import Measurement, Preview, Signal, differences


class Transition(NamedTuple):
    """The outcome of one control interval: the state at its end and the action that was applied during it."""

    state: Tensor
    applied: Tensor


REQUIRED = ("vector_field", "running_cost", "draw_initial_state", "draw_exogenous", "make_closure")
"""Methods that a plant must define."""
PARTS = {
    "controller": ("observe", "actuate", "controller_start", "make_policy"),
    "memory": ("memorise", "latch"),
    "task": ("running_cost", "terminal_cost", "ended", "merit", "setpoints", "draw_exogenous"),
    "start": ("at_rest", "complete_states", "draw_initial_state"),
    "closure": ("make_closure", "make_neural_closure"),
}
"""Methods for which an extension asks its plant, by what they are about: what a controller knows, which is what sensors
read; what it writes into the states; the task in true states; states at the start; closures."""


class Plant(nn.Module):
    """Physics and control problem of one system; ``envs/`` holds examples.

    A subclass declares its signals in the four class attributes (``inputs`` may be empty), and defines
    :meth:`vector_field`, :meth:`observe`, :meth:`running_cost`, :meth:`draw_initial_state`, :meth:`draw_exogenous` and
    :meth:`make_closure`. If it declares ``measurements``, of which a policy may observe any choice, ``observations``
    and :meth:`observe` follow from the choice. Every method is pure and takes any leading batch dimensions; the last
    dimension is that of the signals. A method must work when it is traced, batched and differentiated: it contains no
    detach, device choice or Python branch on a tensor and, beside the draws, no clamp and no random number.
    :func:`rt_torchrl.check_plant` finds where a subclass does not fulfil this.

    Args:
        dt: control interval and integration step Δt [s].
        horizon: length of an episode T_o [s], a whole number of steps.
        closure: the true closure, which the real system uses; it maps the features that :meth:`vector_field` passes to
            it to coefficients.
        observe: names of the ``measurements`` that the policies observe, and of ``observation_sets``; by default the
            first set.

    Raises:
        TypeError: if the plant lacks a method that it must define.
        ValueError: if ``dt`` or ``horizon`` is not positive, ``horizon`` is no multiple of ``dt`` or exceeds
            ten million intervals, or ``observe`` names what the plant does not measure.
    """

    name: str
    states: tuple[Signal, ...]
    actions: tuple[Signal, ...]
    inputs: tuple[Signal, ...] = ()
    observations: tuple[Signal, ...]
    measurements: tuple[Measurement, ...] = ()
    """What the sensors give; empty in a plant that defines ``observations`` and :meth:`observe` itself."""
    observation_sets: Mapping[str, tuple[str, ...]] = MappingProxyType({})
    """Names of measurements that are observed together, by the name of the set."""
    controller_states: tuple[str, ...] = ()
    """Names of the states that a controller computes, as in ``("integral",)``: filters, integrals, the last actions.

    All other states are measured. An exported controller holds these states and advances them by :meth:`step`.
    """
    memories: tuple[str, ...] = ()
    """Names of those of them that :meth:`memorise` alone writes: they hold what was measured, without further noise."""
    closure_inputs: tuple[str, ...] = ()
    """Names and units of the features of the closure, as in ``"blade pitch [deg]"``; results number them without."""
    closure_outputs: tuple[str, ...] = ()
    """The same of the coefficients that the closure gives."""
    state_sizes: tuple[float, ...] = ()
    """Usual sizes of the states, in their units; by default ones."""
    end_cost: float | None = None
    """Cost L_e of each moment after an early end [unit of L_a]; None in a plant whose episodes never end early."""
    unread: int = 0
    """Number of states, the last ones, that no sensor reads; twins and policies do not know of them."""

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        if "discrepancy" in vars(cls):
            raise ValueError(
                f"{cls.__name__}.discrepancy: L_p is a sum of squares, so that least squares fit it; give the scales "
                "of the states instead, discrepancy_scales, with math.inf for a state that is not compared."
            )

    def __init__(self, *, dt: float, horizon: float, closure: nn.Module, observe: Sequence[str] = ()):
        super().__init__()
        kind = type(self)
        missing = [name for name in REQUIRED if getattr(kind, name) is getattr(Plant, name)]
        if missing and kind.innermost is Plant.innermost:  # an extension has those of its plant
            raise TypeError(f"plant {kind.__name__} must define {', '.join(missing)}; docs/own_plant.md shows how.")
        self.n_steps = whole_steps(self.name, dt, horizon)
        self.dt = float(dt)
        self.closure = closure
        self.observed = self._chosen(observe)
        self.previews = tuple(m.read for m in self.observed if isinstance(m.read, Preview))
        if self.observed:
            self.observations = tuple(measurement.observation for measurement in self.observed)
        if self.previews:
            self.inputs = (*self.inputs, *(m.signal for m in self.observed if m.read in self.previews))

    def _chosen(self, observe: Sequence[str]) -> tuple[Measurement, ...]:
        """The measurements that policies observe, each once and in the order in which they are asked for.

        Args:
            observe: names of measurements and of sets of them; nothing means the first set.

        Raises:
            ValueError: if there is no such measurement or set.
        """
        if isinstance(observe, str):
            raise ValueError(f"observe={observe!r} of plant {self.name!r} must be a sequence of names, not a text.")
        known, sets = {measurement.name: measurement for measurement in self.measurements}, self.observation_sets
        observe = observe or tuple(sets)[:1] or tuple(known)
        names = dict.fromkeys(name for word in observe for name in sets.get(word, (word,)))
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ValueError(
                f"observe={tuple(observe)} of plant {self.name!r}: {', '.join(unknown)} does not exist; choose among "
                f"the sets {', '.join(sets) or '(none)'} and the measurements {', '.join(known) or '(none)'}."
            )
        return tuple(known[name] for name in names)

    @property
    def acting_inputs(self) -> tuple[Signal, ...]:
        """Inputs that act on the plant; previews of these stand after them in ``inputs``."""
        return self.inputs[: len(self.inputs) - len(self.previews)]

    @property
    def readings(self) -> tuple[Signal, ...]:
        """The states that sensors read, which are all that a record holds."""
        return self.states[: len(self.states) - self.unread]

    @property
    def innermost(self) -> "Plant":
        """The plant that extensions extend; a plant that extends none is its own."""
        return self

    @property
    def own_scheme(self) -> bool:
        """Whether :meth:`step` has a scheme of its own, where other ones would integrate another system.

        It is that of a plant that overrides :meth:`step` or :meth:`advance`. One that takes a Runge-Kutta step in spite
        of it sets ``own_scheme = False``.
        """
        return type(self).step is not Plant.step or type(self).advance is not Plant.advance

    @property
    def horizon(self) -> float:
        """Length of an episode T_o [s]."""
        return self.n_steps * self.dt

    # Dynamics

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        """Time derivative of the state, ds/dt = f(t, s, a, z, g(s; w_p)), for a held action and exogenous input."""
        raise NotImplementedError

    def actuate(self, state: State, command: Action) -> Action:
        """The action that the actuators make of a command, for example under a rate limit; by default the command."""
        return command

    def memorise(self, t: Time, state: State, exogenous: Input) -> State:
        """The state, into which the controller writes what it keeps of this moment's signals; by default nothing.

        Inputs are those that sensors read, also where an extension lets others act on the plant.
        """
        return state

    def latch(self, state: State, applied: Action) -> State:
        """The end state, into which sampled-data parts write what they remember of the interval; by default nothing."""
        return state

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        """The state after Δt under a held action, by one Runge-Kutta step of the vector field.

        A plant may override this method by a scheme of its own; see :attr:`own_scheme`.
        """
        return rk4_step(lambda t, s: self.vector_field(t, s, applied, exogenous, closure), t, state, self.dt)

    def step(self, t: Time, state: State, command: Action, exogenous: Input, closure: nn.Module) -> Transition:
        r"""One control interval from ``t`` on, :math:`\Phi`: memorise, actuate, advance under the held action, latch.

        The closure is the true one in the real system, and the learned one in the twin.
        """
        return self.step_by(self.advance, t, state, command, exogenous, closure)

    def step_by(
        self, scheme: Callable[..., State], t: Time, state: State, command: Action, exogenous: Input, closure: nn.Module
    ) -> Transition:
        """One control interval in which another scheme than :meth:`advance`, with its arguments, integrates."""
        state = self.memorise(t, state, exogenous)
        applied = self.actuate(state, command)
        return Transition(self.latch(scheme(t, state, applied, exogenous, closure), applied), applied)

    def sensed(self, state: State, exogenous: Input) -> tuple[Float[Tensor, "*batch n_r"], Input]:
        """What sensors read of states and inputs, of which state feedback makes its commands."""
        return state[..., : len(self.readings)], exogenous

    def at_rest(self, readings: Float[Tensor, "*batch n_r"]) -> State:
        """States at the start of an episode, from those that sensors read; the :attr:`unread` ones are at rest."""
        return readings

    # Task

    def observe(self, t: Time, state: State, exogenous: Input) -> Observation:
        """The observation of the policies, scaled to order one, such as tracking errors.

        Raises:
            NotImplementedError: if the plant has neither ``measurements`` nor a method of its own.
        """
        if not self.observed:
            raise NotImplementedError(f"plant {self.name!r} declares no measurements and defines no observe().")
        values = [(m.read(self, t, state, exogenous) - m.offset) / m.scale for m in self.observed]
        _, *values = torch.broadcast_tensors(state[..., 0], *values)
        return torch.stack(values, -1)

    def running_cost(self, t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        r"""Lagrangian L_a of the control problem; the reward is −L_a.

        .. math:: J_a = \frac1{T_o}\Big(\int L_a\,dt + \Phi_a(s(T_o))\Big)
        """
        raise NotImplementedError

    def terminal_cost(self, state: State) -> Cost:
        """Cost Φ_a of the state at the end of an episode, also an early one, in the unit of L_a times seconds.

        By default it is zero.
        """
        return state.new_zeros(state.shape[:-1])

    def ended(self, state: State) -> Ended:
        """Whether an episode has ended in this state; by default never.

        A plant that overrides this method sets :attr:`end_cost`. Where an end is a failure, it is greater than what L_a
        is in a bad episode, or else the end would pay; where an end is the goal, such as a landing, it may be zero, and
        :meth:`terminal_cost` says how good the end is.
        """
        return torch.zeros_like(state[..., 0], dtype=torch.bool)

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Differences c_i of the states that count alike in L_p, in their units; infinite for one not compared.

        By default these are :attr:`state_sizes`, and infinite for :attr:`controller_states`, which say no more than the
        measured states that they follow from; a plant may override them.
        """
        sizes = self.state_sizes or (1.0,) * len(self.states)
        computed = [k for k, signal in enumerate(self.states) if signal.name in self.controller_states]
        return tuple(math.inf if k in computed else size for k, size in enumerate(sizes))

    def discrepancy(self, state: Float[Tensor, "*#batch n_s"], measured: Float[Tensor, "*#batch n_s"]) -> Cost:
        r"""Lagrangian L_p of the identification problem; :math:`J_p = \int L_p(s, \check s)\,dt`.

        .. math:: L_p(s, \check s) = \tfrac12 \sum_i \Big(\frac{s_i - \check s_i}{c_i}\Big)^2

        The scales c are :attr:`discrepancy_scales`; a periodic state differs the short way round.

        Raises:
            ValueError: if there is not one scale for each state, or one is not positive.
        """
        scales = self.discrepancy_scales
        if len(scales) != len(self.states) or not all(scale > 0.0 for scale in scales):
            named = ", ".join(f"{signal.name} [{signal.unit}]" for signal in self.states)
            raise ValueError(
                f"discrepancy_scales={scales} of plant {self.name!r}, by default its state_sizes, must have one "
                f"positive number each: {named}."
            )
        compared = [k for k, scale in enumerate(scales) if scale < math.inf]
        signals = [self.states[k] for k in compared]
        difference = differences(signals, state[..., compared], measured[..., compared])
        return 0.5 * ((difference / state.new_tensor([scales[k] for k in compared])) ** 2).sum(-1)

    def merit(self, states: States, applied: Actions, exogenous: Inputs) -> dict[str, Float[Tensor, " batch"]]:
        """Physical quantities by which an engineer judges whole episodes, named with their units; by default none."""
        return {}

    def setpoints(self, states: State, applied: Action, exogenous: Input) -> dict[str, tuple[Cost, Cost]]:
        """Quantities to be held, named with their units: value and setpoint in each interval; by default none."""
        return {}

    def complete_states(
        self, measured: dict[str, Float[Tensor, " samples"]], exogenous: Input, actions: Action
    ) -> Float[Tensor, "samples n_s"]:
        """All states at n + 1 samples, completed from the states in a log; by default the log must hold all states.

        A plant overrides this method if some states have no sensor but follow from the others, such as filters.

        Args:
            measured: states that were logged, by name, and the ``time`` of the samples.
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

    def controller_start(self, measured: Float[Tensor, "*batch n_y"], exogenous: Input) -> Float[Tensor, "*batch n_c"]:
        """The :attr:`controller_states` of a controller that is switched on, given the other ones; by default zeros."""
        return measured.new_zeros(*measured.shape[:-1], len(self.controller_states))

    def with_previews(self, exogenous: Float[Tensor, "*batch n n_b"]) -> Float[Tensor, "*batch n n_z"]:
        """All exogenous inputs of whole episodes, from the ``acting_inputs``: previews are their shifts.

        Raises:
            ValueError: if the time ahead of a preview is no whole number of control intervals.
        """
        ahead = [preview.shifted(exogenous, self.dt) for preview in self.previews]
        return torch.cat([exogenous, torch.stack(ahead, -1)], -1) if ahead else exogenous

    # Draws, always from the generator that is passed in

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        """Initial states of ``batch`` episodes."""
        raise NotImplementedError

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps n_z"]:
        """Exogenous inputs of ``batch`` episodes, one sample per control interval."""
        raise NotImplementedError

    def make_closure(self, generator: torch.Generator) -> nn.Module:
        """The closure that a twin of this plant starts from, with the weights w_p⁰."""
        raise NotImplementedError

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


def recorded(state: State, applied: Action) -> Action:
    """The action that acts where a recorded one is given: the same one, which has passed the actuators already."""
    return applied


def replaying(plant: Plant) -> Plant:
    """The plant under recorded actions, which :meth:`Plant.actuate` does not change again; it shares all else with it.

    What an extension puts between the actuators and the system acts on recorded actions as on others.
    """
    same = copy.copy(plant)
    vars(same)["actuate"] = recorded
    return same


def require_end_cost(plant: Plant) -> None:
    """Refuse a plant whose episodes end early at no cost, or at one that is no number.

    Raises:
        ValueError: if there is no finite ``end_cost``.
    """
    # An extension ends where its plant does.
    if type(plant.innermost).ended is not Plant.ended and plant.end_cost is None:
        raise ValueError(
            f"plant {plant.name!r} defines ended() and no end_cost; set it to the cost of each moment after an early "
            "end, greater than the running cost of a bad episode."
        )
    if plant.end_cost is not None and not torch.tensor(plant.end_cost).isfinite():
        raise ValueError(f"end_cost={plant.end_cost} of plant {plant.name!r} must be finite.")


def with_memories(plant: Plant, end: State, t: Tensor, measured: State, exogenous: Tensor) -> Tensor:
    """The end of an interval, at whose start the controller memorised what was measured and not what was true."""
    if not plant.memories:
        return end
    memorised = plant.memorise(t, measured, exogenous)
    sources = (memorised if signal.name in plant.memories else end for signal in plant.states)
    return torch.stack([source[..., k] for k, source in enumerate(sources)], -1)


def held(plant: Plant, state: State, end: State) -> Tensor:
    """The state at the end of an interval that began in ``state``: the same one if the episode had ended in it."""
    return end if plant.end_cost is None else torch.where(plant.ended(state).unsqueeze(-1), state, end)


def cost_rate(plant: Plant, t: Tensor, state: Tensor, applied: Tensor, exogenous: Tensor) -> Cost:
    """L_a in an interval that began in ``state``, or L_e if the episode had ended in it."""
    running = plant.running_cost(t, state, applied, exogenous)
    if plant.end_cost is None:
        return running
    return torch.where(plant.ended(state), torch.full_like(running, plant.end_cost), running)


def flight_costs(
    plant: Plant, t: Tensor, states: Float[Tensor, "*batch m n_s"], applied: Tensor, exogenous: Tensor
) -> tuple[Float[Tensor, "*batch n"], State]:
    """L_a in each interval of a flight, or L_e from its early end on, and the state in which it has ended.

    A flight under recorded actions may leave the state again in which it ended, unlike one of :func:`held`.
    """
    running = plant.running_cost(t, states[..., :-1, :], applied, exogenous)
    if plant.end_cost is None:
        return running, states[..., -1, :]
    over = plant.ended(states).cumsum(-1) > 0
    last = (~over).sum(-1).clamp(max=states.shape[-2] - 1)  # place of the first state that has ended, if one has
    end = torch.take_along_dim(states, last[..., None, None], -2).squeeze(-2)
    return torch.where(over[..., :-1], torch.full_like(running, plant.end_cost), running), end


@runtime_checkable
class RunningCost(Protocol):
    """A running cost L_a of a plant, of any batch dimensions; it must not be negative."""

    def __call__(self, plant: Any, t: Time, state: State, applied: Action, exogenous: Input) -> Cost: ...
