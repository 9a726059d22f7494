"""A plant with additional dynamics, which no sensor reads, and real systems that are made of such plants by name."""

import copy
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.closures import PositiveCoefficients
from rt_torchrl.plants.plant import PARTS, Plant
from rt_torchrl.plants.shapes import Action, Hidden, Input, State, Time
from rt_torchrl.plants.signal import Signal


class ExtendedClosure(nn.Module):
    """The closure of a plant beside the parameters of its extension; the features and coefficients are the plant's.

    Args:
        base: closure of the plant that is extended.
        parameters: parameters of the extension.
    """

    def __init__(self, base: nn.Module, parameters: nn.Module):
        super().__init__()
        self.base, self.own = base, parameters
        self.names: dict[str, str] = {**getattr(base, "names", {}), **getattr(parameters, "names", {})}
        """Unit of each coefficient, by name, of both parts."""
        self.meanings: dict[str, str] = {**getattr(base, "meanings", {}), **getattr(parameters, "meanings", {})}
        """What each coefficient is, by name, of both parts."""

    def named_coefficients(self) -> dict[str, Tensor]:
        """Coefficients of both parts by name; a part that does not name its coefficients has none here."""
        parts = (getattr(part, "named_coefficients", dict) for part in (self.base, self.own))
        return {name: value for part in parts for name, value in part().items()}

    @property
    def extension_parameters(self) -> list[nn.Module]:
        """The parameters of each of the nested extensions, those of the innermost first."""
        return [*(self.base.extension_parameters if isinstance(self.base, ExtendedClosure) else ()), self.own]

    def forward(self, features: Float[Tensor, "*batch f"]) -> Float[Tensor, "*batch n"]:
        return self.base(features)


