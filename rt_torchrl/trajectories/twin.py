r"""The digital twin: a plant's step under a learned closure, and how its states depend on the closure's weights.

.. math::
    S_0 = 0, \qquad S_{k+1} = A_kS_k + B_k, \quad
    A_k = \frac{\partial\Phi}{\partial s}(s_k, x_k), \quad B_k = \frac{\partial\Phi}{\partial w}(s_k, x_k)

Here :math:`S_k = ds_k/dw_p` are the sensitivities, whose recurrence the engine ``native`` runs as a part of the
trajectory's. They give the gradient, the Gauss-Newton matrix and the Fisher information of an identification. Their
cost grows with the number of weights, unlike that of an adjoint: they are for up to some hundred weights.
"""

import contextlib
import copy
import math
from collections.abc import Callable
from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from rt_torchrl.plants.plant import Plant, replaying, require_end_cost
from rt_torchrl.plants.sensors import NoisySensors
from rt_torchrl.plants.shapes import Actions, Costs, Inputs, Start, Starts
from rt_torchrl.programs.contract import Holdings
from rt_torchrl.trajectories.engines.interval import Drive, Interval, batched, with_weights
from rt_torchrl.trajectories.engines.native import Native
from rt_torchrl.trajectories.engines.parallel import over_all
from rt_torchrl.trajectories.rollout import (
    DivergenceError,
    Engine,
    Rollout,
    able,
    drive_of,
    require_double,
    require_finite,
)
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Trajectory, control_cost

NOISE_SEED = 4_000_000
"""Seed of the noise of sensors in virtual episodes."""
KEPT = 4
"""Number of policies whose rollouts a twin keeps, such as those that are judged in turn."""


