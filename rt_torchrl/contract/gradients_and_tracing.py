"""Checks of what engines and compilers need: stable steps, exact derivatives of any batch, and traceable methods."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import torch
from torch import Tensor, nn

from rt_torchrl.contract.draws import seeded
from rt_torchrl.contract.methods import Arguments, Calls, Method
from rt_torchrl.plants.closures import BoundedPerceptron
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sampling import rk4_step
from rt_torchrl.programs.machine_code import lanes_of_this_machine
from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.trajectories.engines.code import IntervalCode, point_of
from rt_torchrl.trajectories.engines.interval import CostInterval, Drive, Interval, costate_products
from rt_torchrl.trajectories.engines.parallel import jacobians_by_rows, over_all
from rt_torchrl.trajectories.twin import jacobians_of

STEP = 1e-6
"""Step of a difference, as a share of the argument's size; rounding then errs by 1e-10, and curvature by 1e-12."""
RELATIVE, ABSOLUTE = 1e-5, 1e-6
"""Greatest gap, as a share of the derivative and of the size of the method's value."""
CORNER, JUMP = 1e-5, 1e-4
"""Least gap between the slopes of both sides of a corner, and least change of the value, in its size, of a jump."""
SIGNALS = {"state": "states", "command": "actions", "applied": "actions", "exogenous": "inputs"}
CHECKED = ("vector_field", "step", "running_cost", "terminal_cost", "observe")
STILL = 1e-12
"""Movement of a state, as a share of its size, that is rounding."""
GROWTH = 1.0 + 1e-6
"""Factor per step above which a decaying mode counts as growing; that of an undamped mode is 1 to rounding."""


@torch.no_grad()
def stability(calls: Calls) -> Iterator[str]:
    r"""A violation if a mode that decays in the plant grows in a step: |R(μΔt)| ≤ 1 must hold where Re μ ≤ 0.

    R(z) = 1 + z + z²/2 + z³/6 + z⁴/24 reaches its limit at 2.785 on the negative real axis and at 2.83 on the imaginary
    axis. A plant with a scheme of its own is not checked, because this R does not describe that scheme.
    """
    plant, arguments = calls.plant, calls.some(20)
    if plant.own_scheme:
        return
    for whose, closure in (("the true closure", plant.closure), ("the closure of make_closure", calls.closure)):
        mu = torch.linalg.eigvals(jacobian(plant, closure, arguments))
        decays = mu.real <= 1e-9 * mu.abs()
        growth = torch.where(decays, amplification(mu * plant.dt), 0.0)
        if growth.max() > GROWTH:
            k, b, mode = (growth == growth.max()).nonzero()[0].tolist()
            worst = mu[k, b, mode]
            yield (
                f"dt: {plant.dt:g} s is too long for the eigenvalue {worst:.4g} 1/s of the vector field under {whose}, "
                f"|eigenvalue|·dt = {worst.abs() * plant.dt:.3g}, at state {arguments['state'][k, b].tolist()}: it "
                f"decays, but grows {growth.max():.3g} times in a Runge-Kutta step. Use dt <= "
                f"{stable_step(worst, plant.dt):.3g} s, or treat that mode as settled at once."
            )
            return


@torch.no_grad()
def step_error(calls: Calls) -> float | None:
    """Greatest difference of a state after a Runge-Kutta step and after two of half the length, as a share of its move.

    A fit takes this error of the twin for one of its coefficients, and no standard error says so. It is None for a
    plant with a scheme of its own.
    """
    plant, names = calls.plant, ("t", "state", "applied", "exogenous")
    if plant.own_scheme:
        return None
    t, state, applied, exogenous = (calls.arguments[name] for name in names)

    def step(t: Tensor, state: Tensor, dt: float) -> Tensor:
        return rk4_step(lambda t, s: plant.vector_field(t, s, applied, exogenous, plant.closure), t, state, dt)

    half, whole = 0.5 * plant.dt, step(t, state, plant.dt)
    errors = whole - step(t + half, step(t, state, half), half)
    errors, moves = (change.flatten(0, -2).abs().amax(0) for change in (errors, whole - state))
    sizes = state.flatten(0, -2).abs().amax(0)  # what moves by rounding alone errs by as much
    return float((errors / torch.maximum(moves, STILL * (1.0 + sizes))).max())


