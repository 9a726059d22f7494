r"""The exact solution of the wall's own equation over a control interval."""

import torch
from jaxtyping import Float
from torch import Tensor


def wall_rise(
    superheat: Float[Tensor, "*batch"],
    load: Float[Tensor, "*#batch"],
    conductance: Float[Tensor, "*batch"],
    heat_capacity: float,
    dt: float,
) -> Float[Tensor, "*batch"]:
    r"""Rise T_s(t + Δt) − T_s(t) [K] of :math:`C\dot T_s = Q_h - G\,(T_s - T)` with T and G held,

    .. math:: \big(Q_h/G - (T_s - T)\big)\,\big(1 - e^{-G\Delta t/C}\big).

    Args:
        superheat: superheat T_s − T at the start [K].
        load: heat load Q_h [W].
        conductance: conductance G = U_s A_s [W/K].
        heat_capacity: heat capacity C = m_s c_s [J/K].
        dt: length Δt of the interval [s].
    """
    return -torch.expm1(-conductance * dt / heat_capacity) * (load / conductance - superheat)