class DigitalTwin:
    """Flies virtual episodes of a plant whose true closure it does not know.

    The attribute ``sensitivities`` gives replayed states with their derivatives by the closure's weights. Costs of
    policies are those of flights whose sensors have the :attr:`noise`, as the costs of the real system are.

    Args:
        plant: the physics, which a simulated real system shares; the plant's own closure is never used here.
        closure: the learned closure g(·; w_p).
        engine: gradient engine, see :mod:`rt_torchrl.trajectories.rollout`.

    Raises:
        ValueError: if episodes of the plant end early at no cost.
    """

    def __init__(self, plant: Plant, closure: nn.Module, *, engine: Engine = "native"):
        require_end_cost(plant)
        self.plant, self.closure = plant, closure
        self._engine = engine
        self.replay = Rollout(replaying(plant), closure, engine=engine)
        """Virtual episodes, or parts of them, under recorded actions as they are; see :meth:`Rollout.__call__`."""
        self.sensitivities = Sensitivities(replaying(plant), closure)
        self._planned: list[_Planned] = []
        self._read: ReadInterval | None = None
        self._correction: Callable[[nn.Module], Tensor] | None = None
        self.noise: Float[Tensor, " n_r"] = torch.zeros(len(plant.readings), dtype=torch.float64)
        """Standard deviation of the noise of each sensor; assign what is known."""
        self._noisy: DigitalTwin | None = None
        self._drawn = torch.zeros(0)

    def of(self, plant: Plant) -> "DigitalTwin":
        """A twin of another plant under the same closure, by the same engine if it can roll the plant out."""
        return DigitalTwin(plant, self.closure, engine=able(self._engine, plant))

    @torch.no_grad()
    def replayed(self, record: Trajectory, segment: int = 0) -> Float[Tensor, "samples n_s"]:
        """States of the believed twin with the actions and inputs of a record, as sensors read them.

        They are not numbers in a segment in which the twin diverges.

        Args:
            record: the record.
            segment: number of control intervals after which the replay begins anew in what sensors have read, because
                an unstable twin leaves longer records; 0 for the whole record.
        """
        believed, n = self.believed, len(record.actions)
        starts = believed.completed(record).states
        states = torch.full_like(record.states, math.nan)
        states[0] = record.states[0]
        for first in range(0, n, segment or n):
            part = record.part(first, min(first + (segment or n), n), self.plant.dt)
            with contextlib.suppress(DivergenceError):
                begins = starts[first : first + 1]
                flown = believed.replay(begins, part.exogenous[None], part.actions[None], start=part.start)
                states[first + 1 : first + len(part.states)] = flown.states[0, 1:, : states.shape[-1]]
        return states

    def completed(self, record: Trajectory) -> Trajectory:
        """The record with the states that no sensor reads, as :meth:`followed` finds them, or at rest if they diverge.

        Segments of the record then begin with those that the twin has by then.
        """
        states, read = self.plant.at_rest(record.states), record.states.shape[-1]
        with contextlib.suppress(DivergenceError):
            if self.plant.unread:
                states = torch.cat([record.states, self.followed(record)[:, read:]], -1)
        return record._replace(states=states)

    @torch.no_grad()
    def followed(self, record: Trajectory) -> Float[Tensor, "samples n_s"]:
        """The state at the start of a record, and at the end of each interval that begins with what sensors have read.

        The states that no sensor reads are at rest at the start and go on from interval to interval; errors of the twin
        do not build up in them.

        Raises:
            DivergenceError: if they diverge all the same.
        """
        return self.followed_from(record, record.states.new_zeros(1, record.states.shape[-1]))[:, 0]

    @torch.no_grad()
    def followed_from(self, record: Trajectory, shifts: Float[Tensor, "rows n_r"]) -> Float[Tensor, "samples rows n_s"]:
        """The same for readings that are shifted, in several rows.

        Args:
            record: the record.
            shifts: what is added to all readings in each row.

        Raises:
            DivergenceError: as :meth:`followed`.
        """
        rows, readings = len(shifts), record.states + shifts.unsqueeze(1)
        start = self.plant.at_rest(readings[:, 0])
        commands = torch.cat([record.actions.expand(rows, -1, -1), readings[:, :-1]], -1)
        drive = drive_of(self.plant, record.exogenous.expand(rows, -1, -1), commands, start=record.start)
        # Kept, because the engine compares what is new to it with all that it knows, which takes milliseconds.
        if self._read is None or self._read.closure is not self.closure:
            self._read = ReadInterval(replaying(self.plant), self.closure, None)
        ends = Native().end_states(self._read, start, drive)
        require_finite(self.plant, ends, start, [self.closure], start=record.start)
        return torch.cat([start.unsqueeze(0), ends])

    def control(self, policy: nn.Module, initial_state: Starts, exogenous: Inputs) -> Trajectory:
        """Virtual episodes under a policy; see :meth:`Rollout.__call__`.

        The trajectory is differentiable by the policy's weights and the initial state; the closure is held constant.
        That of state feedback is not differentiable.
        """
        if isinstance(policy, StateFeedback):
            return policy.fly(initial_state, exogenous, self.closure, plant=self.plant)
        return self._planning(policy)(initial_state, exogenous)

    def cost(
        self, policy: nn.Module, initial_state: Starts, exogenous: Inputs, deviation: Actions | None = None
    ) -> Float[Tensor, ""]:
        """Mean J_a of virtual episodes under a policy."""
        return self.episode_costs(policy, initial_state, exogenous, deviation).mean()

    def episode_costs(
        self, policy: nn.Module, initial_state: Starts, exogenous: Inputs, deviation: Actions | None = None
    ) -> Costs:
        """J_a of each virtual episode under a policy, differentiable by its weights unless it is state feedback.

        Args:
            policy: the policy.
            initial_state: initial state of each episode.
            exogenous: exogenous inputs.
            deviation: what is added to the commands of a policy that is no state feedback; None for nothing.
        """
        if self.noise.any():
            batch, n, _ = exogenous.shape
            if self._drawn.shape[:2] != (batch, n):  # the same for every policy
                generator = torch.Generator().manual_seed(NOISE_SEED)
                self._drawn = torch.randn(batch, n, len(self.noise), generator=generator).to(exogenous)
            inputs = torch.cat([exogenous, self.noise * self._drawn], -1)
            return self.noisy.episode_costs(policy, initial_state, inputs, deviation)
        if isinstance(policy, StateFeedback):
            return control_cost(self.plant, self.control(policy, initial_state, exogenous))
        return self._planning(policy).costs(initial_state, exogenous, deviation=deviation)

    def correct(self, correction: Callable[[nn.Module], Tensor] | None) -> None:
        """Take what real episodes say of costs: a function of a policy that gives the log of their ratio to its own.

        Args:
            correction: the function; None for costs as the twin says them.
        """
        self._correction = correction

    def expected_costs(self, policy: nn.Module, initial_state: Starts, exogenous: Inputs) -> Costs:
        """What is expected on the real system of :meth:`episode_costs`, differentiable as these are."""
        costs = self.episode_costs(policy, initial_state, exogenous)
        return costs if self._correction is None else costs * self._correction(policy).exp()

    @property
    def noisy(self) -> "DigitalTwin":
        """The twin whose inputs hold noise of the sensors, which keeps its code: :class:`NoisySensors`."""
        if self._noisy is None or self._noisy.closure is not self.closure:
            self._noisy = self.of(NoisySensors(self.plant))
        return self._noisy

    def retreat(self) -> None:
        """React to a flight that diverges, although the real system flew it; a twin that is alone cannot."""

    def state_dict(self) -> dict[str, Any]:
        """Weights of the trained parts, by name: those of the closure."""
        return {"closure": self.closure.state_dict()}

    @property
    def believed(self) -> "DigitalTwin":
        """The twin that is most likely to be right; a twin that is alone is."""
        return self

    @property
    def hypothesis(self) -> str | None:
        """Name of the hypothesis that :attr:`believed` is of; None if that has nothing beside the plant."""
        return None

    @property
    def believed_law(self) -> nn.Module:
        """Closure of :attr:`plant` in :attr:`believed`, without the parameters that a hypothesis has beside it."""
        return self.closure

    def _planning(self, policy: nn.Module) -> Rollout:
        """The rollout of a policy under the closure held constant, kept as long as both are the same."""
        for planned in self._planned:
            same = planned.rollout.plant is self.plant and planned.closure is self.closure and planned.policy is policy
            if same and planned.holdings.unchanged(self.closure):  # but for the values of its weights
                require_double("policy", policy)
                return planned.rollout
        rollout = Rollout(self.plant, constant(self.closure), policy, engine=self._engine)
        new = _Planned(self.closure, policy, rollout, Holdings(self.closure))
        self._planned = [new, *self._planned[: KEPT - 1]]
        return rollout


