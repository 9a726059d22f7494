"""Checks of the methods' derivatives against finite differences."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from rt_torchrl.contract.calls import Arguments, Calls, Method
from rt_torchrl.contract.draws import seeded
from rt_torchrl.plants.closures import BoundedPerceptron

MANY = 5
STEP = 1e-6
"""Step of a difference, as a share of the argument's size; rounding then errs by 1e-10, and curvature by 1e-12."""
RELATIVE, ABSOLUTE = 1e-5, 1e-6
"""Greatest gap, as a share of the derivative and of the size of the method's value."""
SIGNALS = {"state": "states", "command": "actions", "applied": "actions", "exogenous": "inputs"}
CHECKED = ("vector_field", "step", "running_cost", "terminal_cost", "observe")


def gradients(calls: Calls) -> Iterator[str]:
    """Wrong derivatives of each method by each state and action, and by each weight of the twin's closure.

    They are taken at states of flights. A finding under the true closure is not repeated under the twin's closure.
    """
    arguments, told = calls.some(MANY), set()
    latest = {method.name: method for method in calls.methods()}  # under the twin's closure
    for method in calls.methods():
        if method.name not in CHECKED or method.name in told:
            continue
        for argument in ("state", "command", "applied"):
            if argument in method.takes:
                for text in _by_argument(calls, method, arguments, argument):
                    told.add(method.name)
                    yield text
    for name in ("vector_field", "step"):
        yield from _by_weights(calls, latest[name], arguments)


class _Derivative(NamedTuple):
    """A directional derivative by reverse mode and by finite differences; ``reached`` if autograd saw a path."""

    reverse: Tensor
    differences: Tensor
    reached: bool


def _by_argument(calls: Calls, method: Method, arguments: Arguments, argument: str) -> Iterator[str]:
    measure = _measure(method, arguments, calls.seed)
    value = arguments[argument].clone().requires_grad_()
    reached, gradient = _gradient(lambda: measure({**arguments, argument: value}), [value])
    signals = getattr(calls.plant, SIGNALS[argument])
    for k, signal in enumerate(signals):
        shift = torch.zeros_like(value.detach())
        size = 1e-3 + value.detach()[..., k].abs().max()
        shift[..., k] = STEP * size
        with torch.no_grad():
            ends = [measure({**arguments, argument: value + sign * shift}) for sign in (1.0, -1.0)]
        found = _Derivative(gradient[0][..., k] * size, (ends[0] - ends[1]) / (2.0 * STEP), reached)
        yield from _verdict(method.name, f"{argument} {signal.name!r}", found)


def _by_weights(calls: Calls, method: Method, arguments: Arguments) -> Iterator[str]:
    """Wrong derivatives along one random direction for each tensor of weights."""
    measure = _measure(method, arguments, calls.seed)
    weights = {name: w for name, w in calls.closure.named_parameters() if w.requires_grad}
    reached, gradient = _gradient(lambda: measure(arguments).sum(), list(weights.values()))
    generator, dormant = seeded(calls.seed), _dormant(calls.closure)
    for (name, weight), slope in zip(weights.items(), gradient, strict=True):
        direction = torch.randn(weight.shape, generator=generator, dtype=torch.float64)
        direction *= 1e-3 + weight.detach().abs().max()
        differences = _along(weight, direction, lambda: measure(arguments).sum())
        found = _Derivative((slope * direction).sum(), differences, reached)
        of_all = list(_verdict(method.name, f"closure weight {name!r}", found))
        yield from of_all
        matters = slope.any() or differences.any() or id(weight) in dormant
        if not of_all and method.name == "vector_field" and not matters:
            yield (
                f"vector_field: closure weight {name!r} changes it at none of {measure(arguments).numel()} states; "
                "leave the weight out, or start it where it matters."
            )


def _dormant(closure: nn.Module) -> set[int]:
    """Weights of hidden layers that matter as soon as the last layer of their perceptron is no longer zero."""
    found = [m.network for m in closure.modules() if isinstance(m, BoundedPerceptron)]
    asleep = [network for network in found if not network[-1].get_parameter("weight").any()]
    return {id(weight) for network in asleep for layer in network[:-1] for weight in layer.parameters()}


@torch.no_grad()
def _along(weight: nn.Parameter, direction: Tensor, measure: Callable[[], Tensor]) -> Tensor:
    """The central difference along a direction; the weight then has its value again, to the bit."""
    kept, ends = weight.clone(), []
    for sign in (1.0, -1.0):
        weight.copy_(kept + sign * STEP * direction)
        ends.append(measure())
    weight.copy_(kept)
    return (ends[0] - ends[1]) / (2.0 * STEP)


def _measure(method: Method, arguments: Arguments, seed: int) -> Callable[[Arguments], Tensor]:
    """A random combination of a method's outputs, in units of their size, for each time and episode."""
    with torch.no_grad():
        outputs = method.outputs(arguments)
    generator, weights = seeded(seed), []
    for (_, trailing), value in zip(method.gives.items(), outputs, strict=True):
        share = torch.randn(trailing, generator=generator, dtype=torch.float64)
        weights.append(share / (1e-3 + value.abs().amax((0, 1))))

    def measure(changed: Arguments) -> Tensor:
        pairs = zip(method.outputs(changed), weights, strict=True)
        return torch.stack([(value * w).reshape(*value.shape[:2], -1).sum(-1) for value, w in pairs]).sum(0)

    return measure


def _gradient(measure: Callable[[], Tensor], inputs: list[Tensor]) -> tuple[bool, list[Tensor]]:
    """Whether autograd sees a path at all, and the gradients, which are zero where it sees none."""
    with torch.enable_grad():
        total = measure().sum()
        if not total.requires_grad:
            return False, [torch.zeros_like(x) for x in inputs]
        found = torch.autograd.grad(total, inputs, allow_unused=True)
    return True, [torch.zeros_like(x) if g is None else g for x, g in zip(inputs, found, strict=True)]


def _verdict(method: str, by: str, found: _Derivative) -> Iterator[str]:
    reverse, differences = torch.broadcast_tensors(found.reverse.detach(), found.differences)
    gap = (reverse - differences).abs()
    bad = ~(gap <= ABSOLUTE + RELATIVE * differences.abs())
    if not bad.any():
        return
    if not reverse.isfinite().all():
        yield (
            f"{method}: its derivative by {by} is not finite; expected a finite slope everywhere: mind sqrt, norm and "
            "pow at zero, and torch.where, whose unused branch still passes its slope on."
        )
    elif not reverse[bad].any():
        yield (
            f"{method}: autograd finds no dependence on {by}, finite differences do ({_largest(differences, bad)}); "
            "the path is cut: use torch operations on the tensors themselves, without detach, item, float, numpy, "
            "torch.tensor or no_grad."
        )
    else:
        yield (
            f"{method}: its derivative by {by} is {_largest(reverse, bad)}, by finite differences "
            f"{_largest(differences, bad)} (in units of the signals' sizes, in {int(bad.sum())} of {bad.numel()} "
            "places); a part of the path is cut (detach, item, numpy), or it jumps: use smooth laws, or torch.where "
            "between laws that meet."
        )


def _largest(values: Tensor, chosen: Tensor) -> str:
    picked = values[chosen]
    return f"{picked[picked.abs().argmax()].item():.6g}"
