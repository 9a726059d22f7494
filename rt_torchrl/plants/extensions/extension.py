"""A plant with additional dynamics, which no sensor reads."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal


class ExtendedClosure(nn.Module):
    """The closure of a plant beside the parameters of its extension; the features and coefficients are the plant's.

    Args:
        base: closure of the plant that is extended.
        own: parameters of the extension.
    """

    def __init__(self, base: nn.Module, own: nn.Module):
        super().__init__()
        self.base, self.own = base, own

    @property
    def names(self) -> dict[str, str]:
        """Unit of each coefficient, by name, of both parts."""
        return {**getattr(self.base, "names", {}), **getattr(self.own, "names", {})}

    @property
    def meanings(self) -> dict[str, str]:
        """What each coefficient is, by name, of both parts."""
        return {**getattr(self.base, "meanings", {}), **getattr(self.own, "meanings", {})}

    def named_coefficients(self) -> dict[str, Tensor]:
        """Coefficients of both parts by name; a part that does not name its coefficients has none here."""
        parts = (getattr(part, "named_coefficients", dict) for part in (self.base, self.own))
        return {name: value for part in parts for name, value in part().items()}

    @property
    def all_own(self) -> list[nn.Module]:
        """The parameters of each of the nested extensions, those of the innermost first."""
        return [*(self.base.all_own if isinstance(self.base, ExtendedClosure) else ()), self.own]

    def forward(self, features: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch m"]:
        return self.base(features)


class OwnParameters(nn.Module, ABC):
    """The parameters of an extension."""

    @abstractmethod
    def fresh(self) -> nn.Module:
        """Parameters with the values that a twin begins with, to be trained."""


class Extension(Plant):
    r"""A plant whose inputs or outputs pass through additional dynamics with hidden states x.

    .. math:: (\bar a, x_{k+1}) = r(t_k, x_k, a_k; w), \qquad s_{k+1} = \Phi(t_k, s_k, \bar a, z_k; w_p)

    Here ā is the action that acts on the plant while the actuators believe that a does. The states are those of the
    plant followed by x; the control problem is that of the plant. Parameters w are in the closure, beside those of the
    plant's closure, so that a twin of the extended plant identifies both. Extensions nest.

    Args:
        base: the plant.
        hidden: signals of the hidden states x.
        own: parameters w of the true system, with which a twin begins afresh; None for none.

    Raises:
        ValueError: if the plant overrides ``step`` as a whole, so that nothing can act between actuator and system, or
            has a state with the name of a hidden one.
    """

    name = "extension"  # until the plant gives its own
    own_scheme = True  # between samples the hidden states follow their exact solution, not the vector field

    def __init__(self, base: Plant, hidden: Sequence[Signal], own: OwnParameters | None = None):
        if type(base).step is not Plant.step:
            raise ValueError(
                f"plant {base.name!r} overrides step(), so that nothing can act between its actuators and its system; "
                "override actuate(), advance() and latch() instead."
            )
        if hidden and type(self).rest is Extension.rest:
            raise TypeError(f"{type(self).__name__} has hidden states, and must say by rest() where they begin.")
        twice = {signal.name for signal in base.states} & {signal.name for signal in hidden}
        if twice:
            raise ValueError(f"plant {base.name!r} already has the states {', '.join(sorted(twice))}.")
        closure = base.closure if own is None else ExtendedClosure(base.closure, own)
        super().__init__(dt=base.dt, horizon=base.horizon, closure=closure)
        self.base, self.name, self.unread = base, base.name, base.unread + len(hidden)
        self.states, self.actions, self.inputs = (*base.states, *hidden), base.actions, base.inputs
        self.observations, self.observed, self.previews = base.observations, base.observed, base.previews
        self.controller_states, self.end_cost = base.controller_states, base.end_cost
        self._fresh = None if own is None else own.fresh

    # The additional dynamics

    def respond(
        self,
        hidden: Float[Tensor, "*batch n_x"],
        applied: Float[Tensor, "*batch n_a"],
        closure: nn.Module,
    ) -> tuple[Float[Tensor, "*batch n_a"], Float[Tensor, "*batch n_x"]]:
        """The action that acts in this interval, and the hidden states at its end; by default both as they are."""
        return applied, hidden

    def rates(
        self,
        hidden: Float[Tensor, "*batch n_x"],
        applied: Float[Tensor, "*batch n_a"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_x"]:
        """The rates of the hidden states, whose solution over an interval :meth:`respond` gives."""
        return torch.zeros_like(hidden)

    def acting(
        self, hidden: Float[Tensor, "*batch n_x"], applied: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_a"]:
        """The action that acts at the start of an interval, by which its cost is judged; by default the applied one."""
        return applied

    def meeting(
        self, hidden: Float[Tensor, "*batch n_x"], exogenous: Float[Tensor, "*#batch n_z"]
    ) -> Float[Tensor, "*#batch n_z"]:
        """The inputs that act on the plant in an interval; by default those that sensors read."""
        return exogenous

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Float[Tensor, "*batch n_x"]:
        """The hidden states at the start of an episode, from the states of the plant; by default there are none."""
        return base[..., :0]

    # The system

    def split(
        self, state: Float[Tensor, "*batch n_s"]
    ) -> tuple[Float[Tensor, "*batch n_b"], Float[Tensor, "*batch n_x"]]:
        """States of the plant and hidden states."""
        n = len(self.base.states)
        return state[..., :n], state[..., n:]

    def of_base(self, closure: nn.Module) -> nn.Module:
        """The part of the closure that belongs to the plant."""
        return closure if self._fresh is None else closure.get_submodule("base")

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        action: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        base, hidden = self.split(state)
        acting, met = self.acting(hidden, action), self.meeting(hidden, exogenous)
        field = self.base.vector_field(t, base, acting, met, self.of_base(closure))
        return torch.cat([field, self.rates(hidden, action, closure)], -1)

    def advance(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        """The plant's own scheme under the mean of the action that acts on it in this interval."""
        base, hidden = self.split(state)
        acting, end = self.respond(hidden, applied, closure)
        met = self.meeting(hidden, exogenous)
        return torch.cat([self.base.advance(t, base, acting, met, self.of_base(closure)), end], -1)

    def actuate(
        self, state: Float[Tensor, "*batch n_s"], command: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_a"]:
        return self.base.actuate(self.split(state)[0], command)

    def latch(
        self, state: Float[Tensor, "*batch n_s"], applied: Float[Tensor, "*batch n_a"]
    ) -> Float[Tensor, "*batch n_s"]:
        base, hidden = self.split(state)
        return torch.cat([self.base.latch(base, applied), hidden], -1)

    def at_rest(self, read: Float[Tensor, "*batch n_r"]) -> Float[Tensor, "*batch n_s"]:
        base = self.base.at_rest(read)
        return torch.cat([base, self.rest(base)], -1)

    # The control problem, which is that of the plant

    def observe(
        self, t: Float[Tensor, "*#batch"], state: Float[Tensor, "*batch n_s"], exogenous: Float[Tensor, "*#batch n_z"]
    ) -> Float[Tensor, "*batch n_o"]:
        return self.base.observe(t, self.split(state)[0], exogenous)

    def running_cost(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch"]:
        base, hidden = self.split(state)
        return self.base.running_cost(t, base, self.acting(hidden, applied), exogenous)

    def terminal_cost(self, state: Float[Tensor, "*batch n_s"]) -> Float[Tensor, "*batch"]:
        return self.base.terminal_cost(self.split(state)[0])

    def ended(self, state: Float[Tensor, "*batch n_s"]) -> Bool[Tensor, "*batch"]:
        return self.base.ended(self.split(state)[0])

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Those of the plant; hidden states, which no sensor reads, are not compared."""
        return (*self.base.discrepancy_scales, *(math.inf,) * (len(self.states) - len(self.base.states)))

    def merit(
        self,
        states: Float[Tensor, "batch samples n_s"],
        applied: Float[Tensor, "batch n n_a"],
        exogenous: Float[Tensor, "batch n n_z"],
    ) -> dict[str, Float[Tensor, " batch"]]:
        base, hidden = self.split(states)
        return self.base.merit(base, self.acting(hidden[:, :-1], applied), exogenous)

    def setpoints(self, states: Tensor, applied: Tensor, exogenous: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        base, hidden = self.split(states)
        return self.base.setpoints(base, self.acting(hidden, applied), exogenous)

    def categories(self, exogenous: Float[Tensor, "batch n n_z"]) -> dict[str, Bool[Tensor, " batch"]]:
        return self.base.categories(exogenous)

    def complete_states(self, measured: dict[str, Tensor], exogenous: Tensor, actions: Tensor) -> Tensor:
        """States of the plant from a log; hidden states at rest."""
        base = self.base.complete_states(measured, exogenous, actions)
        return torch.cat([base, self.rest(base)], -1)

    def controller_start(self, measured: Tensor, exogenous: Tensor) -> Tensor:
        return self.base.controller_start(measured, exogenous)

    # Randomness

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        base = self.base.draw_initial_state(batch, generator)
        return torch.cat([base, self.rest(base)], -1)

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps n_z"]:
        return self.base.draw_exogenous(batch, generator)

    def make_closure(self, generator: torch.Generator) -> nn.Module:
        return self._with_own(self.base.make_closure(generator))

    def make_neural_closure(self, generator: torch.Generator, hidden: Sequence[int]) -> nn.Module:
        return self._with_own(self.base.make_neural_closure(generator, hidden))

    def extended(self, closure: nn.Module) -> nn.Module:
        """A closure of the plant without extensions, with the parameters of all its extensions beside it."""
        return self._with_own(self.base.extended(closure) if isinstance(self.base, Extension) else closure)

    def _with_own(self, closure: nn.Module) -> nn.Module:
        return ExtendedClosure(closure, self._fresh()) if self._fresh is not None else closure

    def make_policy(self, generator: torch.Generator) -> nn.Module:
        return self.base.make_policy(generator)


def place_of(plant: Plant, action: str) -> int:
    """Place of an action of a plant.

    Raises:
        ValueError: if the plant has no such action.
    """
    names = [signal.name for signal in plant.actions]
    if action not in names:
        raise ValueError(f"action={action!r} of plant {plant.name!r} does not exist; choose one of {', '.join(names)}.")
    return names.index(action)


def settled(plant: Plant, action: int, states: Float[Tensor, "*batch n_s"]) -> Float[Tensor, "*batch"]:
    """An actuator's position at the start: the state of its name, or else the place in its range nearest to zero."""
    signal, names = plant.actions[action], [state.name for state in plant.states]
    if signal.name in names:
        return states[..., names.index(signal.name)]
    return torch.full_like(states[..., 0], min(max(0.0, signal.low), signal.high))


def replaced(
    values: Float[Tensor, "*batch n"], place: int, value: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch n"]:
    """The values with another one in a place."""
    return torch.cat([values[..., :place], value.unsqueeze(-1), values[..., place + 1 :]], -1)
