"""Who computes: the gradient engines of the library by their names, JAX and CasADi by two methods each."""

import functools
import importlib.util
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
import torch

from benchmarking.case import System
from rt_torchrl import Engine, Rollout, Scenario
from rt_torchrl.trajectories.rollout import refusal

Quantity = Literal["forward", "gradient"]
QUANTITIES: tuple[Quantity, ...] = ("forward", "gradient")
Jax = Literal["jax_scan", "jax_sweep"]
JAX_METHODS: dict[Jax, Literal["scan", "sweep"]] = {"jax_scan": "scan", "jax_sweep": "sweep"}
Casadi = Literal["casadi_scalar", "casadi_lanes"]
CASADI_METHODS: dict[Casadi, Literal["scalar", "lanes"]] = {"casadi_scalar": "scalar", "casadi_lanes": "lanes"}


def quantities_of(name: str) -> tuple[Quantity, ...]:
    """The quantities in which a contender differs from the others: the sweep goes forward by the same scan."""
    return ("gradient",) if name == "jax_sweep" else QUANTITIES


class Calls(NamedTuple):
    """What a contender computes of one scenario: the mean cost, and its gradient by the policy's weights."""

    forward: Callable[[], float]
    gradient: Callable[[], np.ndarray]


class Contender(Protocol):
    """Computes cost and gradient of a system's trajectories."""

    def calls(self, scenario: Scenario) -> Calls:
        """The functions to be timed, always of the same trajectories."""
        ...


@dataclass(frozen=True)
class Contenders:
    """The contenders that a benchmark asks for.

    Args:
        engines: gradient engines of the library.
        jax: methods in JAX.
        casadi: methods in C code of CasADi.
        compiled: compile the engines.
        eager: engines that are not compiled all the same.
    """

    engines: Sequence[Engine]
    jax: Sequence[Jax]
    casadi: Sequence[Casadi]
    compiled: bool
    eager: Sequence[Engine]

    @property
    def names(self) -> list[str]:
        return [*self.engines, *self.jax, *self.casadi]

    def refusal(self, name: str, system: System) -> str | None:
        """The reason why a contender cannot compute a system; None if it can."""
        if name in JAX_METHODS:
            installed = importlib.util.find_spec("jax") is not None
            return None if installed else "jax is not installed; install the extra bench."
        if name in CASADI_METHODS:
            return _refusal_of_casadi(system)
        return refusal(name, system.plant)

    def made(self, name: str, system: System) -> Contender:
        """The contender of a name for a system."""
        if name in JAX_METHODS:
            return _Jax(system, JAX_METHODS[name])
        if name in CASADI_METHODS:
            return _Casadi(system, CASADI_METHODS[name])
        return _Torch(system, name, compiled=self.compiled and name not in self.eager)


class _Torch:
    """A rollout by an engine with the cost of its trajectories, as a user computes them."""

    def __init__(self, system: System, engine: Engine, *, compiled: bool):
        self.system = system
        self.rollout = Rollout(system.plant, system.closure, system.policy, engine=engine, compiled=compiled)

    def calls(self, scenario: Scenario) -> Calls:
        weights = self.system.weights()

        def cost() -> torch.Tensor:
            return self.rollout.costs(*scenario).mean()

        @torch.no_grad()
        def forward() -> float:
            return cost().item()

        def gradient() -> np.ndarray:
            return torch.cat([part.flatten() for part in torch.autograd.grad(cost(), weights)]).numpy()

        return Calls(forward, gradient)


class _Jax:
    """The same equations by hand in JAX."""

    def __init__(self, system: System, method: Literal["scan", "sweep"]):
        from benchmarking.jax_loops import JaxLoops  # here, because jax is an extra

        self.system, self.loops = system, JaxLoops(system, method)

    def calls(self, scenario: Scenario) -> Calls:
        inputs = self.loops.inputs(scenario)
        names = [name for name, _ in self.system.policy.named_parameters()]

        def forward() -> float:
            return float(self.loops.forward(inputs)[0])

        def gradient() -> np.ndarray:
            found = self.loops.gradient(inputs)[1]
            return np.concatenate([np.asarray(found[name]).ravel() for name in names])

        return Calls(forward, gradient)


class _Casadi:
    """The same equations by hand in CasADi, as C code."""

    def __init__(self, system: System, method: Literal["scalar", "lanes"]):
        from benchmarking.casadi_code import CasadiCode  # here, because casadi is an extra

        self.code = CasadiCode(system, method)

    def calls(self, scenario: Scenario) -> Calls:
        inputs = self.code.inputs(scenario)
        return Calls(lambda: self.code.forward(inputs)[0], lambda: self.code.gradient(inputs)[1])


def _refusal_of_casadi(system: System) -> str | None:
    """The reason why CasADi cannot compute a system; None if it can."""
    if importlib.util.find_spec("casadi") is None:
        return "casadi is not installed; install the extra bench."
    if shutil.which("g++") is None:
        return "there is no g++ to compile CasADi's code."
    if (system.case.plant, system.case.closure) != ("flapping_wing", "law"):
        return "only the drone with its law is written in CasADi."
    return None


def made_once(contenders: Contenders) -> Callable[[str, System], Contender]:
    """``contenders.made`` that makes each contender of a system once, so that all sizes share what is compiled."""

    @functools.cache
    def made(name: str, system: System) -> Contender:
        return contenders.made(name, system)

    return made