class _Planned(NamedTuple):
    """A rollout with a constant copy of a closure, which shares its weights and buffers, and what the closure held."""

    closure: nn.Module
    policy: nn.Module
    rollout: Rollout
    holdings: Holdings


class ReadInterval(Interval):
    """One control interval that begins with the states that sensors read; the drive's command holds (a, s)."""

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """The state at the end of the interval."""
        action, readings = drive.command.split((len(self.plant.actions), len(self.plant.readings)), -1)
        start = torch.cat([readings, state[..., readings.shape[-1] :]], -1)
        return self.plant.step(drive.t, start, action, drive.exogenous, self.closure).state


def constant(module: nn.Module) -> nn.Module:
    """A copy of the module that shares its weights but asks for no gradient of them."""
    shared: dict[int, Tensor] = {id(w): nn.Parameter(w.detach(), requires_grad=False) for w in module.parameters()}
    shared |= {id(buffer): buffer for buffer in module.buffers()}
    return copy.deepcopy(module, shared)


# Sensitivities

WIDE = 64
"""Number of columns of S from which batched Jacobians by torch are quicker than one recurrence of states and S."""


class TangentInterval(nn.Module):
    """An interval whose state (s, S) also holds the sensitivities S, flattened, of weights and of initial states.

    Args:
        interval: the interval of the states s, with the closure whose trained weights come first among the columns.
        names: names of these weights in the closure. While the interval is traced, other tensors stand for them, which
            ask for no gradients.
    """

    straight = 400
    """Rows of Jacobians are long but mostly zero, which straight-line code leaves out and loops do not."""

    def __init__(self, interval: Interval, names: tuple[str, ...]):
        super().__init__()
        self.interval, self.names = interval, names

    def forward(self, state: Tensor, drive: Drive) -> Tensor:
        """States and sensitivities, (s, S), at the end of the interval."""
        n_s = len(self.interval.plant.states)
        s, S = state[..., :n_s], state[..., n_s:].unflatten(-1, (n_s, -1))
        jacobians = jacobians_of(self.interval, self.names, s, drive._replace(t=drive.t.expand(s.shape[:1])))
        return torch.cat([self.interval(s, drive), _propagated(jacobians, S).flatten(1)], -1)


