r"""The Cascaded Tanks benchmark as a plant: a pump fills the upper tank, which drains into the lower one."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.cascaded_tanks.closures import Hydraulics, NeuralHydraulics, ramp
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Action, Actions, Cost, Input, Inputs, State, States, Time
from rt_torchrl.plants.signal import Measurement, Signal

STATES = (
    Signal(symbol="h_1", name="upper_level", unit="V"),
    Signal(symbol="h_2", name="lower_level", unit="V"),
)
PUMP = Signal(symbol="u", name="pump_voltage", unit="V", low=0.0, high=7.0)
WANTED = Signal(symbol="r", name="set_point", unit="V", low=0.0, high=10.0)
PUMP_WEIGHT = 0.01
"""Weight in J_a of the squared voltage from 3 V."""
GREATEST_READING = 10.0
"""Reading of the level sensor at its end [V]."""


def sensed_level(plant: Plant, t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """The level of the lower tank as its sensor gives it, which ends at 10 V."""
    return state[..., 1].clamp(max=GREATEST_READING)


def level_error(plant: Plant, t: Tensor, state: Tensor, exogenous: Tensor) -> Tensor:
    """What is missing to the set point [V]."""
    return exogenous[..., 0] - state[..., 1]


class CascadedTanks(Plant):
    r"""Two tanks, of which a sensor reads the lower one; levels are in volts of that sensor.

    .. math::
        \dot h_1 = q_0(u) - q_1 - q_o, \qquad \dot h_2 = q_1 + e\,q_o - q_2 - c\,w\ln\big(1 + e^{(h_2 - 10)/w}\big)

    The scale of the upper level is that of equal tanks: a volt of it is as much water as a volt of the lower level. The
    flows are those of :class:`Hydraulics`. The last term is the overflow of the lower tank at 10 V.

    ====  =============  =========================================  =====  ==========
    kind  name           symbol                                     unit   range
    ====  =============  =========================================  =====  ==========
    s     upper_level    :math:`h_1`, no sensor in the benchmark    V      about 0 … 60
    s     lower_level    :math:`h_2`                                V      0 … 10
    a     pump_voltage   :math:`u`                                  V      0 … 7
    z     set_point      :math:`r`, of the lower level              V      0 … 10
    e     level_error    :math:`(r - h_2)/2`                        -      about ±3
    e     lower_level    :math:`(h_2 - 5)/2`                        -      about ±2.5
    e     upper_level    :math:`(h_1 - 20)/10`                      -      about ±2
    e     set_point      :math:`(r - 5)/2`                          -      about ±2.5
    ====  =============  =========================================  =====  ==========

    The table shows the first set of observations; ``observe`` chooses others.

    Args:
        dt: control interval [s]; the benchmark's is 4.
        horizon: length of an episode T_o [s].
        closure: closure of the real tanks, from (h_1, h_2, u) to the rates of the levels; None for hydraulics as they
            were identified from the benchmark.
        observe: names of measurements and observation sets.

    Raises:
        ValueError: if there is no such measurement.

    Source: Schoukens and Noël, Three benchmarks addressing open challenges in nonlinear system identification, IFAC
    2017.
    """

    name = "cascaded_tanks"
    states = STATES
    actions = (PUMP,)
    inputs = (WANTED,)
    measurements = (
        Measurement(symbol="e", name="level_error", unit="V", low=-10.0, high=10.0, read=level_error, scale=2.0),
        Measurement.of(STATES[1], offset=5.0, scale=2.0),
        Measurement.of(STATES[0], offset=20.0, scale=10.0),
        Measurement.of(WANTED, offset=5.0, scale=2.0),
        Measurement(symbol="y", name="sensed_level", unit="V", high=10.0, read=sensed_level, offset=5.0, scale=2.0),
    )
    observation_sets = {
        "levels": ("level_error", "lower_level", "upper_level", "set_point"),
        "measured": ("level_error", "sensed_level", "set_point"),
    }

    def __init__(
        self,
        *,
        dt: float = 4.0,
        horizon: float = 2048.0,
        closure: nn.Module | None = None,
        observe: Sequence[str] = (),
    ):
        law = Hydraulics.true() if closure is None else closure
        super().__init__(dt=dt, horizon=horizon, closure=law, observe=observe)

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        """Rates of the levels.

        Args:
            t: time [s], unused.
            state: upper and lower level [V].
            action: pump voltage [V].
            exogenous: set point [V], which does not act.
            closure: closure from levels and voltage to the rates [V/s].
        """
        rates = closure(torch.cat([state, action], -1))
        over = Hydraulics.overflow_rate * ramp(state[..., 1] - GREATEST_READING, Hydraulics.overflow_band)
        return torch.stack([rates[..., 0], rates[..., 1] - over], -1)

    def running_cost(self, t: Time, state: State, applied: Action, exogenous: Input) -> Cost:
        """The squared error of the lower level [V²], and a little of the squared voltage."""
        error = state[..., 1] - exogenous[..., 0]
        return error**2 + PUMP_WEIGHT * (applied[..., 0] - 3.0) ** 2

    discrepancy_scales = (math.inf, 1.0)
    """L_p is half the squared error of the lower level [V²]."""

    def merit(self, states: States, applied: Actions, exogenous: Inputs) -> dict[str, Float[Tensor, " batch"]]:
        """RMS error of the lower level."""
        error = states[:, 1:, 1] - exogenous[..., 0]
        return {"RMS level error [V]": error.square().mean(-1).sqrt()}

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} 2"]:
        """Levels between 10 and 30 V above, and between 3 and 8 V below."""
        share = torch.rand(batch, 2, generator=generator, dtype=torch.float64, device=generator.device)
        low, width = share.new_tensor([10.0, 3.0]), share.new_tensor([20.0, 5.0])
        return low + width * share

    def draw_exogenous(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_steps 1"]:
        """A set point between 3.5 and 8 V that jumps every 64 intervals."""
        jumps = -(-self.n_steps // 64)
        level = torch.rand(batch, jumps, 1, generator=generator, dtype=torch.float64, device=generator.device)
        return 3.5 + 4.5 * level.repeat_interleave(64, 1)[:, : self.n_steps]

    def make_closure(self, generator: torch.Generator) -> Hydraulics:
        """Hydraulics that are some 20 % to 50 % off; nothing is drawn."""
        guess = (0.05, 0.008, 0.08, 0.005, 20.0, 0.8)
        return Hydraulics(torch.tensor(guess, dtype=torch.float64, device=generator.device))

    def make_neural_closure(self, generator: torch.Generator, hidden: Sequence[int]) -> nn.Module:
        """The same hydraulics with a perceptron."""
        return NeuralHydraulics(self.make_closure(generator), hidden=hidden, generator=generator)
