"""The methods of a plant with arguments from its episodes, and checks of what they give.

They are shapes, precision and purity under every leading dimension, of policies and closures as well; signs of costs
and the applied action; early ends; and whole turns of periodic states.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from rt_torchrl.contract.draws import misshapen, neural_closure_of, seeded
from rt_torchrl.plants.plant import Plant, require_end_cost
from rt_torchrl.plants.signal import bounds, differences
from rt_torchrl.programs.contract import ImpureError, require_pure
from rt_torchrl.trajectories.rollout import Rollout

Arguments = dict[str, Tensor]
PERIODIC = 1e-6
"""Greatest relative change of a result; the rounding of an angle plus one turn is far smaller."""


class Method(NamedTuple):
    """A method as a function of named tensors: names of its arguments, and names and trailing shapes of its results."""

    name: str
    call: Callable[..., Any]
    takes: tuple[str, ...]
    gives: dict[str, tuple[int, ...]]

    def outputs(self, arguments: Arguments) -> tuple[Any, ...]:
        """The results of the method for named arguments; arguments that it does not take are ignored."""
        result = self.call(*(arguments[name] for name in self.takes))
        return tuple(result) if self.name == "step" and isinstance(result, tuple) else (result,)


class Calls:
    """Times, states, commands, actions and inputs of episodes, with the time first as in the gradient engines.

    Attribute ``arguments`` holds them by name, with ``measured`` for the states of another episode.

    Args:
        plant: the plant.
        t: times, of shape ``n 1``.
        state, command, applied, exogenous: of shape ``n batch`` and their number of signals.
    """

    def __init__(self, plant: Plant, *, t: Tensor, state: Tensor, command: Tensor, applied: Tensor, exogenous: Tensor):
        self.plant, self.arguments = plant, {"t": t, "state": state, "measured": state.roll(1, 1)}
        self.arguments |= {"command": command, "applied": applied, "exogenous": exogenous}
        self.closure: nn.Module = plant.make_closure(seeded())

    @classmethod
    def at_the_start(cls, plant: Plant, episodes: int) -> "Calls":
        """Arguments in the first interval of two groups of episodes; they need only the draws of the plant."""
        generator = seeded()
        state = plant.draw_initial_state(2 * episodes, generator)
        exogenous = plant.draw_exogenous(2 * episodes, generator)[:, 0]
        command = random_commands(plant, (2 * episodes,), generator)
        state, command, exogenous = (x.reshape(2, episodes, -1) for x in (state, command, exogenous))
        t = torch.zeros(2, 1, dtype=torch.float64)
        return cls(plant, t=t, state=state, command=command, applied=command, exogenous=exogenous)

    @classmethod
    @torch.no_grad()
    def in_flight(cls, plant: Plant, episodes: int, steps: int) -> "Calls":
        """Arguments in all intervals of flights of the true plant under random commands.

        Raises:
            DivergenceError: if a flight leaves the finite numbers.
        """
        generator = seeded()
        state = plant.draw_initial_state(episodes, generator)
        exogenous = plant.draw_exogenous(episodes, generator)[:, :steps]
        command = random_commands(plant, (episodes, steps), generator)
        flown = Rollout(plant, plant.closure, engine="autograd")(state, exogenous, command)
        t = plant.dt * torch.arange(steps, dtype=torch.float64).unsqueeze(-1)
        signals = {"state": flown.states[:, :-1], "command": command, "applied": flown.actions, "exogenous": exogenous}
        return cls(plant, t=t, **{name: x.transpose(0, 1).contiguous() for name, x in signals.items()})

    def methods(self) -> list[Method]:
        """Every method; a method that takes a closure comes with the true closure and with that of the twin."""
        plant = self.plant
        n_s, n_a, n_o = len(plant.states), len(plant.actions), len(plant.observations)
        now, then = ("t", "state", "applied", "exogenous"), ("t", "state", "command", "exogenous")
        methods = [
            Method("observe", plant.observe, ("t", "state", "exogenous"), {"observation": (n_o,)}),
            Method("running_cost", plant.running_cost, now, {"cost": ()}),
            Method("terminal_cost", plant.terminal_cost, ("state",), {"cost": ()}),
            Method("discrepancy", plant.discrepancy, ("state", "measured"), {"cost": ()}),
            Method("actuate", plant.actuate, ("state", "command"), {"action": (n_a,)}),
            Method("latch", plant.latch, ("state", "applied"), {"state": (n_s,)}),
        ]
        for closure in (plant.closure, self.closure):
            methods.append(self.field_under(closure, "vector_field"))
            methods.append(Method("step", _under(plant.step, closure), then, {"state": (n_s,), "applied": (n_a,)}))
        return methods

    def field_under(self, closure: nn.Module, name: str) -> Method:
        """The vector field under a closure, by the name that messages blame."""
        takes = ("t", "state", "applied", "exogenous")
        return Method(name, _under(self.plant.vector_field, closure), takes, {"rate": (len(self.plant.states),)})

    def commanded_by(self, policy: nn.Module) -> Method:
        """The command of a policy, by the name of what makes it; it never meets an observation without a batch."""
        plant = self.plant

        def command(t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
            seen = plant.observe(t, state, exogenous)
            action: Tensor = policy(seen) if seen.ndim > 1 else policy(seen.unsqueeze(0)).squeeze(0)
            return action

        return Method("make_policy", command, ("t", "state", "exogenous"), {"command": (len(plant.actions),)})

    def some(self, count: int) -> Arguments:
        """The arguments at ``count`` times at most, which are spread over the flights, for all episodes."""
        n = len(self.arguments["t"])
        at = torch.linspace(0, n - 1, min(count, n)).round().long()
        return {name: value[at].clone() for name, value in self.arguments.items()}


def random_commands(plant: Plant, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Random commands, uniform within the ranges of the actions."""
    low, high = bounds(plant.actions)
    share = torch.rand(*shape, len(plant.actions), generator=generator, dtype=torch.float64)
    return low + share * (high - low)


