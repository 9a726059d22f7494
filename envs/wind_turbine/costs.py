"""What is wanted of the turbine: running costs L_a, each called with the plant, time, state, action and wind."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor

from rt_torchrl.plants.plant import require_weights

if TYPE_CHECKING:
    from rt_torchrl.envs.wind_turbine.plant import WindTurbine


TORQUE_RATE = 15e3
"""Unit of the torque's rate, the greatest rate of the actuator [N m/s]."""


@dataclass(frozen=True, kw_only=True)
class PaperCost:
    r"""The cost ½(α_1 e_1² + α_2 e_P²) with e_P = (τ_g ω_g − P̃)/P_N (paper, eq. control_functional_mb).

    Its reference P̃ = min(P_N, K ω_g³) is 4.06 MW at rated speed, so that its optimum gives away some 15 % of the energy
    that Jonkman's controller makes.

    Args:
        speed: weight α1 of the speed error.
        power: weight α2 of the power error.

    Raises:
        ValueError: if a weight is negative.
    """

    speed: float = 1.0
    power: float = 1.0

    def __post_init__(self) -> None:
        require_weights(self)

    def __call__(
        self,
        plant: "WindTurbine",
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch"]:
        e1 = plant.speed_error(state[..., 1], state[..., 2])
        reference = plant.reference_power(plant.gear_ratio * state[..., 0])
        e_P = (plant.generator_power(state, applied) - reference) / plant.rated_power
        return 0.5 * (self.speed * e1**2 + self.power * e_P**2)


@dataclass(frozen=True, kw_only=True)
class EngineeringCost:
    r"""What the operator of a turbine pays for: energy that is not made, overspeed, and wear of the actuators.

    .. math::
        L_a = w_P\Big(1 - \frac{\min(P, P_r)}{P_r}\Big) + w_X\Big(\frac{(P - P_r)_+}{P_r}\Big)^2
        + w_\omega\Big(\frac{(\omega_g - \omega_{rated})_+}{\gamma_1}\Big)^2
        + w_O\Big(\frac{(\omega_g - \omega_{max})_+}{\gamma_1}\Big)^2
        + w_\beta\Big(\frac{\dot\beta}{1\,\mathrm{deg/s}}\Big)^2
        + w_\tau\Big(\frac{\dot\tau_g}{15\,\mathrm{kN\,m/s}}\Big)^2

    with the power P at the generator shaft, the drivetrain's rated power P_r = 5.297 MW, ω_max = 1.1 ω_rated, and the
    rates of the actions that are applied. Power above rated earns nothing.

    Args:
        energy: weight w_P of the share of rated power that is not made.
        excess: weight w_X of power above rated.
        overspeed: weight w_ω of speed above rated.
        overshoot: weight w_O of speed above 110 % of rated, a soft constraint.
        pitch_rate: weight w_β of the blades' rate.
        torque_rate: weight w_τ of the torque's rate.

    Raises:
        ValueError: if a weight is negative.
    """

    energy: float = 1.0
    excess: float = 1.0
    overspeed: float = 1.0
    overshoot: float = 10.0
    pitch_rate: float = 0.01
    torque_rate: float = 0.01

    def __post_init__(self) -> None:
        require_weights(self)

    def __call__(
        self,
        plant: "WindTurbine",
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch"]:
        share = plant.generator_power(state, applied) / (plant.actions[0].high * plant.rated_generator_speed)
        above = (plant.gear_ratio * state[..., 0] - plant.rated_generator_speed) / plant.speed_error_scale
        beyond = above - 0.1 * plant.rated_generator_speed / plant.speed_error_scale
        torque_rate, pitch_rate = ((applied - state[..., 4:6]) / plant.dt).unbind(-1)
        return (
            self.energy * (1.0 - share.clamp(max=1.0))
            + self.excess * (share - 1.0).clamp(min=0.0) ** 2
            + self.overspeed * above.clamp(min=0.0) ** 2
            + self.overshoot * beyond.clamp(min=0.0) ** 2
            + self.pitch_rate * pitch_rate**2
            + self.torque_rate * (torque_rate / TORQUE_RATE) ** 2
        )
