"""Sensors that read with an offset or with noise, and policies that observe past readings."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from rt_torchrl.plants.extension import Extension, FurtherInputs, replaced
from rt_torchrl.plants.plant import Plant, Transition, with_memories
from rt_torchrl.plants.shapes import Action, Hidden, Input, Observation, State, Time
from rt_torchrl.plants.signal import Signal, place_of

AnySignal = TypeVar("AnySignal", bound=Signal)


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
        self.weights = nn.Parameter(torch.tensor([offset / scale, drift * duration / scale], dtype=torch.float64))

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
        offset: b_0 of the true system, in the unit of the state; 0 for a suspect, which begins there anyway.
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
        inner = base.innermost.controller_states  # past observations are those of the reading
        if inner:
            raise ValueError(
                f"plant {base.name!r} computes {', '.join(inner)} from what is true, not from the "
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
        return replaced(read, self.place, read[..., self.place] - bias)

    def vector_field(self, t: Time, state: State, action: Action, exogenous: Input, closure: nn.Module) -> State:
        readings, _ = self.split(state)
        bias = closure.get_submodule("own")
        field = self.base.vector_field(t, self.true(readings, bias(t)), action, exogenous, self.of_base(closure))
        drift = (bias(t + self.dt) - bias(t)).unsqueeze(-1) / self.dt + torch.zeros_like(field[..., :1])
        return torch.cat([self.true(field, -drift[..., 0]), drift], -1)

    def advance(self, t: Time, state: State, applied: Action, exogenous: Input, closure: nn.Module) -> State:
        readings, _ = self.split(state)
        bias = closure.get_submodule("own")
        now, then = bias(t), bias(t + self.dt)
        end = self.base.advance(t, self.true(readings, now), applied, exogenous, self.of_base(closure))
        last = then.unsqueeze(-1) + torch.zeros_like(end[..., :1])
        return torch.cat([self.true(end, -then), last], -1)

    def true_state(self, state: State) -> Float[Tensor, "*batch n_b"]:
        readings, hidden = self.split(state)
        return self.true(readings, hidden[..., 0])

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Hidden:
        """The bias at the start as the plant's own closure has it."""
        return self.closure.get_submodule("own")(torch.zeros_like(base[..., 0])).unsqueeze(-1)

    def draw_initial_state(self, batch: int, generator: torch.Generator) -> Float[Tensor, "{batch} n_s"]:
        true = self.base.draw_initial_state(batch, generator)
        hidden = self.rest(true)
        return torch.cat([self.true(true, -hidden[..., 0]), hidden], -1)


class NoisySensors(FurtherInputs):
    """A plant whose sensors read s + n; its inputs are those of the plant, and n, white or not.

    Policies, memories and running costs get readings; actuators, the system and the end of an episode true states.

    Args:
        base: the plant of a twin.
    """

    symbol, kind = "n", "noise"

    def read(self, state: State, exogenous: Input) -> State:
        """The state with the noise of the sensors; what no sensor reads has none."""
        noise = exogenous[..., self.count :]
        return state + functional.pad(noise, (0, state.shape[-1] - noise.shape[-1]))

    def step(self, t: Time, state: State, command: Action, exogenous: Input, closure: nn.Module) -> Transition:
        inputs = exogenous[..., : self.count]
        end, applied = self.base.step(t, state, command, inputs, closure)
        return Transition(with_memories(self.base, end, t, self.read(state, exogenous), inputs), applied)

    def sensed(self, state: State, exogenous: Input) -> tuple[Tensor, Input]:
        return self.base.sensed(self.read(state, exogenous), exogenous[..., : self.count])

    def ask(self, part: str, method: str, arguments: dict[str, Any]) -> Any:
        if {"state", "exogenous"} <= arguments.keys():
            arguments["state"] = self.read(arguments["state"], arguments["exogenous"])
        return super().ask(part, method, arguments)