def _under(method: Callable[..., Any], closure: nn.Module) -> Callable[..., Any]:
    return lambda *arguments: method(*arguments, closure)


def module_methods(calls: Calls) -> list[Method]:
    """The command of the plant's policy and the rates under its neural closure, by what makes them."""
    neural = neural_closure_of(calls.plant)
    closures = [] if neural is None else [calls.field_under(neural(seeded()), "make_neural_closure")]
    return [calls.commanded_by(calls.plant.make_policy(seeded())), *closures]


@torch.no_grad()
def method(calls: Calls, method: Method) -> Iterator[str]:
    """Violations for one state, for a batch, and for times by batches, as engines, environment and costs call it."""
    together = calls.some(2)
    wrong = [*_shapes(method, together)]
    yield from wrong
    lead = together["state"].shape[:2]
    rows = [(together[name].expand(lead) if name == "t" else together[name]).flatten(0, 1) for name in method.takes]
    try:
        if not wrong:
            require_pure(_Asked(calls.plant, method), *rows)
    except ImpureError as error:
        yield f"{method.name}: {error}"


class _Asked(nn.Module):
    """A method as a module, whose results stand side by side."""

    def __init__(self, plant: Plant, method: Method):
        super().__init__()
        self.plant, self.method = plant, method

    def forward(self, *rows: Tensor) -> Tensor:
        results = self.method.outputs(dict(zip(self.method.takes, rows, strict=True)))
        return torch.cat([result.reshape(len(rows[0]), -1) for result in results], -1)


def _shapes(method: Method, arguments: Arguments) -> Iterator[str]:
    """The first wrong shape: of one state, which is easiest to get right, of a batch, or of all times."""
    for place in ((0, 0), (0,), ()):
        case = {name: value[place] for name, value in arguments.items()}
        outputs = method.outputs(case)
        if len(outputs) != len(method.gives):
            yield f"{method.name}: gives {len(outputs)} values; expected {', '.join(method.gives)} as a Transition."
            return
        for (name, trailing), value in zip(method.gives.items(), outputs, strict=True):
            if problem := misshapen(value, (*case["state"].shape[:-1], *trailing)):
                given = ", ".join(f"{key} {tuple(case[key].shape)}" for key in method.takes)
                yield (
                    f"{method.name}: {name} has {problem} for {given}. Index the last dimension only (state[..., 0]), "
                    "and combine tensors that broadcast."
                )
                return


