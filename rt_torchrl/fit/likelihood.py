r"""The likelihood of sensor readings under a twin, and its derivatives by all unknowns.

.. math::
    J(w, s_0, b) = \frac12\sum_{i,k,j}\Big(\frac{y^i_{kj} - h_j(s^i_k) - b_j}{\sigma_j}\Big)^2
        + \frac12\sum_i\Big\|\frac{s^i_0 - \hat s^i_0}{\rho}\Big\|^2 + \frac12\Lambda\|w - w^0\|^2

The first sum is over the samples that exist. The unknowns are the closure's weights w, the initial states of all
records, of which no sensor needs to read any component, and the biases b. The prior holds weights of which no record
tells at their first values w⁰. J is the negative logarithm of the posterior, so that its Gauss-Newton matrix is the
Fisher information of the unknowns. With the sensors of :func:`rt_torchrl.fit.sensors.state_sensors` the first sum is
the paper's J_p.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from rt_torchrl.fit.sensors import Sensor, SensorRecord, read, read_slopes, scatter_of, state_places
from rt_torchrl.optimisers.levenberg_marquardt import NormalEquations
from rt_torchrl.plants.closures import BoundedPerceptron
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Actions, States
from rt_torchrl.plants.signal import differences
from rt_torchrl.trajectories.rollout import require_finite
from rt_torchrl.trajectories.twin import DigitalTwin

FIRST_NOISE = 0.1
"""First guess of an unknown noise level, as a share of the scatter of the readings."""
REMEDY = "Check the units of what was recorded, use a smaller dt, or start from a closure nearer to the system."


class WeightPrior:
    """The prior of the weights of a closure's perceptrons (:class:`BoundedPerceptron`), centred on the present ones.

    Other weights, such as constants of the physics, are free.

    Args:
        closure: closure with the weights.
        stiffness: factor Λ of all weights of perceptrons.
    """

    def __init__(self, closure: nn.Module, stiffness: float):
        self.closure, self.stiffness = closure, stiffness
        self.start = self.weights().detach().clone()
        held = {id(w) for m in closure.modules() if isinstance(m, BoundedPerceptron) for w in m.parameters()}
        trained = [w for w in closure.parameters() if w.requires_grad]
        self.held = torch.cat([torch.full_like(w.detach().flatten(), float(id(w) in held)) for w in trained])

    def weights(self) -> Tensor:
        """The trained weights in one vector."""
        return torch.cat([w.flatten() for w in self.closure.parameters() if w.requires_grad])

    def cost(self) -> Tensor:
        """The cost, differentiable by the weights."""
        return 0.5 * self.stiffness * (self.held * (self.weights() - self.start).square()).sum()


class Offsets(nn.Module):
    """First guesses of values, of which some have a trainable offset: first states of records, biases of sensors.

    Args:
        guess: the guesses.
        free: places of the values that have an offset.
        scale: unit of each offset, so that a step of 1 is neither long nor short.
    """

    guess: Tensor
    unit: Tensor

    def __init__(self, guess: Float[Tensor, "*records n"], free: Sequence[int], scale: Float[Tensor, " n"]):
        super().__init__()
        self.register_buffer("guess", guess)
        self.register_buffer("unit", torch.diag(scale)[list(free)])
        self.free = tuple(free)
        self.offsets = nn.Parameter(scale.new_zeros(*guess.shape[:-1], len(self.free)))

    def forward(self) -> Float[Tensor, "*records n"]:
        return self.guess + self.offsets @ self.unit


class Group(NamedTuple):
    """Records of equal length, stacked, with their numbers among all records and the times of their samples.

    ``places`` are those of the unknowns of each record among all unknowns.
    """

    numbers: list[int]
    readings: Float[Tensor, "batch samples n_y"]
    seen: Bool[Tensor, "batch samples n_y"]
    actions: Actions
    exogenous: Float[Tensor, "batch samples n_z"]
    times: Float[Tensor, "batch samples"]
    places: Int[Tensor, "batch n_local"]


class Residuals(NamedTuple):
    """Residuals r of a group in units of the noise, with their derivatives; both are zero where a sample is missing.

    ``jacobian`` holds derivatives by the unknowns of each record, whose places among all unknowns the group knows.
    """

    group: Group
    values: Float[Tensor, "batch samples n_y"]
    jacobian: Float[Tensor, "batch samples n_y n_local"]


class Likelihood:
    """The negative logarithm of the likelihood of records.

    Args:
        twin: the twin; the trainable weights of its closure come first among the unknowns.
        sensors: the sensors of all records.
        spread: standard deviation ρ of the initial states about their guess; infinite where nothing is known. Offsets
            of the initial states come next among the unknowns.
        records: what the sensors read, in records of any lengths.
        noise: standard deviation σ of each sensor; by default those that are given, and a share of the readings'
            scatter for others.
        prior: prior of the closure's weights; None for none.
        weights: whether the closure's weights are unknowns.
        known: whether to take the initial states as known, and biases as zero.
        biases: known biases; None lets those that are wanted be unknowns, which come last.

    Raises:
        ValueError: if a record of n actions has not n+1 readings and n+1 exogenous inputs.
    """

    def __init__(
        self,
        twin: DigitalTwin,
        sensors: Sequence[Sensor],
        spread: Float[Tensor, " n_s"],
        records: Sequence[SensorRecord],
        noise: Float[Tensor, " n_y"] | None = None,
        *,
        prior: WeightPrior | None = None,
        weights: bool = True,
        known: bool = False,
        biases: Float[Tensor, " n_y"] | None = None,
    ):
        for k, (readings, actions, exogenous, *_) in enumerate(records):
            if not len(readings) == len(exogenous) == len(actions) + 1:
                raise ValueError(
                    f"record {k} has {len(actions)} actions, {len(readings)} readings and {len(exogenous)} exogenous "
                    "inputs; it must have one more reading and input than actions. Add the input of the last reading, "
                    "or NaN if it is not known."
                )
        noise = first_noise(sensors, records) if noise is None else noise
        first = torch.stack([record.guess for record in records])
        free = [] if known else (spread > 0.0).nonzero().flatten().tolist()
        sizes = usual_sizes(twin.plant, first, sensors, records) if free else torch.ones_like(first[0])
        biased = [k for k, sensor in enumerate(sensors) if sensor.bias and biases is None and not known]
        # A bias may be far more than noise and scatter, and a step changes it by a unit at most.
        largest = torch.cat([record.readings for record in records]).nan_to_num().abs().amax(0)
        unit = torch.maximum(noise, FIRST_NOISE * largest)
        self.plant: Plant = twin.plant
        self.twin, self.records, self.sensors, self.prior = twin, list(records), tuple(sensors), prior
        self.initial, self.noise, self.spread = Offsets(first, free, sizes), noise, spread.to(first.device)
        self.biases = Offsets(torch.zeros_like(noise) if biases is None else biases, biased, unit)
        self.weight_count = sum(w.numel() for w in twin.closure.parameters() if w.requires_grad)
        self._unknown_weights = self.weight_count if weights else 0
        self.unknowns = nn.ModuleList([*([twin.closure] if weights else []), self.initial, self.biases])
        self._states = state_places(twin.plant, self.sensors)
        lengths = [len(record.actions) for record in records]
        self.groups = [
            self._group([i for i, n in enumerate(lengths) if n == length]) for length in dict.fromkeys(lengths)
        ]

    def _group(self, numbers: list[int]) -> Group:
        readings, actions, exogenous = (
            torch.stack([getattr(self.records[i], name) for i in numbers])
            for name in ("readings", "actions", "exogenous")
        )
        start = readings.new_tensor([self.records[i].start for i in numbers])
        clock = self.plant.dt * torch.arange(readings.shape[1], dtype=start.dtype, device=start.device)
        times, places = start.unsqueeze(-1) + clock, torch.stack([self._places(i) for i in numbers])
        return Group(numbers, readings, ~readings.isnan(), actions, exogenous, times, places)

    def _places(self, number: int) -> Int[Tensor, " n_local"]:
        free = len(self.initial.free)
        first = self._unknown_weights + number * free
        last = self._unknown_weights + self.initial.offsets.numel()
        ranges = [(0, self._unknown_weights), (first, first + free), (last, self.count)]
        return torch.cat([torch.arange(*ends, device=self.noise.device) for ends in ranges])

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return self._unknown_weights + self.initial.offsets.numel() + self.biases.offsets.numel()

    @property
    def samples(self) -> Int[Tensor, " n_y"]:
        """Number of samples of each sensor."""
        return torch.stack([group.seen.sum((0, 1)) for group in self.groups]).sum(0)

    def priors(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """The stiffness of every unknown about the value at which a prior holds it, and its distance from there."""
        offsets = self.initial.offsets
        stiffness, distance = offsets.new_zeros(self.count), offsets.new_zeros(self.count)
        of_states = slice(self._unknown_weights, self._unknown_weights + offsets.numel())
        precisions = (self.initial.unit.sum(-1) / self.spread[list(self.initial.free)]).square()
        stiffness[of_states], distance[of_states] = precisions.expand_as(offsets).flatten(), offsets.flatten()
        if self.prior is not None and self._unknown_weights:
            stiffness[: self._unknown_weights] = self.prior.stiffness * self.prior.held
            distance[: self._unknown_weights] = self.prior.weights() - self.prior.start
        return stiffness, distance

    @torch.no_grad()
    def replay(self, group: Group) -> tuple[States, Float[Tensor, "batch samples n_s n_p"]]:
        """A group as the twin replays it: states, and their derivatives by weights and offsets of initial states.

        Raises:
            DivergenceError: if a state is not finite.
        """
        first, start, closure = self.initial()[group.numbers], group.times[:, 0], self.twin.closure
        free = bool(self.initial.free)
        ends, S = self.twin.sensitivities(first, group.exogenous[:, :-1], group.actions, start=start, initial=free)
        require_finite(self.plant, ends.transpose(0, 1), first, [closure], start=start, remedy=REMEDY)
        by_weights, by_state = S.split([self.weight_count, S.shape[-1] - self.weight_count], -1)
        S = by_weights[..., : self._unknown_weights]
        at_start = S.new_zeros(len(first), 1, first.shape[-1], self._unknown_weights)
        if free:
            unit = self.initial.unit.T
            S = torch.cat([S, by_state @ unit], -1)
            at_start = torch.cat([at_start, unit.expand(*at_start.shape[:3], -1)], -1)
        return torch.cat([first.unsqueeze(1), ends], 1), torch.cat([at_start, S], 1)

    @torch.no_grad()
    def residuals(self) -> list[Residuals]:
        """Residuals of all records, in groups of equal length.

        Raises:
            DivergenceError: if a state is not finite.
        """
        return [self._residuals(group) for group in self.groups]

    def _residuals(self, group: Group) -> Residuals:
        states, S = self.replay(group)
        weights = group.seen / self.noise
        readings = self._read(group, states)
        values = differences([sensor.measurement for sensor in self.sensors], readings, group.readings)
        values = torch.where(group.seen, values, 0.0) * weights
        if None in self._states:
            jacobian = read_slopes(self.sensors, self.plant, group.times, states, group.exogenous) @ S
        else:
            jacobian = S[:, :, self._states]
        by_bias = self.biases.unit.T.expand(*values.shape, -1)
        jacobian = torch.cat([jacobian, by_bias], -1)
        jacobian = torch.where(group.seen.unsqueeze(-1), jacobian, 0.0) * weights.unsqueeze(-1)
        return Residuals(group, values, jacobian)

    def _read(self, group: Group, states: States) -> Float[Tensor, "batch samples n_y"]:
        """What the sensors read, bias included."""
        return read(self.sensors, self.plant, group.times, states, group.exogenous) + self.biases()

    @torch.no_grad()
    def simulated(self) -> list[Float[Tensor, "samples n_y"]]:
        """What the sensors would read along every record, bias included, whether there is a sample or not.

        NaN where they depend on inputs that are not known, as in the last sample of a flight.

        Raises:
            DivergenceError: if a state is not finite.
        """
        readings: dict[int, Tensor] = {}
        for group in self.groups:
            first, start = self.initial()[group.numbers], group.times[:, 0]
            flown = self.twin.replay(first, group.exogenous[:, :-1], group.actions, start=start)
            readings |= dict(zip(group.numbers, self._read(group, flown.states), strict=True))
        return [readings[number] for number in range(len(self.records))]

    @torch.no_grad()
    def normal_equations(self, residuals: Sequence[Residuals] | None = None) -> NormalEquations:
        """J, its gradient and its Gauss-Newton matrix by all unknowns.

        Args:
            residuals: result of :meth:`residuals` with the present unknowns; None computes it.
        """
        like = self.initial.guess
        cost, gradient = like.new_zeros(()), like.new_zeros(self.count)
        matrix = like.new_zeros(self.count, self.count)
        for block in self.residuals() if residuals is None else residuals:
            r, A, places = block.values.flatten(1), block.jacobian.flatten(1, 2), block.group.places
            if not self.initial.free:  # all records have the same unknowns
                r, A, places = r.reshape(1, -1), A.reshape(1, -1, A.shape[-1]), places[:1]
            cost = cost + 0.5 * r.square().sum()
            gradient.index_put_((places,), (A.mT @ r.unsqueeze(-1)).squeeze(-1), accumulate=True)
            matrix.index_put_((places.unsqueeze(-1), places.unsqueeze(-2)), A.mT @ A, accumulate=True)
        stiffness, distance = self.priors()
        matrix.diagonal().add_(stiffness)
        cost = cost + 0.5 * (stiffness * distance.square()).sum()
        return NormalEquations(cost, gradient + stiffness * distance, matrix)


def first_noise(sensors: Sequence[Sensor], records: Sequence[SensorRecord]) -> Float[Tensor, " n_y"]:
    """Noise levels that are given; for others a share of the scatter of the readings.

    Raises:
        ValueError: if there is no record, or a sensor has no sample.
    """
    scatter, levels = scatter_of(sensors, records), []
    size = torch.cat([record.readings for record in records]).nan_to_num().abs().amax(0)
    for sensor, change, largest in zip(sensors, scatter.tolist(), size.tolist(), strict=True):
        guess = FIRST_NOISE * change or 1e-6 * max(largest, 1.0)
        levels.append(guess if sensor.noise is None else sensor.noise)
    return scatter.new_tensor(levels)


def usual_sizes(
    plant: Plant, first: Float[Tensor, "records n_s"], sensors: Sequence[Sensor], records: Sequence[SensorRecord]
) -> Float[Tensor, " n_s"]:
    """Usual size of each state, in which changes of initial states are measured; 1 where nothing tells it.

    It is the greatest of the scatter of the states that the plant draws, that of what a sensor reads of it, and a tenth
    of the guess.
    """
    drawn = plant.draw_initial_state(100, torch.Generator(device=first.device).manual_seed(0))
    sizes = torch.maximum(drawn.std(0), 0.1 * first.abs().amax(0))
    for column, k in enumerate(state_places(plant, sensors)):
        if k is not None:
            values = torch.cat([record.readings[:, column] for record in records])
            values = values[~values.isnan()]
            scatter = (values - values.mean()).square().mean().sqrt()
            sizes[k] = torch.fmax(sizes[k], scatter)  # of a sensor without samples there is none
    return torch.where(sizes > 0.0, sizes, 1.0)
