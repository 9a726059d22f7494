"""Calls that find what is wrong with a plant, or with a classical controller, before a training does."""

import copy
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rt_torchrl.contract.draws import draws, misshapen, modules, seeded, signals
from rt_torchrl.contract.gradients_and_tracing import (
    first_line,
    gradients,
    jacobians,
    stability,
    step_error,
    untraceable,
)
from rt_torchrl.contract.methods import Calls, costs, ends, judgement, method, module_methods, periods
from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.plants.plant import Plant

Check = Callable[[Calls], Iterable[str]]
STATES = 3
"""Number of states that a classical controller is tried in."""
ALWAYS = ("signals", "draws", "closures and policy")
REMEDY = (
    "It must work for every leading dimension and any number of control intervals, read from the shapes of its "
    "arguments and not from n_steps, and under vmap and jacrev of torch.func; call .eval() on layers that normalise a "
    "batch."
)
LIBRARY = str(Path(__file__).parent.parent)


class ContractReport(NamedTuple):
    """The checks of :func:`check_plant` that a plant has passed; ``print`` shows them in words.

    Args:
        plant: name of the plant.
        checks: names of the checks.
        step_error: what a Runge-Kutta step leaves of the greatest move of a state in one, against two half steps; None
            for a plant with a scheme of its own.
        untraceable: what keeps the engine ``native`` from the plant, whose place ``autograd`` then takes; None if
            nothing does, or if the methods were not traced.
    """

    plant: str
    checks: tuple[str, ...]
    step_error: float | None = None
    untraceable: str | None = None

    def __str__(self) -> str:
        accuracy = "" if self.step_error is None else f"; a step errs by {100 * self.step_error:.2g} % of its move"
        engine = f"; engine 'autograd' takes the place of 'native': {self.untraceable}" if self.untraceable else ""
        return f"plant {self.plant!r} fulfils its contract: {', '.join(self.checks)}{accuracy}{engine}"


class PlantContractError(ValueError):
    """A plant does not fulfil its contract; ``violations`` holds a message for each violation."""

    def __init__(self, plant: str, violations: list[str]):
        self.violations = violations
        lines = "\n".join(f"  {k}. {text}" for k, text in enumerate(violations, 1))
        super().__init__(f"plant {plant!r} breaks its contract in {len(violations)} ways:\n{lines}")


def check_plant(
    plant: Plant, *, episodes: int = 4, steps: int = 50, traced: bool = True, trained: bool = True
) -> ContractReport:
    """Find all violations of the :class:`Plant` contract at once, not the first one alone.

    The function flies ``episodes`` short flights under random commands, and checks the plant at the states that they
    visit: signals and their ranges; shapes, precision and finiteness of every method under any leading dimensions;
    purity; draws and their generator; closures and policy; the applied action of the step against the actuators; costs,
    also of an early end; a turn of a periodic state, which must change nothing; gradients against finite differences;
    Jacobians of a batch, which sensitivities need; and the stability of the step. A check is left out if an earlier
    violation makes it impossible.

    Args:
        plant: the plant, with the time step of its training; one on another device is checked by a copy on the CPU.
        episodes: number of flights, at least 2.
        steps: number of control intervals of each flight, at least 2 and at most that of an episode.
        traced: whether the methods are also traced for the engine ``native``.
        trained: whether a twin of this plant trains its closure, so that each weight must matter on the flights; False
            for a real system whose twin is another plant.

    Returns:
        The checks that were made; the function prints nothing.

    Raises:
        PlantContractError: if the plant violates its contract. Each message names the method, what was found, what is
            expected, and what to change.
        ValueError: if ``episodes`` or ``steps`` is below 2, or ``plant`` is a class.
    """
    for argument, value in (("episodes", episodes), ("steps", steps)):
        if value < 2:
            raise ValueError(f"{argument}={value} of the check must be at least 2.")
    if isinstance(plant, type):
        raise ValueError(f"plant={plant.__name__} is a class; give a plant, such as {plant.__name__}().")
    if any(tensor.device.type != "cpu" for tensor in (*plant.parameters(), *plant.buffers())):
        plant = copy.deepcopy(plant).cpu()
    steps = min(steps, plant.n_steps)
    violations = [*signals(plant)] or [*attempt(draws, plant), *attempt(modules, plant)]
    violations = violations or _on_flights(plant, episodes, steps, trained=trained)
    if violations:
        raise PlantContractError(getattr(plant, "name", type(plant).__name__), violations)
    calls = Calls.at_the_start(plant, episodes)
    reason = untraceable(calls) if traced else None
    return ContractReport(plant.name, (*ALWAYS, *ON_FLIGHTS), step_error(calls), reason)


