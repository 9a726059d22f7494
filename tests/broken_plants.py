"""Plants that break the contract, each in one way, and the message that the check must give for each."""

import dataclasses
import math

import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from torch import nn
from traced_function import Bounded, Recurrent, Rows

from rt_torchrl import Transition
from rt_torchrl.plants.policies import mlp

PLACE, SPEED = LinearQuadratic.states
FORCE = LinearQuadratic.actions[0]
AGAIN = "gives something else when it is called again with the same arguments"
BROKEN = {}
"""Classes of broken plants, with a pattern of the violation that is found."""


def breaks(message, method_name=None, **overrides):
    """Add an oracle plant with these attributes to the broken ones; a function is its method of the name."""

    def add(method=None):
        kind = method_name or (method.__name__ if method else next(iter(overrides)))
        methods, label = {kind: method} if method else {}, f"{kind} {len(BROKEN)}"
        BROKEN[label] = type("Broken", (LinearQuadratic,), methods | overrides), message
        return method

    return add


def inherited(name):
    """A method of the oracle plant."""
    return getattr(LinearQuadratic, name)


def changed(name, change):
    """The method of the oracle plant with its result changed."""
    return {name: lambda self, *given: change(inherited(name)(self, *given))}


class Cut(nn.Linear):
    def forward(self, observation):
        return super().forward(observation.detach())


class WithoutSetupContext(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, gradient):
        return gradient


def stronger(policy):
    policy.gain.data *= 1e3
    return policy


def with_a_forgotten_weight(closure):
    closure.forgotten = nn.Parameter(torch.ones(1, dtype=torch.float64))
    return closure


RANGED = dataclasses.replace(PLACE, low=-9.0, high=9.0, periodic=True)
SLOW = dataclasses.replace(SPEED, low=-0.1, high=0.1)
OPEN = dataclasses.replace(FORCE, high=math.inf)
for message, overrides in (
    ("states: is empty; declare at least one Signal", {"states": ()}),
    ("inputs: is .*expected a tuple of Signal", {"inputs": ("disturbance",)}),
    (r"actions: 'force' has range \[-2.0, inf\] N;.*give the Signal the actuator's low and high", {"actions": (OPEN,)}),
    ("actions: 'force' has no unit", {"actions": (dataclasses.replace(FORCE, unit=""),)}),
    ("actions: 'force' is periodic; only a state can be", {"actions": (dataclasses.replace(FORCE, periodic=True),)}),
    ("states: 'velocity' is declared 2 times", {"states": (SPEED, SPEED)}),
    ("name: is 'two words'", {"name": "two words"}),
    (r"draw_initial_state: draws 'velocity' from .* outside \[-0.1, 0.1\]", {"states": (PLACE, SLOW)}),
    ("draw_initial_state: gives torch.float32", changed("draw_initial_state", torch.Tensor.float)),
    (
        r"draw_exogenous: gives shape \(1, 50, 1\), expected .*\(3, 50, 1\).* for batch=3, n_steps=50",
        {"draw_exogenous": lambda self, batch, generator: inherited("draw_exogenous")(self, 1, generator)},
    ),
    (
        "draw_initial_state: (depends on torch's global|gives something else each time)",
        {"draw_initial_state": lambda self, batch, generator: torch.randn(batch, 2, dtype=torch.float64)},
    ),
    (r"end_cost: plant .* defines ended\(\) and no end_cost", {"ended": lambda self, state: state[..., 0] > 9.0}),
    (r"ended: returns torch.bool of shape \(.*, 1\)", {"ended": lambda self, s: s[..., :1] > 9.0, "end_cost": 1.0}),
    ("running_cost: raised KeyError in .*broken_plants.py", {"running_cost": lambda *_: {}["velocity"]}),
    ("running_cost: cost has 1 values that are not finite", changed("running_cost", lambda cost: (-1.0 - cost).sqrt())),
    ("make_closure: has matrix in torch.float32", changed("make_closure", nn.Module.float)),
    ("make_closure: has no trainable weights", changed("make_closure", lambda closure: closure.requires_grad_(False))),
    (
        "closure_outputs: names 1 coefficients, make_closure gives 2",
        {"closure_inputs": ("position [m]", "velocity [m/s]"), "closure_outputs": ("acceleration [m/s²]",)},
    ),
    ("vector_field: closure weight 'forgotten' changes it at none", changed("make_closure", with_a_forgotten_weight)),
    (r"make_policy: draws 'force' .*outside \[-2, 2\]", changed("make_policy", stronger)),
    (f"make_policy: .* {AGAIN}.*a state of the plant", changed("make_policy", lambda _: Bounded(Recurrent()))),
    (
        "make_policy: raised ValueError in .*traced_function.py, .*Expected more than 1 value.*eval",
        changed("make_policy", lambda _: Bounded(Rows(nn.BatchNorm1d(2), nn.Linear(2, 1)))),
    ),
    (
        "make_policy: its derivative by state 'position' is 0, by finite differences .*the path is cut",
        changed("make_policy", lambda _: Bounded(Cut(2, 1, dtype=torch.float64))),
    ),
    (
        "make_neural_closure: raised RuntimeError .*shapes cannot be multiplied",
        {"make_neural_closure": lambda self, generator, hidden: mlp(7, hidden, 1, generator=generator)},
    ),
    (
        r"running_cost: cost has shape \(1,\), expected .* for t",
        changed("running_cost", lambda cost: cost.unsqueeze(-1)),
    ),
    ("vector_field: rate has torch.float32", changed("vector_field", torch.Tensor.float)),
    (r"running_cost: is -0.\d+ at state .*expected no negative cost", changed("running_cost", lambda cost: cost - 1.0)),
    (
        r"step: its applied action is not what actuate\(state, command\) gives",
        changed("step", lambda end: Transition(end.state, 0.5 * end.applied)),
    ),
    ("actuate: an applied action that is commanded again.*another", changed("actuate", lambda applied: 0.5 * applied)),
    ("observe: its derivative by state 'position' is 0, by finite", changed("observe", torch.Tensor.detach)),
    (r"dt: 0.1 s is too long for the eigenvalue -39.* 1/s .*Use dt <= 0.0\d+ s", {"A": ((0.0, 1.0), (-1.0, -40.0))}),
    ("running_cost: its cost changes .* when state 'position' turns by its period 18 m", {"states": (RANGED, SPEED)}),
):
    breaks(message, **overrides)()


