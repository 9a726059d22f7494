"""Checks of what a plant declares and draws: signals, initial states, inputs, closures and policies."""

import math
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal

GROUPS = {"states": "n_s", "actions": "n_a", "inputs": "n_z", "observations": "n_o"}
BATCH = 3


def signals(plant: Plant) -> Iterator[str]:
    """Violations in the plant's name, in its four tuples of signals, and in the names of the controller's states."""
    name = getattr(plant, "name", None)
    if not isinstance(name, str) or not name.isidentifier():
        yield f"name: is {name!r}; give the class a name such as name = 'two_tanks', which run folders are called by."
    for group in GROUPS:
        declared = getattr(plant, group, None)
        if not isinstance(declared, tuple) or not all(isinstance(signal, Signal) for signal in declared):
            yield f"{group}: is {declared!r}; expected a tuple of Signal, declared on the class."
            continue
        if not declared and group != "inputs":
            yield f"{group}: is empty; declare at least one Signal (only inputs may be empty)."
        yield from _of_group(group, declared)
    yield from _of_controller(plant)


def _of_controller(plant: Plant) -> Iterator[str]:
    names = [getattr(signal, "name", None) for signal in getattr(plant, "states", None) or ()]
    for name in plant.controller_states:
        if name not in names:
            yield f"controller_states: {name!r} is no state; it must be one of {', '.join(map(str, names))}."


def _of_group(group: str, declared: tuple[Signal, ...]) -> Iterator[str]:
    names = [signal.name for signal in declared]
    for name in dict.fromkeys(name for name in names if names.count(name) > 1):
        yield f"{group}: {name!r} is declared {names.count(name)} times; give every signal a name of its own."
    for signal in declared:
        for attribute in ("unit", "symbol"):
            if not getattr(signal, attribute):
                yield f"{group}: {signal.name!r} has no {attribute}; give one (unit='-' for a number without unit)."
        bounded = math.isfinite(signal.low) and math.isfinite(signal.high)
        if group == "actions" and not bounded:
            yield (
                f"actions: {signal.name!r} has range [{signal.low}, {signal.high}] {signal.unit}; policies and "
                "exploration need finite limits: give the Signal the actuator's low and high."
            )


def seeded(seed: int) -> torch.Generator:
    """A new generator with the seed."""
    return torch.Generator().manual_seed(seed)


def draws(plant: Plant, seed: int) -> Iterator[str]:
    """Violations in shape, precision, range and source of the initial states and of the inputs."""
    n_s, n_z = len(plant.states), len(plant.inputs)
    wanted = {
        "draw_initial_state": (partial(plant.draw_initial_state, BATCH), (BATCH, n_s), plant.states),
        "draw_exogenous": (partial(plant.draw_exogenous, BATCH), (BATCH, plant.n_steps, n_z), plant.inputs),
    }
    for name, (of, shape, group) in wanted.items():

        def draw(of: Callable[[torch.Generator], Tensor] = of) -> Tensor:
            return of(seeded(seed))

        drawn = draw()
        problem = misshapen(drawn, shape)
        if problem:
            yield f"{name}: gives {problem} for batch={BATCH}, n_steps={plant.n_steps}; expected {wanted_as(shape)}."
            continue
        yield from _out_of_range(name, drawn, group)
        sources = list(_other_sources(name, draw))
        yield from sources or _ignored_generator(name, drawn, of(seeded(seed + 1)))


def misshapen(value: object, shape: tuple[int, ...]) -> str | None:
    """The fault of a value that should be a finite float64 tensor of the shape; None if there is no fault."""
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__}"
    if tuple(value.shape) != shape:
        return f"shape {tuple(value.shape)}"
    if value.dtype != torch.float64:
        return f"{value.dtype}"
    if not value.isfinite().all():
        return f"{int((~value.isfinite()).sum())} values that are not finite"
    return None


def wanted_as(shape: tuple[int, ...]) -> str:
    """The expected value, in words for a message."""
    return f"finite numbers of shape {shape} in torch.float64"


