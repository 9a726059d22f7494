"""A controller as a C99 file: from the measured signals of a plant to its action, with filters and integrals."""

import ctypes
from pathlib import Path

import torch
from torch import Tensor, nn

from rt_torchrl.export.agreement import SEED, detached
from rt_torchrl.export.c_file import CFile, signal_table
from rt_torchrl.export.controller import Controller
from rt_torchrl.export.controller_check import ControllerAgreement, Layout, fly
from rt_torchrl.export.traced_function import TracedFunction, frozen, traced, weights_of
from rt_torchrl.plants.plant import Plant
from rt_torchrl.programs.c_source import CSource, literal
from rt_torchrl.programs.tracer import Tracer


def export_controller(
    policy: nn.Module, path: Path | str, plant: Plant, *, name: str | None = None
) -> ControllerAgreement | None:
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
        The comparison with the controller in torch and with the plant's own states; None without a compiler.

    Raises:
        ValueError: if the path or the name does not fit, the policy does not fit the plant, policy or plant cannot be
            traced (the message names the line), a controller state depends on the closure, the file does not compile,
            or the controller in C differs from that in torch.
    """
    file = CFile(path, f"{plant.name}_controller" if name is None else name)
    written = CController(Controller(plant, frozen(detached(policy, plant))), file.name)

    def compare(library: ctypes.CDLL) -> ControllerAgreement:
        return fly(written.controller, library, file.name, written.layout)

    return file.write(written.comment(), written.declarations(), written.source(), compare)


TIME = {("t", 0): "t"}


class CController:
    """The functions of a controller in C.

    Args:
        controller: the controller.
        name: prefix of the functions.

    Raises:
        ValueError: if policy or plant cannot be traced, or a controller state depends on the closure.
    """

    def __init__(self, controller: Controller, name: str):
        self.controller, self.name = controller, name
        self.parts = _traced(controller)
        plant, parts = controller.plant, self.parts.values()
        states = set().union(*(part.reads(word) for part in parts for word in ("measured", "following")))
        inputs = set().union(*(part.reads("inputs") for part in parts))
        self.layout = Layout(sorted(states), sorted(inputs), len(controller.held), len(plant.actions))
        self._signals = [plant.states[controller.measured[k]] for k in self.layout.states]
        self._signals += [plant.inputs[k] for k in self.layout.inputs]

    def source(self) -> CSource:
        """The functions ``init`` and ``step``, and what they call."""
        name, last = self.name, [f"state->last[{k}] = measured[{k}];" for k in range(self.layout.n_last)]
        source = CSource(weights_of({"policy": self.controller.policy}))
        memory, command = self._array("memory", self.layout.n_memory), self._array("command", self.layout.n_actions)
        now, before = self._signals_in("measured"), self._signals_in("state->last")
        start, act = self.parts["start"], self.parts["act"]
        settled = list(zip(memory.values(), start.outputs["memory"], strict=True))
        rest = ["state->steps = 0;", *(f"{place} = 0.0;" for place in command.values()), *last]
        head = f"void {name}_init({name}_state *state, const double *measured)"
        source.add(head, start.program, now, settled, last=rest)
        arguments = f"(double t, {name}_state *state, const double *measured"
        actions = [(f"action[{k}]", value) for k, value in enumerate(act.outputs["applied"])]
        actions += list(zip(command.values(), act.outputs["command"], strict=True))
        head = f"static void {name}_act{arguments}, double *action)"
        source.add(head, act.program, TIME | memory | now, actions)
        dt = literal(self.controller.plant.dt)
        steps = [f"{name}_act({dt} * (double)state->steps, state, measured, action);", *last, "state->steps += 1;"]
        if self.controller.held:
            advance = self.parts["advance"]
            following = {("following", k): place for (array, k), place in now.items() if array == "measured"}
            ends = list(zip(memory.values(), advance.outputs["memory"], strict=True))
            given = TIME | memory | before | command | following
            source.add(f"static void {name}_advance{arguments})", advance.program, given, ends)
            call = f"    {name}_advance({dt} * (double)(state->steps - 1), state, measured);"
            steps = ["if (state->steps > 0) {", call, "}", *steps]
        source.write(f"void {name}_step({name}_state *state, const double *measured, double *action)", steps)
        return source

    @staticmethod
    def _array(array: str, size: int) -> dict[tuple[str, int], str]:
        """The places in C of an array of the state."""
        return {(array, k): f"state->{array}[{k}]" for k in range(size)}

    def _signals_in(self, array: str) -> dict[tuple[str, int], str]:
        """The place in C of every measured state and input that is read."""
        keys = [*(("measured", k) for k in self.layout.states), *(("inputs", k) for k in self.layout.inputs)]
        return {key: f"{array}[{place}]" for place, key in enumerate(keys)}

    def declarations(self) -> list[str]:
        """The state of a controller and the functions."""
        layout, name = self.layout, self.name
        return [
            "typedef struct {",
            "    unsigned long long steps; /* control intervals since the start */",
            f"    double command[{layout.n_actions}]; /* what the policy asked for last */",
            *([f"    double memory[{layout.n_memory}];"] if layout.n_memory else []),
            *([f"    double last[{layout.n_last}]; /* what was measured last */"] if layout.n_last else []),
            f"}} {name}_state;",
            "",
            f"void {name}_init({name}_state *state, const double *measured);",
            f"void {name}_step({name}_state *state, const double *measured, double *action);",
        ]

    def comment(self) -> list[str]:
        """The lines of the header."""
        plant, name = self.controller.plant, self.name
        held = [plant.states[k] for k in self.controller.held]
        n_last, n_actions = max(1, self.layout.n_last), self.layout.n_actions
        return [
            f"{name}: a controller of the plant {plant.name} ({type(self.controller.policy).__name__}), written by",
            "rt_torchrl. It allocates nothing and needs only math.h. Each controller has a state of its own.",
            "",
            f"    {name}_state state;",
            f"    double measured[{n_last}], action[{n_actions}];",
            "    ...read measured...",
            f"    {name}_init(&state, measured);",
            f"    ...every {plant.dt:g} s read measured...",
            f"    {name}_step(&state, measured, action);",
            "",
            "init is called once, before the first step. step is called at the start of every control interval, over",
            "which its action is held.",
            "",
            *signal_table({"measured": self._signals, "action": plant.actions, "state.memory": held}),
            "",
            "The action is what the actuators make of the command of the policy, such as within rate limits. The",
            "command is in state.command.",
            *(MEMORY if held else []),
        ]


MEMORY = (
    "init settles the memory on the first measurement; after it, state.memory may be overwritten, for example by the",
    "present place of an actuator. Between two steps the memory is advanced with measured states that move in a",
    "straight line, and with inputs that are held.",
    "A NaN in a measurement stays in the memory: check your sensors before, and call init again after.",
)


def _traced(controller: Controller) -> dict[str, TracedFunction]:
    """The functions ``start``, ``act`` and, if the controller has states, ``advance``."""
    plant, generator = controller.plant, torch.Generator().manual_seed(SEED)
    state, inputs = plant.draw_initial_state(1, generator), plant.draw_exogenous(1, generator)[:, 0]
    signals = {"measured": state[:, controller.measured], "inputs": inputs}
    now = {"t": state.new_zeros(1), "memory": state[:, controller.held], **signals}
    what, modules = f"the controller of plant {plant.name!r}", [controller.policy]

    def act(**given: Tensor) -> dict[str, Tensor]:
        return dict(zip(("command", "applied"), controller.act(**given), strict=True))

    parts = {
        "start": traced(what, lambda **given: {"memory": controller.start(**given)}, signals),
        "act": traced(what, act, now, modules),
    }
    if controller.held:
        with torch.no_grad():
            command, _ = controller.act(**now)
        given = {**now, "command": command, "following": signals["measured"]}
        parts["advance"] = _advance(what, controller, given)
    return parts


def _advance(what: str, controller: Controller, given: dict[str, Tensor]) -> TracedFunction:
    controller.closure = unknown = UnknownClosure(controller.plant.closure)
    try:
        with torch.no_grad():
            controller.advance(**given)
        found = traced(what, lambda **x: {"memory": controller.advance(**x)}, given, prepare=unknown.begin)
    finally:
        controller.closure = controller.plant.closure
    if found.reads("closure"):
        names = ", ".join(controller.plant.controller_states)
        raise ValueError(
            f"{what} cannot be exported: its states ({names}) depend on the closure, which a controller does not know. "
            "Name in controller_states only what follows from measured signals."
        )
    return found


class UnknownClosure(nn.Module):
    """A closure whose values are inputs named ``closure`` of a program, after one call with values."""

    def __init__(self, closure: nn.Module):
        super().__init__()
        self.closure = closure
        self._shapes: list[torch.Size] = []
        self._tracer: Tracer | None = None

    def begin(self, tracer: Tracer) -> None:
        """Go on with inputs of a tracer."""
        self._tracer = tracer

    def forward(self, features: Tensor) -> Tensor:
        if self._tracer is None:
            found: Tensor = self.closure(features)
            self._shapes.append(found.shape)
            return found
        values = torch.zeros(self._shapes.pop(0), dtype=torch.float64)
        self._tracer.input(values, "closure")
        return values
