"""Plants that break the contract, each in one way, and the message that the check must give for each."""

import dataclasses

import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from torch import nn
from traced_function import Bounded, Recurrent, Rows

from rt_torchrl import Signal
from rt_torchrl.plants.plant import Transition

SPEED = LinearQuadratic.states[1]


class NoStates(LinearQuadratic):
    states = ()


class NoSignals(LinearQuadratic):
    inputs = ("disturbance",)


class NoLimits(LinearQuadratic):
    actions = (Signal(symbol="a", name="force", unit="N", low=-2.0),)


class NoUnit(LinearQuadratic):
    actions = (Signal(symbol="a", name="force", unit="", low=-2.0, high=2.0),)


class Twice(LinearQuadratic):
    states = (SPEED, SPEED)


class NoName(LinearQuadratic):
    name = "two words"


class OutOfRange(LinearQuadratic):
    states = (LinearQuadratic.states[0], Signal(symbol="v", name="velocity", unit="m/s", low=-0.1, high=0.1))


class SinglePrecision(LinearQuadratic):
    def draw_initial_state(self, batch, generator):
        return super().draw_initial_state(batch, generator).float()


class OneEpisode(LinearQuadratic):
    def draw_exogenous(self, batch, generator):
        return super().draw_exogenous(1, generator)


class GlobalNumbers(LinearQuadratic):
    def draw_initial_state(self, batch, generator):
        return torch.randn(batch, 2, dtype=torch.float64)


class Counting(LinearQuadratic):
    count = 0

    def draw_exogenous(self, batch, generator):
        self.count += 1
        return self.count + super().draw_exogenous(batch, generator)


class SingleClosure(LinearQuadratic):
    def make_closure(self, generator):
        return super().make_closure(generator).float()


class FrozenClosure(LinearQuadratic):
    def make_closure(self, generator):
        return super().make_closure(generator).requires_grad_(False)


class StrongPolicy(LinearQuadratic):
    def make_policy(self, generator):
        policy = super().make_policy(generator)
        policy.gain.data *= 1e3
        return policy


class RememberingPolicy(LinearQuadratic):
    def make_policy(self, generator):
        return Bounded(Recurrent())


class NormalisingPolicy(LinearQuadratic):
    def make_policy(self, generator):
        return Bounded(Rows(nn.BatchNorm1d(2), nn.Linear(2, 1)))


class DroppingPolicy(LinearQuadratic):
    def make_policy(self, generator):
        return Bounded(Rows(nn.Linear(2, 8), nn.Dropout(), nn.Linear(8, 1)))


class Cut(nn.Linear):
    def forward(self, observation):
        return super().forward(observation.detach())


class CutPolicy(LinearQuadratic):
    def make_policy(self, generator):
        return Bounded(Cut(2, 1, dtype=torch.float64))


class RememberingClosure(LinearQuadratic):
    def make_neural_closure(self, generator, hidden):
        return Bounded(Recurrent(outputs=2))


class FirstDimension(LinearQuadratic):
    def observe(self, t, state, exogenous):
        return torch.stack([state[:, 0], state[:, 1]], -1)


class KeptDimension(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous).unsqueeze(-1)


class SingleRates(LinearQuadratic):
    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action, exogenous, closure).float()


class NotANumber(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) + (state[..., 0] - 1e3).sqrt()


class InPlace(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        state -= 1.0
        return 0.5 * (state**2).sum(-1)


class Remembering(LinearQuadratic):
    last = 0.0

    def observe(self, t, state, exogenous):
        seen, self.last = state + self.last, state.mean()
        return seen


class Together(LinearQuadratic):
    def observe(self, t, state, exogenous):
        return state - state.mean(dim=tuple(range(state.ndim - 1)) or 0).detach() if state.ndim > 1 else 0.0 * state


class Profit(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) - 1.0


class OtherAction(LinearQuadratic):
    def step(self, t, state, command, exogenous, closure):
        return Transition(super().step(t, state, command, exogenous, closure).state, 0.5 * command)


class Halving(LinearQuadratic):
    def actuate(self, state, command):
        return 0.5 * command


class DetachedState(LinearQuadratic):
    def observe(self, t, state, exogenous):
        return state.detach()


class DetachedWeights(LinearQuadratic):
    def vector_field(self, t, state, action, exogenous, closure):
        with torch.no_grad():
            unknown = closure(state)
        return super().vector_field(t, state, action, exogenous, lambda features: 0.0 * features) + unknown


class PartlyDetached(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) + (state * state.detach()).sum(-1)


class InfiniteSlope(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) + torch.where(
            state[..., 0] > 1e3, (0.0 * state[..., 0]).sqrt(), 0.0
        )


class UnusedWeight(LinearQuadratic):
    def make_closure(self, generator):
        closure = super().make_closure(generator)
        closure.forgotten = nn.Parameter(torch.ones(1, dtype=torch.float64))
        return closure


class WithoutForwardMode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, gradient):
        return gradient


class ReverseOnly(LinearQuadratic):
    def latch(self, state, applied):
        return WithoutForwardMode.apply(state)


class Stiff(LinearQuadratic):
    A = ((0.0, 1.0), (-1.0, -40.0))


class Explosive(LinearQuadratic):
    A = ((5000.0, 1.0), (-1.0, 0.0))

    def __init__(self):
        super().__init__(horizon=20.0)

    def running_cost(self, t, state, applied, exogenous):
        return 0.0 * state[..., 0]


