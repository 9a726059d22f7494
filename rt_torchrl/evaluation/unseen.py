"""Evaluation of twin and policies on episodes that no training has drawn: on the plant, the twin or a real system."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Costs
from rt_torchrl.systems.exploration import ExplorationConfig, LivePolicy
from rt_torchrl.trajectories.rollout import DivergenceError, Rollout
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import (
    Trajectory,
    batch_of,
    continued,
    control_cost,
    identification_cost,
    until_end,
)
from rt_torchrl.trajectories.twin import DigitalTwin

if TYPE_CHECKING:  # who draws unseen episodes of a plant needs no TorchRL
    from rt_torchrl.plants.signal import StateBounds
    from rt_torchrl.systems.real_system import RealSystem

UNSEEN_SEED = 1_000_000
"""Seed of the unseen episodes: the same for every training, so that trainings compare on common random numbers."""
VALIDATION_SEED = 2_000_000
"""Seed of the validation episodes, on which a policy is chosen; its cost is then reported on the unseen episodes."""


class RealController(nn.Module, ABC):
    """A controller that can only be flown on the real system.

    Args:
        plant: physics and control problem of the twin.
    """

    def __init__(self, plant: Plant):
        super().__init__()
        self.plant = plant

    @abstractmethod
    def fly_real(self, count: int, *, seed: int) -> Trajectory:
        """As many episodes of the sequence that belongs to a seed."""


Baseline = ClassicalController | RealController
"""A controller that is judged beside the policies: on the plant, or on a real system of which no closure is known."""


class UnseenEpisodes:
    """Real episodes with initial states and disturbances that no training has drawn.

    The true closure is the plant's own; assign :attr:`closure` for another one. Controllers that are flown
    beside policies are made for :attr:`physics`, the plant itself; assign the plant that is known of a system with
    states that no sensor reads. :attr:`bounds` on states are counted among the plant's own quantities.

    Args:
        plant: the real system in simulation.
        count: number of episodes, at least 2.
        device: device on which the rollouts run.
        seed: seed of the draws of initial states and disturbances.
    """

    judged_on = "simulation"
    """Where the episodes are flown: simulation, simulation of the real system, twin, or real system."""

    def __init__(
        self,
        plant: Plant,
        count: int = 20,
        *,
        device: torch.device | str = "cpu",
        seed: int = UNSEEN_SEED,
    ):
        if count < 2:
            raise ValueError(f"count={count} of unseen episodes must be at least 2 for a confidence interval.")
        generator = torch.Generator(device=device).manual_seed(seed)
        self.plant = plant
        self.closure: nn.Module | None = plant.closure
        self.physics = plant
        self.bounds: StateBounds | None = None
        self.initial_state = plant.draw_initial_state(count, generator)
        self.exogenous = plant.draw_exogenous(count, generator)

    @property
    def flying(self) -> Plant:
        """The plant that the flights are of."""
        return self.plant

    @torch.no_grad()
    def fly(self, policy: nn.Module) -> Trajectory:
        """Fly the episodes with a policy or a classical controller."""
        if isinstance(policy, StateFeedback):
            return policy.fly(self.initial_state, self.exogenous, self.known_closure(), plant=self.plant)
        return self.rollout(policy)(self.initial_state, self.exogenous)

    def rollout(self, policy: nn.Module) -> Rollout:
        """The closed loop of a policy and the real system."""
        return Rollout(self.plant, self.known_closure(), policy)

    def known_closure(self) -> nn.Module:
        """The true closure.

        Raises:
            ValueError: if nobody knows it.
        """
        if self.closure is None:
            raise ValueError(
                f"the true closure of plant {self.plant.name!r} is not known (closure=None), so no episode can be "
                "flown in simulation; assign it, or fly on the real system."
            )
        return self.closure

    @torch.no_grad()
    def control_costs(self, policy: nn.Module) -> Costs:
        """J_a of each episode."""
        if self.closure is None or isinstance(policy, StateFeedback):
            return self.costs_of(self.fly(policy))
        return self.rollout(policy).costs(self.initial_state, self.exogenous)

    def costs_of(self, flown: Trajectory) -> Costs:
        """J_a of each of the flown episodes."""
        return control_cost(self.flying, flown)

    def validation(self, times: int = 1) -> "UnseenEpisodes | None":
        """Validation episodes: so many times as many, with other draws; None if nobody knows the closure.

        A policy that is chosen by its cost on some episodes costs less on these than on others.
        """
        if self.closure is None:
            return None
        count, device = times * self.initial_state.shape[0], self.initial_state.device
        episodes = UnseenEpisodes(self.plant, count, device=device, seed=VALIDATION_SEED)
        episodes.closure = self.closure
        return episodes

    def judge(self, flown: Trajectory) -> "Judged":
        """J_a and the plant's own quantities in flown episodes."""
        plant = self.flying
        merit = plant.merit(flown.states, flown.actions, flown.exogenous)
        return Judged(self.costs_of(flown), merit | (self.bounds.merit(flown.states) if self.bounds else {}))

    @torch.no_grad()
    def identification_costs(self, physics: Plant, closure: nn.Module, flown: Trajectory, segment: int = 0) -> Costs:
        """J_p of each episode, which a twin replays with the flown actions and the true disturbances.

        The twin begins with what sensors read, and is compared with it, to an early end where an episode has one. J_p
        is infinite where the twin diverges.

        Args:
            physics: physics of the twin, which need not be that of the real system.
            closure: closure of the twin.
            flown: the episodes as flown on the real system.
            segment: number of control intervals of the segments over which J_p is the mean, as in step 4; 0 for whole
                episodes.
        """
        twin, read = DigitalTwin(physics, closure), len(self.plant.readings)

        def costs(batch: Trajectory) -> Costs:
            try:
                replayed = twin.replay(batch.states[:, 0], batch.exogenous, batch.actions, start=batch.start)
            except DivergenceError:
                if len(batch.states) == 1:
                    return batch.states.new_full((1,), torch.inf)
                return torch.cat([costs(batch_of([alone])) for alone in batch.each()])
            return identification_cost(physics, replayed, batch.states)

        def means(flown: Trajectory) -> Costs:
            episodes, n = flown.actions.shape[:2]
            measured = flown._replace(states=flown.states[..., :read])
            flown = batch_of([twin.completed(episode) for episode in measured.each()])
            flown = flown.segments(min(segment, n), physics.dt) if segment else flown
            return costs(flown).unflatten(0, (episodes, -1)).mean(1)

        flights = self.to_their_end(flown)
        if all(len(flight.actions) == self.plant.n_steps for flight in flights):
            return means(flown)
        return torch.cat([means(batch_of([flight])) for flight in flights])

    def to_their_end(self, flown: Trajectory) -> list[Trajectory]:
        """The flown episodes one by one, each to its early end where it has one."""
        return [until_end(self.flying, flight) for flight in flown.each()]


