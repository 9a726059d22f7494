"""A sensor that reads with an offset, which may drift."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from rt_torchrl.plants.extensions.extension import Extension, OwnParameters
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.signal import Signal


class SensorErrors(OwnParameters):
    """Offset b_0 and drift ḃ of a sensor, as weights in units of a scale.

    Args:
        state: name of the state that is read.
        unit: its unit.
        scale: size of an offset that counts as one, in the unit of the state.
        duration: time in which a drift of one reaches that size [s].
        values: offset, and drift per second.
    """

    def __init__(self, state: str, unit: str, scale: float, duration: float, values: tuple[float, float]):
        super().__init__()
        self.scale, self.duration, self._arguments = scale, duration, (state, unit, scale, duration)
        self.names = {f"{state}_offset": unit, f"{state}_drift": f"{unit}/s"}
        self.meanings = {f"{state}_offset": "offset of the sensor", f"{state}_drift": "drift of the sensor"}
        self.weights = nn.Parameter(torch.tensor([values[0] / scale, values[1] * duration / scale]).double())

    def named_coefficients(self) -> dict[str, Tensor]:
        """Offset and drift by name."""
        offset, drift = (self.scale * self.weights).unbind()
        return dict(zip(self.names, (offset, drift / self.duration), strict=True))

    def forward(self, t: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """The bias b(t)."""
        offset, drift = (self.scale * self.weights).unbind()
        return offset + drift * t / self.duration

    def fresh(self) -> "SensorErrors":
        """No offset and no drift, to be trained."""
        return SensorErrors(*self._arguments, (0.0, 0.0))


class BiasedSensor(Extension):
    r"""A plant with a sensor that reads y = s_i + b(t), with b(t) = b_0 + ḃt.

    The state s_i of the extended plant is what the sensor *reads*: policies and records hold the reading, while the
    vector field and the cost of the plant get s_i − b, and so do its end and its set points. The hidden state holds b,
    so that the cost knows it.

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
        names = [signal.name for signal in base.states]
        if state not in names:
            raise ValueError(
                f"state={state!r} of plant {base.name!r} does not exist; choose one of {', '.join(names)}."
            )
        if not 0.0 < scale < math.inf or not (math.isfinite(offset) and math.isfinite(drift)):
            raise ValueError(f"scale={scale} must be positive, offset={offset} and drift={drift} finite.")
        if base.controller_states:
            raise ValueError(
                f"plant {base.name!r} computes {', '.join(base.controller_states)} from what is true, not from the "
                f"reading of {state}; a biased sensor needs a plant without controller_states."
            )
        self.place, self.state = names.index(state), state
        unit = base.states[self.place].unit
        signal = Signal(symbol="b", name=f"bias_of_{state}", unit=unit)
        errors = SensorErrors(state, unit, scale, base.horizon, (offset, drift))
        super().__init__(base, [signal], errors.requires_grad_(False))

    def true(self, read: Float[Tensor, "*batch n_b"], bias: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch n_b"]:
        """States of the plant, from what the sensors read."""
        shift = torch.zeros_like(read)
        return read - torch.cat(
            [shift[..., : self.place], bias.unsqueeze(-1) + shift[..., :1], shift[..., self.place + 1 :]], -1
        )

    def vector_field(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        action: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        read, _ = self.split(state)
        bias = closure.get_submodule("own")
        field = self.base.vector_field(t, self.true(read, bias(t)), action, exogenous, self.of_base(closure))
        drift = (bias(t + self.dt) - bias(t)).unsqueeze(-1) / self.dt + torch.zeros_like(field[..., :1])
        return torch.cat([self.true(field, -drift[..., 0]), drift], -1)

    def advance(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
        closure: nn.Module,
    ) -> Float[Tensor, "*batch n_s"]:
        read, _ = self.split(state)
        bias = closure.get_submodule("own")
        now, then = bias(t), bias(t + self.dt)
        end = self.base.advance(t, self.true(read, now), applied, exogenous, self.of_base(closure))
        last = then.unsqueeze(-1) + torch.zeros_like(end[..., :1])
        return torch.cat([self.true(end, -then), last], -1)

    def running_cost(
        self,
        t: Float[Tensor, "*#batch"],
        state: Float[Tensor, "*batch n_s"],
        applied: Float[Tensor, "*batch n_a"],
        exogenous: Float[Tensor, "*#batch n_z"],
    ) -> Float[Tensor, "*batch"]:
        """The cost of the true state, which no sensor reads."""
        read, hidden = self.split(state)
        return self.base.running_cost(t, self.true(read, hidden[..., 0]), applied, exogenous)

    def terminal_cost(self, state: Float[Tensor, "*batch n_s"]) -> Float[Tensor, "*batch"]:
        read, hidden = self.split(state)
        return self.base.terminal_cost(self.true(read, hidden[..., 0]))

    def merit(self, states: Tensor, applied: Tensor, exogenous: Tensor) -> dict[str, Tensor]:
        read, hidden = self.split(states)
        return self.base.merit(self.true(read, hidden[..., 0]), applied, exogenous)

    def ended(self, state: Float[Tensor, "*batch n_s"]) -> Bool[Tensor, "*batch"]:
        """Whether the plant ends the episode in its true state."""
        read, hidden = self.split(state)
        return self.base.ended(self.true(read, hidden[..., 0]))

    def setpoints(self, states: Tensor, applied: Tensor, exogenous: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        read, hidden = self.split(states)
        return self.base.setpoints(self.true(read, hidden[..., 0]), applied, exogenous)

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Float[Tensor, "*batch 1"]:
        """The bias at the start as the true system has it; a twin's states hold its own from the first interval on."""
        return self.closure.get_submodule("own")(torch.zeros_like(base[..., 0])).unsqueeze(-1)

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        true = self.base.draw_initial_state(batch, generator)
        hidden = self.rest(true)
        return torch.cat([self.true(true, -hidden[..., 0]), hidden], -1)