def jacobian(plant: Plant, closure: nn.Module, arguments: Arguments) -> Tensor:
    """∂f/∂s at every time and episode, ``n batch n_s n_s``, by central differences: no gradient is trusted yet."""
    t, state, applied, exogenous = (arguments[name] for name in ("t", "state", "applied", "exogenous"))
    size = 1e-6 * (1e-3 + state.abs().amax((0, 1)))
    columns = []
    for shift in torch.diag(size):
        ends = [plant.vector_field(t, state + sign * shift, applied, exogenous, closure) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * shift.sum()))
    return torch.stack(columns, -1)


def amplification(z: Tensor) -> Tensor:
    """The factor |R(z)| of a four-stage Runge-Kutta step of fourth order."""
    return (1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))).abs()


def stable_step(mu: Tensor, dt: float) -> float:
    """The longest step, to 5 %, in which a mode that decays does not grow."""
    while amplification(mu * dt) > GROWTH:
        dt *= 0.95
    return dt


def gradients(calls: Calls) -> Iterator[str]:
    """Wrong derivatives of each method by states and actions, and by the weights of the twin's closure and the policy.

    They are taken at states of flights. A finding under the true closure is not repeated under the twin's closure.
    """
    arguments, reported = calls.some(5), set()
    latest = {method.name: method for method in calls.methods()}  # under the twin's closure
    for method in calls.methods():
        if method.name in CHECKED and method.name not in reported:
            for argument in ("state", "command", "applied"):
                for text in _by_argument(calls, method, arguments, argument) if argument in method.takes else ():
                    reported.add(method.name)
                    yield text
    for name in ("vector_field", "step"):
        yield from _by_weights(calls, latest[name], arguments, calls.closure, "closure")
    if "observe" not in reported:
        policy = calls.plant.make_policy(seeded())
        command = calls.commanded_by(policy)
        yield from _by_argument(calls, command, arguments, "state")
        yield from _by_weights(calls, command, arguments, policy, "policy")


def _by_argument(calls: Calls, method: Method, arguments: Arguments, argument: str) -> Iterator[str]:
    """Wrong derivatives along each signal of an argument, at each time and episode."""
    value = arguments[argument].clone()
    measure = _measure(method, {**arguments, argument: value})
    (gradient,) = _gradients(measure, [value.requires_grad_()])
    for k, signal in enumerate(getattr(calls.plant, SIGNALS[argument])):
        direction = torch.zeros_like(value)
        direction[..., k] = 1e-3 + value.detach()[..., k].abs().max()
        slope = (gradient * direction).sum(-1)
        differences = _differences(value, direction, measure, slope)
        yield from _verdict(method.name, f"{argument} {signal.name!r}", slope, differences)


def _by_weights(calls: Calls, method: Method, arguments: Arguments, module: nn.Module, whose: str) -> Iterator[str]:
    """Wrong derivatives along one random direction for each tensor of weights."""
    measure, generator, dormant = _measure(method, arguments), seeded(), _dormant(module)
    weights = {name: w for name, w in module.named_parameters() if w.requires_grad}
    for (name, weight), gradient in zip(weights.items(), _gradients(measure, [*weights.values()]), strict=True):
        direction = torch.randn(weight.shape, generator=generator, dtype=torch.float64)
        direction *= 1e-3 + weight.detach().abs().max()
        slope = (gradient * direction).sum()
        differences = _differences(weight, direction, lambda: measure().sum(), slope)
        violations = [*_verdict(method.name, f"{whose} weight {name!r}", slope, differences)]
        yield from violations
        matters = gradient.any() or differences.any() or id(weight) in dormant
        if not violations and method.name == "vector_field" and not matters:
            yield (
                f"vector_field: closure weight {name!r} changes it at none of {measure().numel()} states; leave the "
                "weight out, or start it where it matters."
            )


def _dormant(closure: nn.Module) -> set[int]:
    """Weights of hidden layers that matter as soon as the last layer of their perceptron is no longer zero."""
    networks = [m.network for m in closure.modules() if isinstance(m, BoundedPerceptron)]
    asleep = [network for network in networks if not network[-1].get_parameter("weight").any()]
    return {id(weight) for network in asleep for layer in network[:-1] for weight in layer.parameters()}


