r"""Trajectories :math:`s_{k+1} = \Phi(s_k, x_k; w)` and their gradients, by four engines behind one call.

====================  ==================================================  ======================================
engine                gradient                                            for
====================  ==================================================  ======================================
``native``            exact discrete adjoint, machine code over lanes     training on CPUs
``parallel``          exact discrete adjoint, parallel over time          training on GPUs
``odeint_adjoint``    continuous adjoint by torchdiffeq, error O(dt)      reference, the paper's method
``autograd``          backpropagation through every step, exact           what native cannot trace, double-checking
====================  ==================================================  ======================================
"""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Actions, Costs, Inputs, Start, Starts
from rt_torchrl.trajectories.engines.code import require_pure_once
from rt_torchrl.trajectories.engines.interval import (
    Autograd,
    CostInterval,
    Drive,
    GradientEngine,
    Interval,
    OdeintAdjoint,
)
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.engines.parallel import Parallel
from rt_torchrl.trajectories.trajectory import Trajectory, control_cost

Engine = Literal["native", "parallel", "odeint_adjoint", "autograd"]
ENGINES: dict[Engine, type[GradientEngine]] = {
    "native": Native,
    "parallel": Parallel,
    "odeint_adjoint": OdeintAdjoint,
    "autograd": Autograd,
}


class DivergenceError(FloatingPointError):
    """A trajectory left the finite numbers."""


class Rollout:
    """Rolls a plant out under a closure, with commands that are given or with a policy in the loop.

    Args:
        plant: the physics.
        closure: the plant's own closure for the real system, a learned one for its twin.
        policy: policy that computes the command of each interval; None if each call passes the commands.
        engine: name of the engine that computes gradients with respect to weights, initial state and drive.

    Raises:
        ValueError: if the engine does not exist, cannot follow the plant's own scheme, or a module is not in double
            precision.
    """

    def __init__(
        self,
        plant: Plant,
        closure: nn.Module,
        policy: nn.Module | None = None,
        *,
        engine: Engine = "native",
    ):
        refused = refusal(engine, plant)
        if refused:
            raise ValueError(refused)
        for role, module in (("closure", closure), ("policy", policy)):
            require_double(role, module)
        self.plant = plant
        self.interval = Interval(plant, closure, policy)
        self._costed = CostInterval(self.interval)
        self.engine = engine
        self._engine = ENGINES[engine]()

    def __call__(
        self, initial_state: Starts, exogenous: Inputs, command: Actions | None = None, *, start: Start = 0.0
    ) -> Trajectory:
        """The trajectory of ``n`` intervals.

        Args:
            initial_state: initial state s_0 of each realisation.
            exogenous: exogenous inputs z, held over each interval.
            command: commands to the actuators; None if there is a policy.
            start: time of s_0 [s], one for all realisations, or one for each.

        Raises:
            ValueError: if shapes do not fit the plant and each other, or commands are given beside a policy.
            DivergenceError: if a state is not finite; the message names plant, realisation, time and state.
            ImpureError: if policy, closure or plant answer one question in two ways, or mix realisations.
        """
        return self._flown(initial_state, exogenous, self._drive(initial_state, exogenous, command, start), start)

    def _flown(self, initial_state: Starts, exogenous: Inputs, drive: Drive, start: Start) -> Trajectory:
        self._require_pure(self.interval, initial_state, drive)
        ends = self._engine.end_states(self.interval, initial_state, drive)
        require_finite(self.plant, ends, initial_state, [self.interval.closure, self.interval.policy], start=start)
        states = torch.cat([initial_state.unsqueeze(0), ends])
        # The actions are a function of the states, so that every engine differentiates the actions the same way.
        applied = self.plant.actuate(states[:-1], self.interval.command(states[:-1], drive))
        return Trajectory(states.transpose(0, 1), applied.transpose(0, 1), exogenous, start)

    def costs(
        self,
        initial_state: Starts,
        exogenous: Inputs,
        command: Actions | None = None,
        *,
        start: Start = 0.0,
        deviation: Actions | None = None,
    ) -> Costs:
        """J_a of each trajectory of :meth:`__call__`, as :func:`control_cost` gives it; quicker, and in less memory.

        Args:
            initial_state, exogenous, command, start: as :meth:`__call__`.
            deviation: what is added to the commands of the policy, such as what an episode has explored.

        Raises:
            ValueError, DivergenceError, ImpureError: as :meth:`__call__`.
        """
        drive = self._drive(initial_state, exogenous, command, start, deviation)
        # What is replayed runs on after an end, so that only its trajectory says when it ended.
        summed = self.plant.end_cost is None or self.interval.policy is not None
        self._require_pure(self._costed, functional.pad(initial_state, (0, 1)), drive)
        costs = self._engine.costs(self._costed, initial_state, drive) if summed else None
        if costs is not None and all_finite(costs):
            charged = getattr(self.plant.terminal_cost, "__func__", None) is not Plant.terminal_cost
            if charged:  # the sum holds the change from the first state's
                costs = costs + self.plant.terminal_cost(initial_state) / (exogenous.shape[1] * self.plant.dt)
            return costs
        return control_cost(self.plant, self._flown(initial_state, exogenous, drive, start))

    def _require_pure(self, interval: nn.Module, initial_state: Tensor, drive: Drive) -> None:
        if self.engine != "native" or initial_state.device.type != "cpu":  # which asks when it traces
            require_pure_once(interval, initial_state, drive)

    def _drive(
        self,
        initial_state: Tensor,
        exogenous: Tensor,
        command: Tensor | None,
        start: float | Tensor,
        deviation: Tensor | None = None,
    ) -> Drive:
        """The drive, after a check of everything."""
        plant, batch, n = self.plant, initial_state.shape[0], exogenous.shape[1] if exogenous.ndim == 3 else -1
        if (command is None) == (self.interval.policy is None) or (command is not None and deviation is not None):
            raise ValueError(
                f"plant {plant.name!r} is rolled out with commands, or with a policy and deviations from its commands: "
                "without a policy pass command and no deviation, with one pass no command."
            )
        given = {
            "initial_state": (initial_state, (batch, len(plant.states))),
            "exogenous": (exogenous, (batch, n, len(plant.inputs))),
            "command": (command, (batch, n, len(plant.actions))),
            "deviation": (deviation, (batch, n, len(plant.actions))),
        }
        for argument, (value, shape) in given.items():
            if value is not None and (tuple(value.shape) != shape or value.dtype != torch.float64):
                raise ValueError(
                    f"{argument} has shape {tuple(value.shape)} and dtype {value.dtype}; plant {plant.name!r} "
                    f"needs shape {shape} (batch, steps, signals) in torch.float64."
                )
            if value is not None and not all_finite(value):
                raise ValueError(f"{argument} holds NaN or infinite values; clean the record before it is used.")
        return drive_of(plant, exogenous, command if deviation is None else deviation, start=start)


