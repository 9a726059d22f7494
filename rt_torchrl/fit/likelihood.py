r"""The likelihood of sensor readings under a twin, and its derivatives by all unknowns.

.. math::
    J(w, s_0, b) = \frac12\sum_{i,k,j}\Big(\frac{y^i_{kj} - h_j(s^i_k) - b_j}{\sigma_j}\Big)^2
        + \frac12\sum_i\Big\|\frac{s^i_0 - \hat s^i_0}{\rho}\Big\|^2
        + \frac12\sum_i\Big\|\frac{s^i_0 - s^{i-1}_n}{q}\Big\|^2 + \frac12\Lambda\|w - w^0\|^2

The first sum is over the samples that exist. The unknowns are the closure's weights w, the initial states of all
records, of which no sensor needs to read any component, and the biases b. The second sum is over records with a start
of their own, the third over records that follow another one, from whose end process noise q parts them (weak
constraint). J is the negative logarithm of the posterior, so that its Gauss-Newton matrix is the Fisher information of
the unknowns.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rt_torchrl.fit.output_error import REMEDY, InitialStates
from rt_torchrl.fit.sensor_record import SensorRecord, held_to_the_end
from rt_torchrl.fit.sensors import Sensor, read, read_slopes
from rt_torchrl.fit.weight_prior import WeightPrior
from rt_torchrl.optimisers.levenberg_marquardt import NormalEquations
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import differences
from rt_torchrl.trajectories.rollout import require_finite
from rt_torchrl.trajectories.twin import DigitalTwin


class Biases(nn.Module):
    """Constant offsets of the sensors that have one, zero at first.

    Args:
        sensors: all sensors.
        scale: unit of the offset of each sensor, so that a step of 1 is neither long nor short.
    """

    unit: Tensor

    def __init__(self, sensors: Sequence[Sensor], scale: Float[Tensor, " n_y"]):
        super().__init__()
        biased = [k for k, sensor in enumerate(sensors) if sensor.bias]
        self.register_buffer("unit", torch.diag(scale)[biased])
        self.offsets = nn.Parameter(scale.new_zeros(len(biased)))

    def forward(self) -> Float[Tensor, " n_y"]:
        return self.offsets @ self.unit


class Residuals(NamedTuple):
    """Residuals r of a record in units of the noise, with their derivatives; both are zero where a sample is missing.

    ``jacobian`` holds derivatives by the unknowns of this record, whose places among all unknowns are ``places``.
    """

    values: Float[Tensor, "samples n_r"]
    jacobian: Float[Tensor, "samples n_r n_local"]
    places: Int[Tensor, " n_local"]


class Replays(NamedTuple):
    """Records of equal length as the twin replays them, with the derivatives by weights and initial states."""

    numbers: list[int]
    states: Float[Tensor, "batch n+1 n_s"]
    sensitivity: Float[Tensor, "batch n+1 n_s n_p"]


class Likelihood:
    """The negative logarithm of the likelihood of records.

    Args:
        twin: the twin; the trainable weights of its closure come first among the unknowns.
        records: what the sensors read, in records of any lengths.
        sensors: the sensors of all records.
        initial: initial states of the records; their offsets come next.
        noise: standard deviation σ of each sensor.
        spread: standard deviation ρ of the initial states about their guess; infinite for none.
        process: standard deviation q of what process noise does to every state between two records that follow each
            other; None if no record follows.
        biases: offsets of the sensors, which come last; None for none.
        prior: prior of the closure's weights; None for none.
        weights: whether the closure's weights are unknowns.
    """

    def __init__(
        self,
        twin: DigitalTwin,
        records: Sequence[SensorRecord],
        sensors: Sequence[Sensor],
        initial: InitialStates,
        noise: Float[Tensor, " n_y"],
        *,
        spread: Float[Tensor, " n_s"] | None = None,
        process: Float[Tensor, " n_s"] | None = None,
        biases: Biases | None = None,
        prior: WeightPrior | None = None,
        weights: bool = True,
    ):
        self.twin, self.records, self.sensors = twin, list(records), tuple(sensors)
        self.initial, self.noise, self.prior = initial, noise, prior
        self.spread = torch.full_like(initial.measured[0], math.inf) if spread is None else spread
        self.biases, self.process = biases or Biases((), noise), process
        self.weight_count = sum(w.numel() for w in twin.closure.parameters() if w.requires_grad)
        self._shown = self.weight_count if weights else 0
        self.unknowns = nn.ModuleList([*([twin.closure] if weights else []), initial, self.biases])
        lengths = [len(record.actions) for record in records]
        self._groups = [[i for i, n in enumerate(lengths) if n == length] for length in dict.fromkeys(lengths)]

    @property
    def plant(self) -> Plant:
        return self.twin.plant

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return self._shown + self.initial.offsets.numel() + self.biases.offsets.numel()

    @property
    def first_stiffness(self) -> Float[Tensor, "records n_free"]:
        """Stiffness of the offsets of every initial state about its guess; zero for a record that follows another."""
        each = (self.initial.unit.sum(-1) / self.spread[list(self.initial.free)]).square()
        own = [float(not record.follows) for record in self.records]
        return each.new_tensor(own)[:, None] * each

    @torch.no_grad()
    def replays(self) -> list[Replays]:
        """Replay every record with the present unknowns.

        Raises:
            DivergenceError: if a state is not finite.
        """
        return [self._replay(group) for group in self._groups]

    def _replay(self, group: list[int]) -> Replays:
        records, first = [self.records[i] for i in group], self.initial()[group]
        actions, exogenous = (torch.stack([getattr(r, name) for r in records]) for name in ("actions", "exogenous"))
        start = first.new_tensor([record.start for record in records])
        ends, S = self.twin.sensitivities(first, exogenous, actions, start=start, initial=True)
        require_finite(self.plant, ends.transpose(0, 1), first, [self.twin.closure], start=start, remedy=REMEDY)
        n_s = first.shape[-1]
        at_start = torch.cat([S.new_zeros(n_s, self.weight_count), torch.eye(n_s, dtype=S.dtype, device=S.device)], -1)
        S = torch.cat([at_start.expand(len(group), 1, -1, -1), S], 1)
        by_offset = S[..., self.weight_count :] @ self.initial.unit.T
        S = torch.cat([S[..., : self._shown], by_offset], -1)
        return Replays(group, torch.cat([first.unsqueeze(1), ends], 1), S)

    @torch.no_grad()
    def residuals(self, replays: Sequence[Replays] | None = None) -> list[Residuals]:
        """Residuals of all records, in their order.

        Args:
            replays: result of :meth:`replays` with the present unknowns; None computes it.
        """
        found: dict[int, Residuals] = {}
        for replay in self.replays() if replays is None else replays:
            found |= dict(zip(replay.numbers, self._residuals(replay), strict=True))
        return [found[number] for number in range(len(self.records))]

    def _residuals(self, replay: Replays) -> list[Residuals]:
        numbers, states, S = replay
        records = [self.records[i] for i in numbers]
        inputs = held_to_the_end(torch.stack([record.exogenous for record in records]))
        start = states.new_tensor([[record.start] for record in records])
        t = start + self.plant.dt * torch.arange(states.shape[1], dtype=states.dtype, device=states.device)
        given = (self.sensors, self.plant, t, states, inputs)
        readings, seen = (torch.stack([getattr(r, name) for r in records]) for name in ("readings", "seen"))
        signals = [sensor.measurement for sensor in self.sensors]
        values = differences(signals, read(*given) + self.biases(), readings) / self.noise
        by_bias = self.biases.unit.T.expand(*values.shape, -1)
        jacobian = torch.cat([read_slopes(*given) @ S, by_bias], -1) / self.noise.unsqueeze(-1)
        values = torch.where(seen, values, 0.0)
        jacobian = torch.where(seen.unsqueeze(-1), jacobian, 0.0)
        return [Residuals(values[k], jacobian[k], self._places(i)) for k, i in enumerate(numbers)]

    @torch.no_grad()
    def simulated(self) -> Float[Tensor, "samples n_y"]:
        """What the sensors would read along the first record, bias included, whether there is a sample or not."""
        (states, *_), record = self.replays()[0].states, self.records[0]
        t = record.start + self.plant.dt * torch.arange(len(states), dtype=states.dtype, device=states.device)
        return read(self.sensors, self.plant, t, states, held_to_the_end(record.exogenous)) + self.biases()

    @torch.no_grad()
    def normal_equations(self, residuals: Sequence[Residuals] | None = None) -> NormalEquations:
        """J, its gradient and its Gauss-Newton matrix by all unknowns.

        Args:
            residuals: result of :meth:`residuals` with the present unknowns; None computes it.
        """
        like = self.initial.measured
        gradient, matrix = like.new_zeros(self.count), like.new_zeros(self.count, self.count)
        cost = like.new_zeros(())
        replays = self.replays() if residuals is None or self.process is not None else []
        blocks = self.residuals(replays) if residuals is None else residuals
        for block in (*blocks, *self.pushes(replays)):
            r, A = block.values.flatten(), block.jacobian.flatten(0, 1)
            cost = cost + 0.5 * (r @ r)
            gradient[block.places] += A.T @ r
            matrix[block.places[:, None], block.places] += A.T @ A
        found = self._with_first_states(NormalEquations(cost, gradient, matrix))
        return self.prior.added(found) if self.prior is not None and self._shown else found

    def _with_first_states(self, found: NormalEquations) -> NormalEquations:
        """The equations with the prior of the initial states."""
        stiffness, offsets = self.first_stiffness, self.initial.offsets
        held = slice(self._shown, self._shown + offsets.numel())
        found.gradient[held] += (stiffness * offsets).flatten()
        found.matrix.diagonal()[held] += stiffness.flatten()
        return found._replace(cost=found.cost + 0.5 * (stiffness * offsets.square()).sum())

    @torch.no_grad()
    def pushes(self, replays: Sequence[Replays] | None = None) -> list[Residuals]:
        """What process noise does to the states between records that follow each other, in units of q."""
        if self.process is None:
            return []
        states: dict[int, tuple[Tensor, Tensor]] = {}
        for replay in self.replays() if replays is None else replays:
            ends = zip(replay.states[:, [0, -1]], replay.sensitivity[:, [0, -1]], strict=True)
            states |= dict(zip(replay.numbers, ends, strict=True))
        found, biases = [], self.biases.offsets.numel()
        for number, record in enumerate(self.records):
            if not record.follows:
                continue
            (s, S), (before, S_before) = states[number], states[number - 1]
            values = differences(self.plant.states, s[0], before[1]) / self.process
            own, places = S[0][:, self._shown :], self._places(number)
            rest = self._places(number - 1)
            jacobian = torch.cat([-S_before[1], own], -1) / self.process[:, None]
            kept = slice(len(rest) - biases)
            joined = torch.cat([rest[kept], places[self._shown : len(places) - biases]])
            found.append(Residuals(values[None], jacobian[None], joined))
        return found

    def held_back(self, inverse: Float[Tensor, "n n"]) -> float:
        """Number of unknowns that priors determine instead of the data, by the inverse of the information."""
        n = self.weight_count
        stiffness = self.first_stiffness.flatten()
        found = (stiffness * inverse.diagonal()[n : n + len(stiffness)]).sum()
        for push in self.pushes():
            A, places = push.jacobian[0], push.places
            found = found + (A.T @ A * inverse[places[:, None], places]).sum()
        return float(found if self.prior is None else found + self.prior.determined(inverse))

    def _places(self, number: int) -> Int[Tensor, " n_local"]:
        free = len(self.initial.free)
        first = self._shown + number * free
        last = self._shown + self.initial.offsets.numel()
        ranges = [(0, self._shown), (first, first + free), (last, self.count)]
        return torch.cat([torch.arange(*ends, device=self.noise.device) for ends in ranges])