class TwinEpisodes(UnseenEpisodes):
    """Episodes that are flown on the twin as it is now: the one that is most likely to be right.

    The real system does not move. Costs here are what the twin says, not what the real system would cost. Initial
    states and disturbances are the plant's draws. An episode in which the twin diverges costs NaN, and so do its mean
    and its confidence interval. Where the twin's sensors have noise, controllers get readings with it, and flights hold
    these readings, as those of the real system do.

    Args:
        twin: the twin.
        plant: physics and control problem of the real system.
        count: number of episodes, at least 2.
        device: device of the twin.
    """

    judged_on = "twin"

    def __init__(self, twin: DigitalTwin, plant: Plant, count: int = 20, *, device: torch.device | str = "cpu"):
        super().__init__(plant, count, device=device)
        self.closure, self._twin = None, twin

    @property
    def flying(self) -> Plant:
        """The plant of the believed twin, which has more states than the real system's where a hypothesis adds some."""
        return self._twin.believed.plant

    @torch.no_grad()
    def fly(self, policy: nn.Module) -> Trajectory:
        """The flights on the twin; one in which the twin diverges is NaN from its first interval."""
        twin, start = self._twin.believed, self.flying.at_rest(self.initial_state)
        levels = self._twin.noise
        if not levels.any():
            return self._controlled(twin, policy, start, self.exogenous)
        count, n, _ = self.exogenous.shape
        generator = torch.Generator(device=start.device).manual_seed(UNSEEN_SEED)
        noise = levels * torch.randn(count, n + 1, len(levels), generator=generator, dtype=torch.float64)
        flown = self._controlled(twin.noisy, policy, start, torch.cat([self.exogenous, noise[:, :-1]], -1))
        noise = torch.where(twin.plant.ended(flown.states).unsqueeze(-1), 0.0, noise)  # so that what has ended has
        readings = flown.states + functional.pad(noise, (0, flown.states.shape[-1] - noise.shape[-1]))
        return Trajectory(readings, flown.actions, self.exogenous)

    def _controlled(
        self, twin: DigitalTwin, policy: nn.Module, start: Tensor, inputs: Float[Tensor, "k n n_z"]
    ) -> Trajectory:
        """Episodes on a twin, of which those that diverge are NaN."""
        try:
            return twin.control(policy, start, inputs)
        except DivergenceError:
            if len(start) > 1:
                alone = zip(start.split(1), inputs.split(1), strict=True)
                return batch_of([self._controlled(twin, policy, *episode).each()[0] for episode in alone])
            states = start.new_full((1, inputs.shape[1] + 1, start.shape[-1]), torch.nan)
            states[:, 0] = start
            return Trajectory(states, states.new_full((1, inputs.shape[1], len(self.plant.actions)), torch.nan), inputs)

    def identification_costs(self, physics: Plant, closure: nn.Module, flown: Trajectory, segment: int = 0) -> Costs:
        """Not a number: the real system has not flown these episodes, so that no twin can be compared with it."""
        return torch.full((len(flown.states),), torch.nan, dtype=torch.float64, device=flown.states.device)


