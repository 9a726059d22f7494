"""The stability of an explicit step."""

from rt_torchrl.plants.integrators import RK4_REAL_STABILITY


def require_stable_step(plant: str, dt: float, rate: float, *, mode: str, remedy: str) -> None:
    """Refuse a step that makes an explicit Runge-Kutta step unstable.

    Args:
        plant: name of the plant, for the message.
        dt: step [s].
        rate: fastest decay rate |Re μ| of the linearised plant [1/s].
        mode: name of the state that decays at that rate, for the message.
        remedy: another remedy than a smaller step, for the message.

    Raises:
        ValueError: if dt·rate exceeds the stability limit of RK4 on the negative real axis, 2.785.
    """
    if dt * rate > RK4_REAL_STABILITY:
        raise ValueError(
            f"dt={dt} s makes plant {plant!r} unstable: {mode} decays at {rate:.4g} 1/s, so dt·rate = {dt * rate:.3g} "
            f"exceeds the limit {RK4_REAL_STABILITY} of an explicit fourth-order Runge-Kutta step. "
            # The share keeps the rounded advice below the limit.
            f"Use dt <= {0.995 * RK4_REAL_STABILITY / rate:.3g} s, or {remedy}."
        )