@torch.no_grad()
def _differences(x: Tensor, direction: Tensor, measure: Callable[[], Tensor], slope: Tensor) -> Tensor:
    """The central difference along a direction of a tensor, which then has its value again, to the bit.

    In a corner, such as that of a rate limit, it is what lies nearest to the slope between the differences of both
    sides.
    """
    value, ends = x.clone(), []
    for sign in (1.0, 0.0, -1.0):
        x.copy_(value + sign * STEP * direction)
        ends.append(measure())
    x.copy_(value)
    sides = torch.stack([ends[0] - ends[1], ends[1] - ends[2]]) / STEP
    low, high = sides.amin(0), sides.amax(0)
    corner = ((high - low) > CORNER * (1.0 + slope.abs())) & ((high - low) * STEP < JUMP)
    return torch.where(corner, slope.clamp(low, high), sides.mean(0))


def _measure(method: Method, arguments: Arguments) -> Callable[[], Tensor]:
    """A random combination of a method's outputs, in units of their size, for each time and episode."""
    with torch.no_grad():
        outputs = method.outputs(arguments)
    generator, weights = seeded(), []
    for trailing, value in zip(method.gives.values(), outputs, strict=True):
        share = torch.randn(trailing, generator=generator, dtype=torch.float64)
        weights.append(share / (1e-3 + value.abs().amax((0, 1))))

    def measure() -> Tensor:
        pairs = zip(method.outputs(arguments), weights, strict=True)
        return torch.stack([(value * w).reshape(*value.shape[:2], -1).sum(-1) for value, w in pairs]).sum(0)

    return measure


def _gradients(measure: Callable[[], Tensor], inputs: list[Tensor]) -> Sequence[Tensor]:
    """The gradients by inputs, which are zero where autograd sees no path."""
    with torch.enable_grad():
        value = measure()
        return costate_products(value, inputs, torch.ones_like(value))


def _verdict(method: str, by: str, slope: Tensor, differences: Tensor) -> Iterator[str]:
    """A violation if a slope by autograd is not that by finite differences."""
    bad = ~((slope - differences).abs() <= ABSOLUTE + RELATIVE * differences.abs())
    if not bad.any():
        return
    k = differences[bad].abs().argmax()
    found = f"{method}: its derivative by {by} is {slope[bad][k]:.6g}, by finite differences {differences[bad][k]:.6g}"
    yield (
        f"{found} (in units of the signals' sizes, in {int(bad.sum())} of {bad.numel()} places). Zero, or a part: the "
        "path is cut; use torch operations on the tensors themselves, without detach, item, float, numpy, torch.tensor "
        "or no_grad. Not finite: mind sqrt, norm and pow at zero, and torch.where, whose unused branch still passes "
        "its slope on. Or it jumps: use smooth laws, or torch.where between laws that meet."
    )


def jacobians(calls: Calls) -> Iterator[str]:
    """A violation if the Jacobian of the step by torch.func, of all states at once, differs from that by autograd.

    Sensitivities need the former. Both Jacobians are exact, so that only rounding may differ; it is measured against
    entries down to a millionth of the greatest.
    """
    arguments = calls.some(3)
    drive = Drive(arguments["t"], arguments["exogenous"], arguments["command"])
    interval, state = Interval(calls.plant, calls.closure, None), arguments["state"]
    reverse = jacobians_by_rows(interval, state, drive)
    vectorised = over_all(partial(jacobians_of, interval, ()), state, drive)
    gap = ((vectorised - reverse).abs() / (1e-6 * reverse.abs().max() + reverse.abs())).max()
    if gap > 1e-6:
        yield (
            f"step: its Jacobian by torch.func differs from that by autograd, by {gap:.1e}; an own "
            "torch.autograd.Function needs a vmap that is right."
        )


def untraceable(calls: Calls) -> str | None:
    """What keeps the engine ``native`` from the plant under its own policy, with the line of code; None if nothing.

    Whatever the code raises for one realisation keeps it from the plant.
    """
    plant, arguments, lanes = calls.plant, calls.arguments, lanes_of_this_machine()
    interval = CostInterval(Interval(plant, calls.closure, plant.make_policy(seeded())))
    drive = Drive(arguments["t"], arguments["exogenous"], arguments["command"][..., :0])
    point = point_of(arguments["state"][0], drive, lanes.number, interval.sums)
    try:
        IntervalCode(interval, point, lanes).prepare_sweep(interval, False)
    except Exception as error:
        return str(error) if isinstance(error, UntraceableError) else f"{type(error).__name__}: {first_line(error)}"
    return None


def first_line(error: Exception) -> str:
    """The first line of what an error says, or its kind."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