def _on_flights(plant: Plant, episodes: int, steps: int, *, trained: bool) -> list[str]:
    """The violations that need states to be found; an early violation ends the search."""
    calls = Calls.at_the_start(plant, episodes)
    violations = [*attempt(methods, calls), *attempt(stability, calls)]
    if violations:
        return violations
    try:
        calls = Calls.in_flight(plant, episodes, steps)
    except FloatingPointError as error:
        return [f"step: {error}"]
    if not trained:
        calls.closure.requires_grad_(False)
    return [text for check in (*ON_FLIGHTS.values(), judgement) for text in attempt(check, calls)]


def attempt(check: Callable[..., Iterable[str]], subject: Plant | Calls, *rest: Any, name: str = "") -> Iterator[str]:
    """The violations that a check finds; an error that the plant raises is one more, under the name of what failed."""
    try:
        yield from check(subject, *rest)
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [x for x in frames if not x.filename.startswith((LIBRARY, "<")) and "site-packages" not in x.filename]
        own = own or [frames[-1]]
        yield (
            f"{name or own[0].name}: raised {type(error).__name__} in {own[-1].filename}, line {own[-1].lineno}: "
            f"{first_line(error)}. {REMEDY}"
        )


def methods(calls: Calls) -> Iterator[str]:
    """Violations of every method, of the policy and of the neural closure."""
    for candidate in (*calls.methods(), *module_methods(calls)):
        yield from attempt(method, calls, candidate, name=candidate.name)


def require_controller(name: str, law: object, plant: Plant) -> None:
    """Refuse what is no class of classical controllers, or one whose law does not fit the plant.

    Args:
        name: what the class was given as, for the message.
        law: the class.
        plant: the plant that it controls.

    Raises:
        ValueError: if there is something wrong; the message says what, and what is expected.
    """
    if not (isinstance(law, type) and issubclass(law, ClassicalController)):
        raise ValueError(f"{name}={law!r} must be a class derived from ClassicalController: give the class itself.")
    controller, state = law(plant), plant.draw_initial_state(STATES, seeded())[:, : len(plant.readings)]
    size, about, actions = controller.memory_size, f"{name}: {law.__name__}", len(plant.actions)
    memory, exogenous = controller.first_memory(state), plant.draw_exogenous(STATES, seeded())[:, 0]
    _require(f"{about}.first_memory returns a memory", memory, size)
    try:
        command, memory = controller.law(state, memory, exogenous)
    except (IndexError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{about}.law fails for states of shape {tuple(state.shape)}, a memory of shape {tuple(memory.shape)} and "
            f"inputs of shape {tuple(exogenous.shape)}: {first_line(error)}. It is law(state, memory, exogenous), its "
            f"memory has as many columns as memory_size={size} says, and it returns both, command and memory."
        ) from error
    _require(f"{about}.law returns a command", command, actions)
    _require(f"{about}.law returns a memory", memory, size)


def _require(about: str, value: object, columns: int) -> None:
    """Refuse what is no finite tensor of a batch with so many columns in double precision."""
    if problem := misshapen(value, (STATES, columns)):
        raise ValueError(
            f"{about} of {problem}: a row for each of {STATES} states, and a column, which is state[:, :1] and not "
            "state[:, 0], for each action or number of the memory (memory_size)."
        )


ON_FLIGHTS: dict[str, Check] = {
    "shapes and purity": methods,
    "costs": costs,
    "early ends": ends,
    "periods": periods,
    "stability of the step": stability,
    "gradients": gradients,
    "jacobians": jacobians,
}
