"""Classical controllers of the tank's vent, which learned policies are compared with."""

import torch

from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.envs.cryogenic_tank.plant import GREATEST_DROP, CryogenicTank
from rt_torchrl.plants.shapes import Action, Input, Memory, State


class OnOffValve(ClassicalController):
    r"""A hysteresis valve that opens to a fixed drop above :math:`\tilde p + h` and shuts below :math:`\tilde p - h`.

    The valve starts shut. h = 1 kPa is not tuned: a narrower band always lowers J_a a little, but wears the valve out.
    The drop is tuned: the simplex of Nelder and Mead on twenty loads leaves it where it starts, at the end of the
    range.
    """

    plant: CryogenicTank
    gain_units = {"opening": "Pa"}
    default_gains: tuple[float, ...] = (GREATEST_DROP,)
    half_band = 1e3  # h [Pa]
    memory_size = 1

    def law(self, state: State, memory: Memory, exogenous: Input) -> tuple[Action, Memory]:
        error = state[..., 2:] - self.plant.set_point
        is_open = torch.where(error > self.half_band, 1.0, torch.where(error < -self.half_band, 0.0, memory))
        return self.plant.action_of(is_open * self.gains[0]), is_open


class PIValve(ClassicalController):
    r"""A proportional and integral law of the pressure error, with an integral that stops where the valve saturates.

    .. math:: \Delta p_V = K_P\,(p - \tilde p) + K_I\int(p - \tilde p)\,dt

    K_P = 7.7 and K_I = 4.5e-5/s give a time constant of τ = 12 h and K_I = K_P/(4τ): an open valve takes up 1.3 W per
    kPa of drop, and 1 W raises the pressure of the tank at the start by 8.3 Pa/h. From there the simplex of Nelder and
    Mead on twenty loads finds the default gains, a tenfold gain and almost no integral. A load of
    129 W is then held 1 kPa above the target, and an integral would only overshoot after starts that are 25 kPa off.
    """

    plant: CryogenicTank
    gain_units = {"K_P": "-", "K_I": "1/s"}
    default_gains = (77.5, 6.1e-10)
    memory_size = 1

    def law(self, state: State, memory: Memory, exogenous: Input) -> tuple[Action, Memory]:
        K_P, K_I = self.gains.unbind()
        error = state[..., 2:] - self.plant.set_point
        # The contribution of the integral to the drop stays within the range of the valve.
        integral = (memory + K_I * error * self.plant.dt).clamp(0.0, GREATEST_DROP)
        return self.plant.action_of(K_P * error + integral), integral
