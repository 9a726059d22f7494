"""The two wings of the drone, as blade elements along their span."""

import math

import numpy as np
import torch
from torch import Tensor, nn


class Wings(nn.Module):
    r"""Two wings with a chord that is a quarter ellipse along the span, and the forces on them.

    With r = R_0 + R sin θ the chord c(r) = (4c̄/π)√(1 − ((r − R_0)/R)²) is (4c̄/π) cos θ, and c dr is (4c̄R/π) cos²θ dθ.
    It is smooth up to the tip, where c(r) itself has an infinite slope: six Gauss nodes suffice.

    Args:
        root: distance R_0 of the root from the flapping axis [m].
        length: length R of a wing [m].
        mean_chord: mean chord c̄ [m].
        nodes: number of blade elements.
        air_density: density ρ of the air [kg/m³].
        smallest_airspeed: floor ε of the airspeed |U| of an element [m/s].
    """

    radius: Tensor
    """Distances r_j of the elements from the flapping axis [m]."""
    strip_mass: Tensor
    """Weights ρ c(r_j) dr_j of the elements of both wings [kg/m]."""

    def __init__(
        self,
        *,
        root: float,
        length: float,
        mean_chord: float,
        nodes: int,
        air_density: float,
        smallest_airspeed: float,
    ):
        super().__init__()
        self.smallest_airspeed = smallest_airspeed
        places, weights = np.polynomial.legendre.leggauss(nodes)
        theta = torch.from_numpy(0.25 * math.pi * (places + 1.0))
        area = 4.0 * mean_chord * length / math.pi * theta.cos() ** 2
        self.register_buffer("radius", root + length * theta.sin())
        # The two wings have ½ρ c dr each.
        self.register_buffer("strip_mass", air_density * area * 0.25 * math.pi * torch.from_numpy(weights))

    def force(
        self, v_x: Tensor, v_z: Tensor, phi_dot: Tensor, alpha: Tensor, closure: nn.Module
    ) -> tuple[Tensor, Tensor]:
        r"""Forces F_x and F_z [N] of both wings in the flapping frame, paper eqs. (drone_eq_lift) to (drone_eq_Cdrag).

        .. math::
            \begin{pmatrix}F_x\\F_z\end{pmatrix} = \int\rho\,c(r)\,|U|\left[-C_D\begin{pmatrix}U_x\\U_z\end{pmatrix}
            + C_L\begin{pmatrix}-U_z\\U_x\end{pmatrix}\right]dr, \quad U_x = v_x - \dot\phi r,\; U_z = v_z

        Only the coefficients need the wing frame, (U_ξ, U_ζ) = R_2(α)(U_x, U_z): in every frame drag lies along the
        velocity and lift a quarter turn ahead of it. The flow along the span carries no force and is dropped.

        Note: the paper prints R_2(α) with the sign of R_2(β_w); here it has the opposite sign, [[cos, −sin], [sin,
        cos]] in (x, z), because with the printed sign the lift points downwards on both half-strokes.
        Note: |U| is √(U_x² + U_z² + ε²), which keeps direction and slope finite where the wing meets still air.

        Args:
            v_x: velocity of the root to the air along x of the flapping frame [m/s].
            v_z: velocity of the root to the air along z of the flapping frame [m/s].
            phi_dot: flapping rate φ̇ [rad/s].
            alpha: pitch α of the wings about their span [rad].
            closure: closure from (sin α_e, cos α_e) to C_L and C_D [-] of a blade element.
        """
        U_x, U_z = v_x.unsqueeze(-1) - phi_dot.unsqueeze(-1) * self.radius, v_z.unsqueeze(-1)
        sin_alpha, cos_alpha = torch.sin(alpha).unsqueeze(-1), torch.cos(alpha).unsqueeze(-1)
        U_xi, U_zeta = cos_alpha * U_x - sin_alpha * U_z, sin_alpha * U_x + cos_alpha * U_z
        speed = torch.sqrt(U_x**2 + U_z**2 + self.smallest_airspeed**2)
        C_L, C_D = closure(torch.stack([U_xi / speed, U_zeta / speed], -1)).unbind(-1)
        pressure = self.strip_mass * speed
        return (
            -(pressure * (C_D * U_x + C_L * U_z)).sum(-1),
            (pressure * (C_L * U_x - C_D * U_z)).sum(-1),
        )
