"""Kinds of things that traced code reads and a user may change, with the change and what is refused."""

import argparse
import collections
import contextvars
import copy
import dataclasses
import enum
import functools
import os
import threading
import types
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import settings_of_a_user as settings
import torch
from linear_quadratic import LinearQuadratic
from settings_of_a_user import Constants
from torch import nn

SCALE, TEXT, PAIR = 0.1, "0.1", (0.1, 1.0)
NUMBERS, ARRAY = torch.tensor([0.1], dtype=torch.float64), np.array([0.1])
CONFIG, NESTED, LIST, GROUP, QUEUE = {"scale": 0.1}, ({"scale": 0.1},), [0.1], {0.1}, collections.deque([0.1])
NAMESPACE, ARGUMENTS = types.SimpleNamespace(scale=0.1), argparse.Namespace(scale=0.1)
CONTEXT, LOCAL = contextvars.ContextVar("scale", default=0.1), threading.local()
LOCAL.scale = 0.1


class Options:
    def __init__(self):
        self.scale = 0.1

    def read(self):
        return self.scale


class Slotted:
    __slots__ = ("scale",)

    def __init__(self):
        self.scale = 0.1


class Refusing(Options):
    """Cannot be pickled."""

    def __reduce_ex__(self, protocol):
        raise TypeError("no")

    def __deepcopy__(self, memo):
        found = Refusing()
        found.scale = self.scale
        return found


class RefusingSlots(Slotted):
    __slots__ = ()
    __reduce_ex__, __deepcopy__ = Refusing.__reduce_ex__, lambda self, memo: copy.copy(self)


class Dropping(Options):
    def __getstate__(self):
        return {}


@dataclasses.dataclass(frozen=True)
class Frozen:
    scale: float = 0.1


class Mode(enum.Enum):
    SLOW, FAST = 0.1, 10.0


class Pair(NamedTuple):
    scale: float
    other: float


OBJECT, SLOTS, FROZEN, MODE, LAYER, NAMED = Options(), Slotted(), Frozen(), Mode.SLOW, nn.Linear(1, 1), Pair(0.1, 1.0)
LAYER.scale = 0.1
BOUND, FUNCTIONS = OBJECT.read, {"read": lambda: SCALE}
PARTIAL = functools.partial(lambda options: options["scale"], CONFIG)


def made(scale):
    """A function of a variable around it, and one that changes the variable."""

    def read():
        return scale

    def write(value):
        nonlocal scale
        scale = value

    return read, write


READ, WRITE = made(0.1)


def by_default(options=CONFIG):
    return options["scale"]


def counted():
    return counted.scale


counted.scale = 0.1


def within(function):
    """A decorator."""

    @functools.wraps(function)
    def wrapped(*given):
        return function(*given)

    return wrapped


@within
def decorated():
    return SCALE


def imported():
    import settings_of_a_user

    return settings_of_a_user.SCALE


def imported_from():
    from settings_of_a_user import SCALE as scale

    return scale


class Scaled(LinearQuadratic):
    """A plant with a factor of its cost that comes from somewhere."""

    read = staticmethod(lambda plant: 1.0)

    def running_cost(self, t, state, applied, exogenous):
        return super().running_cost(t, state, applied, exogenous) * self.read(self)


def here(name, value):
    globals()[name] = value


def with_attributes(**attributes):
    """A plant of a class with attributes, whose names its cost reads."""
    return type("Attributed", (Scaled,), attributes)(horizon=0.5)


def read_by(function):
    return lambda: with_attributes(read=staticmethod(function))


def holding(thing, read):
    """A plant that holds a thing, as an attribute of its own or of its class."""

    def make(own=True):
        found = with_attributes(read=staticmethod(read), **({} if own else {"thing": thing()}))
        if own:
            found.thing = thing()
        return found

    return make


def surrounded():
    """A plant whose class stands in a function, and reads a variable of it."""
    scale = 0.1

    class Inner(Scaled):
        def read(self, plant):
            return scale

        def change(self, value):
            nonlocal scale
            scale = value

    return Inner(horizon=0.5)


def around_a_table():
    table = {"scale": 0.1}

    class Inner(Scaled):
        held = staticmethod(lambda: table)

        def read(self, plant):
            return table["scale"]

    return Inner(horizon=0.5)


def one(plant):
    return plant.thing.scale


def scale_of_thing(value, plant):
    plant.thing.scale = value


