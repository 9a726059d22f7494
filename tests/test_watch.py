"""Watches: they tell at once that a fingerprint may be another one, and never miss a change."""

import collections
import copy
import functools
import gc
import weakref

import numpy as np
import pytest
import test_fingerprint
import torch
from linear_quadratic import LinearClosure, LinearQuadratic
from test_fingerprint import CHANGES, ODD, Inner, counting
from torch import nn

from rt_torchrl.programs.fingerprint import fingerprint
from rt_torchrl.trajectories.engines import programs
from rt_torchrl.trajectories.rollout import Rollout


def watch_of(module):
    found = fingerprint(module).watch
    assert found.holds(module)
    return found


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_seen(change):
    module = Inner()
    watch = watch_of(module)
    CHANGES[change](module)
    assert not watch.holds(module)


class Plain:
    """An object of a user."""

    def __init__(self):
        self.gain, self.table = 2.0, [1.0, [2.0]]


class Rich(Inner):
    """A module with everything that a watch compares."""

    def __init__(self):
        super().__init__()
        self.part, self.array, self.kinds = Plain(), np.ones(3), {"a", "b"}
        self.ordered, self.pair = collections.OrderedDict(a=1), (Plain(), 1.0)
        self.transposed = torch.ones(2, 3, dtype=torch.float64).t()
        self.method = self.part.__init__


class Other(Plain):
    pass


FURTHER = {
    "a buffer, behind torch's back": lambda m: m.offset.data.add_(1e-12),
    "the memory of a buffer": lambda m: m.offset.numpy().__setitem__(0, 1.0),
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


@pytest.mark.parametrize("change", FURTHER)
def test_a_hidden_change_is_seen(change):
    module = Rich()
    watch = watch_of(module)
    FURTHER[change](module)
    assert not watch.holds(module)


GLOBALS = {"GRAVITY": 1.62, "TABLE": test_fingerprint.TABLE.clone(), "weight_force": lambda x: x}


@pytest.mark.parametrize("name", GLOBALS)
def test_a_changed_global_is_seen(name, monkeypatch):
    module = Inner()
    watch = watch_of(module)
    monkeypatch.setitem(vars(test_fingerprint), name, GLOBALS[name])
    assert not watch.holds(module)


def test_the_content_of_a_global_is_seen():
    module = Inner()
    watch = watch_of(module)
    test_fingerprint.TABLE.mul_(2.0)
    assert not watch.holds(module)
    test_fingerprint.TABLE.div_(2.0)
    assert watch.holds(module)


LEVEL = 1.0


def level(x):
    return LEVEL * x


def test_what_a_replaced_function_reads_is_seen(monkeypatch):
    """Its globals are others than those of the function before."""
    module = Inner()
    monkeypatch.setitem(vars(test_fingerprint), "weight_force", level)
    before, _, watch = fingerprint(module)
    monkeypatch.setitem(globals(), "LEVEL", 2.0)
    assert not watch.holds(module) and fingerprint(module).digest != before


@pytest.mark.parametrize("name", ["greatest", "forward", "new"])
def test_a_changed_class_is_seen(name, monkeypatch):
    module = Inner()
    watch = watch_of(module)
    monkeypatch.setattr(Inner, name, lambda self, x: x, raising=False)
    assert not watch.holds(module)


def test_other_base_classes_are_seen():
    first, second = (type(name, (Inner,), {}) for name in ("First", "Second"))
    module = type("Derived", (first,), {})()
    watch = watch_of(module)
    type(module).__bases__ = (second,)
    assert not watch.holds(module)


def test_variables_of_functions_are_seen():
    module, (read, write) = Inner(), counting(1.0)
    module.shift = read
    watch = watch_of(module)
    write(2.0)
    assert not watch.holds(module)


def test_weights_may_change_their_values():
    module = Inner()
    watch = watch_of(module)
    with torch.no_grad():
        module.linear.weight.add_(1.0)
    module(torch.ones(1, 2, dtype=torch.float64)).sum().backward()
    torch.optim.Adam(module.parameters()).step()
    module.load_state_dict(copy.deepcopy(module.state_dict()))
    torch.rand(1)
    assert watch.holds(module)


@pytest.mark.parametrize("change", ["parameter", "data"])
def test_other_weights_are_seen(change):
    """Machine code reads the memory of the weights."""
    module, other = Inner(), nn.Parameter(torch.zeros(2, 2, dtype=torch.float64))
    watch = watch_of(module)
    if change == "parameter":
        module.linear.weight = other
    else:
        module.linear.weight.data = other.data
    assert not watch.holds(module)


class Counting:
    """Pickles what it computes."""

    def __init__(self):
        self.count = [0]

    def __reduce__(self):
        return Counting, (), {"count": [*self.count]}


class Slotted:
    __slots__ = ("gain",)


class Growing(list):
    pass


def with_slot():
    found = Slotted()
    found.gain = 1.0
    return found


UNWATCHED = {
    "a reduction of its own": (Counting, lambda x: x.count.append(1)),
    "slots": (with_slot, lambda x: setattr(x, "gain", 2.0)),
    "a list of its own": (Growing, lambda x: x.append(1.0)),
    "a queue": (collections.deque, lambda x: x.append(1.0)),
    "an array of objects": (lambda: np.array([[1.0], None], dtype=object), lambda x: x[0].append(2.0)),
    "a partial function": (lambda: functools.partial(max, 1), lambda x: x.keywords.update(key=abs)),
}


@pytest.mark.parametrize("kind", UNWATCHED)
def test_what_cannot_be_watched_has_always_changed(kind):
    make, change = UNWATCHED[kind]
    module = Inner()
    module.odd = make()
    before, _, watch = fingerprint(module)
    change(module.odd)
    assert fingerprint(module).digest != before and not watch.holds(module)


@pytest.mark.parametrize("kind", ODD)
def test_odd_attributes(kind):
    module = Inner()
    module.odd = ODD[kind]()
    watch = fingerprint(module).watch
    module.odd = None
    assert not watch.holds(module)


def test_a_watch_keeps_no_module_alive():
    module = Inner()
    watch, seen = fingerprint(module).watch, weakref.ref(module)
    del module
    gc.collect()
    assert seen() is None and watch is not None


def test_a_rollout_makes_a_fingerprint_once(monkeypatch):
    """Until something of its interval changes; then its cost is that of the changed interval."""
    made = []
    monkeypatch.setattr(programs, "fingerprint", lambda module: made.append(module) or fingerprint(module))
    plant, closure = LinearQuadratic(), LinearClosure(torch.zeros(2, 2))
    generator = torch.Generator().manual_seed(0)
    policy, scenario = (
        plant.make_policy(generator),
        (plant.draw_initial_state(3, generator), torch.ones(3, 4, 1).double()),
    )
    native, exact = (Rollout(plant, closure, policy, engine=engine) for engine in ("native", "autograd"))
    for _ in range(3):
        native.costs(*scenario).sum().backward()
        torch.optim.SGD(policy.parameters(), lr=1e-3).step()
        torch.testing.assert_close(native.costs(*scenario), exact.costs(*scenario))
    assert len(made) == 1
    plant._A.data.mul_(2.0)
    torch.testing.assert_close(native.costs(*scenario), exact.costs(*scenario))
    assert len(made) == 2