def refusal(engine: Engine, plant: Plant) -> str | None:
    """The reason why an engine cannot roll a plant out, for a message; None if it can."""
    if engine not in ENGINES:
        return f"engine={engine!r} does not exist; choose one of {', '.join(get_args(Engine))}."
    if not ENGINES[engine].exact and (plant.own_scheme or plant.end_cost is not None):
        does = "steps by a scheme of its own" if plant.own_scheme else "has episodes that end early"
        exact = ", ".join(name for name, kind in ENGINES.items() if kind.exact)
        return f"engine={engine!r} integrates the vector field, but plant {plant.name!r} {does}; use one of {exact}."
    return None


def able(engine: Engine, plant: Plant) -> Engine:
    """The engine, or ``autograd`` for a plant that it cannot roll out, such as one with a scheme of its own."""
    return "autograd" if engine in ENGINES and refusal(engine, plant) else engine


def all_finite(x: Tensor) -> bool:
    """Whether all numbers are finite.

    On CPUs NumPy tells it: after a large operation the threads of torch wait actively for some milliseconds, and take
    the cores from those of the engine ``native``.
    """
    numbers = x.detach()
    return bool(np.isfinite(numbers.numpy()).all() if numbers.device.type == "cpu" else numbers.isfinite().all())


def require_finite(
    plant: Plant,
    ends: Float[Tensor, "n batch n_s"],
    initial_state: Starts,
    modules: Sequence[nn.Module | None],
    *,
    start: Start = 0.0,
    remedy: str = "Use a smaller dt, or weights nearer to ones that are known to work.",
) -> None:
    """Refuse a trajectory that has left the finite numbers.

    Args:
        plant: the physics.
        ends: states at the end of every interval.
        initial_state: initial states s_0.
        modules: closure and policy of the trajectory, for the message.
        start: time of s_0 [s], one for all realisations or one for each.
        remedy: advice to the user, for the message.

    Raises:
        DivergenceError: if a state is not finite; the message names plant, realisation, time and the last finite state.
    """
    if all_finite(ends):
        return
    k, realisation, component = (~ends.isfinite()).nonzero()[0].tolist()
    began = float(start[realisation]) if isinstance(start, Tensor) else start
    last = (ends[k - 1] if k else initial_state)[realisation].tolist()
    weights = [type(module).__name__ for module in modules if module is not None]
    raise DivergenceError(
        f"plant {plant.name!r} diverged in realisation {realisation} at t = {began + (k + 1) * plant.dt:g} s: "
        f"{plant.states[component].name} is not finite; the state before was {last}, the weights those of "
        f"{' and '.join(weights)}. {remedy}"
    )


def drive_of(plant: Plant, exogenous: Tensor, command: Tensor | None, *, start: Start = 0.0) -> Drive:
    """The drive, time first, of inputs and commands with the batch first; :class:`Rollout` explains ``start``.

    Raises:
        ValueError: if there is no interval, or inputs or commands are not in double precision.
    """
    batch, n = exogenous.shape[:2]
    t = start + plant.dt * torch.arange(n, dtype=torch.float64, device=exogenous.device).unsqueeze(-1)
    commands = exogenous.new_empty(n, batch, 0) if command is None else command.transpose(0, 1)
    if n < 1 or {exogenous.dtype, commands.dtype} != {torch.float64}:  # machine code would read beside them
        raise ValueError(
            f"exogenous of {n} intervals of plant {plant.name!r} is in {exogenous.dtype}, commands in "
            f"{commands.dtype}; a trajectory needs at least one interval, and both in torch.float64."
        )
    return Drive(t, exogenous.transpose(0, 1), commands)


def require_double(role: str, module: nn.Module | None) -> None:
    """Refuse modules that would mix single with double precision.

    Raises:
        ValueError: if a parameter is not float64; the message names the first one.
    """
    for name, weight in module.named_parameters() if module is not None else ():
        if weight.dtype != torch.float64:
            raise ValueError(
                f"{role} {type(module).__name__} has {name} in {weight.dtype}; trajectories are integrated in "
                f"torch.float64. Call {role}.double()."
            )