class Extension(Plant):
    r"""A plant whose inputs or outputs pass through additional dynamics with hidden states x.

    .. math:: (\bar a, x_{k+1}) = r(t_k, x_k, a_k; w), \qquad s_{k+1} = \Phi(t_k, s_k, \bar a, z_k; w_p)

    Here ā is the action that acts on the plant while the actuators believe that a does. The states are those of the
    plant followed by x. Everything else is asked of the plant, by :meth:`ask`: its task in its :meth:`true_state` and
    under the action that acts, and what a controller knows in what sensors read. An extension says how its dynamics
    differ and nothing else. Parameters w are in the closure, beside those of the plant's closure, so that a twin of the
    extended plant identifies both. Extensions nest.

    Args:
        base: the plant.
        hidden: signals of the hidden states x.
        parameters: w of the true system, which are frozen; None for none. A twin begins with :meth:`fresh` ones.

    Raises:
        ValueError: if the plant overrides ``step`` as a whole, so that nothing can act between actuator and system, and
            the extension does not; or if it has a state with the name of a hidden one.
    """

    name = "extension"  # until the plant gives its own

    def __init__(self, base: Plant, hidden: Sequence[Signal], parameters: nn.Module | None = None):
        if type(base).step is not Plant.step and type(self).step is Plant.step:
            raise ValueError(
                f"plant {base.name!r} overrides step(), so that nothing can act between its actuators and its system; "
                "override actuate(), advance() and latch() instead."
            )
        if hidden and type(self).rest is Extension.rest:
            raise TypeError(f"{type(self).__name__} has hidden states, and must say by rest() where they begin.")
        twice = {signal.name for signal in base.states} & {signal.name for signal in hidden}
        if twice:
            raise ValueError(f"plant {base.name!r} already has the states {', '.join(sorted(twice))}.")
        joint = base.closure if parameters is None else ExtendedClosure(base.closure, parameters.requires_grad_(False))
        super().__init__(dt=base.dt, horizon=base.horizon, closure=joint)
        self.base, self.name, self.unread = base, base.name, base.unread + len(hidden)
        self.states, self.actions, self.inputs = (*base.states, *hidden), base.actions, base.inputs
        self.observations, self.observed, self.previews = base.observations, base.observed, base.previews
        self.controller_states, self.memories, self.end_cost = base.controller_states, base.memories, base.end_cost
        self._parameterised = parameters is not None

    @property
    def innermost(self) -> Plant:
        return self.base.innermost

    @property
    def own_scheme(self) -> bool:
        """Whether hidden states follow their exact solution between samples, or the plant has its own scheme."""
        if type(self).advance is Plant.advance:
            return False
        differs = type(self).advance is not Extension.advance or type(self).step is not Plant.step
        return differs or len(self.states) > len(self.base.states) or self.base.own_scheme

    # The additional dynamics

    def respond(self, hidden: Hidden, applied: Action, closure: nn.Module) -> tuple[Action, Hidden]:
        """The action that acts in this interval, and the hidden states at its end; by default :meth:`acting`, and x."""
        return self.acting(hidden, applied), hidden

    def rates(self, hidden: Hidden, applied: Action, closure: nn.Module) -> Hidden:
        """The rates of the hidden states; by default their mean rates over an interval, of what has no rate."""
        return (self.respond(hidden, applied, closure)[1] - hidden) / self.dt

    def acting(self, hidden: Hidden, applied: Action) -> Action:
        """The action that acts at the start of an interval, by which its cost is judged; by default the applied one."""
        return applied

    def true_state(self, state: State) -> Float[Tensor, "*batch n_b"]:
        """The states of the plant, by which cost, end and merit are judged; by default those that sensors read."""
        return self.split(state)[0]

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Hidden:
        """The hidden states at the start of an episode, from the states of the plant; by default there are none."""
        return base[..., :0]

    def fresh(self) -> nn.Module:
        """The parameters w that a twin begins with, to be trained; by default those of the true system."""
        return copy.deepcopy(self.closure.get_submodule("own")).requires_grad_()

    # The dynamics

    def split(self, state: State) -> tuple[Float[Tensor, "*batch n_b"], Hidden]:
        """States of the plant, as sensors read them, and hidden states."""
        n = len(self.base.states)
        return state[..., :n], state[..., n:]

    def joined(self, base: Float[Tensor, "*batch n_b"], hidden: Hidden) -> State:
        """All states, of which :meth:`split` gives the two parts."""
        return torch.cat([base, hidden], -1)

    def of_base(self, closure: nn.Module) -> nn.Module:
        """The part of the closure that belongs to the plant."""
        return closure.get_submodule("base") if self._parameterised else closure

    def coefficients(self, closure: nn.Module) -> Float[Tensor, " n"]:
        """The extension's own coefficients in a closure, of one whose parameters are :class:`PositiveCoefficients`."""
        w = closure.get_submodule("own")
        assert isinstance(w, PositiveCoefficients), f"the parameters of {type(self).__name__}"
        return w.coefficients

    def law(self, closure: nn.Module) -> nn.Module:
        """The closure that acts on the plant; by default that of the plant."""
        return self.of_base(closure)

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        base, hidden = self.split(state)
        field = self.base.vector_field(t, base, self.acting(hidden, action), exogenous, self.law(closure))
        return self.joined(field, self.rates(hidden, action, closure))

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        """The plant's own scheme under the mean of the action that acts on it in this interval."""
        base, hidden = self.split(state)
        acting, end = self.respond(hidden, applied, closure)
        return self.joined(self.base.advance(t, base, acting, exogenous, self.law(closure)), end)

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Those of the plant; hidden states, which no sensor reads, are not compared."""
        return (*self.base.discrepancy_scales, *(math.inf,) * (len(self.states) - len(self.base.states)))

    def ask(self, part: str, method: str, arguments: dict[str, Any]) -> Any:
        """What the plant answers when a method is called, in its own states, with what the extension has beside it.

        Args:
            part: what the method is about, see :data:`~rt_torchrl.plants.plant.PARTS`.
            method: name of the method.
            arguments: arguments by name, in their order.
        """
        hidden: Any = None
        for place in arguments.keys() & {"state", "states"}:
            base, hidden = self.split(arguments[place])
            arguments[place] = self.true_state(arguments[place]) if part == "task" else base
            if part == "task" and "applied" in arguments:  # a state for each action, of episodes perhaps one more
                at = hidden[..., : arguments["applied"].shape[-2], :] if place == "states" else hidden
                arguments["applied"] = self.acting(at, arguments["applied"])
        answer = getattr(self.base, method)(*arguments.values())
        if part == "memory":
            return self.joined(answer, hidden)
        if part == "start":
            return self.joined(answer, self.rest(answer))
        return self._with_parameters(answer) if part == "closure" else answer

    def extended(self, closure: nn.Module) -> nn.Module:
        """A closure of the plant without extensions, with the parameters of all its extensions beside it."""
        return self._with_parameters(self.base.extended(closure) if isinstance(self.base, Extension) else closure)

    def _with_parameters(self, closure: nn.Module) -> nn.Module:
        return ExtendedClosure(closure, self.fresh()) if self._parameterised else closure


def _delegated(part: str, method: str) -> Callable[..., Any]:
    """A method of an extension that asks the plant for its answer."""
    signature = inspect.signature(getattr(Plant, method))

    def answer(*arguments: Any, **named: Any) -> Any:
        values = signature.bind(*arguments, **named).arguments
        extension: Extension = values.pop("self")
        return extension.ask(part, method, values)

    return answer


for _part, _methods in PARTS.items():
    for _method in _methods:
        setattr(Extension, _method, _delegated(_part, _method))


class FurtherInputs(Extension):
    """A plant whose inputs are its own and one more for each state that sensors read, which only an interval gets."""

    own_scheme = True
    """What is added between intervals is no integral of the vector field."""
    symbol, kind = "", ""
    """Symbol of the further inputs, and what they are, which comes before the names of the states."""

    def __init__(self, base: Plant):
        super().__init__(base, [])
        self.count = len(base.inputs)
        further = [Signal(symbol=self.symbol, name=f"{self.kind}_{s.name}", unit=s.unit) for s in base.readings]
        self.inputs = (*base.inputs, *further)

    def ask(self, part: str, method: str, arguments: dict[str, Any]) -> Any:
        if "exogenous" in arguments:
            arguments["exogenous"] = arguments["exogenous"][..., : self.count]
        return super().ask(part, method, arguments)


def replaced(
    values: Float[Tensor, "*batch n"], place: int, value: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch n"]:
    """The values with another one in a place."""
    return torch.cat([values[..., :place], value.unsqueeze(-1), values[..., place + 1 :]], -1)


Change = Callable[[Any], Plant]
"""A function that makes another plant of a plant."""
System = Mapping[str, Change]
"""What makes a real system of a plant, by the part of the plant that it changes."""


class Catalogue(NamedTuple):
    """Real systems that are made of a plant, by name; they combine if they change different parts.

    Args:
        systems: all systems, by name.
        parts: all parts of the plant that a system may change, in the order in which the changes are made.
    """

    systems: Mapping[str, System]
    parts: tuple[str, ...]

    def __call__(self, plant: Plant, names: Sequence[str]) -> Plant:
        """The plant, which a twin knows, with all that the named systems have beside it.

        Raises:
            ValueError: if a name does not exist, or two of the systems change the same part.
        """
        missing = ", ".join(name for name in names if name not in self.systems)
        if missing:
            raise ValueError(f"unknown={tuple(names)}: {missing} does not exist; choose {', '.join(self.systems)}.")
        changes: dict[str, Change] = {}
        for name in names:
            twice = changes.keys() & self.systems[name].keys()
            if twice:
                raise ValueError(f"unknown={tuple(names)}: two of them change the {' and the '.join(twice)}.")
            changes |= self.systems[name]
        for part in self.parts:
            plant = changes[part](plant) if part in changes else plant
        return plant
