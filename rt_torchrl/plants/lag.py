r"""First-order lags of recorded signals, such as the filters of a controller.

A lag :math:`T\dot{\hat y} = y - \hat y` under a held input follows

.. math:: \hat y_{k+1} = e^{-\Delta t/T}\hat y_k + (1 - e^{-\Delta t/T})\,\bar y_k
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def between(values: Float[Tensor, " samples"]) -> Float[Tensor, " n"]:
    """The mean of the values at both ends of every interval."""
    return 0.5 * (values[1:] + values[:-1])


def lag(start: Tensor, driving: Float[Tensor, " n"], steps: float) -> Float[Tensor, " samples"]:
    """A first-order lag from ``start``; ``steps`` is dt over its time constant."""
    from scipy.signal import lfilter  # imported here: loading takes a second, and only logs need it

    decay = math.exp(-steps)
    ends, _ = lfilter([1.0 - decay], [1.0, -decay], driving.numpy(), zi=[decay * start.item()])
    return torch.cat([start.reshape(1), torch.from_numpy(ends)])
