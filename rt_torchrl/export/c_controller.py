r"""The controller of a plant, its policy with the states that it computes of the measured signals; and as a C99 file.

The states of a plant are :math:`s = (y, c)`, with c those of :attr:`Plant.controller_states` and y the measured ones.
At :math:`t_k` the controller takes c over the interval that has passed, and acts:

.. math::
    c_k = \Phi_c(t_{k-1}, (y_{k-1}, c_{k-1}), a_{k-1}, z_{k-1}), \qquad
    a_k = \pi\big(\mathrm{observe}(t_k, (y_k, c_k), z_k)\big)

:math:`\Phi_c` is the plant's own step, in which y moves in a straight line from :math:`y_{k-1}` to :math:`y_k` instead
of by the vector field. Filters and integrals then differ from the plant's own by the curvature of y within an interval,
:math:`O(\Delta t^2)`, and need no closure.
"""

import copy
import ctypes
import math
import re
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.export import c_file
from rt_torchrl.export.agreement import SEED, action_sizes, detached, frozen, require_close
from rt_torchrl.plants.extension import ExtendedClosure
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import differences, place_of
from rt_torchrl.programs.c_source import CSource, literal

INTERVALS = 1000
"""Greatest number of control intervals of the flight on which both are compared."""


class Controller:
    """The controller of a plant under a policy, for any number of machines at once.

    Args:
        plant: the plant; its closure is called, but no result may depend on it.
        policy: the policy.

    Raises:
        ValueError: if the plant has no state of a name in its ``controller_states``.
    """

    def __init__(self, plant: Plant, policy: nn.Module):
        self.plant, self.policy = frozen(plant), policy
        self.closure: nn.Module = self.plant.closure
        names = plant.controller_states
        self.held = [place_of("controller_states", name, plant.states, plant.name) for name in names]
        self.measured = [k for k in range(len(plant.states)) if k not in self.held]
        self._order = torch.tensor([*self.measured, *self.held]).argsort()
        self._moving = copy.deepcopy(self.plant)

    def start(self, measured: Float[Tensor, "*batch n_y"], inputs: Float[Tensor, "*batch n_z"]) -> Tensor:
        """The controller's states c_0 at the first measurement.

        Raises:
            ValueError: if the plant starts another number of states than it names.
        """
        start = self.plant.controller_start(measured, inputs)
        if start.shape[-1:] != (len(self.held),):
            raise ValueError(
                f"controller_start of plant {self.plant.name!r} returns shape {tuple(start.shape)}; its last dimension "
                f"must be {len(self.held)}, the number of controller_states."
            )
        return start

    def act(
        self,
        t: Float[Tensor, "*#batch"],
        memory: Float[Tensor, "*batch n_c"],
        measured: Float[Tensor, "*batch n_y"],
        inputs: Float[Tensor, "*batch n_z"],
    ) -> tuple[Float[Tensor, "*batch n_a"], Float[Tensor, "*batch n_a"]]:
        """The command a_k of the policy, and the action that the actuators make of it.

        Args:
            t: present time [s].
            memory: the controller's states c_k.
            measured: measured states y_k.
            inputs: exogenous inputs z_k.
        """
        state = self.joined(measured, memory)
        command = self.policy(self.plant.observe(t, state, inputs))
        return command, self.plant.actuate(state, command)

    def advance(
        self,
        t: Float[Tensor, "*#batch"],
        memory: Float[Tensor, "*batch n_c"],
        measured: Float[Tensor, "*batch n_y"],
        inputs: Float[Tensor, "*batch n_z"],
        command: Float[Tensor, "*batch n_a"],
        following: Float[Tensor, "*batch n_y"],
    ) -> Float[Tensor, "*batch n_c"]:
        """The controller's states at the end of an interval.

        Args:
            t: time at its start [s].
            memory: the controller's states at its start.
            measured: measured states at its start.
            inputs: exogenous inputs that acted during it.
            command: command that was held during it.
            following: measured states at its end.
        """
        signals = [self.plant.states[k] for k in self.measured]
        rate = differences(signals, following, measured) / self.plant.dt if signals else measured
        state = self.joined(measured, memory)
        return self._along(rate).step(t, state, command, inputs, self.closure).state[..., self.held]

    def _along(self, rate: Tensor) -> Plant:
        """The plant whose measured states change at a given rate."""
        inner, field = self._moving.innermost, self.plant.innermost.vector_field
        # Extensions call the vector field of the plant that they extend, whose states are the first ones.
        n = len(inner.states)
        measured, held = ([k for k in places if k < n] for places in (self.measured, self.held))
        order = torch.tensor([*measured, *held]).argsort()

        def vector_field(t: Tensor, state: Tensor, action: Tensor, exogenous: Tensor, closure: nn.Module) -> Tensor:
            held_rates = field(t, state, action, exogenous, closure)[..., held]
            return torch.cat([rate[..., : len(measured)], held_rates], -1)[..., order]

        vars(inner)["vector_field"] = vector_field
        return self._moving

    def joined(self, measured: Tensor, memory: Tensor) -> Tensor:
        """States of measured ones and the controller's, in the plant's order."""
        return torch.cat([measured, memory], -1)[..., self._order]


