"""The classical controller of the drone, which learned policies are compared with."""

import torch

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.plants.shapes import Action, Input, Memory, State


class TrimmedPD(ClassicalController):
    r"""A proportional and derivative law of each axis around the trim in the mean wind.

    .. math::
        A_\phi = A_0 + K_{P,z}\,(z_f - z) - K_{D,z}\,\dot z, \qquad
        \beta_w = \beta_0 - K_{P,x}\,(x_f - x) + K_{D,x}\,\dot x

    with A_0 = 76.74 deg and β_0 = −12.50 deg, the trim in 1 m/s headwind. Like the policies, it does not measure the
    wind. On a drone that observes its position alone, the speeds are those of the filters of the position.

    Gains of 16 deg/m and 16 deg s/m upwards, 23 deg/m and 23 deg s/m forwards give a point mass two poles at 2 rad/s,
    with 0.25 m/s² of lift per degree of A_φ and g of thrust per radian of β_w. From there the simplex of Nelder and
    Mead on twenty gusts finds the default gains, with full stroke until the target is near.
    """

    plant: FlappingWing
    gain_units = {"K_Pz": "deg/m", "K_Dz": "deg s/m", "K_Px": "deg/m", "K_Dx": "deg s/m"}
    default_gains = (571.0, 397.0, 61.5, 44.0)
    trim = (76.74, -12.50)

    def law(self, state: State, memory: Memory, exogenous: Input) -> tuple[Action, Memory]:
        K_Pz, K_Dz, K_Px, K_Dx = self.gains.unbind()
        e_x, e_z = (self.plant.target - state[..., :2]).unbind(-1)
        v_x, v_z = self.plant.seen_velocity(state).unbind(-1)
        amplitude = self.trim[0] + K_Pz * e_z - K_Dz * v_z
        angle = self.trim[1] - K_Px * e_x + K_Dx * v_x
        return torch.stack([amplitude, angle], -1), memory
