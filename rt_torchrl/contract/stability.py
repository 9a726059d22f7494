"""A check that the explicit Runge-Kutta step is stable for the fastest decay of the plant."""

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from rt_torchrl.contract.calls import Arguments, Calls
from rt_torchrl.plants.plant import Plant

GROWTH = 1.0 + 1e-6
"""Factor per step above which a decaying mode counts as growing; that of an undamped mode is 1 to rounding."""
MANY = 20


@torch.no_grad()
def stability(calls: Calls) -> Iterator[str]:
    r"""A violation if a mode that decays in the plant grows in a step: |R(μΔt)| ≤ 1 must hold where Re μ ≤ 0.

    R(z) = 1 + z + z²/2 + z³/6 + z⁴/24 reaches its limit at 2.785 on the negative real axis and at 2.83 on the imaginary
    axis. A plant with a scheme of its own is not checked, because this R does not describe that scheme.
    """
    plant, arguments = calls.plant, calls.some(MANY)
    if plant.own_scheme:
        return
    for whose, closure in (("the true closure", plant.closure), ("the closure of make_closure", calls.closure)):
        mu = torch.linalg.eigvals(jacobian(plant, closure, arguments))
        decays = mu.real <= 1e-9 * mu.abs()
        growth = torch.where(decays, amplification(mu * plant.dt), 0.0)
        if growth.max() > GROWTH:
            k, b, mode = (growth == growth.max()).nonzero()[0].tolist()
            worst = mu[k, b, mode]
            yield (
                f"dt: {plant.dt:g} s is too long for the eigenvalue {worst:.4g} 1/s of the vector field under {whose}, "
                f"|eigenvalue|·dt = {worst.abs() * plant.dt:.3g}, at state {arguments['state'][k, b].tolist()}: it "
                f"decays, but grows {growth.max():.3g} times in a Runge-Kutta step. Use dt <= "
                f"{stable_step(worst, plant.dt):.3g} s, or treat that mode as settled at once."
            )
            return


def jacobian(plant: Plant, closure: nn.Module, arguments: Arguments) -> Tensor:
    """∂f/∂s at every time and episode, ``n batch n_s n_s``, by central differences: no gradient is trusted yet."""
    t, state, applied, exogenous = (arguments[name] for name in ("t", "state", "applied", "exogenous"))
    size = 1e-6 * (1e-3 + state.abs().amax((0, 1)))
    columns = []
    for shift in torch.diag(size):
        ends = [plant.vector_field(t, state + sign * shift, applied, exogenous, closure) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * shift.sum()))
    return torch.stack(columns, -1)


def amplification(z: Tensor) -> Tensor:
    """The factor |R(z)| of a four-stage Runge-Kutta step of fourth order."""
    return (1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))).abs()


def stable_step(mu: Tensor, dt: float) -> float:
    """The longest step, to 5 %, in which a mode that decays does not grow."""
    while amplification(mu * dt) > GROWTH:
        dt *= 0.95
    return dt
