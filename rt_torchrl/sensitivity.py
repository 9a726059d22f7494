r"""Forward sensitivities of a trajectory to the closure's weights, :math:`S_k = ds_k/dw_p`.

.. math::
    S_0 = 0, \qquad S_{k+1} = A_kS_k + B_k, \quad
    A_k = \frac{\partial\Phi}{\partial s}(s_k, x_k), \quad B_k = \frac{\partial\Phi}{\partial w}(s_k, x_k)

As in the parallel adjoint, all A_k and B_k are one batched call each; only the linear recurrence is sequential. They
give the gradient, the Gauss-Newton matrix and the Fisher information of an identification. Their cost grows with the
number of weights, that of an adjoint does not: they are for closures of some ten weights.
"""

import torch
from hoptorch.scan import scan
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.compilation import compiled_if
from rt_torchrl.engines.parallel_adjoint import linearise
from rt_torchrl.engines.recurrence import march, march_by_scan
from rt_torchrl.interval import Drive, Interval
from rt_torchrl.plant import Plant
from rt_torchrl.trajectory import drive_of


class Sensitivities:
    """Trajectories under recorded actions with their sensitivities.

    Args:
        plant: the physics.
        closure: its trainable weights are what is varied, flattened in the order of ``parameters()``.
        compiled: compile recurrences and Jacobians.
    """

    def __init__(self, plant: Plant, closure: nn.Module, *, compiled: bool = False):
        self.interval = Interval(plant, closure, None)
        self._march = compiled_if(compiled, march_by_scan, march)
        self._linearise = compiled_if(compiled, linearise)
        self._weight_jacobians = compiled_if(compiled, weight_jacobians)
        self._propagate = compiled_if(compiled, propagate_by_scan, propagate)

    @torch.no_grad()
    def __call__(
        self,
        initial_state: Float[Tensor, "batch n_s"],
        exogenous: Float[Tensor, "batch n n_z"],
        actions: Float[Tensor, "batch n n_a"],
        *,
        start: float | Float[Tensor, " batch"] = 0.0,
    ) -> tuple[Float[Tensor, "batch n n_s"], Float[Tensor, "batch n n_s n_w"]]:
        """States s_1 ... s_n and their sensitivities S_1 ... S_n; ``start`` is the time of s_0 [s]."""
        drive = drive_of(self.interval.plant, exogenous, actions, start=start)
        initial_state = initial_state.clone(memory_format=torch.contiguous_format)
        ends = self._march(self.interval, initial_state, drive)
        starts = torch.cat([initial_state.unsqueeze(0), ends[:-1]])
        names = tuple(name for name, w in self.interval.closure.named_parameters() if w.requires_grad)
        A = self._linearise(self.interval, starts, drive)
        B = self._weight_jacobians(self.interval, names, starts, drive)
        return ends.transpose(0, 1), self._propagate(A, B).transpose(0, 1)


def weight_jacobians(interval: Interval, names: tuple[str, ...], starts: Tensor, drive: Drive) -> Tensor:
    """∂Φ/∂w at every interval, ``n batch n_s n_w``, by n_w forward-mode products."""
    weights = tuple(interval.closure.get_parameter(name) for name in names)
    sizes = [w.numel() for w in weights]
    basis = torch.eye(sum(sizes), dtype=starts.dtype, device=starts.device)

    def end(*values: Tensor) -> Tensor:
        replaced = {f"closure.{name}": value for name, value in zip(names, values, strict=True)}
        return torch.func.functional_call(interval, replaced, (starts, drive))

    def column(direction: Tensor) -> Tensor:
        parts = direction.split(sizes)
        tangents = tuple(part.reshape(w.shape) for part, w in zip(parts, weights, strict=True))
        return torch.func.jvp(end, weights, tangents)[1]

    return torch.func.vmap(column, out_dims=-1)(basis)


def propagate(A: Tensor, B: Tensor) -> Tensor:
    """S_1 ... S_n, ``n batch n_s n_w``, by a loop."""
    sensitivity, found = torch.zeros_like(B[0]), []
    for transition, source in zip(A, B, strict=True):
        sensitivity = transition @ sensitivity + source
        found.append(sensitivity)
    return torch.stack(found)


def propagate_by_scan(A: Tensor, B: Tensor) -> Tensor:
    """The same by one ``scan``, for the compiler."""

    def body(sensitivity, x):
        transition, source = x
        product = (transition.unsqueeze(-1) * sensitivity.unsqueeze(-3)).sum(-2)
        sensitivity = (product + source).contiguous()
        return sensitivity, sensitivity.clone()

    start = torch.zeros_like(B[0], memory_format=torch.contiguous_format)
    return scan(body, start, (A.contiguous(), B.contiguous()))[1]
