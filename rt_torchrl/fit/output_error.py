r"""The output error J_p of a twin on segments of a log, and its derivatives by weights and initial states.

.. math:: J_p(w, s_0^1, \dots, s_0^m) = \sum_i\sum_{k=0}^{n_i} L_p(s^i_k, \check s^i_k)\,\Delta t

A sensor's first sample is as noisy as any other, and a system that forgets slowly carries the error of its first sample
through the whole segment. The initial states are therefore unknowns beside the weights, and first samples count as much
as any other samples.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import pad

from rt_torchrl.optimisers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import differences
from rt_torchrl.trajectories.rollout import require_finite
from rt_torchrl.trajectories.sensitivity import Sensitivities
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

NOISE_TOLERANCE = 1e-8
"""Levenberg-Marquardt ends where a step promises to lower J_p by less than this share. One standard error of a weight
changes J_p by about one part in the number of samples, so the default for noise-free records would end too early."""
INITIAL_ITERATIONS = 10
"""Number of trial steps for initial states alone; it is small because J_p is nearly quadratic in them."""
REMEDY = "Check the units of what was recorded, use a smaller dt, or start from a closure nearer to the system."


class InitialStates(nn.Module):
    """Initial state s_0 of every segment: a first guess, such as the measured state, plus trainable offsets.

    Args:
        first: first guess of the initial state of every segment.
        free: indices of the states that have an offset.
        scale: unit of the offset of each state; it is about the noise, so that a step of 1 is neither long nor short.
    """

    measured: Tensor
    unit: Tensor

    def __init__(self, first: Float[Tensor, "segments n_s"], free: Sequence[int], scale: Float[Tensor, " n_s"]):
        super().__init__()
        self.register_buffer("measured", first)
        self.register_buffer("unit", torch.diag(scale)[list(free)])
        self.free = tuple(free)
        self.offsets = nn.Parameter(scale.new_zeros(len(first), len(self.free)))

    def forward(self) -> Float[Tensor, "segments n_s"]:
        return self.measured + self.offsets @ self.unit

    @classmethod
    def as_measured(cls, segments: Sequence[Trajectory]) -> "InitialStates":
        """Initial states without offsets."""
        first = first_states(segments)
        return cls(first, (), torch.ones_like(first[0]))

    @classmethod
    def estimated(
        cls, twin: DigitalTwin, segments: Sequence[Trajectory], free: Sequence[int], sensitivities: Sensitivities
    ) -> "InitialStates":
        """Initial states whose offsets have the twin's present RMS residual as their unit.

        No step then leaves by much what the sensors allow.
        """
        if not free:
            return cls.as_measured(segments)
        fixed = OutputError(twin, segments, cls.as_measured(segments), weights=False, sensitivities=sensitivities)
        measured = torch.cat([segment.states for segment in segments])
        replayed = torch.cat([found.states for found in fixed.replays()])
        residual = differences(twin.plant.states, replayed, measured).square().mean(0).sqrt()
        # A residual of zero would leave no unit to measure an offset in.
        return cls(first_states(segments), free, residual.clamp_min(1e-9 * measured.abs().amax(0).clamp_min(1e-9)))


def first_states(segments: Sequence[Trajectory]) -> Float[Tensor, "segments n_s"]:
    """The measured initial states of segments."""
    return torch.stack([segment.states[0] for segment in segments])


class Replayed(NamedTuple):
    """A segment as the twin replays it: the states s_0 ... s_n, and the derivatives in every sample.

    ``gradient`` and ``curvature`` are derivatives of L_p by the state. ``sensitivity`` is the derivative of the state
    by the unknowns of this segment; ``places`` holds their places in the vector of all unknowns.
    """

    states: Float[Tensor, "samples n_s"]
    gradient: Float[Tensor, "samples n_s"]
    curvature: Float[Tensor, "samples n_s n_s"]
    sensitivity: Float[Tensor, "samples n_s n_local"]
    places: Int[Tensor, " n_local"]


class OutputError:
    """The cost J_p of a twin on segments of a log.

    Args:
        twin: the twin; the trainable weights of its closure come first among the unknowns.
        segments: segments of the log, of any lengths.
        initial: initial states of the segments; their offsets come last among the unknowns.
        weights: whether the closure's weights are unknowns.
        sensitivities: forward sensitivities of the twin; ``twin.sensitivities`` by default.
    """

    def __init__(
        self,
        twin: DigitalTwin,
        segments: Sequence[Trajectory],
        initial: InitialStates,
        *,
        weights: bool = True,
        sensitivities: Sensitivities | None = None,
    ):
        self.twin, self.segments, self.initial = twin, list(segments), initial
        self._sensitivities = sensitivities or twin.sensitivities
        self.weight_count = sum(w.numel() for w in twin.closure.parameters() if w.requires_grad)
        self._shown = self.weight_count if weights else 0
        self.unknowns = nn.ModuleList([twin.closure, initial] if weights else [initial])

    @property
    def plant(self) -> Plant:
        return self.twin.plant

    def cost(self) -> Tensor:
        """The cost J_p; autograd differentiates it by the adjoint of the twin's engine."""
        total = self.initial.measured.new_zeros(())
        for (states, actions, exogenous, start), first in zip(self.segments, self.initial(), strict=True):
            flown = self.twin.replay(first[None], exogenous[None], actions[None], start=start)
            total = total + self.plant.dt * self.plant.discrepancy(flown.states[0], states).sum()
        return total

    @torch.no_grad()
    def replays(self) -> list[Replayed]:
        """Replay every segment with the present unknowns.

        Raises:
            DivergenceError: if a state is not finite.
        """
        return [self._replay(*numbered) for numbered in enumerate(zip(self.segments, self.initial(), strict=True))]

    def _replay(self, number: int, given: tuple[Trajectory, Tensor]) -> Replayed:
        (measured, actions, exogenous, start), first = given
        ends, S = self._sensitivities(first[None], exogenous[None], actions[None], start=start, initial=True)
        require_finite(self.plant, ends[0, :, None], first[None], [self.twin.closure], start=start, remedy=REMEDY)
        states = torch.cat([first[None], ends[0]])
        at_start = torch.cat(
            [S.new_zeros(len(first), self.weight_count), torch.eye(len(first), dtype=S.dtype, device=S.device)], -1
        )
        S = torch.cat([at_start[None], S[0]])
        by_initial = S[..., self.weight_count :] @ self.initial.unit.T
        g, H = discrepancy_derivatives(self.plant, states[None], measured[None])
        return Replayed(states, g[0], H[0], torch.cat([S[..., : self._shown], by_initial], -1), self._places(number))

    @torch.no_grad()
    def normal_equations(self, replays: Sequence[Replayed] | None = None) -> NormalEquations:
        """J_p, its gradient and its Gauss-Newton matrix by all unknowns.

        Args:
            replays: result of :meth:`replays` with the present unknowns; None computes it.
        """
        count = self._shown + self.initial.offsets.numel()
        gradient, matrix = self.initial.measured.new_zeros(count), self.initial.measured.new_zeros(count, count)
        cost, dt = self.initial.measured.new_zeros(()), self.plant.dt
        for replayed, segment in zip(replays or self.replays(), self.segments, strict=True):
            S, i = replayed.sensitivity, replayed.places
            cost = cost + dt * self.plant.discrepancy(replayed.states, segment.states).sum()
            gradient[i] += dt * torch.einsum("ki,kiw->w", replayed.gradient, S)
            matrix[i[:, None], i] += dt * torch.einsum("kiv,kiw->vw", S, replayed.curvature @ S)
        return NormalEquations(cost, gradient, matrix)

    def fit_initial_states(self) -> None:
        """Estimate the initial states with the present weights; ``weights`` must be False."""
        LevenbergMarquardt(self.initial, tolerance=NOISE_TOLERANCE).run(self.normal_equations, INITIAL_ITERATIONS)

    def _places(self, number: int) -> Int[Tensor, " n_local"]:
        free = len(self.initial.free)
        shown, own = (torch.arange(n, device=self.initial.measured.device) for n in (self._shown, free))
        return torch.cat([shown, self._shown + number * free + own])


