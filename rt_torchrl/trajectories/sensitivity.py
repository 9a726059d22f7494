r"""Forward sensitivities of a trajectory to the closure's weights, :math:`S_k = ds_k/dw_p`.

.. math::
    S_0 = 0, \qquad S_{k+1} = A_kS_k + B_k, \quad
    A_k = \frac{\partial\Phi}{\partial s}(s_k, x_k), \quad B_k = \frac{\partial\Phi}{\partial w}(s_k, x_k)

As in the parallel adjoint, a batched call computes all A_k and B_k; only the linear recurrence is sequential. The
sensitivities give the gradient, the Gauss-Newton matrix and the Fisher information of an identification. Their cost
grows with the number of weights, unlike that of an adjoint: they are for closures of up to some hundred weights.
"""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.plant import Plant
from rt_torchrl.trajectories.engines.compilation import compiled_if, marked_dynamic, plain
from rt_torchrl.trajectories.engines.interval import Interval
from rt_torchrl.trajectories.engines.linearisation import linearise, linearise_by_rows, over_all
from rt_torchrl.trajectories.engines.recurrence import march, march_by_scan, march_by_step
from rt_torchrl.trajectories.rollout import drive_of

WIDE = 4
"""Ratio of weights to states above which reverse-mode products for all states are quicker than one for each weight."""


class Sensitivities:
    """Trajectories under recorded actions with their sensitivities.

    Args:
        plant: the physics.
        closure: closure with the trainable weights w_p, flattened in the order of ``parameters()``.
        compiled: compile recurrences and Jacobians, for trajectories that all have the same length.
        compiled_step: compile one interval instead, for trajectories of any length.
    """

    def __init__(self, plant: Plant, closure: nn.Module, *, compiled: bool = False, compiled_step: bool = False):
        self.interval = Interval(plant, closure, None)
        self._march = march_by_step if compiled_step else compiled_if(compiled, march_by_scan, march)
        wide = sum(w.numel() for w in closure.parameters() if w.requires_grad) > WIDE * len(plant.states)
        # The Jacobians by rows are not compiled: the compiler gains little there.
        self._jacobians = linearise_by_rows if wide else compiled_if(compiled, linearise)
        self._propagate = compiled_if(compiled, propagate_by_scan, propagate)

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
        """States s_1 ... s_n and their sensitivities S_1 ... S_n.

        Args:
            initial_state: initial state s_0 of each trajectory.
            exogenous: exogenous inputs z, held over each interval.
            actions: actions, held over each interval.
            start: time of s_0 [s], one for all trajectories or one for each.
            initial: append the n_s columns of ds_k/ds_0.
        """
        drive = drive_of(self.interval.plant, exogenous, actions, start=start)
        initial_state = marked_dynamic(plain(initial_state), 0)
        ends = self._march(self.interval, initial_state, drive)
        starts = torch.cat([initial_state.unsqueeze(0), ends[:-1]])
        names = tuple(name for name, w in self.interval.closure.named_parameters() if w.requires_grad)
        n_s = initial_state.shape[-1]
        A, B = over_all(partial(self._jacobians, self.interval, names), starts, drive).tensor_split([n_s], -1)
        if initial:
            # s_0 acts like weights that are used in the first interval alone.
            B = torch.cat([B, torch.cat([A[:1], torch.zeros_like(A[1:])])], -1)
        return ends.transpose(0, 1), self._propagate(A, B).transpose(0, 1)


def propagate(A: Tensor, B: Tensor) -> Tensor:
    """The sensitivities S_1 ... S_n, ``n batch n_s n_w``, by a loop."""
    sensitivity, found = torch.zeros_like(B[0]), []
    for transition, source in zip(A, B, strict=True):
        sensitivity = transition @ sensitivity + source
        found.append(sensitivity)
    return torch.stack(found)


def propagate_by_scan(A: Tensor, B: Tensor) -> Tensor:
    """The sensitivities of :func:`propagate` by one ``scan``, for the compiler."""
    from hoptorch.scan import scan  # here, because it takes seconds to load and only the compiler needs it

    def body(sensitivity: Tensor, x: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        transition, source = x
        product = (transition.unsqueeze(-1) * sensitivity.unsqueeze(-3)).sum(-2)
        sensitivity = (product + source).contiguous()
        return sensitivity, sensitivity.clone()

    start = torch.zeros_like(B[0], memory_format=torch.contiguous_format)
    return scan(body, start, (A.contiguous(), B.contiguous()))[1]
