"""Checks of the shapes, precision and purity of methods, closures and policy, under every leading dimension."""

from collections.abc import Iterator

import torch
from torch import Tensor

from rt_torchrl.contract.calls import Arguments, Calls, Method
from rt_torchrl.contract.draws import misshapen, neural_closure_of, seeded, wanted_as
from rt_torchrl.programs.contract import PURE

TOLERANCE = 1e-10
"""Greatest difference as a share of a value: vector instructions may round powers and exponentials differently."""


@torch.no_grad()
def methods(calls: Calls) -> Iterator[str]:
    """Violations for one state, for a batch, and for times by batches, as engines, environment and costs call them."""
    together = calls.some(2)
    for method in calls.methods():
        found = list(_shapes(method, together)) or list(_purity(method, together)) or list(_rows(method, together))
        yield from found
    made = [calls.commanded_by(calls.plant.make_policy(seeded(calls.seed)))]
    neural = neural_closure_of(calls.plant)
    if neural is not None:
        made.append(calls.field_under(neural(seeded(calls.seed)), "make_neural_closure"))
    for method in made:
        try:
            yield from list(_shapes(method, together)) or [*_purity(method, together), *_rows(method, together)]
        except Exception as error:  # layers of torch may raise anything for some leading dimension
            said = str(error).splitlines()[0] if str(error) else ""
            yield (
                f"{method.name}: what it makes raises {type(error).__name__}: {said}. It must work for every leading "
                f"dimension: rows of one, a batch, and times by batches. {PURE}."
            )
    yield from _judgement(calls)


def _row(arguments: Arguments, k: int, b: int | None = None) -> Arguments:
    """The arguments at time k, of all episodes with a time of shape ``1``, or of episode b alone with a scalar time."""
    if b is None:
        return {name: value[k] for name, value in arguments.items()}
    return {name: value[k, 0] if name == "t" else value[k, b] for name, value in arguments.items()}


def _shapes(method: Method, arguments: Arguments) -> Iterator[str]:
    """The first wrong shape; the case that is easiest to get right comes first."""
    times, batch = arguments["state"].shape[:2]
    cases = {(): _row(arguments, 0, 0), (batch,): _row(arguments, 0), (times, batch): arguments}
    for lead, case in cases.items():
        outputs = method.outputs(case)
        if len(outputs) != len(method.gives):
            yield f"{method.name}: gives {len(outputs)} values; expected {', '.join(method.gives)} as a Transition."
            return
        for (name, trailing), value in zip(method.gives.items(), outputs, strict=True):
            problem = misshapen(value, (*lead, *trailing))
            if problem:
                given = ", ".join(f"{key} {tuple(case[key].shape)}" for key in method.takes)
                yield (
                    f"{method.name}: {name} has {problem} for {given}; expected {wanted_as((*lead, *trailing))}. "
                    "Index the last dimension only (state[..., 0]), and combine tensors that broadcast."
                )
                return


def _purity(method: Method, arguments: Arguments) -> Iterator[str]:
    """A violation if the method changes its arguments, or gives different results for the same arguments."""
    kept = {name: value.clone() for name, value in arguments.items()}
    first = [value.clone() for value in _tensors(method, arguments)]
    changed = [name for name in method.takes if not torch.equal(kept[name], arguments[name])]
    if changed:
        for name in changed:
            arguments[name].copy_(kept[name])
        yield f"{method.name}: changes its argument {' and '.join(changed)} in place; make a new tensor instead."
        return
    method.outputs(_row(arguments, 1))
    method.outputs({name: value[:1].expand_as(value) for name, value in arguments.items()})
    again = _tensors(method, arguments)
    if not all(map(torch.equal, first, again)):
        yield (
            f"{method.name}: gives something else when it is called again with the same arguments; it must be a pure "
            "function: no random number inside, and nothing kept from call to call (what is remembered is a state). "
            f"{PURE}."
        )


def _tensors(method: Method, arguments: Arguments) -> list[Tensor]:
    return [value for value in method.outputs(arguments) if isinstance(value, Tensor)]


def _rows(method: Method, arguments: Arguments) -> Iterator[str]:
    """A violation if the results of a batch differ from those of its rows one by one."""
    times, batch = arguments["state"].shape[:2]
    together = method.outputs(arguments)
    rows = [[method.outputs(_row(arguments, k, b)) for b in range(batch)] for k in range(times)]
    for place, name in enumerate(method.gives):
        alone = torch.stack([torch.stack([found[place] for found in row]) for row in rows])
        gap = ((together[place] - alone).abs() / (1e-6 + alone.abs().amax((0, 1)))).max()
        if gap > TOLERANCE:
            yield (
                f"{method.name}: {name} of a batch differs from that of its rows one by one, by {gap:.1e} of its size; "
                "rows are systems of their own: no sum, mean or norm over a leading dimension."
            )


def _judgement(calls: Calls) -> Iterator[str]:
    """Violations in merit and categories of whole episodes."""
    state, applied, exogenous = (calls.arguments[name].transpose(0, 1) for name in ("state", "applied", "exogenous"))
    batch, n = state.shape[:2]
    if n < 3:  # the start alone is no episode
        return
    found = {
        "merit": (calls.plant.merit(state, applied[:, :-1], exogenous[:, :-1]), torch.float64),
        "categories": (calls.plant.categories(exogenous), torch.bool),
    }
    for name, (quantities, dtype) in found.items():
        for key, value in quantities.items():
            if not isinstance(value, Tensor) or tuple(value.shape) != (batch,) or value.dtype != dtype:
                given = f"{tuple(value.shape)} in {value.dtype}" if isinstance(value, Tensor) else type(value).__name__
                yield f"{name}: {key!r} is {given} for {batch} episodes; expected shape ({batch},) in {dtype}."