class RealEpisodes(UnseenEpisodes):
    """Episodes that are flown on the real system itself, without exploration, each time they are asked for.

    A system that takes a seed flies the same episodes for every policy, and its sequence of training episodes then
    goes on as if nothing had been flown in between. A system without a seed flies other episodes each time.

    Args:
        system: the real system.
        count: number of episodes, at least 2.
        physics: the plant that is known of it, with the states that sensors read; None for the system's own plant.
        device: device of the twin, which replays the episodes.
    """

    judged_on = "real system"

    def __init__(
        self,
        system: "RealSystem",
        count: int = 20,
        *,
        physics: Plant | None = None,
        device: torch.device | str = "cpu",
    ):
        super().__init__(system.plant, count, device=device)
        self.closure = None
        self.physics = system.plant if physics is None else physics
        self._system, self._count = system, count
        self._flights: list[tuple[Trajectory, Costs, list[int]]] = []
        """Flown episodes with the J_a and the number of control intervals of each."""
        self.paid: list[float] = []
        """J_a of each flight, also of those before a failure or an interrupt."""

    @property
    def flying(self) -> Plant:
        """The plant that is known of the system, of whose states the flights hold the readings."""
        return self.physics

    @torch.no_grad()
    def fly(self, policy: nn.Module) -> Trajectory:
        """Fly as many episodes on the real system, whose training episodes then go on as if it had not.

        An episode with a reading that a safety layer refuses is flown again: its cost would be that of another reading.

        Raises:
            ValueError: if in several episodes in a row the system fails, or has such readings.
        """
        from rt_torchrl.steps.interact import RealFlights
        from rt_torchrl.systems.collectors import collector_of

        if isinstance(policy, RealController):
            whole = policy.fly_real(self._count, seed=UNSEEN_SEED)
            lengths = [len(flight.actions) for flight in super().to_their_end(whole)]
            self._flights.append((whole, control_cost(self.physics, whole), lengths))
            self.paid += self._flights[-1][1].tolist()
            return whole
        generator = torch.Generator(device=self.initial_state.device)
        actor = LivePolicy(self.plant, policy, ExplorationConfig(), generator=generator)
        rollout = collector_of(self._system, actor, self.plant).rollout
        flights = RealFlights(self._system, actor, rollout, self.plant)
        state = self._system.state_dict()
        self._system.set_seed(UNSEEN_SEED)
        flown = list[Trajectory]()
        try:
            for _ in range(self._count):
                flight = flights.fly(policy, strength=0.0, whole=True)
                flown.append(flight.record)
                self.paid.append(flight.cost.item())
        finally:
            self._system.load_state_dict(state)
        whole = batch_of([self._to_the_horizon(record) for record in flown])
        costs = whole.states.new_tensor(self.paid[-self._count :])
        self._flights.append((whole, costs, [len(record.actions) for record in flown]))
        return whole

    def costs_of(self, flown: Trajectory) -> Costs:
        """J_a of each of the episodes that were flown here, as the system measured it."""
        return next(costs for known, costs, _ in self._flights if known is flown)

    def to_their_end(self, flown: Trajectory) -> list[Trajectory]:
        """The flown episodes one by one, each to the end that the system had, which noisy readings need not show."""
        lengths = next(lengths for known, _, lengths in self._flights if known is flown)
        return [flight.part(0, n, self.plant.dt) for flight, n in zip(flown.each(), lengths, strict=True)]

    def _to_the_horizon(self, record: Trajectory) -> Trajectory:
        """A record of an episode; one that ended early stays in the state in which it ended."""
        states, actions, exogenous, *_ = record
        rest = self.plant.n_steps - len(actions)
        states = torch.cat([states, states[-1:].expand(rest, -1)])
        actions = torch.cat([actions, actions[-1:].expand(rest, -1)])
        return Trajectory(states, actions, continued(exogenous, self.plant.n_steps))


