"""Sensors that read with an offset, and inputs of which they read a part."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rt_torchrl.plants.extension import Extension, replaced
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.shapes import Action, Hidden, Input, State, Time
from rt_torchrl.plants.signal import Signal, place_of


class SensorErrors(nn.Module):
    """Offset b_0 and drift ḃ of a sensor, as weights in units of a scale.

    Args:
        state: name of the state that is read.
        unit: its unit.
        scale: size of an offset that counts as one, in the unit of the state.
        duration: time in which a drift of one reaches that size [s].
        offset, drift: the offset, and the drift per second.
    """

    def __init__(self, state: str, unit: str, scale: float, duration: float, *, offset: float, drift: float):
        super().__init__()
        self.scale, self.duration = scale, duration
        self.names = {f"{state}_offset": unit, f"{state}_drift": f"{unit}/s"}
        self.meanings = {f"{state}_offset": "offset of the sensor", f"{state}_drift": "drift of the sensor"}
        self.weights = nn.Parameter(torch.tensor([offset / scale, drift * duration / scale]).double())

    def named_coefficients(self) -> dict[str, Tensor]:
        """Offset and drift by name."""
        offset, drift = (self.scale * self.weights).unbind()
        return dict(zip(self.names, (offset, drift / self.duration), strict=True))

    def forward(self, t: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """The bias b(t)."""
        offset, drift = (self.scale * self.weights).unbind()
        return offset + drift * t / self.duration


class BiasedSensor(Extension):
    r"""A plant with a sensor that reads y = s_i + b(t), with b(t) = b_0 + ḃt.

    The state s_i of the extended plant is what the sensor *reads*: policies and records hold the reading, while the
    plant's vector field, cost, end and set points get s_i − b. The hidden state holds b, so that they know it.

    Args:
        base: the plant.
        state: name of the state that is read.
        offset: b_0 of the true system, in the unit of the state.
        drift: ḃ of the true system, in the unit of the state per second.
        scale: size of an offset that changes what the policy does, in the unit of the state; it scales the weights.

    Raises:
        ValueError: if there is no such state, the scale is not positive, or a state that the controller computes
            follows from the reading, because the vector field would compute it from the true value.
    """

    def __init__(self, base: Plant, state: str, offset: float, drift: float = 0.0, *, scale: float):
        self.place, self.state = place_of("state", state, base.states, base.name), state
        if not 0.0 < scale < math.inf or not (math.isfinite(offset) and math.isfinite(drift)):
            raise ValueError(f"scale={scale} must be positive, offset={offset} and drift={drift} finite.")
        if base.controller_states:
            raise ValueError(
                f"plant {base.name!r} computes {', '.join(base.controller_states)} from what is true, not from the "
                f"reading of {state}; a biased sensor needs a plant without controller_states."
            )
        unit = base.states[self.place].unit
        signal = Signal(symbol="b", name=f"bias_of_{state}", unit=unit)
        errors = SensorErrors(state, unit, scale, base.horizon, offset=offset, drift=drift)
        super().__init__(base, [signal], errors)

    def fresh(self) -> nn.Module:
        """No offset and no drift, to be trained."""
        errors = super().fresh()
        with torch.no_grad():
            errors.get_parameter("weights").zero_()
        return errors

    def true(self, read: Float[Tensor, "*batch n_b"], bias: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch n_b"]:
        """States of the plant, from what the sensors read."""
        shift = torch.zeros_like(read)
        return read - torch.cat(
            [shift[..., : self.place], bias.unsqueeze(-1) + shift[..., :1], shift[..., self.place + 1 :]], -1
        )

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        read, _ = self.split(state)
        bias = closure.get_submodule("own")
        field = self.base.vector_field(t, self.true(read, bias(t)), action, exogenous, self.of_base(closure))
        drift = (bias(t + self.dt) - bias(t)).unsqueeze(-1) / self.dt + torch.zeros_like(field[..., :1])
        return torch.cat([self.true(field, -drift[..., 0]), drift], -1)

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        read, _ = self.split(state)
        bias = closure.get_submodule("own")
        now, then = bias(t), bias(t + self.dt)
        end = self.base.advance(t, self.true(read, now), applied, exogenous, self.of_base(closure))
        last = then.unsqueeze(-1) + torch.zeros_like(end[..., :1])
        return torch.cat([self.true(end, -then), last], -1)

    def true_state(self, state: State) -> Float[Tensor, "*batch n_b"]:
        read, hidden = self.split(state)
        return self.true(read, hidden[..., 0])

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Hidden:
        """The bias at the start as the true system has it; a twin's states hold its own from the first interval on."""
        return self.closure.get_submodule("own")(torch.zeros_like(base[..., 0])).unsqueeze(-1)

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        true = self.base.draw_initial_state(batch, generator)
        hidden = self.rest(true)
        return torch.cat([self.true(true, -hidden[..., 0]), hidden], -1)