def export_controller(policy: nn.Module, path: Path | str, plant: Plant, *, name: str | None = None) -> float | None:
    """Write a policy as C99 with everything between the measured signals and the action.

    The file holds a :class:`Controller`: the plant's ``observe`` and ``actuate``, and the states that the plant names
    in ``controller_states``, which ``<name>_init`` starts and ``<name>_step`` advances once in every control interval.
    It allocates nothing and needs only ``math.h``. Signals that no action depends on are no inputs. The header
    describes all signals, with units and ranges, and shows the calls.

    The check compiles the file and flies the plant by it.

    Args:
        policy: any ``policy(observation) -> action`` in double precision that can be traced to arithmetic.
        path: file to write, such as ``controller.c``; the header gets the same name with ``.h``.
        plant: plant with the policy's observations and actions.
        name: prefix of the functions; by default the name of the plant with ``_controller``.

    Returns:
        Greatest difference of an action from that of the controller in torch in the intervals that it flies, as a share
        of its range; None without a compiler.

    Raises:
        ValueError: if the path or the name does not fit, the policy does not fit the plant, policy or plant cannot be
            traced (the message names the line), a controller state depends on the closure, the file does not compile,
            or the controller in C differs from that in torch.
    """
    path, name = c_file.named(path, name, f"{plant.name}_controller")
    return CController(Controller(plant, detached(policy, plant)), name).write(path)