class Judged(NamedTuple):
    """J_a and the plant's own quantities of each unseen episode under one controller."""

    control_costs: Costs
    merit: dict[str, Costs]

    def statistics(self) -> dict[str, Any]:
        """Number of ``episodes``; mean and interval of ``J_a`` and of each quantity in ``merit``, with its median."""
        merit = {
            name: mean_with_confidence(values) | {"median": values.quantile(0.5).item()}
            for name, values in self.merit.items()
        }
        count = len(self.control_costs)
        return {"episodes": count, "J_a": mean_with_confidence(self.control_costs), "merit": merit}


def mean_with_confidence(values: Float[Tensor, " n"], over: Float[Tensor, " n"] | None = None) -> dict[str, Any]:
    """Mean and percentile-bootstrap 95 % confidence interval (2000 resamples), as ``metrics.json`` holds them.

    Of values that are not all finite, the mean and both ends of the interval are not finite either.

    Args:
        values: the values.
        over: values of the same episodes, by whose mean the mean is divided.
    """
    from scipy.stats import bootstrap  # here, because it takes a second to load and only results need it

    samples = [sample.detach().cpu().numpy().astype(np.float64) for sample in (values, over) if sample is not None]

    def statistic(values: np.ndarray, over: np.ndarray | float = 1.0, *, axis: int = -1) -> np.ndarray:
        return np.mean(values, axis) / np.mean(over, axis if np.ndim(over) else None)

    mean = float(statistic(*samples))
    if not np.isfinite(samples).all() or np.ptp(samples, -1).max() == 0.0:
        return {"mean": mean, "confidence_interval": [mean, mean]}
    options = {"n_resamples": 2000, "method": "percentile", "rng": np.random.default_rng(0)}
    interval = bootstrap(samples, statistic, paired=True, **options).confidence_interval
    return {"mean": mean, "confidence_interval": [float(interval.low), float(interval.high)]}


def compared(costs: Costs, others: Costs) -> dict[str, Any]:
    """The mean of costs over that of others in the same episodes, with its interval, and how many are lower."""
    return {"ratio": mean_with_confidence(costs, others), "cheaper": int((costs < others).sum())}