@torch.no_grad()
def judgement(calls: Calls) -> Iterator[str]:
    """Violations in merit and setpoints of whole episodes."""
    state, applied, exogenous = (calls.arguments[name].transpose(0, 1) for name in ("state", "applied", "exogenous"))
    batch, steps = state.shape[:2]
    for key, pair in calls.plant.setpoints(state, applied, exogenous).items():
        for what, value in zip(("value", "setpoint"), pair, strict=True):
            if problem := misshapen(value, (batch, steps)):
                yield f"setpoints: the {what} of {key!r} has {problem} for {batch} episodes of {steps} intervals."
    for key, value in calls.plant.merit(state, applied[:, :-1], exogenous[:, :-1]).items():
        numbers = value.nan_to_num() if isinstance(value, Tensor) else value  # which not every episode has
        if problem := misshapen(numbers, (batch,)):
            yield f"merit: {key!r} has {problem} for {batch} episodes."


@torch.no_grad()
def costs(calls: Calls) -> Iterator[str]:
    """Violations in the signs of the costs, in the applied action of a step, and in commanding that action again."""
    plant, arguments = calls.plant, calls.arguments
    for method in calls.methods():
        if method.name in ("running_cost", "terminal_cost", "discrepancy"):
            (cost,) = method.outputs(arguments)
            if (cost < 0.0).any():
                k, b = (cost == cost.min()).nonzero()[0].tolist()
                yield (
                    f"{method.name}: is {cost.min():.4g} at state {arguments['state'][k, b].tolist()}; expected no "
                    "negative cost: add a constant, or penalise squares of errors."
                )
    size = 1e-9 * (1.0 + arguments["applied"].abs().amax((0, 1)))
    applied = plant.actuate(arguments["state"], arguments["command"])
    step = plant.step(arguments["t"], arguments["state"], arguments["command"], arguments["exogenous"], plant.closure)
    gaps = {
        "step: its applied action is not what actuate(state, command) gives; call actuate in step, because "
        "trajectories report its action": step.applied - applied,
        "actuate: an applied action that is commanded again from the same state becomes another one; where a safety "
        "layer sends another action, that is recorded as the command, too. What limits nothing, such as a rotation, "
        "belongs into vector_field": plant.actuate(arguments["state"], applied) - applied,
    }
    yield from (f"{text} (up to {gap.abs().max():.4g})." for text, gap in gaps.items() if (gap.abs() > size).any())


@torch.no_grad()
def ends(calls: Calls) -> Iterator[str]:
    """Violations in what says that an episode has ended, and in what that costs."""
    plant, state = calls.plant, calls.arguments["state"]
    try:
        require_end_cost(plant)
    except ValueError as error:
        yield f"end_cost: {error}"
        return
    ended = plant.ended(state)
    if ended.dtype != torch.bool or ended.shape != state.shape[:-1]:
        yield (
            f"ended: returns {ended.dtype} of shape {tuple(ended.shape)} for states of shape {tuple(state.shape)}; "
            f"expected torch.bool of shape {tuple(state.shape[:-1])}, one answer for each state."
        )


@torch.no_grad()
def periods(calls: Calls) -> Iterator[str]:
    """Methods whose results change with a turn of a periodic state."""
    plant, arguments = calls.plant, calls.arguments
    for k, signal in ((k, signal) for k, signal in enumerate(plant.states) if signal.periodic):
        turned = arguments["state"].clone()
        turned[..., k] += signal.period
        for method in (method for method in calls.methods() if "state" in method.takes):
            pairs = zip(method.outputs(arguments), method.outputs(arguments | {"state": turned}), strict=True)
            for name, (first, second) in zip(method.gives, pairs, strict=True):
                gap = differences(plant.states, second, first) if name == "state" else second - first
                if (gap.abs() > PERIODIC * (1.0 + first.abs())).any():
                    yield (
                        f"{method.name}: its {name} changes by up to {gap.abs().max():.4g} when state {signal.name!r} "
                        f"turns by its period {signal.period:g} {signal.unit}; use its cosine and sine, or the short "
                        "way round."
                    )