def _out_of_range(name: str, drawn: Tensor, group: tuple[Signal, ...]) -> Iterator[str]:
    for signal, values in zip(group, drawn.unbind(-1), strict=True):
        if (values < signal.low).any() or (values > signal.high).any():
            yield (
                f"{name}: draws {signal.name!r} from {values.min():g} to {values.max():g} {signal.unit}, outside "
                f"[{signal.low:g}, {signal.high:g}]; draw within the Signal's range, or widen it."
            )


def _other_sources(name: str, draw: Callable[[], Tensor]) -> Iterator[str]:
    """A violation if the draw depends on more than its generator.

    It may draw torch's global random numbers, as layers do before their weights are overwritten, but may not use them.
    """
    kept = torch.random.get_rng_state()
    first = draw()
    torch.random.set_rng_state(kept)
    same = torch.equal(first, draw())
    torch.manual_seed(1 + torch.initial_seed())
    unmoved = torch.equal(first, draw())
    torch.random.set_rng_state(kept)
    if not same:
        yield (
            f"{name}: gives something else each time for generators of the same seed; take every random number from "
            "the generator that is passed in, and change nothing of the plant."
        )
    elif not unmoved:
        yield f"{name}: depends on torch's global random numbers; pass generator=generator to every random function."


def _ignored_generator(name: str, drawn: Tensor, other: Tensor) -> Iterator[str]:
    """A violation if episodes differ from each other but not between seeds; all episodes may be the same."""
    if torch.equal(drawn, other) and not torch.equal(drawn, drawn[:1].expand_as(drawn)):
        yield (
            f"{name}: draws different episodes, but the same ones for generators of another seed; take every random "
            "number from the generator that is passed in."
        )


def modules(plant: Plant, seed: int) -> Iterator[str]:
    """Violations in precision and source of the weights of closures and policy, and in the policy's commands."""
    made: dict[str, Callable[[torch.Generator], nn.Module]]
    made = {"make_closure": plant.make_closure, "make_policy": plant.make_policy}
    neural = neural_closure_of(plant)
    made |= {} if neural is None else {"make_neural_closure": neural}
    for name, make in made.items():
        first = make(seeded(seed))
        if not isinstance(first, nn.Module):
            yield f"{name}: gives a {type(first).__name__}; expected a torch.nn.Module."
            continue
        yield from _single_precision(name, first)
        yield from _other_sources(name, partial(_drawn_weights, make, seed))
        if not any(weight.requires_grad for weight in first.parameters()):
            yield f"{name}: has no trainable weights; what is learned must be an nn.Parameter with requires_grad."
    if not isinstance(plant.closure, nn.Module):
        yield f"closure: is a {type(plant.closure).__name__}; pass a torch.nn.Module to Plant.__init__."
        return
    yield from _single_precision("closure", plant.closure)
    yield from _commands(plant, seed)


def neural_closure_of(plant: Plant) -> Callable[[torch.Generator], nn.Module] | None:
    """What makes the neural closure of a plant, a small one; None if the plant defines none."""
    # An extension has the closures of its plant.
    if type(plant.innermost).make_neural_closure is Plant.make_neural_closure:
        return None
    return partial(plant.make_neural_closure, hidden=(4,))


def _drawn_weights(make: Callable[[torch.Generator], nn.Module], seed: int) -> Tensor:
    module = make(seeded(seed))
    weights = [weight.detach().double().flatten() for weight in module.state_dict().values()]
    return torch.cat(weights) if weights else torch.empty(0)


def _single_precision(name: str, module: nn.Module) -> Iterator[str]:
    for weight, value in module.named_parameters():
        if value.dtype != torch.float64:
            yield f"{name}: has {weight} in {value.dtype}; expected torch.float64: call .double()."


def _commands(plant: Plant, seed: int) -> Iterator[str]:
    """Violations in the policy's commands for observations of order one, as they should be scaled."""
    policy = plant.make_policy(seeded(seed))
    count, n_o = 50, len(plant.observations)
    seen = 3.0 * torch.rand(count, n_o, generator=seeded(seed), dtype=torch.float64) - 1.5
    command = policy(seen)
    problem = misshapen(command, (count, len(plant.actions)))
    if problem:
        shape = (count, len(plant.actions))
        yield f"make_policy: its commands on {count} observations have {problem}; expected {wanted_as(shape)}."
    else:
        yield from _out_of_range("make_policy", command.detach(), plant.actions)
