"""What a module holds: a change gives another digest, and is seen at once; values of weights and buffers are inputs."""

import collections
import copy
import functools
import gc
import threading
import types
import weakref

import numpy as np
import pytest
import torch
from torch import nn

from rt_torchrl.programs.contract import Holdings

TABLE = {}


class Constants:
    """A namespace."""

    density = 1.2


class Inner(nn.Module):
    """A module with attributes of many kinds."""

    greatest = 3.0

    def __init__(self):
        super().__init__()
        self.linear, self.activation = nn.Linear(2, 2).double(), torch.tanh
        self.register_buffer("offset", torch.zeros(2, dtype=torch.float64))
        self.scale, self.names, self.inner, self.shift = 2.0, ["a"], {"k": (1, 2)}, lambda x: x + 1.0
        self.plain, self.zeros = torch.ones(2, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)

    def forward(self, x):
        return self.shift(self.activation(self.linear(x))) * self.scale + self.offset


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
    "the sign of a zero": lambda m: m.zeros.neg_(),
}


class Plain:
    """An object of a user."""

    def __init__(self):
        self.gain, self.table = 2.0, [1.0, [2.0]]


class Rich(Inner):
    """A module with everything that is compared."""

    def __init__(self):
        super().__init__()
        self.part, self.array, self.kinds = Plain(), np.ones(3), {"a", "b"}
        self.ordered, self.pair = collections.OrderedDict(a=1), (Plain(), 1.0)
        self.transposed = torch.ones(2, 3, dtype=torch.float64).t()
        self.method = self.part.__init__


class Other(Plain):
    pass


FURTHER = {
    "a plain tensor, behind torch's back": lambda m: m.plain.data.add_(1e-12),
    "the memory of a plain tensor": lambda m: m.plain.numpy().__setitem__(0, 2.0),
    "the type of a weight": lambda m: m.linear.float(),
    "other memory for a buffer": lambda m: setattr(m.offset, "data", torch.zeros(2, dtype=torch.float64)),
    "a transposed tensor": lambda m: m.transposed.numpy().__setitem__((1, 1), 2.0),
    "the strides of a tensor": lambda m: m.transposed.t_(),
    "an array": lambda m: m.array.__setitem__(1, 2.0),
    "the shape of an array": lambda m: setattr(m.array, "shape", (3, 1)),
    "a set": lambda m: m.kinds.add("c"),
    "an ordered dictionary": lambda m: m.ordered.update(b=2),
    "another key for the same number": lambda m: m.ordered.update(b=m.ordered.pop("a")),
    "an attribute of an object": lambda m: setattr(m.part, "gain", 3.0),
    "a list of an object": lambda m: m.part.table[1].append(3.0),
    "an object in a pair": lambda m: setattr(m.pair[0], "gain", 3.0),
    "the class of an object": lambda m: setattr(m.part, "__class__", Other),
    "all attributes of an object": lambda m: setattr(m.part, "__dict__", {**vars(m.part), "gain": 3.0}),
    "all attributes of the module": lambda m: setattr(m, "__dict__", {**vars(m), "scale": 3.0}),
    "the class of the module": lambda m: setattr(m, "__class__", Inner),
    "the first hook of a layer": lambda m: m.linear.register_forward_pre_hook(lambda *a: None),
    "a buffer that is not saved": lambda m: m.register_buffer("late", torch.zeros(1), persistent=False),
    "a default of a function": lambda m: setattr(m.shift, "__defaults__", (1.0,)),
    "the code of a function": lambda m: setattr(m.shift, "__code__", (lambda x: x - 3.0).__code__),
}


def held(module):
    found = Holdings(module)
    assert found.unchanged(module) and Holdings(module).digest == found.digest
    return found


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_gives_another_digest(change):
    module = Rich()
    before = held(module)
    CHANGES[change](module)
    assert not before.unchanged(module) and Holdings(module).digest != before.digest


@pytest.mark.parametrize("change", FURTHER)
def test_a_hidden_change_is_seen(change):
    module = Rich()
    before = held(module)
    FURTHER[change](module)
    assert not before.unchanged(module)