def discrepancy_derivatives(
    plant: Plant, states: Float[Tensor, "batch n n_s"], measured: Float[Tensor, "batch n n_s"]
) -> tuple[Float[Tensor, "batch n n_s"], Float[Tensor, "batch n n_s n_s"]]:
    """Gradient and Hessian of L_p by the state, in every sample; hidden states, which are not compared, have zeros."""
    n, hidden = len(plant.readings), states.shape[-1] - len(plant.readings)

    def gradient(read: Tensor, unread: Tensor, reading: Tensor) -> tuple[Tensor, Tensor]:
        found = torch.func.grad(lambda own: plant.discrepancy(torch.cat([own, unread]), reading))(read)
        return found, found

    samples = torch.func.vmap(torch.func.jacrev(gradient, has_aux=True))
    read, unread = states.flatten(0, 1).split([n, hidden], -1)
    curvature, slope = samples(read, unread, measured.flatten(0, 1))
    slope, curvature = pad(slope, (0, hidden)), pad(curvature, (0, hidden, 0, hidden))
    return slope.unflatten(0, states.shape[:2]), curvature.unflatten(0, states.shape[:2])


def compared(curvature: Float[Tensor, "batch n n_s n_s"]) -> Bool[Tensor, " n_s"]:
    """Whether L_p depends on each state, as its Hessian shows."""
    return (curvature != 0.0).flatten(0, 2).any(0)
