r"""A twin that cannot be differentiated: an FMU, or a legacy code that is called.

Its sensitivities are those of an ensemble about the present weights and initial state (the bundle variant of the
iterative ensemble Kalman smoother): of members :math:`x \pm \epsilon\xi_m` with trajectories :math:`s^\pm_m`,

.. math:: S = D\,\Xi^\top(\Xi\,\Xi^\top)^{-1}, \qquad D_m = \frac{s^+_m - s^-_m}{2\epsilon}.

Members in pairs cancel the curvature, so that the iteration ends where the gradient does. Everything that asks a twin
for sensitivities, such as an estimation with its uncertainty, then works without gradients.

Source: Bocquet and Sakov, Q. J. R. Meteorol. Soc. 140 (2014) 1521.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.rollout import require_finite
from rt_torchrl.trajectories.sensitivity import Sensitivities
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

Simulate = Callable[[nn.Module, Tensor, Tensor, Tensor, float], Tensor]
"""Simulates one record: a function from the closure, the initial state ``n_s``, the exogenous inputs ``n n_z``, the
actions ``n n_a`` and the time of the initial state [s] to the states ``n n_s`` at the ends of all intervals."""


class SimulatedTwin(DigitalTwin):
    """A twin whose trajectories somebody else's code computes.

    Args:
        plant: the plant, whose signals and control interval count; its vector field is not used in a replay.
        closure: closure with the trained weights, which ``simulate`` reads.
        simulate: function that simulates a record, see :data:`Simulate`.
        pairs: number of pairs of members; by default the number of weights and states, and two more.
        spread: distance ε of the members from the mean, in units of a weight (1 is a factor of e for a logarithm).
        state_spread: distance ε of the members from the mean in every state; by default ``spread`` times its size, or
            times 1 where it is smaller.
        seed: seed of the members, which are the same in every call, so that the cost is a smooth function.

    Raises:
        ValueError: if a spread is not positive, or there are fewer pairs than weights and states.
    """

    def __init__(
        self,
        plant: Plant,
        closure: nn.Module,
        simulate: Simulate,
        *,
        pairs: int | None = None,
        spread: float = 1e-2,
        state_spread: Float[Tensor, " n_s"] | None = None,
        seed: int = 0,
    ):
        super().__init__(plant, closure)
        if not spread > 0.0 or (state_spread is not None and not (state_spread > 0.0).all()):
            raise ValueError(f"spread={spread} and state_spread={state_spread} of the ensemble must be positive.")
        count = sum(w.numel() for w in closure.parameters() if w.requires_grad) + len(plant.states)
        if pairs is not None and pairs < count:
            raise ValueError(f"pairs={pairs} of the ensemble must be at least {count}, the number of its unknowns.")
        self.simulate = simulate
        self.sensitivities = EnsembleSensitivities(self, pairs or count + 2, spread, state_spread, seed)

    @torch.no_grad()
    def replay(
        self,
        initial_state: Float[Tensor, "batch n_s"],
        exogenous: Float[Tensor, "batch n n_z"],
        actions: Float[Tensor, "batch n n_a"],
        *,
        start: float | Float[Tensor, " batch"] = 0.0,
    ) -> Trajectory:
        """Virtual episodes under recorded actions, one after the other.

        Raises:
            DivergenceError: if a state is not finite.
        """
        starts = torch.as_tensor(start, dtype=torch.float64).expand(len(initial_state)).tolist()
        rows = zip(initial_state, exogenous, actions, starts, strict=True)
        ends = torch.stack([self.simulate(self.closure, *row) for row in rows])
        require_finite(self.plant, ends.transpose(0, 1), initial_state, [self.closure], start=start)
        return Trajectory(torch.cat([initial_state.unsqueeze(1), ends], 1), actions, exogenous, start)


class EnsembleSensitivities(Sensitivities):
    """Sensitivities by an ensemble about the present weights and initial states; the module describes them.

    Args:
        twin: the twin that simulates the members.
        pairs, spread, state_spread, seed: see :class:`SimulatedTwin`.
    """

    def __init__(
        self,
        twin: SimulatedTwin,
        pairs: int,
        spread: float,
        state_spread: Float[Tensor, " n_s"] | None,
        seed: int,
    ):
        super().__init__(twin.plant, twin.closure)
        self._twin, self._pairs, self._spread, self._state_spread, self._seed = twin, pairs, spread, state_spread, seed

    @torch.no_grad()
    def __call__(
        self,
        initial_state: Float[Tensor, "batch n_s"],
        exogenous: Float[Tensor, "batch n n_z"],
        actions: Float[Tensor, "batch n n_a"],
        *,
        start: float | Float[Tensor, " batch"] = 0.0,
        initial: bool = False,
    ) -> tuple[Float[Tensor, "batch n n_s"], Float[Tensor, "batch n n_s n_w"]]:
        """States s_1 ... s_n and their sensitivities by the ensemble, as :class:`Sensitivities` gives them."""
        trained = [w for w in self.interval.closure.parameters() if w.requires_grad]
        sizes, n_s = [w.numel() for w in trained], initial_state.shape[-1]
        mean = [w.detach().clone() for w in trained]
        count = sum(sizes) + n_s
        generator = torch.Generator().manual_seed(self._seed)
        Xi = torch.randn(count, self._pairs, generator=generator, dtype=torch.float64)
        step = torch.cat(
            [torch.full((sum(sizes),), self._spread, dtype=torch.float64), self._state_step(initial_state)]
        )
        middle = self._twin.replay(initial_state, exogenous, actions, start=start).states[:, 1:]
        differences = []
        try:
            for change in (step[:, None] * Xi).T:
                ends = []
                for sign in (1.0, -1.0):
                    parts = (sign * change[: sum(sizes)]).split(sizes)
                    for w, value, part in zip(trained, mean, parts, strict=True):
                        w.copy_(value + part.view_as(w))
                    first = initial_state + sign * change[sum(sizes) :]
                    ends.append(self._twin.replay(first, exogenous, actions, start=start).states[:, 1:])
                differences.append(0.5 * (ends[0] - ends[1]))
        finally:
            for w, value in zip(trained, mean, strict=True):
                w.copy_(value)
        S = torch.stack(differences, -1) @ torch.linalg.pinv(Xi) / step
        return middle, S if initial else S[..., : sum(sizes)]

    def _state_step(self, initial_state: Float[Tensor, "batch n_s"]) -> Float[Tensor, " n_s"]:
        if self._state_spread is not None:
            return self._state_spread
        return self._spread * initial_state.abs().amax(0).clamp_min(1.0)