def test_variables_and_defaults_of_functions_are_seen():
    module, (read, write) = Inner(), counting(1.0)
    module.shift = read
    before = held(module)
    write(2.0)
    assert not before.unchanged(module) and Holdings(module).digest != before.digest
    digests = set()
    for power in (2.0, 3.0):
        module.shift = lambda x, power=power: x**power
        digests.add(Holdings(module).digest)
        module.shift = functools.partial(torch.pow, exponent=power)
        digests.add(Holdings(module).digest)
    assert len(digests) == 4


def test_weights_and_buffers_may_change_their_values_and_copies_are_equal():
    module = Inner()
    before = held(module)
    with torch.no_grad():
        module.linear.weight.add_(1.0)
        module.offset.fill_(3.0)
    module(torch.ones(1, 2, dtype=torch.float64)).sum().backward()
    torch.optim.Adam(module.parameters()).step()
    module.load_state_dict(copy.deepcopy(module.state_dict()))
    assert before.unchanged(module)
    module.linear.weight = nn.Parameter(torch.zeros(2, 2, dtype=torch.float64))
    assert Holdings(module).digest == Holdings(copy.deepcopy(module)).digest == before.digest


@pytest.mark.parametrize("change", ["parameter", "data", "buffer"])
def test_other_memory_of_inputs_is_seen(change):
    """Machine code reads the memory of weights and buffers."""
    module, other = Inner(), nn.Parameter(torch.zeros(2, 2, dtype=torch.float64))
    before = held(module)
    if change == "parameter":
        module.linear.weight = other
    elif change == "data":
        module.linear.weight.data = other.data
    else:
        module.offset = torch.ones(2, dtype=torch.float64)
    assert not before.unchanged(module) and Holdings(module).digest == before.digest


def test_a_buffer_that_is_also_read_elsewhere_is_compared_there():
    module = Inner()
    module.part = module.offset[:1]
    before = held(module)
    module.offset.fill_(3.0)
    assert not before.unchanged(module) and Holdings(module).digest != before.digest


def test_shared_weights_are_another_program():
    apart, shared = (nn.ModuleList([nn.Linear(2, 2), nn.Linear(2, 2)]) for _ in range(2))
    shared[1].weight = shared[0].weight
    assert Holdings(apart).digest != Holdings(shared).digest == Holdings(copy.deepcopy(shared)).digest


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
    before = Holdings(module)
    assert Holdings(module).digest == before.digest
    module.odd = None
    assert not before.unchanged(module) and Holdings(module).digest != before.digest


def test_generators_may_be_used():
    module = Inner()
    module.torch, module.numpy = torch.Generator(), np.random.default_rng(0)
    before = held(module)
    torch.rand(3, generator=module.torch), module.numpy.random()
    assert before.unchanged(module)


def test_objects_known_by_address_are_kept_alive():
    module, seen, kept = Inner(), set(), []
    for _ in range(50):  # the address of a lock that is freed would be taken by the next one
        module.odd = threading.Lock()
        found = Holdings(module)
        kept.append(found.alive)
        assert found.digest not in seen
        seen.add(found.digest)


def test_no_module_is_kept_alive():
    module = Inner()
    found, seen = Holdings(module), weakref.ref(module)
    del module
    gc.collect()
    assert seen() is None and found is not None


class Slotted:
    __slots__ = ("gain",)


class Growing(list):
    pass


def with_slot():
    found = Slotted()
    found.gain = 1.0
    return found


CHANGING = {
    "slots": (with_slot, lambda x: setattr(x, "gain", 2.0)),
    "a list of its own": (Growing, lambda x: x.append(1.0)),
    "a queue": (collections.deque, lambda x: x.append(1.0)),
    "an array of objects": (lambda: np.array([[1.0], None], dtype=object), lambda x: x[0].append(2.0)),
    "a partial function": (lambda: functools.partial(max, 1), lambda x: x.keywords.update(key=abs)),
    "a view of a dictionary": (lambda: types.MappingProxyType(TABLE), lambda x: TABLE.update(a=len(TABLE))),
    "an object that cannot be pickled": (Refusing, lambda x: setattr(x, "gain", 2.0)),
}


@pytest.mark.parametrize("kind", CHANGING)
def test_objects_of_every_kind_are_read(kind):
    make, change = CHANGING[kind]
    module = Inner()
    module.odd = make()
    before = Holdings(module)
    change(module.odd)
    assert not before.unchanged(module) and Holdings(module).digest != before.digest
