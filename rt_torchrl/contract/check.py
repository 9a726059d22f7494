"""One call that finds what is wrong with a plant, before a training finds it."""

import inspect
from collections.abc import Callable, Iterable, Iterator

from rt_torchrl.contract.calls import Calls
from rt_torchrl.contract.costs import costs
from rt_torchrl.contract.draws import draws, modules
from rt_torchrl.contract.gradients import gradients
from rt_torchrl.contract.methods import methods
from rt_torchrl.contract.periods import periods
from rt_torchrl.contract.signals import signals
from rt_torchrl.contract.stability import stability
from rt_torchrl.contract.tracing import forward_mode, tracing
from rt_torchrl.plants.plant import Plant


class PlantContractError(ValueError):
    """A plant does not fulfil its contract; ``violations`` holds a message for each way in which it does not."""

    def __init__(self, plant: str, violations: list[str]):
        self.violations = violations
        lines = "\n".join(f"  {k}. {text}" for k, text in enumerate(violations, 1))
        super().__init__(f"plant {plant!r} breaks its contract in {len(violations)} ways:\n{lines}")


def check_plant(plant: Plant, *, episodes: int = 4, steps: int = 50, seed: int = 0, traced: bool = True) -> None:
    """Find what of the :class:`Plant` contract a plant does not fulfil: everything at once, not the first alone.

    Looked at, on states that ``episodes`` short flights under random commands visit: signals and their ranges; shapes,
    precision and finiteness of every method under any leading dimensions; purity; draws and their generator; closures
    and policy; that the step applies what the actuators say; costs; that a turn of a periodic state changes nothing;
    gradients against finite differences; forward mode and one graph, as the engines and the compiler need them; and
    the stability of the Runge-Kutta step. A check whose ground another one took away is left out.

    Args:
        plant: at the time step that it will be trained with.
        episodes: number of flights, at least 2.
        steps: control intervals of each, at least 2; at most an episode's.
        seed: of the draws and of the random commands.
        traced: also trace the methods into one graph. It takes seconds, and methods that are checked at run time by
            jaxtyping cannot be traced.

    Raises:
        PlantContractError: with a message for each violation: the method, what was found, what is expected, and what
            to change.
        ValueError: if ``episodes`` or ``steps`` is below 2.
    """
    for argument, value in (("episodes", episodes), ("steps", steps)):
        if value < 2:
            raise ValueError(f"{argument}={value} of the check must be at least 2.")
    found = list(signals(plant)) or list(attempt(draws, plant, seed)) + list(attempt(modules, plant, seed))
    if not found:
        found = _on_flights(plant, episodes, min(steps, plant.n_steps), seed, traced)
    if found:
        raise PlantContractError(getattr(plant, "name", type(plant).__name__), found)


def _on_flights(plant: Plant, episodes: int, steps: int, seed: int, traced: bool) -> list[str]:
    """The checks that need states; each only where those before it have left something to check."""
    calls = Calls.at_the_start(plant, episodes, seed)
    found = [*attempt(methods, calls), *attempt(stability, calls)]
    if found:
        return found
    try:
        calls = Calls.in_flight(plant, episodes, steps, seed)
    except FloatingPointError as error:
        return [f"step: {error}"]
    checks = [methods, costs, periods, stability, gradients, forward_mode, *([tracing] if traced else [])]
    return [text for check in checks for text in attempt(check, calls)]


def attempt(check: Callable[..., Iterable[str]], *arguments) -> Iterator[str]:
    """The violations that a check finds; what the plant itself raises is one more."""
    try:
        yield from check(*arguments)
    except Exception as error:
        raised = inspect.trace()[-1]
        yield (
            f"{raised.function}: raised {type(error).__name__} in {raised.filename}, line {raised.lineno}: "
            f"{str(error).splitlines()[0] if str(error) else ''}. It must work for every leading dimension, under "
            "forward and reverse differentiation."
        )