class UnreadInput(Extension):
    r"""A plant on which more acts than its sensors read, :math:`\bar z = z + \sum_k p_k`, such as gusts beside a mean.

    .. math:: \dot p_k = -\omega_kq_k, \qquad \dot q_k = \omega_kp_k, \qquad p_k(0), q_k(0) \sim N(0, \sigma^2/K)

    Each of the K harmonics is a rotating vector with a random amplitude and phase, so that the sum is stationary with
    the deviation σ. The vectors are hidden states with their exact solution; what acts is held over an interval, as
    every input is.

    Args:
        base: the plant.
        name: name of the input.
        deviation: standard deviation σ of what no sensor reads, in the unit of the input.
        frequencies: angular frequencies ω_k [rad/s].

    Raises:
        ValueError: if there is no such input, the deviation is not positive and finite, or a frequency is not, or there
            is none.
    """

    cosine: Tensor
    sine: Tensor
    frequency: Tensor

    def __init__(self, base: Plant, name: str, deviation: float, frequencies: Sequence[float]):
        self.place, self.deviation = place_of("name", name, base.acting_inputs, base.name), deviation
        for argument, values in (("deviation", [deviation]), ("frequencies", frequencies)):
            if not values or not all(0.0 < value < math.inf for value in values):
                raise ValueError(f"{argument}={values} of what no sensor of {name} reads must be positive and finite.")
        unit = base.inputs[self.place].unit
        hidden = [
            Signal(symbol=f"{part}_{{{k}}}", name=f"unread_{name}_{part}_{k}", unit=unit)
            for part in ("p", "q")
            for k in range(len(frequencies))
        ]
        super().__init__(base, hidden)
        turn = torch.tensor(frequencies, dtype=torch.float64)
        self.register_buffer("frequency", turn)
        self.register_buffer("cosine", torch.cos(turn * base.dt))
        self.register_buffer("sine", torch.sin(turn * base.dt))

    def meeting(self, hidden: Hidden, exogenous: Input) -> Float[Tensor, "*batch n_z"]:
        """What sensors read and what they do not."""
        unread = hidden[..., : len(self.frequency)].sum(-1)
        met = exogenous + torch.zeros_like(hidden[..., :1])
        return replaced(met, self.place, met[..., self.place] + unread)

    def respond(self, hidden: Hidden, applied: Action, closure: nn.Module) -> tuple[Action, Hidden]:
        p, q = hidden.split(len(self.frequency), -1)
        return applied, torch.cat([self.cosine * p - self.sine * q, self.sine * p + self.cosine * q], -1)

    def rates(self, hidden: Hidden, applied: Action, closure: nn.Module) -> Hidden:
        p, q = hidden.split(len(self.frequency), -1)
        return torch.cat([-self.frequency * q, self.frequency * p], -1)

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Hidden:
        """Nothing that is not read, which is the mean."""
        return torch.zeros_like(base[..., :1]).expand(*base.shape[:-1], 2 * len(self.frequency))

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        base = self.base.draw_initial_state(batch, generator)
        n = len(self.frequency)
        drawn = torch.randn(batch, 2 * n, generator=generator, dtype=torch.float64, device=generator.device)
        return torch.cat([base, self.deviation / math.sqrt(n) * drawn], -1)
