r"""Forward sensitivities of a trajectory to the closure's weights, :math:`S_k = ds_k/dw_p`.

.. math::
    S_0 = 0, \qquad S_{k+1} = A_kS_k + B_k, \quad
    A_k = \frac{\partial\Phi}{\partial s}(s_k, x_k), \quad B_k = \frac{\partial\Phi}{\partial w}(s_k, x_k)

The engine ``native`` runs this recurrence as a part of the trajectory's. The sensitivities give the gradient, the
Gauss-Newton matrix and the Fisher information of an identification. Their cost grows with the number of weights, unlike
that of an adjoint: they are for closures of up to some hundred weights.
"""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Actions, Inputs, Start, Starts
from rt_torchrl.trajectories.engines import Native
from rt_torchrl.trajectories.engines.interval import Drive, Interval, with_weights
from rt_torchrl.trajectories.engines.parallel import linearise_by_rows, over_all
from rt_torchrl.trajectories.rollout import drive_of

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
        held = dict(self.interval.closure.named_parameters())
        weights = {f"closure.{name}": held[name] for name in self.names}
        t = drive.t.expand(s.shape[:1])

        def end(values: dict[str, Tensor], s: Tensor, *drive: Tensor) -> Tensor:
            return with_weights(self.interval, values, s, Drive(*drive))

        jacobians = torch.func.vmap(torch.func.jacrev(end, argnums=(0, 1)), in_dims=(None, 0, 0, 0, 0))
        by_weights, A = jacobians(weights, s, t, drive.exogenous, drive.command)
        # A weight may be one number, of no dimension.
        sources = [jacobian.reshape(*A.shape[:2], -1) for jacobian in by_weights.values()]
        # s_0 acts like weights that are used in the first interval alone.
        unused = S.shape[-1] - sum(part.shape[-1] for part in sources)
        B = torch.cat([*sources, s.new_zeros(*s.shape, unused)], -1)
        return torch.cat([self.interval(s, drive), (A @ S + B).flatten(1)], -1)


class Sensitivities:
    """Trajectories under recorded actions with their sensitivities.

    Args:
        plant: the physics.
        closure: closure with the trainable weights w_p, flattened in the order of ``parameters()``.
    """

    def __init__(self, plant: Plant, closure: nn.Module):
        self.interval = Interval(plant, closure, None)
        self._tangent = TangentInterval(self.interval, self._trained())
        self._engine = Native(compiled=False)

    @torch.no_grad()
    def __call__(
        self, initial_state: Starts, exogenous: Inputs, actions: Actions, *, start: Start = 0.0, initial: bool = False
    ) -> tuple[Float[Tensor, "batch n n_s"], Float[Tensor, "batch n n_s n_w"]]:
        """States s_1 ... s_n and their sensitivities S_1 ... S_n.

        Args:
            initial_state: initial state s_0 of each trajectory.
            exogenous: exogenous inputs z, held over each interval.
            actions: actions, held over each interval.
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
        state, found = torch.cat([initial_state, S.flatten(1)], -1), None
        if S.shape[-1] <= WIDE:
            found = self._engine.own_end_states(self._tangent, state, drive)
        if found is not None:
            ends, S_ends = found.split([n_s, n_s * S.shape[-1]], -1)
            S_ends = S_ends.unflatten(-1, S.shape[1:])
        else:
            ends = self._engine.end_states(self.interval, initial_state, drive)
            S_ends = self._propagated(S, torch.cat([initial_state.unsqueeze(0), ends[:-1]]), drive)
        return ends.transpose(0, 1), S_ends.transpose(0, 1)

    def _trained(self) -> tuple[str, ...]:
        """Names of the closure's trained weights."""
        return tuple(name for name, w in self.interval.closure.named_parameters() if w.requires_grad)

    def _propagated(self, S: Tensor, starts: Tensor, drive: Drive) -> Tensor:
        """The sensitivities S_1 ... S_n, ``n batch n_s n_w``, from the Jacobians of all intervals at once."""
        jacobians = over_all(partial(linearise_by_rows, self.interval, self._trained()), starts, drive)
        A, B = jacobians.tensor_split([starts.shape[-1]], -1)
        unused, found = S.shape[-1] - B.shape[-1], []
        for transition, source in zip(A, B, strict=True):
            S = transition @ S + torch.nn.functional.pad(source, (0, unused))
            found.append(S)
        return torch.stack(found)