GLOBAL = {
    "number": (lambda plant: SCALE, lambda value, plant: here("SCALE", value)),
    "text": (lambda plant: float(TEXT), lambda value, plant: here("TEXT", str(value))),
    "tuple": (lambda plant: PAIR[0], lambda value, plant: here("PAIR", (value, 1.0))),
    "named tuple": (lambda plant: NAMED.scale, lambda value, plant: here("NAMED", Pair(value, 1.0))),
    "tensor": (lambda plant: NUMBERS, lambda value, plant: NUMBERS.fill_(value)),
    "array": (lambda plant: torch.as_tensor(ARRAY), lambda value, plant: ARRAY.fill(value)),
    "dict": (lambda plant: CONFIG["scale"], lambda value, plant: CONFIG.update(scale=value)),
    "dict in a tuple": (lambda plant: NESTED[0]["scale"], lambda value, plant: NESTED[0].update(scale=value)),
    "list": (lambda plant: LIST[0], lambda value, plant: LIST.__setitem__(0, value)),
    "set": (lambda plant: max(GROUP), lambda value, plant: GROUP.clear() or GROUP.add(value)),
    "deque": (lambda plant: QUEUE[0], lambda value, plant: QUEUE.__setitem__(0, value)),
    "object": (lambda plant: OBJECT.scale, lambda value, plant: setattr(OBJECT, "scale", value)),
    "object with slots": (lambda plant: SLOTS.scale, lambda value, plant: setattr(SLOTS, "scale", value)),
    "method of an object": (lambda plant: OBJECT.read(), lambda value, plant: setattr(OBJECT, "scale", value)),
    "bound method": (lambda plant: BOUND(), lambda value, plant: setattr(OBJECT, "scale", value)),
    "partial": (lambda plant: PARTIAL(), lambda value, plant: CONFIG.update(scale=value)),
    "namespace": (lambda plant: NAMESPACE.scale, lambda value, plant: setattr(NAMESPACE, "scale", value)),
    "arguments": (lambda plant: ARGUMENTS.scale, lambda value, plant: setattr(ARGUMENTS, "scale", value)),
    "layer": (lambda plant: LAYER.scale, lambda value, plant: setattr(LAYER, "scale", value)),
    "frozen dataclass": (lambda plant: FROZEN.scale, lambda value, plant: here("FROZEN", Frozen(value))),
    "enumeration": (lambda plant: MODE.value, lambda value, plant: here("MODE", Mode(value))),
    "context variable": (lambda plant: CONTEXT.get(), lambda value, plant: CONTEXT.set(value) and None),
    "thread's variable": (lambda plant: LOCAL.scale, lambda value, plant: setattr(LOCAL, "scale", value)),
    "environment": (
        lambda plant: float(os.environ.get("SCALE", "0.1")),
        lambda value, plant: os.environ.update(SCALE=str(value)),
    ),
    "environment by getenv": (
        lambda plant: float(os.getenv("SCALE", "0.1")),
        lambda value, plant: os.environ.update(SCALE=str(value)),
    ),
    "functions in a dict": (
        lambda plant: FUNCTIONS["read"](),
        lambda value, plant: FUNCTIONS.update(read=lambda: value),
    ),
    "nonlocal": (lambda plant: READ(), lambda value, plant: WRITE(value)),
    "function": (lambda plant: decorated(), lambda value, plant: here("decorated", lambda: value)),
    "global of a decorated function": (lambda plant: decorated(), lambda value, plant: here("SCALE", value)),
    "default": (lambda plant: by_default(), lambda value, plant: CONFIG.update(scale=value)),
    "attribute of a function": (lambda plant: counted(), lambda value, plant: setattr(counted, "scale", value)),
    "class attribute": (lambda plant: Constants.scale, lambda value, plant: setattr(Constants, "scale", value)),
    "dict of a class": (
        lambda plant: Constants.table["scale"],
        lambda value, plant: Constants.table.update(scale=value),
    ),
    "static method": (
        lambda plant: Constants.read(),
        lambda value, plant: setattr(Constants, "read", staticmethod(lambda value=value: value)),
    ),
    "global of a static method": (
        lambda plant: Constants.read(),
        lambda value, plant: setattr(settings, "SCALE", value),
    ),
    "number of another module": (
        lambda plant: settings.SCALE,
        lambda value, plant: setattr(settings, "SCALE", value),
    ),
    "dict of another module": (
        lambda plant: settings.CONFIG["scale"],
        lambda value, plant: settings.CONFIG.update(scale=value),
    ),
    "function of another module": (
        lambda plant: settings.scale(),
        lambda value, plant: settings.CONFIG.update(scale=value),
    ),
    "object of another module": (
        lambda plant: settings.OPTIONS.scale,
        lambda value, plant: setattr(settings.OPTIONS, "scale", value),
    ),
    "class of another module": (
        lambda plant: settings.Constants.scale,
        lambda value, plant: setattr(settings.Constants, "scale", value),
    ),
    "import": (lambda plant: imported(), lambda value, plant: setattr(settings, "SCALE", value)),
    "import from": (lambda plant: imported_from(), lambda value, plant: setattr(settings, "SCALE", value)),
}
HELD = {
    "object": (holding(Options, one), scale_of_thing),
    "object with slots": (holding(Slotted, one), scale_of_thing),
    "object that refuses pickle": (holding(Refusing, one), scale_of_thing),
    "slots that refuse pickle": (
        holding(RefusingSlots, one),
        scale_of_thing,
    ),
    "object that drops its state": (holding(Dropping, one), scale_of_thing),
    "list": (
        holding(lambda: [0.1], lambda plant: plant.thing[0]),
        lambda value, plant: plant.thing.__setitem__(0, value),
    ),
    "dict": (
        holding(lambda: {"scale": 0.1}, lambda plant: plant.thing["scale"]),
        lambda value, plant: plant.thing.update(scale=value),
    ),
    "tensor": (
        holding(lambda: torch.tensor(0.1, dtype=torch.float64), lambda plant: plant.thing),
        lambda value, plant: plant.thing.fill_(value),
    ),
    "array": (
        holding(lambda: np.array([0.1]), lambda plant: torch.as_tensor(plant.thing)),
        lambda value, plant: plant.thing.fill(value),
    ),
    "context variable": (
        holding(lambda: CONTEXT, lambda plant: plant.thing.get()),
        lambda value, plant: CONTEXT.set(value) and None,
    ),
    "number": (
        holding(lambda: 0.1, lambda plant: plant.thing),
        lambda value, plant: setattr(plant if "thing" in vars(plant) else type(plant), "thing", value),
    ),
}
KINDS = {f"global {kind}": (read_by(read), change) for kind, (read, change) in GLOBAL.items()}
KINDS |= {f"attribute {kind}": given for kind, given in HELD.items()}
KINDS |= {f"class {kind}": (functools.partial(make, own=False), change) for kind, (make, change) in HELD.items()}
KINDS["variable around a class"] = (surrounded, lambda value, plant: plant.change(value))
KINDS["dict around a class"] = (around_a_table, lambda value, plant: plant.held().update(scale=value))
REFUSED = {
    "global dict": "CONFIG, a dict",
    "global dict in a tuple": "NESTED, a tuple",
    "global list": "LIST, a list",
    "global set": "GROUP, a set",
    "global deque": "QUEUE, a deque",
    "global object": "OBJECT, an Options",
    "global object with slots": "SLOTS, a Slotted",
    "global method of an object": "OBJECT, an Options",
    "global bound method": "BOUND",
    "global partial": "PARTIAL",
    "global namespace": "NAMESPACE",
    "global arguments": "ARGUMENTS",
    "global layer": "LAYER, a Linear",
    "global context variable": "CONTEXT, a ContextVar",
    "global thread's variable": "LOCAL",
    "global environment": "os.environ",
    "global environment by getenv": "os.environ",
    "global functions in a dict": "FUNCTIONS, a dict",
    "global default": "a default of an argument, a dict",
    "global dict of a class": "Constants.table, a dict",
    "global dict of another module": "settings.CONFIG, a dict",
    "global function of another module": "CONFIG, a dict",
    "global object of another module": "settings.OPTIONS",
    "global import": "imports 'settings_of_a_user' inside",
    "global import from": "imports 'settings_of_a_user' inside",
    "dict around a class": "variable table of the function around it, a dict",
} | {
    f"class {kind}": "class attribute Attributed.thing" for kind in (*(name for name in HELD if "number" not in name),)
}
"""What is refused, with words of the message; everything else is followed."""


@contextmanager
def as_before(monkeypatch):
    """A context that begins with the same settings, whatever was changed before."""
    for name in ("SCALE", "TEXT", "PAIR", "NAMED", "FROZEN", "MODE", "decorated", "QUEUE"):
        monkeypatch.setitem(globals(), name, copy.deepcopy(globals()[name]))
    monkeypatch.setattr(settings, "SCALE", 0.1)
    for holder in (Constants, counted, OBJECT, SLOTS, NAMESPACE, ARGUMENTS, LAYER, LOCAL, settings.OPTIONS):
        monkeypatch.setattr(holder, "scale", 0.1)
    monkeypatch.setattr(Constants, "read", vars(Constants)["read"])
    for table in (CONFIG, NESTED[0], settings.CONFIG, Constants.table, FUNCTIONS):
        for key, value in [*table.items()]:
            monkeypatch.setitem(table, key, value)
    LIST[0] = 0.1
    monkeypatch.setenv("SCALE", "0.1")
    NUMBERS.fill_(0.1), ARRAY.fill(0.1), GROUP.clear(), GROUP.add(0.1), WRITE(0.1)
    token = CONTEXT.set(0.1)
    yield
    CONTEXT.reset(token)