class CController:
    """The functions of a controller in C.

    Args:
        controller: the controller.
        name: prefix of the functions.

    Raises:
        ValueError: if policy or plant cannot be traced, or a controller state depends on the closure.
    """

    def __init__(self, controller: Controller, name: str):
        self.controller, self.name, plant = controller, name, controller.plant
        self.parts = _traced(controller)
        read = (f.reads(word) for f in self.parts.values() for word in ("measured", "last"))
        self.read = sorted(set().union(*read))
        signals = [*(plant.states[k] for k in controller.measured), *plant.inputs]
        self.signals = [signals[k] for k in self.read]
        lengths = {"command": len(plant.actions), "memory": len(controller.held), "last": len(self.signals)}
        self.arrays = {array: max(1, n) for array, n in lengths.items()}  # C has no empty arrays

    def source(self) -> CSource:
        """The functions ``init`` and ``step``, and those that they call."""
        name, source = self.name, c_file.source_of(self.controller.policy)
        dt, places = literal(self.controller.plant.dt), dict.fromkeys(("measured", "last"), self.read)
        calls, terms = {}, {"next": "state->memory"} | {array: f"state->{array}" for array in self.arrays}
        for part, function in self.parts.items():
            head = c_file.add_function(source, f"{name}_{part}", function, places, kind="static void")
            terms["t"] = f"{dt} * (double)(state->steps - 1)" if part == "advance" else f"{dt} * (double)state->steps"
            arguments = re.findall(r"(\w+)(?=[,)])", head)
            calls[part] = f"{name}_{part}({', '.join(terms.get(word, word) for word in arguments)});"
        last = [f"state->last[{k}] = measured[{k}];" for k in range(len(self.signals))]
        rest = [f"state->command[{k}] = 0.0;" for k in range(self.arrays["command"])]
        start, before = [], []
        if self.controller.held:
            start, before = [calls["start"]], [f"if (state->steps > 0) {calls['advance']}"]
        init, step = (head.rstrip(";") for head in self.declarations()[-2:])
        source.write(init, [*start, "state->steps = 0;", *rest, *last])
        source.write(step, [*before, calls["act"], *last, "state->steps += 1;"])
        return source

    def write(self, path: Path) -> float | None:
        """Write the file and its header after a flight, see :func:`~rt_torchrl.export.c_file.write_c`."""
        return c_file.write_c(path, self.name, self.comment(), self.declarations(), self.source(), self.fly)

    def declarations(self) -> list[str]:
        """The state of a controller and the functions."""
        name = self.name
        return [
            "typedef struct {",
            "    unsigned long long steps; /* control intervals since the start */",
            *(f"    double {array}[{n}];" for array, n in self.arrays.items()),
            f"}} {name}_state;",
            "",
            f"void {name}_init({name}_state *state, const double *measured);",
            f"void {name}_step({name}_state *state, const double *measured, double *action);",
        ]

    def comment(self) -> list[str]:
        """The lines of the header."""
        plant, name = self.controller.plant, self.name
        held = [plant.states[k] for k in self.controller.held]
        return [
            f"{name}: a controller of the plant {plant.name} ({type(self.controller.policy).__name__}), written by",
            "rt_torchrl. It allocates nothing and needs only math.h. Each controller has a state of its own.",
            "",
            f"    {name}_state state;",
            f"    double measured[{self.arrays['last']}], action[{len(plant.actions)}];",
            f"    {name}_init(&state, measured);            once, before the first step",
            f"    {name}_step(&state, measured, action);    every {plant.dt:g} s, over which the action is held",
            "",
            *c_file.signal_table({"measured": self.signals, "action": plant.actions, "state.memory": held}),
            "",
            "The action is what the actuators make of state.command, the command of the policy. Check what is measured",
            "before a step: nothing here refuses a NaN or a reading beyond its range.",
            *(MEMORY if held else []),
        ]

    @torch.no_grad()
    def fly(self, library: ctypes.CDLL) -> float:
        """Fly the plant by the controller in C, and give the same measurements to the controller in torch.

        Raises:
            ValueError: if the two differ by more than the tolerance.
        """
        controller, plant = self.controller, self.controller.plant
        generator = torch.Generator().manual_seed(SEED)
        state, exogenous = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)
        fields = [("steps", ctypes.c_ulonglong), *((array, ctypes.c_double * n) for array, n in self.arrays.items())]
        in_c: Any = type("State", (ctypes.Structure,), {"_fields_": fields})()
        measured, flown = state[:, controller.measured], list[tuple[Tensor, Tensor]]()
        self._call(library, "init", in_c, measured, exogenous[:, 0])
        memory, command = controller.start(measured, exogenous[:, 0]), state.new_zeros(1, len(plant.actions))
        for k in range(min(plant.n_steps, INTERVALS)):
            t, inputs, following = state.new_tensor([k * plant.dt]), exogenous[:, k], state[:, controller.measured]
            if k > 0 and controller.held:
                memory = controller.advance(t - plant.dt, memory, measured, exogenous[:, k - 1], command, following)
            measured = following
            applied = self._call(library, "step", in_c, measured, inputs, len(plant.actions))
            flown.append((applied, controller.act(t, memory, measured, inputs)[1]))
            command = state.new_tensor([list(in_c.command)])
            state = plant.step(t, state, command, inputs, plant.closure).state
            if not state.isfinite().all():  # the plant has left its range; what follows is no flight
                break
        of_c, of_torch = (torch.cat(actions) for actions in zip(*flown, strict=True))
        what, of = f"the controller {self.name} in C", action_sizes(plant, of_torch)
        return require_close(of_c, of_torch, of, c_file.TOLERANCE, plant.actions, what)

    def _call(
        self, library: ctypes.CDLL, part: str, in_c: Any, measured: Tensor, inputs: Tensor, count: int = 0
    ) -> Tensor:
        signals = c_file.c_array(torch.cat([measured, inputs], -1)[0, self.read].tolist())
        return c_file.called(getattr(library, f"{self.name}_{part}"), [ctypes.byref(in_c), signals], count).unsqueeze(0)