def jacobians_of(interval: Interval, names: tuple[str, ...], starts: Tensor, drive: Drive) -> Tensor:
    """[∂Φ/∂s, ∂Φ/∂w] of every row, ``rows n_s n_s+n_w``, by a reverse-mode product for each state."""
    parameters = dict(interval.closure.named_parameters())
    weights = {f"closure.{name}": parameters[name] for name in names}

    def end(values: dict[str, Tensor], state: Tensor, *drive: Tensor) -> Tensor:
        return with_weights(interval, values, state, Drive(*drive))

    rows = batched(torch.func.jacrev(end, argnums=(1, 0)), in_dims=(None, 0, 0, 0, 0))
    by_state, by_weights = rows(weights, starts, *drive)
    # A weight may be one number, of no dimension.
    parts = (jacobian.reshape(*by_state.shape[:2], -1) for jacobian in by_weights.values())
    return torch.cat([by_state, *parts], -1)


def _propagated(jacobians: Tensor, S: Tensor) -> Tensor:
    """The sensitivities at the end of an interval; s_0 acts like weights that are used in the first one alone."""
    A, B = jacobians.tensor_split([jacobians.shape[-2]], -1)
    return A @ S + functional.pad(B, (0, S.shape[-1] - B.shape[-1]))


class Sensitivities:
    """Trajectories under given actions with their sensitivities.

    Args:
        plant: the physics.
        closure: closure with the trainable weights w_p, flattened in the order of ``parameters()``.
    """

    def __init__(self, plant: Plant, closure: nn.Module):
        self.interval = Interval(plant, closure, None)
        self._tangent = TangentInterval(self.interval, self._trained())
        self._engine = Native()

    @torch.no_grad()
    def __call__(
        self, initial_state: Starts, exogenous: Inputs, actions: Actions, *, start: Start = 0.0, initial: bool = False
    ) -> tuple[Float[Tensor, "batch n n_s"], Float[Tensor, "batch n n_s n_w"]]:
        """States s_1 ... s_n and their sensitivities S_1 ... S_n.

        Args:
            initial_state: initial state s_0 of each trajectory.
            exogenous: exogenous inputs z, held over each interval.
            actions: commands, held over each interval; actions as they were applied if the plant is :func:`replaying`.
            start: time of s_0 [s], one for all trajectories or one for each.
            initial: append the n_s columns of ds_k/ds_0.
        """
        drive = drive_of(self.interval.plant, exogenous, actions, start=start)
        batch, n_s = initial_state.shape
        if self._tangent.names != self._trained():  # a weight was frozen or freed since
            self._tangent = TangentInterval(self.interval, self._trained())
        count = sum(w.numel() for w in self.interval.closure.parameters() if w.requires_grad)
        S = initial_state.new_zeros(batch, n_s, count)
        if initial:
            S = torch.cat([S, torch.eye(n_s, dtype=S.dtype, device=S.device).expand(batch, -1, -1)], -1)
        state, joint_ends = torch.cat([initial_state, S.flatten(1)], -1), None
        if S.shape[-1] <= WIDE:
            joint_ends = self._engine.native_end_states(self._tangent, state, drive)
        if joint_ends is not None:
            ends, S_ends = joint_ends.split([n_s, n_s * S.shape[-1]], -1)
            S_ends = S_ends.unflatten(-1, S.shape[1:])
        else:
            ends = self._engine.end_states(self.interval, initial_state, drive)
            starts = torch.cat([initial_state.unsqueeze(0), ends[:-1]])
            jacobians = over_all(partial(jacobians_of, self.interval, self._trained()), starts, drive)
            S_ends = torch.stack([*accumulate(jacobians, lambda S, now: _propagated(now, S), initial=S)][1:])
        return ends.transpose(0, 1), S_ends.transpose(0, 1)

    def _trained(self) -> tuple[str, ...]:
        """Names of the closure's trained weights."""
        return tuple(name for name, w in self.interval.closure.named_parameters() if w.requires_grad)
