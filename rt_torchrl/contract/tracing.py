"""Checks of forward mode and of tracing, which the engines and the compiler need."""

from collections.abc import Iterator

import torch
from torch import Tensor

from rt_torchrl.contract.calls import Arguments, Calls, Method
from rt_torchrl.contract.draws import seeded
from rt_torchrl.programs.machine_code import lanes_of_this_machine
from rt_torchrl.programs.program import UntraceableError
from rt_torchrl.trajectories.engines.code import IntervalCode, point_of
from rt_torchrl.trajectories.engines.interval import CostInterval, Drive, Interval
from rt_torchrl.trajectories.engines.parallel import linearise, raised_limits, without_warnings_of_libraries

REMEDY = (
    "no Python branch on a tensor, .item(), float(tensor), numpy or print inside; use torch.where, and torch functions "
    "throughout"
)
MANY = 3


def forward_mode(calls: Calls) -> Iterator[str]:
    """A violation if the Jacobian of the step by batched forward-mode products differs from that by reverse mode.

    The parallel engine uses the forward-mode products. Both Jacobians are exact, so that only rounding may differ; it
    is measured against entries down to a millionth of the greatest.
    """
    arguments = calls.some(MANY)
    drive = Drive(arguments["t"], arguments["exogenous"], arguments["command"])
    interval, state = Interval(calls.plant, calls.closure, None), arguments["state"].requires_grad_()
    try:
        with without_warnings_of_libraries():
            jacobians = linearise(interval, (), state.detach(), drive)
    except Exception as error:
        yield f"step: torch.func.jvp under vmap fails: {_first_line(error)} {_where(error)}Expected {REMEDY}."
        return
    rows = [torch.autograd.grad(end.sum(), state, retain_graph=True)[0] for end in interval(state, drive).unbind(-1)]
    reverse = torch.stack(rows, -2)
    gap = ((jacobians - reverse).abs() / (1e-6 * reverse.abs().max() + reverse.abs())).max()
    if gap > 1e-6:
        yield (
            f"step: its Jacobian by forward mode differs from that by reverse mode, by {gap:.1e}; an own "
            "torch.autograd.Function needs a jvp that is right."
        )


def tracing(calls: Calls) -> Iterator[str]:
    """Methods that are not one graph; they are traced without a compiler, so that only the plant can fail."""
    arguments = calls.some(MANY)
    for method in calls.methods():

        def traced(arguments: Arguments, method: Method = method) -> tuple[Tensor, ...]:
            return method.outputs(arguments)

        try:
            with raised_limits():
                found = torch.compile(traced, fullgraph=True, backend="eager")(arguments)
        except Exception as error:
            yield f"{method.name}: is not one graph: {_first_line(error)} {_where(error)}Expected {REMEDY}."
            continue
        for (name, _), one, other in zip(method.gives.items(), found, method.outputs(arguments), strict=True):
            if not torch.allclose(one, other, rtol=1e-10, atol=1e-10):
                yield f"{method.name}: {name} has another value when it is traced; expected {REMEDY}."


def untraceable(calls: Calls) -> str | None:
    """What keeps the engine ``native`` from the plant under its own policy, with the line of code; None if nothing.

    Whatever the code raises for one realisation keeps it from the plant.
    """
    plant, arguments, lanes = calls.plant, calls.arguments, lanes_of_this_machine()
    policy = plant.make_policy(seeded(calls.seed))
    initial_state = torch.nn.functional.pad(arguments["state"][0], (0, 1))  # the cost is one more state
    drive = Drive(arguments["t"], arguments["exogenous"], arguments["command"][..., :0])
    point = point_of(initial_state, drive, lanes.number)
    try:
        interval = CostInterval(Interval(plant, calls.closure, policy))
        IntervalCode(interval, point, lanes).prepare_sweep(interval, False)
    except Exception as error:
        return str(error) if isinstance(error, UntraceableError) else f"{type(error).__name__}: {_first_line(error)}"
    return None


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def _where(error: Exception) -> str:
    """The last line of the user's code that the compiler names."""
    lines = str(error).splitlines()
    places = [k for k, line in enumerate(lines) if line.strip().startswith('File "')]
    if not places:
        return ""
    code = lines[places[-1] + 1].strip() if places[-1] + 1 < len(lines) else ""
    return f"({lines[places[-1]].strip()}: {code}) "
