"""The methods of a plant, with arguments from its episodes."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from rt_torchrl.contract.draws import seeded
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import bounds
from rt_torchrl.trajectories.rollout import Rollout

Arguments = dict[str, Tensor]


class Method(NamedTuple):
    """A method as a function of named tensors: names of its arguments, and names and trailing shapes of its results."""

    name: str
    call: Callable[..., Any]
    takes: tuple[str, ...]
    gives: dict[str, tuple[int, ...]]

    def outputs(self, arguments: Arguments) -> tuple[Any, ...]:
        """The results of the method for named arguments; arguments that it does not take are ignored."""
        found = self.call(*(arguments[name] for name in self.takes))
        return tuple(found) if self.name == "step" and isinstance(found, tuple) else (found,)


class Calls:
    """Times, states, commands, actions and inputs of episodes, with the time first as in the gradient engines.

    Args:
        plant: the plant.
        arguments: tensors by name: ``t`` of shape ``n 1``; ``state``, ``command``, ``applied``, ``exogenous`` and
            ``measured`` (states of another episode) of shape ``n batch`` and their number of signals.
        seed: seed of the twin's closure.
    """

    def __init__(self, plant: Plant, arguments: Arguments, seed: int):
        self.plant, self.arguments, self.seed = plant, arguments, seed
        self.closure: nn.Module = plant.make_closure(seeded(seed))

    @classmethod
    def at_the_start(cls, plant: Plant, episodes: int, seed: int) -> "Calls":
        """Arguments in the first interval of two groups of episodes; they need only the draws of the plant."""
        generator = seeded(seed)
        state = plant.draw_initial_state(2 * episodes, generator)
        exogenous = plant.draw_exogenous(2 * episodes, generator)[:, 0]
        command = random_commands(plant, (2 * episodes,), generator)
        state, command, exogenous = (x.reshape(2, episodes, -1) for x in (state, command, exogenous))
        t = torch.zeros(2, 1, dtype=torch.float64)
        return cls(plant, _named(t, state, command, exogenous, applied=command), seed)

    @classmethod
    @torch.no_grad()
    def in_flight(cls, plant: Plant, episodes: int, steps: int, seed: int) -> "Calls":
        """Arguments in all intervals of flights of the true plant under random commands.

        Raises:
            DivergenceError: if a flight leaves the finite numbers.
        """
        generator = seeded(seed)
        state = plant.draw_initial_state(episodes, generator)
        exogenous = plant.draw_exogenous(episodes, generator)[:, :steps]
        command = random_commands(plant, (episodes, steps), generator)
        flown = Rollout(plant, plant.closure, engine="autograd")(state, exogenous, command)
        t = plant.dt * torch.arange(steps, dtype=torch.float64).unsqueeze(-1)
        rows = [x.transpose(0, 1).contiguous() for x in (flown.states[:, :-1], command, exogenous, flown.actions)]
        return cls(plant, _named(t, *rows), seed)

    def methods(self) -> list[Method]:
        """Every method; a method that takes a closure comes with the true closure and with that of the twin."""
        plant = self.plant
        n_s, n_a, n_o = len(plant.states), len(plant.actions), len(plant.observations)
        now = ("t", "state", "applied", "exogenous")
        found = [
            Method("observe", plant.observe, ("t", "state", "exogenous"), {"observation": (n_o,)}),
            Method("running_cost", plant.running_cost, now, {"cost": ()}),
            Method("terminal_cost", plant.terminal_cost, ("state",), {"cost": ()}),
            Method("discrepancy", plant.discrepancy, ("state", "measured"), {"cost": ()}),
            Method("actuate", plant.actuate, ("state", "command"), {"action": (n_a,)}),
            Method("latch", plant.latch, ("state", "applied"), {"state": (n_s,)}),
        ]
        for closure in (plant.closure, self.closure):
            found.append(self.field_under(closure, "vector_field"))
            found.append(
                Method("step", _under(plant.step, closure), _commanded(now), {"state": (n_s,), "applied": (n_a,)})
            )
        return found

    def field_under(self, closure: nn.Module, name: str) -> Method:
        """The vector field under a closure, by the name that messages blame."""
        takes = ("t", "state", "applied", "exogenous")
        return Method(name, _under(self.plant.vector_field, closure), takes, {"rate": (len(self.plant.states),)})

    def commanded_by(self, policy: nn.Module) -> Method:
        """The command of a policy, by the name of what makes it; it never meets an observation without a batch."""
        plant = self.plant

        def command(t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
            seen = plant.observe(t, state, exogenous)
            found: Tensor = policy(seen) if seen.ndim > 1 else policy(seen.unsqueeze(0)).squeeze(0)
            return found

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


def _named(t: Tensor, state: Tensor, command: Tensor, exogenous: Tensor, applied: Tensor) -> Arguments:
    names = ("t", "state", "command", "exogenous", "applied", "measured")
    return dict(zip(names, (t, state, command, exogenous, applied, state.roll(1, 1)), strict=True))


def _commanded(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple("command" if name == "applied" else name for name in names)


def _under(method: Callable[..., Any], closure: nn.Module) -> Callable[..., Any]:
    return lambda *arguments: method(*arguments, closure)
