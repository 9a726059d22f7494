"""Actuators that lag, ring, act late or do only a share of what they are asked for."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from rt_torchrl.plants.closures import FACTOR, PositiveCoefficients
from rt_torchrl.plants.extension import Extension, replaced
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.sampling import whole_multiple
from rt_torchrl.plants.shapes import Action, Cost, Hidden, State
from rt_torchrl.plants.signal import Signal, place_of

LONGEST_DELAY = 64
"""Greatest number of control intervals of a delay: each is a hidden state, which every engine carries along."""


class Actuator(Extension):
    """A plant with an actuator between an action that is asked for and the one that acts on the plant.

    A subclass says by :meth:`respond` what the actuator does. By default the first hidden state acts at the start of an
    interval, and all hidden states begin an episode at rest. A cost of the action's rate is one of what is asked for.

    Args:
        base: the plant.
        action: name of the action.
        hidden: signals of the hidden states.
        parameters: those of the true system; None for none.

    Raises:
        ValueError: if there is no such action.
    """

    def __init__(self, base: Plant, action: str, hidden: Sequence[Signal] = (), parameters: nn.Module | None = None):
        self.place = place_of("action", action, base.actions, base.name)
        super().__init__(base, hidden, parameters)
        names = [state.name for state in base.states]
        self._last = names.index(action) if action in names else None  # the state that holds the action applied last

    def acting(self, hidden: Hidden, applied: Action) -> Action:
        return replaced(applied, self.place, hidden[..., 0])

    def rest(self, base: State) -> Hidden:
        """The state of the action's name, or else the place in the action's range nearest to zero."""
        if self._last is None:
            signal = self.actions[self.place]
            position = torch.full_like(base[..., 0], min(max(0.0, signal.low), signal.high))
        else:
            position = base[..., self._last]
        return position.unsqueeze(-1).expand(*base.shape[:-1], len(self.states) - len(self.base.states))

    def ask(self, part: str, method: str, arguments: dict[str, Any]) -> Any:
        if part == "task" and arguments.keys() >= {"state", "applied"} and self._last is not None:
            state, applied = arguments["state"], arguments["applied"]
            change = self.acting(self.split(state)[1], applied) - applied
            # The last action moves by as much as the applied one, so that their difference stays.
            moved = state[..., self._last] + change[..., self.place]
            arguments["state"] = replaced(state, self._last, moved)
        return super().ask(part, method, arguments)


def _signal_of(base: Plant, action: str) -> Signal:
    """The signal of what an actuator is asked for."""
    return base.actions[place_of("action", action, base.actions, base.name)]


class LaggedActuator(Actuator):
    r"""A plant with an actuator that follows what it is asked for through n equal lags, whose time constants sum to T.

    .. math:: \frac Tn\dot x_j = x_{j-1} - x_j, \quad j = 1 \dots n, \quad x_0 = a

    One lag is the usual first-order actuator. A chain is a dead time T whose response rises within some
    :math:`T/\sqrt n`; unlike that of :class:`DelayedActuator`, its parameter is continuous, so that a twin identifies
    it. Each stage has its exact solution for the mean of the stage before it over the interval,
    :math:`x' = u + (x - u)e^{-h}` with the mean :math:`u + (x - u)(1 - e^{-h})/h` and :math:`h = n\Delta t/T`. The mean
    of the last stage acts on the plant. One lag is exact for any T > 0; a short T makes the plant that is extended.

    Args:
        base: the plant.
        action: name of the action that lags.
        time_constant: T of the true system, which a twin identifies [s].
        stages: number n of lags.

    Raises:
        ValueError: if there is no such action, a time constant is not positive and finite, or there is no stage.
    """

    def __init__(self, base: Plant, action: str, time_constant: float, *, stages: int = 1):
        if stages < 1:
            raise ValueError(f"stages={stages} of {action} must be at least 1.")
        self.stages = stages
        signal, ends = _signal_of(base, action), [""] if stages == 1 else [f"_{k}" for k in range(1, stages + 1)]
        hidden = [
            Signal(symbol=f"{signal.symbol}'{end}", name=f"lagged_{action}{end}", unit=signal.unit) for end in ends
        ]
        names, meanings = {f"{action}_lag": "s"}, {f"{action}_lag": f"time constant of {action}"}
        parameters = PositiveCoefficients([time_constant], names=names, meanings=meanings, factor=FACTOR)
        super().__init__(base, action, hidden, parameters)

    def respond(self, hidden: Hidden, applied: Action, closure: nn.Module) -> tuple[Action, Hidden]:
        steps = self.dt * self.stages / self.coefficients(closure)[0]
        decay = torch.exp(-steps)
        share = (1.0 - decay) / steps
        mean, ends = applied[..., self.place], []
        for x in hidden.unbind(-1):
            off = x - mean
            ends.append(mean + off * decay)
            mean = mean + off * share
        return replaced(applied, self.place, mean), torch.stack(ends, -1)

    def rates(self, hidden: Hidden, applied: Action, closure: nn.Module) -> Hidden:
        before = torch.cat([applied[..., self.place : self.place + 1], hidden[..., :-1]], -1)
        return (before - hidden) * self.stages / self.coefficients(closure)[0]

    def acting(self, hidden: Hidden, applied: Action) -> Action:
        return replaced(applied, self.place, hidden[..., -1])


class ResonantActuator(Actuator):
    r"""A plant with an actuator that follows what it is asked for as an underdamped oscillator.

    .. math:: \ddot x + 2\zeta\omega\dot x + \omega^2x = \omega^2a, \qquad \zeta = \frac{d}{1 + d} < 1

    Between samples x has its exact solution for a held a. Its mean over the interval acts on the plant; the integral of
    the equation over Δt gives it, :math:`\bar a = a - (\Delta\dot x + 2\zeta\omega\Delta x)/(\omega^2\Delta t)`.

    Args:
        base: the plant.
        action: name of the action.
        frequency: natural frequency ω of the true system [rad/s].
        damping: damping ratio ζ of the true system [-], in (0, 1).

    Raises:
        ValueError: if there is no such action, ω is not positive and finite, or ζ is out of its range.
    """

    def __init__(self, base: Plant, action: str, frequency: float, damping: float):
        signal = _signal_of(base, action)
        if not 0.0 < damping < 1.0:
            raise ValueError(f"damping={damping} of {action} must lie in (0, 1); use LaggedActuator beyond.")
        position = Signal(symbol=signal.symbol + "'", name=f"resonant_{action}", unit=signal.unit)
        rate = Signal(symbol=rf"\dot{{{signal.symbol}}}'", name=f"rate_of_{action}", unit=f"{signal.unit}/s")
        names = {f"{action}_frequency": "rad/s", f"{action}_damping_odds": "-"}
        meanings = dict(zip(names, (f"natural frequency of {action}", "zeta/(1 - zeta) of it"), strict=True))
        odds = damping / (1.0 - damping)
        parameters = PositiveCoefficients([frequency, odds], names=names, meanings=meanings, factor=FACTOR)
        super().__init__(base, action, [position, rate], parameters)

    def respond(self, hidden: Hidden, applied: Action, closure: nn.Module) -> tuple[Action, Hidden]:
        demand, (x, v) = applied[..., self.place], hidden.unbind(-1)
        omega, odds = self.coefficients(closure).unbind()
        zeta = odds / (1.0 + odds)
        decay, ringing = zeta * omega, omega * torch.sqrt(1.0 - zeta * zeta)
        envelope, turn = torch.exp(-decay * self.dt), ringing * self.dt
        cosine, sine = envelope * torch.cos(turn), envelope * torch.sin(turn) / ringing
        off = x - demand
        end = off * (cosine + decay * sine) + v * sine
        rate = v * (cosine - decay * sine) - omega * omega * off * sine
        mean = demand - (rate - v + 2.0 * decay * (end - off)) / (omega * omega * self.dt)
        return replaced(applied, self.place, mean), torch.stack([demand + end, rate], -1)

    def rates(self, hidden: Hidden, applied: Action, closure: nn.Module) -> Hidden:
        x, v = hidden.unbind(-1)
        omega, odds = self.coefficients(closure).unbind()
        zeta = odds / (1.0 + odds)
        pull = omega * omega * (applied[..., self.place] - x)
        return torch.stack([v, pull - 2.0 * zeta * omega * v], -1)

    def rest(self, base: State) -> Hidden:
        position = super().rest(base)[..., 0]
        return torch.stack([position, torch.zeros_like(position)], -1)


class DelayedActuator(Actuator):
    r"""A plant with an actuator that does in each interval what it was asked for n intervals ago.

    .. math:: \bar a_k = a_{k-n}

    The hidden states are the n actions under way, the oldest first.

    Args:
        base: the plant.
        action: name of the action.
        delay: dead time [s], a whole number n of control intervals, 1 to 64.

    Raises:
        ValueError: if there is no such action, or the delay is out of its range.
    """

    def __init__(self, base: Plant, action: str, delay: float):
        n, signal = whole_multiple(f"delay of {action}", delay, base.dt), _signal_of(base, action)
        if n > LONGEST_DELAY:
            raise ValueError(
                f"delay={delay} s of {action} must be at most {LONGEST_DELAY} control intervals of {base.dt:g} s; "
                "approximate a longer one by LaggedActuator with several stages."
            )
        hidden = [
            Signal(symbol=f"{signal.symbol}_{{-{k}}}", name=f"delayed_{action}_{k}", unit=signal.unit)
            for k in range(n, 0, -1)
        ]
        super().__init__(base, action, hidden)

    def respond(self, hidden: Hidden, applied: Action, closure: nn.Module) -> tuple[Action, Hidden]:
        under_way = torch.cat([hidden[..., 1:], applied[..., self.place : self.place + 1]], -1)
        return self.acting(hidden, applied), under_way


class ScaledActuator(Actuator):
    r"""A plant with an actuator that does :math:`\bar a = ga`, such as one whose supply voltage sags.

    It has no hidden states and no parameters that a twin identifies. The range of the action is that of what the
    actuator is asked for; what it does may lie beyond.

    Args:
        base: the plant.
        action: name of the action.
        gain: gain g.

    Raises:
        ValueError: if there is no such action, or the gain is not positive and finite.
    """

    def __init__(self, base: Plant, action: str, gain: float):
        self.gain = gain
        if not 0.0 < gain < math.inf:
            raise ValueError(f"gain={gain} of {action} must be positive and finite, such as 0.95 for a loss of 5 %.")
        super().__init__(base, action)

    def acting(self, hidden: Hidden, applied: Action) -> Action:
        return replaced(applied, self.place, self.gain * applied[..., self.place])


class PositionedActuator(Actuator):
    """A plant with an actuator whose position x is where its last action has left it; a subclass says how it moves.

    Args:
        base: the plant.
        action: name of the action.
        size: what the motion is limited by, in the unit of the action, of a rate per second.

    Raises:
        ValueError: if there is no such action, or the size is not positive and finite.
    """

    def __init__(self, base: Plant, action: str, size: float):
        self.size, signal = size, _signal_of(base, action)
        if not 0.0 < size < math.inf:
            raise ValueError(f"size={size} of {action} must be positive and finite.")
        position = Signal(symbol=signal.symbol + "'", name=f"position_of_{action}", unit=signal.unit)
        super().__init__(base, action, [position])

    def moved(self, x: Cost, demand: Cost) -> Cost:
        """The position at the end of an interval in which an action is asked for."""
        raise NotImplementedError

    def mean(self, x: Cost, end: Cost, demand: Cost) -> Cost:
        """The mean position over the interval; by default that of its end."""
        return end

    def respond(self, hidden: Hidden, applied: Action, closure: nn.Module) -> tuple[Action, Hidden]:
        x, demand = hidden[..., 0], applied[..., self.place]
        end = self.moved(x, demand)
        return replaced(applied, self.place, self.mean(x, end, demand)), end.unsqueeze(-1)

    def acting(self, hidden: Hidden, applied: Action) -> Action:
        """By default the position at the end of the interval: the motion takes no time."""
        return replaced(applied, self.place, self.moved(hidden[..., 0], applied[..., self.place]))


class RateLimitedActuator(PositionedActuator):
    r"""A plant with an actuator that reaches what it is asked for with no more than a rate r, :math:`|\dot x| \le r`.

    In an interval it moves for the time :math:`\min(\Delta t, |a - x|/r)` and rests then; its mean acts on the plant.
    ``size`` is r.
    """

    acting = Actuator.acting

    def moved(self, x: Cost, demand: Cost) -> Cost:
        return x + (demand - x).clamp(-self.size * self.dt, self.size * self.dt)

    def mean(self, x: Cost, end: Cost, demand: Cost) -> Cost:
        moving = ((demand - x).abs() / (self.size * self.dt)).clamp(max=1.0)
        return end - 0.5 * moving * (end - x)


class PlayActuator(PositionedActuator):
    r"""A plant with play (backlash) of ± b between an actuator and what it moves, :math:`|a - x| \le b`.

    The position follows only where the actuator pushes it, :math:`x' = \max(a - b, \min(a + b, x))`. ``size`` is b.
    """

    def moved(self, x: Cost, demand: Cost) -> Cost:
        return torch.maximum(demand - self.size, torch.minimum(demand + self.size, x))


class StickingActuator(PositionedActuator):
    """A plant with an actuator that sticks until it is asked for more than s away from its position, and then slips.

    It slips to where it is asked for. ``size`` is s.
    """

    def moved(self, x: Cost, demand: Cost) -> Cost:
        return torch.where((demand - x).abs() > self.size, demand, x)