class StackedObservations(Extension):
    r"""A plant whose policies observe the present and the last n observations, :math:`(e_k, e_{k-1}, \dots, e_{k-n})`.

    The past observations are states that the controller computes (:attr:`Plant.controller_states`): no sensor gives
    them, an exported controller holds them, and they follow from a log. At t = 0 they are the first observation, also
    in each window of a continuous operation, :math:`e_{-j} = e_0`.

    The suspects of the plant are suspects here. Where a real system has something beside the plant, stack the
    observations of the extended plant, or extend the stacked one; both observe what sensors read.

    Args:
        base: the plant, perhaps extended.
        count: number n of past observations.

    Raises:
        ValueError: if ``count`` is not at least 1, or the plant has a state with the name of a past observation.
    """

    def __init__(self, base: Plant, count: int):
        if count < 1:
            raise ValueError(f"count={count} of past observations must be at least 1.")
        self.count, self._read = count, len(base.readings)
        past = [Signal(symbol=s.symbol, name=s.name, unit=s.unit) for s in _past(base.observations, count)]
        super().__init__(base, past)
        self.states = (*base.readings, *past, *base.states[self._read :])
        self.unread = base.unread
        names = tuple(signal.name for signal in past)
        self.controller_states, self.memories = (*base.controller_states, *names), (*base.memories, *names)
        self.observations = (*base.observations, *_past(base.observations, count))
        self.observed = (*base.observed, *_past(base.observed, count))

    @property
    def own_scheme(self) -> bool:
        """That of the plant: past observations stand still between samples, whatever integrates."""
        return self.base.own_scheme

    # The past observations, which stand behind what sensors read and before what none reads

    def split(self, state: State) -> tuple[Float[Tensor, "*batch n_b"], Hidden]:
        """States of the plant and past observations."""
        n, end = self._read, self._read + self.count * len(self.base.observations)
        return torch.cat([state[..., :n], state[..., end:]], -1), state[..., n:end]

    def joined(self, base: Float[Tensor, "*batch n_b"], hidden: Hidden) -> State:
        return torch.cat([base[..., : self._read], hidden, base[..., self._read :]], -1)

    def observe(self, t: Time, state: State, exogenous: Input) -> Observation:
        """The present observation and the past ones, the latest first."""
        base, past = self.split(state)
        now = self.base.observe(t, base, exogenous)
        first = (t.abs() < 0.5 * self.dt).unsqueeze(-1)
        return torch.cat([now, torch.where(first, torch.cat([now] * self.count, -1), past)], -1)

    def memorise(self, t: Time, state: State, exogenous: Input) -> State:
        base, past = self.split(state)
        observations = self.observe(t, state, exogenous)[..., : past.shape[-1]]
        return self.joined(self.base.memorise(t, base, exogenous), observations)

    def rest(self, base: Float[Tensor, "*batch n_b"]) -> Hidden:
        """Zeros, in the place of which the first observation is taken at t = 0."""
        zero = torch.zeros_like(base[..., :1])
        return zero.expand(*base.shape[:-1], self.count * len(self.base.observations))

    def at_rest(self, readings: Float[Tensor, "*batch n_r"]) -> State:
        return self.joined(self.base.at_rest(readings[..., : self._read]), readings[..., self._read :])

    def complete_states(self, measured: dict[str, Tensor], exogenous: Tensor, actions: Tensor) -> Tensor:
        """States of the plant from a log, and the observations that follow; t begins with 0 where no time is given."""
        base = self.base.complete_states(measured, exogenous, actions)
        samples = torch.arange(len(base), device=base.device)
        t = measured.get("time", self.dt * samples.to(base))
        observations = self.base.observe(t[:-1], base[:-1], exogenous)
        before = samples.unsqueeze(-1) - torch.arange(1, self.count + 1, device=base.device)
        return self.joined(base, observations[before.clamp(min=0)].flatten(-2))

    def controller_start(self, measured: Tensor, exogenous: Tensor) -> Tensor:
        return torch.cat([self.base.controller_start(measured, exogenous), self.rest(measured)], -1)

    # The task, which is that of the plant

    @property
    def discrepancy_scales(self) -> tuple[float, ...]:
        """Those of the plant; past observations, which follow from its states, are not compared."""
        scales, n_past = self.base.discrepancy_scales, self.count * len(self.base.observations)
        return (*scales[: self._read], *(math.inf,) * n_past, *scales[self._read :])

    def suspects(self) -> Mapping[str, Plant]:
        return {name: StackedObservations(suspect, self.count) for name, suspect in self.base.suspects().items()}

    def further_suspects(self) -> Mapping[str, Plant]:
        further = self.base.further_suspects()
        return {name: StackedObservations(suspect, self.count) for name, suspect in further.items()}

    make_policy = Plant.make_policy  # of all observations; the plant's own policy knows the present one alone


def _past(signals: tuple[AnySignal, ...], count: int) -> list[AnySignal]:
    """The signals of 1 to ``count`` intervals ago, all of one moment together."""
    return [
        replace(signal, symbol=f"({signal.symbol})_{{-{k}}}", name=f"{signal.name}_{k}_ago")
        for k in range(1, count + 1)
        for signal in signals
    ]
