r"""The turbine with the signals that a classical controller has: rotor speed, its rate, and the pitch of the blades."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.envs.wind_turbine.gain_scheduled import GainScheduled
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.plants.signal import Signal


class InstrumentedTurbine(WindTurbine):
    r"""A :class:`WindTurbine` with observations beyond the speed error.

    A policy has no memory. The plant therefore holds the memory of a PI law: the pitch that was applied last is its
    integral, and a faster low-pass of the generator speed with Jonkman's corner frequency ω_c = 0.25 Hz gives the rate,

    .. math:: \dot\omega_F = \omega_c(\omega_g - \omega_F)

    ====  ========================  ==========================================  =====  =================
    kind  name                      symbol                                      unit   range
    ====  ========================  ==========================================  =====  =================
    s     fast_generator_speed      :math:`\omega_F`, after the other six       rad/s  positive
    e     speed_above_rated         :math:`(\omega_F - \omega_{rated})/\gamma_1`  -    about [-2, 1]
    e     speed_rate                :math:`(\omega_g - \omega_F)/\gamma_1`      -      about [-0.2, 0.2]
    e     pitch                     :math:`\beta/30` deg, applied last          -      0 ... 1
    ====  ========================  ==========================================  =====  =================

    Costs, actuators and the other signals are those of :class:`WindTurbine`.
    """

    fast_filter = 1.570796  # ω_c [rad/s], CornerFreq of the reference controller

    states = (
        *WindTurbine.states,
        Signal(symbol=r"\omega_F", name="fast_generator_speed", unit="rad/s"),
    )
    controller_states = tuple(signal.name for signal in states[1:])
    observations = (
        *WindTurbine.observations,
        Signal(symbol=r"e_\omega", name="speed_above_rated", unit="-", low=-2.0, high=1.0),
        Signal(symbol=r"e_{\dot\omega}", name="speed_rate", unit="-", low=-0.2, high=0.2),
        Signal(symbol=r"e_\beta", name="pitch", unit="-", low=0.0, high=1.0),
    )

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        action: Float[Tensor, "*batch 2"],
        exogenous: Float[Tensor, "*#batch 1"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        rate = super().vector_field(t, state[..., :6], action, exogenous, closure)
        fast = self.fast_filter * (self.gear_ratio * state[..., 0] - state[..., 6])
        return torch.cat([rate, fast.unsqueeze(-1)], -1)

    def latch(
        self, state: Float[Tensor, "*batch n_s"], applied: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch n_s"]:
        return torch.cat([state[..., :4], applied, state[..., 6:]], -1)

    def observe(
        self, t: Float[Tensor, "*#batch"], state: Float[Tensor, "*batch n_s"], exogenous: Float[Tensor, "*#batch 1"]
    ) -> Float[Tensor, "*batch 5"]:
        errors = super().observe(t, state, exogenous)
        above = (state[..., 6] - self.rated_generator_speed) / self.speed_error_scale
        rate = (self.gear_ratio * state[..., 0] - state[..., 6]) / self.speed_error_scale
        pitch = state[..., 5] / self.actions[1].high
        return torch.cat([errors, torch.stack([above, rate, pitch], -1)], -1)

    def controller_start(
        self, measured: Float[Tensor, "*batch 1"], exogenous: Float[Tensor, "*batch 1"]
    ) -> Float[Tensor, "*batch 6"]:
        """The start of a :class:`WindTurbine`, and a settled fast filter."""
        return torch.cat([super().controller_start(measured, exogenous), self.gear_ratio * measured], -1)

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        state = super().draw_initial_state(batch, generator)
        return torch.cat([state, self.gear_ratio * state[:, :1]], -1)

    def make_policy(self, generator: torch.Generator, *, bias: bool = False) -> nn.Module:
        """A gain-scheduled law whose gains start too large or too small by a factor of up to 2.

        Raises:
            ValueError: if ``bias`` is true, because this law has no bias.
        """
        if bias:
            raise ValueError(f"bias={bias} must be False: a gain-scheduled law has no bias. Take WindTurbine for one.")
        return GainScheduled(self, generator=generator)