@breaks("make_closure: raised .*Error in .*linear_quadratic.py, line")
def make_closure(self, generator):
    return LinearClosure("matrix")


@breaks(r"latch: raised RuntimeError in .*broken_plants\.py, line .*autograd.Function.*vmap and jacrev")
def latch(self, state, applied):
    return WithoutSetupContext.apply(state)


@breaks("draw_exogenous: gives something else each time", count=0)
def draw_exogenous(self, batch, generator):
    self.count += 1
    return self.count + inherited("draw_exogenous")(self, batch, generator)


@breaks("draw_exogenous: draws different episodes, but the same ones for generators of another seed", "draw_exogenous")
def draw_with_a_seed(self, batch, generator):
    own = torch.Generator().manual_seed(0)
    return torch.rand(batch, self.n_steps, 1, generator=own, dtype=torch.float64)


@breaks("observe: raised IndexError in .*broken_plants.py, line", "observe")
def observe_by_column(self, t, state, exogenous):
    return torch.stack([state[:, 0], state[:, 1]], -1)


@breaks(f"observe: .* {AGAIN}", "observe", last=0.0)
def observe_with_a_memory(self, t, state, exogenous):
    seen, self.last = state + self.last, state.mean()
    return seen


@breaks("observe: .* depends on the other realisations", "observe")
def observe_together(self, t, state, exogenous):
    return state - state.mean(dim=tuple(range(state.ndim - 1)) or 0).detach() if state.ndim > 1 else 0.0 * state


@breaks("running_cost: .* depends on the other realisations", "running_cost")
def cost_at_the_first_time(self, t, state, applied, exogenous):
    return inherited("running_cost")(self, t, state, applied, exogenous) * (1.0 + t.flatten()[0])


@breaks(f"running_cost: .* {AGAIN}.*change none of their arguments", "running_cost")
def cost_in_place(self, t, state, applied, exogenous):
    state -= 1.0
    return 0.5 * (state**2).sum(-1)


def partly_detached(self, t, state, applied, exogenous):
    return state.square().sum(-1) + (state * state.detach()).sum(-1)


breaks("running_cost: its derivative by state 'position' is .*by finite differences", "running_cost")(partly_detached)


@breaks("running_cost: its derivative by state 'position' is -?nan", "running_cost")
def cost_with_an_infinite_slope(self, t, state, applied, exogenous):
    return state.square().sum(-1) + torch.where(state[..., 0] > 1e3, (0.0 * state[..., 0]).sqrt(), 0.0)


@breaks("vector_field: its derivative by closure weight 'matrix' is -?0, by finite", "vector_field")
def field_without_weights(self, t, state, action, exogenous, closure):
    with torch.no_grad():
        unknown = closure(state)
    return inherited("vector_field")(self, t, state, action, exogenous, lambda features: 0.0 * features) + unknown


@breaks("merit: raised RuntimeError .*not from n_steps")
def merit(self, states, applied, exogenous):
    return {"work [J]": (torch.zeros(self.n_steps, dtype=states.dtype) + applied[..., 0]).mean(-1)}


@breaks("setpoints: the setpoint of 'position .m.' has shape .*expected")
def setpoints(self, states, applied, exogenous):
    return {"position [m]": (states[..., 0], torch.zeros((), dtype=states.dtype))}


@breaks("step: plant 'linear_quadratic' diverged in realisation", "running_cost", A=((5000.0, 1.0), (-1.0, 0.0)))
def cost_of_nothing(self, t, state, applied, exogenous):
    return 0.0 * state[..., 0]


class Branching(LinearQuadratic):
    def vector_field(self, t, state, action, exogenous, closure):
        if (state[..., 0] > 0.0).any():
            action = 1.0 * action
        return super().vector_field(t, state, action, exogenous, closure)


BROKEN["branch"] = Branching, "vector_field: raised RuntimeError in .*broken_plants.py, .*data-dependent control flow"


class Late(LinearQuadratic):
    def running_cost(self, t, state, applied, exogenous):
        cost = super().running_cost(t, state, applied, exogenous)
        if t.max() > 100.0:
            cost = 2.0 * cost
        return cost


class Sorting(LinearQuadratic):
    """A plant that keeps the contract with an operator that cannot become machine code."""

    def vector_field(self, t, state, action, exogenous, closure):
        return super().vector_field(t, state, action, exogenous, closure) + 0.0 * state.sort(-1).values


CONFIG = {"weight": 2.0}


class Configured(LinearQuadratic):
    """A plant that keeps the contract, with a weight that machine code would not see change."""

    def running_cost(self, t, state, applied, exogenous):
        return CONFIG["weight"] * super().running_cost(t, state, applied, exogenous)


UNTRACEABLE = {
    Late: r"branch of Python .*running_cost, .*broken_plants\.py.*if t",
    Sorting: r"sort.*broken_plants\.py",
    Configured: r"running_cost .*reads the global CONFIG, a dict.*a buffer",
}
"""Plants that keep the contract and do not become machine code, with the reason."""
