"""Fingerprints: what changes a module's results changes its fingerprint, apart from the values of its weights."""

import copy
import functools
import threading
import types

import numpy as np
import pytest
import torch
from torch import nn

from rt_torchrl.programs.fingerprint import fingerprint

GRAVITY = 9.81
TABLE = torch.tensor([1.0, 2.0], dtype=torch.float64)


def weight_force(x):
    return GRAVITY * x


class Constants:
    """A namespace."""

    density = 1.2


class Inner(nn.Module):
    """Reads a global through a function, and an attribute of its class."""

    greatest = 3.0

    def __init__(self):
        super().__init__()
        self.linear, self.activation = nn.Linear(2, 2).double(), torch.tanh
        self.register_buffer("offset", torch.zeros(2, dtype=torch.float64))
        self.scale, self.names, self.inner, self.shift = 2.0, ["a"], {"k": (1, 2)}, lambda x: x + 1.0
        self.plain = torch.ones(2, dtype=torch.float64)

    def forward(self, x):
        return self.shift(weight_force(self.activation(self.linear(x)))) * self.scale + self.offset * TABLE


def digest(module):
    return fingerprint(module)[0]


def counting(start):
    """A function with a variable of its own, and one that changes it."""
    count = start

    def read(x):
        return x * count

    def write(value):
        nonlocal count
        count = value

    return read, write


def _setting(name, value):
    return lambda m: setattr(m, name, value)


CHANGES = {
    "a number": _setting("scale", 3.0),
    "an integer in place of a float": _setting("scale", 2),
    "an element of a list": lambda m: m.names.append("b"),
    "an element of a dictionary": lambda m: m.inner.update(k=(1, 3)),
    "a buffer": lambda m: m.offset.add_(1e-12),
    "a plain tensor": lambda m: m.plain.mul_(2.0),
    "the dtype of a buffer": lambda m: setattr(m, "offset", m.offset.float()),
    "an activation function": _setting("activation", torch.sin),
    "another lambda": _setting("shift", lambda x: x - 1.0),
    "a new attribute": _setting("more", 0),
    "a frozen weight": lambda m: m.linear.bias.requires_grad_(False),
    "no bias": lambda m: setattr(m.linear, "bias", None),
    "evaluation": lambda m: m.eval(),
    "another submodule": _setting("linear", nn.Sequential(nn.Linear(2, 2).double())),
    "a hook": lambda m: m.register_forward_hook(lambda *a: None),
    "the sign of a zero": lambda m: m.offset.neg_(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_seen(change):
    module = Inner()
    before = digest(module)
    assert digest(module) == before
    CHANGES[change](module)
    assert digest(module) != before


@pytest.mark.parametrize("name, value", [("GRAVITY", 1.62), ("TABLE", 2.0 * TABLE), ("weight_force", lambda x: x)])
def test_a_changed_global_is_seen(name, value, monkeypatch):
    module = Inner()
    before = digest(module)
    monkeypatch.setitem(globals(), name, value)
    assert digest(module) != before
    monkeypatch.undo()
    assert digest(module) == before


@pytest.mark.parametrize("name", ["greatest", "forward"])
def test_a_changed_class_is_seen(name, monkeypatch):
    module = Inner()
    before = digest(module)
    monkeypatch.setattr(Inner, name, lambda self, x: x)
    assert digest(module) != before


def test_variables_and_defaults_of_functions_are_seen():
    module, (read, write) = Inner(), counting(1.0)
    module.shift = read
    before = digest(module)
    write(2.0)
    assert digest(module) != before
    digests = set()
    for power in (2.0, 3.0):
        module.shift = lambda x, power=power: x**power
        digests.add(digest(module))
        module.shift = functools.partial(torch.pow, exponent=power)
        digests.add(digest(module))
    assert len(digests) == 4


def test_weights_may_change_and_copies_are_equal():
    module = Inner()
    before = digest(module)
    with torch.no_grad():
        module.linear.weight.add_(1.0)
    module.linear.weight = nn.Parameter(torch.zeros(2, 2, dtype=torch.float64))
    assert digest(module) == digest(copy.deepcopy(module)) == before


def test_shared_weights_are_another_program():
    apart, shared = (nn.ModuleList([nn.Linear(2, 2), nn.Linear(2, 2)]) for _ in range(2))
    shared[1].weight = shared[0].weight
    assert digest(apart) != digest(shared) == digest(copy.deepcopy(shared))


def _recursive(x):
    return _recursive(x - 1.0) if x > 0 else x


def _local_class():
    class Local:
        def __init__(self):
            self.gain = 2.0

    return Local()


class Refusing:
    """Cannot be pickled, and says so by an unusual error."""

    def __reduce_ex__(self, protocol):
        raise RuntimeError("no")


def _closure_of_itself():
    def f(x):
        return f(x)

    return f


ODD = {
    "a lock": threading.Lock,
    "a generator of Python": lambda: (i for i in range(3)),
    "a local class": _local_class,
    "a refusing object": Refusing,
    "a recursive function": lambda: _recursive,
    "a function that holds itself": _closure_of_itself,
    "a cached local function": lambda: functools.cache(_closure_of_itself()),
    "a module": lambda: np,
    "a bound method": lambda: Inner().forward,
    "a file": lambda: open(__file__, encoding="utf-8"),  # noqa: SIM115
    "an operator of torch": lambda: torch.ops.aten.sin.default,
    "a method of tensors": lambda: torch.Tensor.sin,
    "a class": lambda: Constants,
    "a universal function": lambda: np.sin,
}


@pytest.mark.parametrize("kind", ODD)
def test_odd_attributes(kind):
    module = Inner()
    module.odd = ODD[kind]()
    before = digest(module)
    assert digest(module) == before
    module.odd = None
    assert digest(module) != before


def test_generators_may_be_used():
    module = Inner()
    module.torch, module.numpy = torch.Generator(), np.random.default_rng(0)
    before = digest(module)
    torch.rand(3, generator=module.torch), module.numpy.random()
    assert digest(module) == before


def test_objects_known_by_address_are_kept_alive():
    module, seen, kept = Inner(), set(), []
    for _ in range(50):  # the address of a lock that is freed would be taken by the next one
        module.odd = threading.Lock()
        found, alive, _ = fingerprint(module)
        kept.append(alive)
        assert found not in seen
        seen.add(found)


def test_functions_with_the_same_code_read_globals_of_their_own():
    first, second = ({"LEVEL": 1.0, "__name__": name} for name in ("first", "second"))
    code = (lambda self: LEVEL).__code__  # noqa: F821
    methods = {name: types.FunctionType(code, held) for name, held in (("low", first), ("high", second))}
    module = type("Levels", (Inner,), methods)()
    before = fingerprint(module).digest
    second["LEVEL"] = 2.0
    assert fingerprint(module).digest != before
