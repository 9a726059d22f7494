"""What a module holds: a change gives another digest, and is seen at once; values of weights and buffers are inputs."""

import copy
import ctypes
import functools

import numpy as np
import pytest
import torch
from torch import nn

from rt_torchrl.programs import machine_code
from rt_torchrl.programs.contract import Holdings
from rt_torchrl.programs.machine_code import ObjectCode


class Plain:
    """An object of a user."""

    def __init__(self):
        self.gain, self.table = 2.0, [1.0, [2.0]]


class Inner(nn.Module):
    """A module with attributes of many kinds."""

    def __init__(self):
        super().__init__()
        self.linear, self.activation, self.scale = nn.Linear(2, 2).double(), torch.tanh, 2.0
        self.register_buffer("offset", torch.zeros(2, dtype=torch.float64))
        self.shift = lambda x: x + 1.0
        self.plain, self.zeros = torch.ones(2, 3, dtype=torch.float64).t(), torch.zeros(1, dtype=torch.float64)
        self.part, self.kinds, self.pair = Plain(), {"a", "b"}, (Plain(), 1.0)
        self.least = functools.partial(max, 1)

    def forward(self, x):
        return self.shift(self.activation(self.linear(x))) * self.scale + self.offset


def setting(name, value):
    return lambda m: setattr(m, name, value)


CHANGES = {
    "a number": setting("scale", 3.0),
    "an integer in place of a float": setting("scale", 2),
    "a plain tensor, behind torch's back": lambda m: m.plain.data.add_(1e-12),
    "the memory of a plain tensor": lambda m: m.plain.numpy().__setitem__((1, 1), 2.0),
    "the strides of a tensor": lambda m: m.plain.t_(),
    "the sign of a zero": lambda m: m.zeros.neg_(),
    "the dtype of a buffer": lambda m: setattr(m, "offset", m.offset.float()),
    "a set": lambda m: m.kinds.add("c"),
    "a list of an object": lambda m: m.part.table[1].append(3.0),
    "an object in a pair": lambda m: setattr(m.pair[0], "gain", 3.0),
    "an activation function": setting("activation", torch.sin),
    "another lambda": setting("shift", lambda x: x - 1.0),
    "a keyword of a partial function": lambda m: m.least.keywords.update(key=abs),
    "a default of a function": lambda m: setattr(m.shift, "__defaults__", (1.0,)),
    "a new attribute": setting("more", 0),
    "a frozen weight": lambda m: m.linear.bias.requires_grad_(False),
    "no bias": lambda m: setattr(m.linear, "bias", None),
    "evaluation": lambda m: m.eval(),
    "another submodule": setting("linear", nn.Sequential(nn.Linear(2, 2).double())),
    "a hook": lambda m: m.register_forward_hook(lambda *a: None),
    "the class of the module": lambda m: setattr(m, "__class__", type("Other", (Inner,), {})),
}
MEMORY = {
    "another parameter": lambda m: setattr(m.linear, "weight", nn.Parameter(torch.zeros(2, 2).double())),
    "other memory of a parameter": lambda m: setattr(m.linear.weight, "data", torch.zeros(2, 2).double()),
    "another buffer": lambda m: setattr(m, "offset", torch.ones(2).double()),
}
"""Changes of what machine code reads as inputs, whose memory it knows."""


@pytest.mark.parametrize("change", [*CHANGES, *MEMORY])
def test_a_change_is_seen_and_gives_another_digest(change):
    module = Inner()
    before = Holdings(module)
    assert before.unchanged(module) and Holdings(module).digest == before.digest
    (CHANGES | MEMORY)[change](module)
    assert not before.unchanged(module) and (Holdings(module).digest == before.digest) is (change in MEMORY)


def test_weights_and_buffers_may_change_their_values_and_copies_are_equal():
    module = Inner()
    module.generators = torch.Generator(), np.random.default_rng(0)
    before = Holdings(module)
    with torch.no_grad():
        module.linear.weight.add_(1.0)
        module.offset.fill_(3.0)
    torch.rand(3, generator=module.generators[0]), module.generators[1].random()
    module.load_state_dict(copy.deepcopy(module.state_dict()))
    assert before.unchanged(module)
    plain = nn.Sequential(nn.Linear(2, 2), nn.Tanh())
    assert Holdings(plain).digest == Holdings(copy.deepcopy(plain)).digest


def test_what_is_shared_is_another_program_and_a_buffer_is_compared_where_it_is_read_elsewhere():
    apart, shared = (nn.ModuleList([nn.Linear(2, 2), nn.Linear(2, 2)]) for _ in range(2))
    shared[1].weight = shared[0].weight
    assert Holdings(apart).digest != Holdings(shared).digest == Holdings(copy.deepcopy(shared)).digest
    module = Inner()
    module.part_of_it = module.offset[:1]
    before = Holdings(module)
    module.offset.fill_(3.0)
    assert not before.unchanged(module) and Holdings(module).digest != before.digest


# Object code: kept on disk, made again where it is damaged, loaded by any number of processes.


def text(number):
    """A function that stores a number where its argument points."""
    return f"define void @put(ptr %x) {{\n  store double {number:.6e}, ptr %x\n  ret void\n}}\n"


def stored(number, code=None):
    found = np.zeros(1)
    (code or ObjectCode(text(number), "put", (ctypes.c_void_p,)))(found)
    return found[0]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(machine_code, "cache_folder", lambda: tmp_path / "native")
    return tmp_path / "native"


@pytest.fixture
def compilations(monkeypatch):
    """The texts that were compiled."""
    seen, compile_ = [], machine_code._compile
    monkeypatch.setattr(machine_code, "_compile", lambda text: seen.append(text) or compile_(text))
    return seen


@pytest.mark.parametrize("damage", ["empty", "half", "one byte", "longer"])
def test_damaged_code_is_made_again(damage, folder, compilations):
    stored(1.0)
    (kept,) = folder.iterdir()
    whole = kept.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    damages = {"empty": b"", "half": whole[: len(whole) // 2], "one byte": flipped, "longer": whole + b"1"}
    kept.write_bytes(damages[damage])
    assert stored(1.0) == 1.0
    assert len(compilations) == 2 and kept.read_bytes() == whole
