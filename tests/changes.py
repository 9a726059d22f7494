"""Kinds of things that traced code reads and a user may change, from ``data/changes.txt``, and the things."""

import array
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
from traced_function import sections

SCALE, TEXT, PAIR = 0.1, "0.1", (0.1, 1.0)
READ_BY_THE_TABLE = (os, array)
NUMBERS, ARRAY = torch.tensor([0.1], dtype=torch.float64), np.array([0.1])
CONFIG, NESTED, LIST, GROUP, QUEUE = {"scale": 0.1}, ({"scale": 0.1},), [0.1], {0.1}, collections.deque([0.1])
NAMESPACE, CONTEXT = types.SimpleNamespace(scale=0.1), contextvars.ContextVar("scale", default=0.1)
LOCAL = threading.local()
LOCAL.scale = 0.1


class Options:
    def __init__(self):
        self.scale = 0.1

    def read(self):
        return self.scale


class Slotted:
    __slots__ = ("scale",)
    __init__ = Options.__init__


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


def here(**values):
    globals().update(values)


def with_attributes(**attributes):
    """A plant of a class with attributes, whose names its cost reads."""
    return type("Attributed", (Scaled,), attributes)(horizon=0.5)


def holding(thing, read, *, own):
    """A plant that holds a thing, as an attribute of its own or of its class."""
    plant = with_attributes(read=staticmethod(read), **({} if own else {"thing": thing}))
    if own:
        plant.thing = thing
    return plant


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


def evaluated(arguments, text):
    return eval(f"lambda {arguments}: {text}", globals())


KINDS = {}
"""Maker of a plant, change to a value, and words of the refusal by the kind; without them the change is followed."""
TABLE = sections("changes.txt")
for row in TABLE["global"].values():
    kind, read, change = row.parts
    make = functools.partial(with_attributes, read=staticmethod(evaluated("plant", read)))
    KINDS[f"global {kind}"] = make, evaluated("value, plant", change), row.word
for row in TABLE["held"].values():
    thing, read, change = map(evaluated, ("", "plant", "value, plant"), row.parts)
    for where in ("attribute", "class"):
        plain = where == "attribute" or row.parts[0] == "0.1"
        make = functools.partial(
            lambda thing, read, own: holding(thing(), read, own=own), thing, read, where != "class"
        )
        KINDS[f"{where} {row.parts[0]}"] = make, change, None if plain else "class attribute Attributed.thing"
KINDS["variable around a class"] = surrounded, lambda value, plant: plant.change(value), None
KINDS["dict around a class"] = (
    around_a_table,
    lambda value, plant: plant.held().update(scale=value),
    "variable table of the function around it, a dict",
)


@contextmanager
def as_before(monkeypatch):
    """A context that begins with the same settings, whatever was changed before."""
    for name in ("SCALE", "TEXT", "PAIR", "NAMED", "FROZEN", "MODE", "decorated", "QUEUE"):
        monkeypatch.setitem(globals(), name, copy.deepcopy(globals()[name]))
    monkeypatch.setattr(settings, "SCALE", 0.1)
    for holder in (Constants, counted, OBJECT, SLOTS, NAMESPACE, LAYER, LOCAL, settings.OPTIONS):
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