class Raising(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        raise KeyError("velocity")


class OwnSeed(LinearQuadratic):
    def draw_exogenous(self, batch, generator):
        own = torch.Generator().manual_seed(0)
        return torch.rand(batch, self.n_steps, 1, generator=own, dtype=torch.float64)


class BrokenClosure(LinearQuadratic):
    def make_closure(self, generator):
        return LinearClosure("matrix")


class Branching(LinearQuadratic):
    def vector_field(self, t, state, action, exogenous, closure):
        if (state[..., 0] > 0.0).any():
            action = 1.0 * action
        return super().vector_field(t, state, action, exogenous, closure)


class Late(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        cost = super().running_cost(t, state, applied, exogenous)
        return 2.0 * cost if t.max() > 100.0 else cost


class Unwrapped(LinearQuadratic):
    """A plant whose position is the angle of a motor, which its cost takes for a length."""

    states = (dataclasses.replace(LinearQuadratic.states[0], low=-9.0, high=9.0, periodic=True), SPEED)


class PeriodicForce(LinearQuadratic):
    actions = (dataclasses.replace(LinearQuadratic.actions[0], periodic=True),)


AGAIN = "gives something else when it is called again with the same arguments"
TRACED = {Branching: "vector_field: is not one graph: .*if \\(state", Late: "running_cost: is not one graph: "}
"""Found by tracing alone."""
BROKEN = {
    NoStates: "states: is empty; declare at least one Signal",
    NoSignals: "inputs: is .*expected a tuple of Signal",
    NoLimits: r"actions: 'force' has range \[-2.0, inf\] N;.*give the Signal the actuator's low and high",
    NoUnit: "actions: 'force' has no unit",
    Twice: "states: 'velocity' is declared 2 times",
    NoName: "name: is 'two words'",
    OutOfRange: r"draw_initial_state: draws 'velocity' from .* outside \[-0.1, 0.1\]",
    SinglePrecision: "draw_initial_state: gives torch.float32",
    OneEpisode: r"draw_exogenous: gives shape \(1, 50, 1\) for batch=3, n_steps=50; expected .*\(3, 50, 1\)",
    GlobalNumbers: "draw_initial_state: (depends on torch's global|gives something else each time)",
    Counting: "draw_exogenous: gives something else each time",
    SingleClosure: "make_closure: has matrix in torch.float32",
    FrozenClosure: "make_closure: has no trainable weights",
    StrongPolicy: r"make_policy: draws 'force' .*outside \[-2, 2\]",
    RememberingPolicy: f"make_policy: {AGAIN}.*a state of the plant",
    NormalisingPolicy: "make_policy: raised ValueError in .*traced_function.py, .*Expected more than 1 value.*eval",
    DroppingPolicy: rf"make_policy: {AGAIN}.*\.eval\(\)",
    CutPolicy: "make_policy: autograd finds no dependence on state 'position'",
    RememberingClosure: f"make_neural_closure: {AGAIN}",
    FirstDimension: "observe: raised IndexError in .*broken_plants.py, line",
    KeptDimension: r"running_cost: cost has shape \(1,\) for t \(\), .*expected .*shape \(\)",
    SingleRates: "vector_field: rate has torch.float32",
    NotANumber: "running_cost: cost has 1 values that are not finite",
    InPlace: "running_cost: changes its argument state in place",
    Remembering: "observe: gives something else when it is called again with the same arguments",
    Together: "observe: observation of a batch differs from that of its rows one by one",
    Profit: r"running_cost: is -0.\d+ at state .*expected no negative cost",
    OtherAction: r"step: its applied action is not what actuate\(state, command\) gives",
    Unwrapped: "running_cost: its cost changes by up to .* when state 'position' turns by its period 18 m; use its",
    PeriodicForce: "actions: 'force' is periodic; only a state can be: take its cosine and sine instead",
    Halving: "actuate: an applied action that is commanded again from the same state becomes another",
    DetachedState: "observe: autograd finds no dependence on state 'position'",
    DetachedWeights: "vector_field: autograd finds no dependence on closure weight 'matrix'",
    PartlyDetached: "running_cost: its derivative by state 'position' is .*by finite differences",
    InfiniteSlope: "running_cost: its derivative by state 'position' is not finite",
    UnusedWeight: "vector_field: closure weight 'forgotten' changes it at none",
    ReverseOnly: r"latch: raised RuntimeError in .*broken_plants\.py, line .*autograd.Function.*forward and reverse",
    Stiff: r"dt: 0.1 s is too long for the eigenvalue -39.* 1/s .*Use dt <= 0.0\d+ s",
    Explosive: "step: plant 'linear_quadratic' diverged in realisation",
    Raising: "running_cost: raised KeyError in .*broken_plants.py",
    OwnSeed: "draw_exogenous: draws different episodes, but the same ones for generators of another seed",
    BrokenClosure: "make_closure: raised .*Error in .*linear_quadratic.py, line",
}


class Sorting(LinearQuadratic):
    """A plant that keeps the contract with an operator that cannot become machine code."""

    def vector_field(self, t, state, action, exogenous, closure):
        rates = super().vector_field(t, state, action, exogenous, closure)
        return rates + 0.0 * state.sort(-1).values


CONFIG = {"weight": 2.0}


class Configured(LinearQuadratic):
    """A plant that keeps the contract, with a weight that machine code would not see change."""

    def running_cost(self, t, state, applied, exogenous):
        return CONFIG["weight"] * super().running_cost(t, state, applied, exogenous)