MEMORY = (
    "init settles the memory on the first measurement; after it, state.memory may be overwritten, for example by the",
    "present place of an actuator. Between two steps the memory is advanced with measured states that move in a",
    "straight line, and with inputs that are held.",
    "A NaN in a measurement stays in the memory: check your sensors before, and call init again after.",
)


def _traced(controller: Controller) -> dict[str, c_file.TracedFunction]:
    """The function ``act``; of a controller with states also ``start`` and ``advance``.

    Measured states and inputs are one argument, ``measured``; those of the interval before are ``last``.
    """
    plant, generator, n = controller.plant, torch.Generator().manual_seed(SEED), len(controller.measured)
    state, inputs = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)[:, 0]
    measured, what = torch.cat([state[:, controller.measured], inputs], -1), f"the controller of plant {plant.name!r}"

    def start(measured: Tensor) -> dict[str, Tensor]:
        return {"next": controller.start(measured[:, :n], measured[:, n:])}

    def act(t: Tensor, memory: Tensor, measured: Tensor) -> dict[str, Tensor]:
        command, action = controller.act(t, memory, measured[:, :n], measured[:, n:])
        return {"command": command, "action": action}

    def advance(t: Tensor, memory: Tensor, last: Tensor, command: Tensor, measured: Tensor) -> dict[str, Tensor]:
        following = measured[:, :n]
        return {"next": controller.advance(t, memory, last[:, :n], last[:, n:], command, following)}

    now = {"t": state.new_zeros(1), "memory": state[:, controller.held], "measured": measured}
    parts = {"act": c_file.traced(what, act, now, controller.policy)}
    if not controller.held:
        return parts
    parts["start"] = c_file.traced(what, start, {"measured": measured})
    with torch.no_grad():
        example = {"t": now["t"], "memory": now["memory"], "last": measured, "command": act(**now)["command"]}
        example["measured"] = measured
        controller.closure = unknown(plant.closure)
        known = advance(**example)["next"].isfinite().all()
        parts["advance"] = c_file.traced(what, advance, example)
        controller.closure = plant.closure
    if not known:
        raise ValueError(
            f"{what} cannot be exported: its states ({', '.join(plant.controller_states)}) depend on the closure, "
            "which a controller does not know. Name in controller_states only what follows from measured signals."
        )
    return parts


def unknown(closure: nn.Module) -> nn.Module:
    """A closure of unknown coefficients; the parameters of extensions beside it are unknown, too."""
    if not isinstance(closure, ExtendedClosure):
        return UnknownClosure(closure)
    own = frozen(closure.own)
    for weight in own.parameters():
        weight.fill_(math.nan)
    return ExtendedClosure(unknown(closure.base), own)


class UnknownClosure(nn.Module):
    """A closure of unknown coefficients, so that all that depends on them is NaN."""

    def __init__(self, closure: nn.Module):
        super().__init__()
        self.closure = closure
        self._count: int | None = None

    def forward(self, features: Tensor) -> Tensor:
        if self._count is None:
            self._count = self.closure(features).shape[-1]
        return features.new_full((*features.shape[:-1], self._count), math.nan)
