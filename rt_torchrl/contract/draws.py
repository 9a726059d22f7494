"""Checks of what a plant declares and draws: signals, initial states, inputs, closures and policies."""

import math
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

GROUPS = ("states", "actions", "inputs", "observations")
BATCH = 3


def signals(plant: Plant) -> Iterator[str]:
    """Violations in the plant's name, in its four tuples of signals, and in the names of the controller's states."""
    name = getattr(plant, "name", None)
    if not isinstance(name, str) or not name.isidentifier():
        yield f"name: is {name!r}; give the class a name such as name = 'two_tanks', which run folders are called by."
    for group in GROUPS:
        declared = getattr(plant, group, None)
        if not isinstance(declared, tuple) or not all(isinstance(signal, Signal) for signal in declared):
            or_by = " (or by measurements there)" if group == "observations" else ""
            yield f"{group}: is {declared!r}; expected a tuple of Signal, declared on the class{or_by}."
            continue
        if not declared and group != "inputs":
            yield f"{group}: is empty; declare at least one Signal (only inputs may be empty)."
        names = [signal.name for signal in declared]
        for signal in declared:
            for fault in _faults(group, signal, names.count(signal.name)):
                yield f"{group}: {signal.name!r} {fault}."
    names = [getattr(signal, "name", None) for signal in getattr(plant, "states", None) or ()]
    for name in (name for name in plant.controller_states if name not in names):
        yield f"controller_states: {name!r} is no state; it must be one of {', '.join(map(str, names))}."


def _faults(group: str, signal: Signal, count: int) -> list[str]:
    bounded = math.isfinite(signal.low) and math.isfinite(signal.high)
    faults = {
        f"is declared {count} times; give every signal a name of its own": count > 1,
        "has no unit; give one (unit='-' for a number without unit)": not signal.unit,
        "has no symbol; give one": not signal.symbol,
        "is periodic; only a state can be: take its cosine and sine instead": signal.periodic and group != "states",
        f"has range [{signal.low}, {signal.high}] {signal.unit}; policies and exploration need finite limits: give the "
        "Signal the actuator's low and high": group == "actions" and not bounded,
    }
    return [text for text, wrong in faults.items() if wrong]


def seeded(seed: int = 0) -> torch.Generator:
    """A new generator with the seed."""
    return torch.Generator().manual_seed(seed)


def draws(plant: Plant) -> Iterator[str]:
    """Violations in shape, precision, range and source of the initial states and of the inputs."""
    expected = {
        "draw_initial_state": ((BATCH, len(plant.states)), plant.states),
        "draw_exogenous": ((BATCH, plant.n_steps, len(plant.inputs)), plant.inputs),
    }
    for name, (shape, group) in expected.items():
        draw = partial(getattr(plant, name), BATCH)
        drawn = draw(seeded())
        if problem := misshapen(drawn, shape):
            yield f"{name}: gives {problem} for batch={BATCH}, n_steps={plant.n_steps}."
        else:
            yield from _out_of_range(name, drawn, group)
            yield from _other_sources(name, draw)


def misshapen(value: object, shape: tuple[int, ...]) -> str | None:
    """What a value is that should be a finite float64 tensor of the shape, and what it should; None if it is one."""
    if not isinstance(value, Tensor):
        found = f"a {type(value).__name__}"
    elif tuple(value.shape) != shape:
        found = f"shape {tuple(value.shape)}"
    elif value.dtype != torch.float64:
        found = f"{value.dtype}"
    elif not value.isfinite().all():
        found = f"{int((~value.isfinite()).sum())} values that are not finite"
    else:
        return None
    return f"{found}, expected finite numbers of shape {shape} in torch.float64"


def _out_of_range(name: str, drawn: Tensor, group: tuple[Signal, ...]) -> Iterator[str]:
    for signal, values in zip(group, drawn.unbind(-1), strict=True):
        if (values < signal.low).any() or (values > signal.high).any():
            yield (
                f"{name}: draws {signal.name!r} from {values.min():g} to {values.max():g} {signal.unit}, outside "
                f"[{signal.low:g}, {signal.high:g}]; draw within the Signal's range, or widen it."
            )


def _other_sources(name: str, draw: Callable[[torch.Generator], Tensor]) -> Iterator[str]:
    """A violation if a draw depends on more than its generator, or not on it; all episodes may be the same.

    It may draw torch's global random numbers, as layers do before their weights are overwritten, but may not use them.
    """
    with torch.random.fork_rng(devices=()):
        first = draw(seeded())
        torch.manual_seed(1 + torch.initial_seed())
        again, other = draw(seeded()), draw(seeded(1))
    remedy = "take every random number from the generator that is passed in, and change nothing of the plant."
    if not torch.equal(first, again):
        yield f"{name}: gives something else each time for generators of the same seed; {remedy}"
    elif torch.equal(first, other) and not torch.equal(first, first[:1].expand_as(first)):
        yield f"{name}: draws different episodes, but the same ones for generators of another seed; {remedy}"


def modules(plant: Plant) -> Iterator[str]:
    """Violations in precision and source of the weights of closures and policy, and in the policy's commands."""
    neural = neural_closure_of(plant)
    makers: dict[str, Callable[[torch.Generator], nn.Module]]
    makers = {"closure": lambda generator: plant.closure}
    makers |= {"make_closure": plant.make_closure, "make_policy": plant.make_policy}
    makers |= {} if neural is None else {"make_neural_closure": neural}
    inputs, outputs = plant.innermost.closure_inputs, plant.innermost.closure_outputs
    for name, make in makers.items():
        module = make(seeded())
        if not isinstance(module, nn.Module):
            yield f"{name}: is a {type(module).__name__}; expected a torch.nn.Module."
            continue
        for weight, value in module.named_parameters():
            if value.dtype != torch.float64:
                yield f"{name}: has {weight} in {value.dtype}; expected torch.float64: call .double()."
        yield from _other_sources(name, partial(_drawn_weights, make))
        if inputs and name.endswith("closure"):
            found = module(torch.zeros(1, len(inputs), dtype=torch.float64)).shape[-1]
            if found != len(outputs):
                yield f"closure_outputs: names {len(outputs)} coefficients, {name} gives {found}; name each of them."
        if name != "closure" and not any(weight.requires_grad for weight in module.parameters()):
            yield f"{name}: has no trainable weights; what is learned must be an nn.Parameter with requires_grad."
    # Observations are of order one, as they should be scaled.
    shape = (50, len(plant.actions))
    observations = 3.0 * torch.rand(50, len(plant.observations), generator=seeded(), dtype=torch.float64) - 1.5
    command = plant.make_policy(seeded())(observations)
    if problem := misshapen(command, shape):
        yield f"make_policy: its commands on 50 observations have {problem}."
    else:
        yield from _out_of_range("make_policy", command.detach(), plant.actions)


def neural_closure_of(plant: Plant) -> Callable[[torch.Generator], nn.Module] | None:
    """What makes the neural closure of a plant, a small one; None if the plant defines none."""
    # An extension has the closures of its plant.
    if type(plant.innermost).make_neural_closure is Plant.make_neural_closure:
        return None
    return partial(plant.make_neural_closure, hidden=(4,))


def _drawn_weights(make: Callable[[torch.Generator], nn.Module], generator: torch.Generator) -> Tensor:
    """All numbers of a module, as one row."""
    weights = [weight.detach().double().flatten() for weight in make(generator).state_dict().values()]
    return torch.cat([torch.empty(0), *weights]).unsqueeze(0)
