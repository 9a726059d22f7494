"""Virtual episodes: their draws, and the cost of a policy in them."""

from collections import deque
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from rt_torchrl.trajectories.rollout import DivergenceError
from rt_torchrl.trajectories.state_feedback import StateFeedback
from rt_torchrl.trajectories.trajectory import Scenario, Trajectory, continued, pieces_of_equal_length
from rt_torchrl.trajectories.twin import DigitalTwin
from rt_torchrl.twinning.exogenous import ExogenousConfig, ExogenousProcess, sample_experience
from rt_torchrl.twinning.extreme_starts import ExtremeStarts
from rt_torchrl.twinning.flight import Flight
from rt_torchrl.twinning.planners.constraints import Constraints


class VirtualEpisodes:
    """Episodes on the twin with the disturbances that the real system has met.

    Args:
        twin: twin on which the episodes are flown.
        config: parameters of the fit of a process to a real episode's exogenous input.
        experience: number of latest real episodes whose processes are kept.
        generator: source of every draw.
    """

    constraints: Constraints | None = None
    """Bounds on states, whose price counts where policies are compared; None for none."""
    extremes: ExtremeStarts | None = None
    """Extreme initial states, from which a new policy must not fail; None for none."""

    def __init__(self, twin: DigitalTwin, config: ExogenousConfig, experience: int, *, generator: torch.Generator):
        self.twin, self.config, self.generator = twin, config, generator
        self.processes: deque[ExogenousProcess] = deque(maxlen=experience)

    def judge_by(self, constraints: Constraints | None, extremes: int) -> None:
        """Compare policies by bounds on states, too, and from the extremes of so many random initial states."""
        self.constraints = constraints
        self.extremes = ExtremeStarts(self.twin.plant, extremes, self.generator.device)

    def wanting(self, arm: str) -> bool:
        """Whether an arm with a twin still needs the inputs of one whole real episode."""
        return arm != "model_free" and not self.processes

    def learn(self, record: Trajectory) -> None:
        """Fit a process to the inputs that acted on the plant in a real episode, and keep it."""
        self.processes.append(self._process(record))

    def learn_flight(self, flight: Flight | None) -> None:
        """The same of a flight, if it is whole; inputs of one that ended early are continued to the horizon."""
        if flight is None or not flight.whole:
            return
        record, n = flight.record, self.twin.plant.n_steps
        self.learn(record._replace(exogenous=continued(record.exogenous, n)) if flight.ended else record)

    def repeated(self, record: Trajectory) -> Scenario:
        """The start and the inputs of a real episode, which are continued to the horizon if it ended early."""
        plant = self.twin.plant
        acted = record.exogenous[:, : len(plant.acting_inputs)]
        whole = len(acted) >= plant.n_steps or plant.end_cost is None
        inputs = record.exogenous if whole else plant.with_previews(continued(acted, plant.n_steps))
        return Scenario(record.states[:1], inputs[None])

    def paired(self, records: Sequence[Trajectory]) -> tuple[list[Trajectory], list[ExogenousProcess]]:
        """The latest records that have a process, and these processes, in pairs.

        If only a part of an episode is sound, the records differ in length. Then they are cut to pieces of one length,
        and each piece gets a process that is not kept.

        Args:
            records: the latest records, oldest first.
        """
        processes = list(self.processes)[-len(records) :]
        latest = list(records)[-len(processes) :] if processes else []
        if latest and all(len(a.actions) == len(b.mean) for a, b in zip(latest, processes, strict=True)):
            return latest, processes
        plant = self.twin.plant
        pieces = pieces_of_equal_length(records, plant.n_steps, plant.dt)
        return pieces, [self._process(piece) for piece in pieces]

    def _process(self, record: Trajectory) -> ExogenousProcess:
        plant, signals = self.twin.plant, self.twin.plant.acting_inputs
        acted = record.exogenous[:, : len(signals)]
        return ExogenousProcess(acted, dt=plant.dt, signals=signals, config=self.config)

    def draw(self, count: int) -> Scenario:
        """Draw random initial states, and exogenous inputs from the processes that are kept.

        Note: the paper plans with the initial state and the disturbances of the last episode alone. Here the initial
        states are random and the disturbances are those of the last ``experience`` episodes, because a policy that is
        optimal for one wind can lie just beyond a cliff of another: the turbine's torque law then stalls the rotor in
        one wind of twenty.
        """
        plant, large_scale = self.twin.plant, self.config.large_scale
        initial_state = plant.draw_initial_state(count, self.generator)
        exogenous = sample_experience(self.processes, count, self.generator, large_scale=large_scale)
        return Scenario(initial_state, plant.with_previews(exogenous))

    @torch.no_grad()
    def cost(self, policy: nn.Module, episodes: Scenario) -> Tensor:
        """Mean J_a of a policy; infinite if the twin diverges under it."""
        try:
            cost = self.twin.cost(policy, *episodes)
        except DivergenceError:
            return torch.full((), torch.inf, dtype=torch.float64, device=episodes.initial_state.device)
        return cost.nan_to_num(nan=torch.inf, posinf=torch.inf)

    def tail(self, policy: nn.Module, episodes: Scenario) -> float:
        """Mean J_a of a policy from the extreme starts, under the inputs of some episodes; zero without extremes."""
        return self.cost(policy, self.extremes.under(episodes)).item() if self.extremes else 0.0

    def with_extremes(self, episodes: Scenario) -> Scenario:
        """Some episodes, and those from the extreme starts."""
        return self.extremes.beside(episodes) if self.extremes else episodes

    @torch.no_grad()
    def price(self, policy: nn.Module, episodes: Scenario) -> Tensor:
        """The cost by which policies are compared: mean J_a, with the price of leaving the bounds if there are some."""
        cost = self.cost(policy, episodes)
        if not self.constraints or not cost.isfinite() or isinstance(policy, StateFeedback):
            return cost
        return self.constraints.priced(
            cost.expand(len(episodes.initial_state)), self.twin.control(policy, *episodes)
        ).mean()

    def state_dict(self) -> dict[str, Any]:
        return {"processes": [process.state_dict() for process in self.processes]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.processes.clear()
        self.processes.extend(
            ExogenousProcess.from_state(saved, self.twin.plant.acting_inputs) for saved in state["processes"]
        )
