r"""What to do next: the manoeuvres whose records would tell most about the weights.

A record of a manoeuvre m adds the Fisher information F_m of the weights, what its unknown initial state takes away
included. The next manoeuvre is the one with the greatest gain

.. math:: \ln\det(F + F_m) - \ln\det F

(D-optimality): it makes the volume of the confidence region of all weights smallest. No reading is needed, because to
first order the information does not depend on what is read.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rt_torchrl.fit.least_squares import Estimation
from rt_torchrl.fit.likelihood import Likelihood
from rt_torchrl.fit.record import SensorRecord, sensor_record
from rt_torchrl.fit.uncertainty import inverse_information
from rt_torchrl.trajectories.trajectory import Trajectory

LEAST_INFORMATION = 1e-12
"""Information of a weight, as a share of the greatest one, that stands for none."""


class Choice(NamedTuple):
    """A manoeuvre that is to be flown: its name, its gain, and the standard errors of the weights after it.

    An error is infinite where neither this manoeuvre nor what was known before says anything of the weight.
    """

    name: str
    gain: float
    errors: Float[Tensor, " n_w"]


def weight_information(likelihood: Likelihood) -> Float[Tensor, "n_w n_w"]:
    r"""Information of the weights, of which the initial states and biases have taken their part.

    .. math:: F = H_{ww} - H_{wn}H_{nn}^{-1}H_{nw}
    """
    H, n = likelihood.normal_equations().matrix, likelihood.weight_count
    cross, own = H[:n, n:], H[n:, n:]
    return H[:n, :n] - cross @ inverse_information(own).matrix @ cross.T


def next_manoeuvres(
    estimation: Estimation,
    manoeuvres: Mapping[str, Trajectory],
    noise: Float[Tensor, " n_y"],
    *,
    count: int = 1,
    known: Sequence[SensorRecord] = (),
) -> list[Choice]:
    """The manoeuvres to fly, best first; one may come several times.

    Args:
        estimation: twin and sensors; the twin's present weights are what is believed.
        manoeuvres: actions and inputs of each manoeuvre, by name, with the state that it begins in as first state;
            its other states are not used.
        noise: noise level of every sensor.
        count: number of manoeuvres to choose.
        known: records that there are already.

    Raises:
        ValueError: if there is no manoeuvre, or ``count`` is below 1; DivergenceError if the twin diverges in one.
    """
    if not manoeuvres or count < 1:
        raise ValueError(f"manoeuvres={list(manoeuvres)}, count={count}: there must be one of each at least.")

    def of(records: Sequence[SensorRecord]) -> Tensor:
        return weight_information(estimation.likelihood(records, noise))

    found = {name: of([sensor_record(estimation.twin.plant, estimation.sensors, m)]) for name, m in manoeuvres.items()}
    size = torch.stack([F.diagonal() for F in found.values()]).sum(0)
    least = torch.diag(LEAST_INFORMATION * size.clamp_min(1e-300))  # so that weights that nothing shows are no obstacle
    told = of(known) if known else torch.zeros_like(least)
    chosen: list[Choice] = []
    while len(chosen) < count:
        gains = {name: volume(least + told + F) - volume(least + told) for name, F in found.items()}
        name = max(gains, key=lambda one: gains[one])
        told = told + found[name]
        chosen.append(Choice(name, gains[name], _errors(told)))
    return chosen


def _errors(F: Tensor) -> Tensor:
    """Standard errors of the weights by their information; infinite for those of which it says nothing."""
    inverse = inverse_information(F)
    each = torch.eye(len(F), dtype=F.dtype, device=F.device)
    return torch.where(inverse.unknown(each), math.inf, inverse.matrix.diagonal().sqrt())


def volume(F: Tensor) -> float:
    """ln det F, by a scaling to unit diagonal that keeps weights of any size apart from rounding."""
    unit = F.diagonal().sqrt()
    values = torch.linalg.eigvalsh(F / torch.outer(unit, unit)).clamp_min(LEAST_INFORMATION)
    return 2.0 * float(unit.log().sum()) + float(values.log().sum()) if unit.isfinite().all() else math.nan
