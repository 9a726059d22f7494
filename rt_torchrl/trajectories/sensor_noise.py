r"""White noise of sensors: how much of it real episodes hold, and flights of a twin whose policy meets it.

A sensor reads :math:`y_k = s_k + n_k`. Policies act on readings, and the cost of a real episode is one of readings, so
that an episode may cost more than a right twin says of it. The increments that a right twin misses are

.. math:: e_k = y_{k+1} - \Phi(y_k, a_k, z_k) \approx n_{k+1} - A_k n_k, \qquad A_k = \partial\Phi/\partial s

Neighbours of them are alike by :math:`E[e_k n_k^\top] = -A_k\Sigma`, with the diagonal Σ of the variances of the noise,
which what the twin lacks is not: it is smooth, or new in each interval. Least squares over all of them give

.. math:: \sigma_j^2 = -\sum_k e_{k-1,j}\,A_{k,j}^\top We_k \Big/ \sum_k A_{k,j}^\top WA_{k,j}

with the column :math:`A_{k,j}` and the weights W, one over the mean square of each increment. A sensor whose
increments are mostly something else has none.

Source: Odelson, Rajamani, Rawlings, Automatica 42 (2006) 303, who estimate covariances of noise by autocovariances.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from rt_torchrl.plants.plant import Transition, with_memories
from rt_torchrl.plants.shapes import Action, Input, State, Time
from rt_torchrl.plants.signal import differences
from rt_torchrl.trajectories.anchored import FurtherInputs
from rt_torchrl.trajectories.trajectory import Trajectory
from rt_torchrl.trajectories.twin import DigitalTwin

SHIFT = 1e-4
"""Step of the differences that give A, as a share of the scatter of each reading."""

MOST = 0.5
"""Share of the mean square of increments that noise explains of a sensor that has some."""


class NoisySensors(FurtherInputs):
    """A plant whose sensors read s + n; its inputs are those of the plant, and n, white or not.

    Policies, memories and running costs get readings; actuators, the system and the end of an episode true states.

    Args:
        base: the plant of a twin.
    """

    symbol, kind = "n", "noise"

    def read(self, state: State, exogenous: Input) -> State:
        """The state with the noise of the sensors; what no sensor reads has none."""
        noise = exogenous[..., self.count :]
        return state + functional.pad(noise, (0, state.shape[-1] - noise.shape[-1]))

    def step(self, t: Time, state: State, command: Action, exogenous: Input, closure: torch.nn.Module) -> Transition:
        inputs = exogenous[..., : self.count]
        end, applied = self.base.step(t, state, command, inputs, closure)
        return Transition(with_memories(self.base, end, t, self.read(state, exogenous), inputs), applied)

    def ask(self, part: str, method: str, arguments: dict[str, Any]) -> Any:
        if {"state", "exogenous"} <= arguments.keys():
            arguments["state"] = self.read(arguments["state"], arguments["exogenous"])
        return super().ask(part, method, arguments)


@torch.no_grad()
def noise_levels(twin: DigitalTwin, records: Sequence[Trajectory]) -> Float[Tensor, " n_r"]:
    """Standard deviation σ of the white noise of each sensor, zero where increments show none.

    Only three measured samples in a row tell something.

    Args:
        twin: the twin, fitted to the records.
        records: what sensors have read in real episodes, and what was applied.

    Raises:
        DivergenceError: if the twin diverges within an interval that begins with what was read.
    """
    signals, earlier, later, slopes = twin.plant.readings, list[Tensor](), list[Tensor](), list[Tensor]()
    for record in records:
        sizes = SHIFT * record.states.std(0)
        shifts = torch.cat([torch.zeros_like(sizes)[None], sizes.diag()])
        ends = twin.followed_from(record, shifts)[1:, :, : len(signals)]
        missed = differences(signals, record.states[1:], ends[:, 0])
        slope = differences(signals, ends[:, 1:], ends[:, :1]) / sizes[:, None]  # of the second index by the first
        seen = torch.ones_like(record.states[:, 0], dtype=torch.bool) if record.seen is None else record.seen
        measured = seen[:-2] & seen[1:-1] & seen[2:]
        earlier.append(missed[:-1][measured])
        later.append(missed[1:][measured])
        slopes.append(slope[1:][measured].nan_to_num(posinf=0.0, neginf=0.0))
    e, following, A = torch.cat(earlier), torch.cat(later), torch.cat(slopes)
    squares = following.square().mean(0)
    weighted = A * squares.reciprocal().nan_to_num(posinf=0.0)
    products = -(e * (weighted * following.unsqueeze(1)).sum(-1)).sum(0)
    variances = (products / (weighted * A).sum((0, 2))).nan_to_num().clamp_min(0.0)
    explained = variances + variances @ A.square().mean(0)
    return torch.where(explained > MOST * squares, variances, 0.0).sqrt()
