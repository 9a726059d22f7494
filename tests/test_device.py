"""Whole trainings on a device that is not the CPU: every tensor lies where the run's generator does."""

import dataclasses
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from small_runs import FULL, SMALL
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

from rt_torchrl.runs.command_line import load_recipe
from rt_torchrl.runs.run_folder import load_tensors, save_tensors
from rt_torchrl.steps.config import AssimilationConfig, PlannerConfig


class _Backend(_DummyBackendModule):
    """What ``torch.cuda`` is to CUDA."""

    def synchronize(self, device=None):
        """Nothing: all is done at once."""

    def get_rng_state(self, device=None):
        return torch.get_rng_state()

    def set_rng_state(self, state, device=None):
        """Nothing: its global generator is that of the CPU."""

    def get_amp_supported_dtype(self):
        """No type of lower precision; torch asks whenever it knows a device of this name."""
        return []


NAME = "pretend"
_setup_privateuseone_for_python_backend(NAME, backend_module=_Backend())
DEVICE = torch.device(NAME, 0)
REAL = torch.Generator
aten = torch.ops.aten
MOVES = (aten._to_copy.default, aten.copy_.default)
INDEXING = (aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default)
FROM_DATA = (torch.tensor, torch.as_tensor, torch.asarray)
READ = (torch.Tensor.tolist, torch.Tensor.__format__)
PLACES = (torch.Tensor.__getitem__, torch.Tensor.__setitem__)


class PretendTensor(torch.Tensor):
    """Says that it is on the device, around a tensor on the CPU."""

    @staticmethod
    def __new__(cls, inner):
        like = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        return torch.Tensor._make_wrapper_subclass(cls, inner.size(), device=DEVICE, **like)

    def __init__(self, inner):
        self.inner = inner

    def __repr__(self):
        return f"PretendTensor({self.inner})"

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return carried_out(func, args, kwargs or {})


class PretendGenerator(REAL):
    """A generator of the device."""

    def __new__(cls):
        return super().__new__(cls, "cpu")

    @property
    def device(self):
        return DEVICE


class _AnyGenerator(type):
    def __instancecheck__(cls, instance):
        return type.__instancecheck__(REAL, instance)


class _Generator(metaclass=_AnyGenerator):
    """Stands for ``torch.Generator``, which makes none of a device that torch was not built for."""

    def __new__(cls, device="cpu"):
        return PretendGenerator() if torch.device(device).type == NAME else REAL(device=device)


class PretendKernels(TorchDispatchMode):
    """Makes a tensor on the device where one is asked for there; what has one among its arguments needs no mode."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return carried_out(func, args, kwargs or {})


class PretendFunctions(TorchFunctionMode):
    """What torch does with a device above its kernels."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func in FROM_DATA and kwargs.get("device") is not None:
            return func(*args, **kwargs | {"device": None}).to(kwargs["device"])
        if func is torch.Tensor.new_tensor:
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(args[0].device)
        if func in READ:
            args = (args[0].cpu(), *args[1:])
        if func is torch.Tensor.numpy and isinstance(args[0], PretendTensor):
            raise TypeError(f"numpy cannot read a tensor on {DEVICE}; copy it to the CPU first.")
        if func in PLACES and isinstance(args[0], PretendTensor):
            # Torch lifts a list of places to the device below any mode.
            args = (args[0], lifted(args[1]), *args[2:])
        found = func(*args, **kwargs)
        # The kernels get another object for the generator, which does not know its device.
        for given in (x for x in (*args, *kwargs.values()) if isinstance(x, REAL)):
            if isinstance(found, torch.Tensor) and found.device.type != given.device.type:
                raise RuntimeError(f"{func.__name__}: generator on {given.device}, tensor on {found.device}.")
        return found


def lifted(index):
    """A place in a tensor, with tensors for sequences."""
    parts = index if isinstance(index, tuple) else (index,)
    found = (torch.tensor(x, dtype=None if x else torch.long) if isinstance(x, list | tuple) else x for x in parts)
    return tuple(found)


def carried_out(func, args, kwargs):
    """The operation on the CPU; its result is on the device if it was asked for there, or is made of such tensors."""
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    others = [x for x in tensors if not isinstance(x, PretendTensor)]
    if len(others) < len(tensors) and not may_mix(func, args, others):
        raise RuntimeError(f"{func}: expected all tensors on {DEVICE}, {[tuple(x.shape) for x in others]} are on cpu.")
    asked = kwargs.get("device")
    there = len(others) < len(tensors) if asked is None else torch.device(asked).type == NAME
    if func is aten.copy_.default:
        there = isinstance(args[0], PretendTensor)
    inner, named = tree_map_only(PretendTensor, lambda x: x.inner, (args, kwargs))
    if asked is not None:
        named["device"] = torch.device("cpu")
    # A tensor of zeros without memory cannot be wrapped.
    kernel = aten.zeros.default if func is aten._efficientzerotensor.default else func
    found = kernel(*inner, **named)
    if not there:
        return args[0] if func is aten.copy_.default else found
    return return_and_correct_aliasing(func, args, kwargs, tree_map_only(torch.Tensor, PretendTensor, found))


def may_mix(func, args, others):
    """Whether CUDA too takes these tensors of the CPU beside its own."""
    if func in MOVES or not others:
        return True
    here = isinstance(args[0], PretendTensor)
    if func in INDEXING:  # the places may lie on the CPU
        return here and (len(args) < 3 or isinstance(args[2], PretendTensor) or not args[2].dim())
    numbers = torch.Tag.pointwise in func.tags and not any(x.dim() for x in others)
    return numbers and (here or not func._schema.is_mutable)


@contextmanager
def pretend_device() -> Iterator[torch.device]:
    """The device, as long as the block lasts; ``device="pretend"`` names it."""
    # The backward pass of a device has a thread of its own, which the modes do not reach.
    with torch.autograd.set_multithreading_enabled(False), PretendFunctions(), PretendKernels():
        torch.Generator = _Generator
        try:
            yield DEVICE
        finally:
            torch.Generator = REAL


RECIPES = Path(__file__).parent.parent / "recipes"
# One gradient of each kind makes every kind of tensor.
LEARNER = dataclasses.replace(FULL.learner, critic_iterations=2, actor_iterations=1)
STEPS = {"assimilation": AssimilationConfig(iterations=1), "planner": PlannerConfig(iterations=1), "learner": LEARNER}
ESTIMATED = AssimilationConfig(
    iterations=1, method="levenberg_marquardt", inputs="record", initial="estimated", prior=0.1, segment=2
)
NEURAL = {"closure": "mlp", "policy": "mlp", "hidden": (4,)}
TD3 = dataclasses.replace(LEARNER, algorithm="td3")


@pytest.fixture
def train(tmp_path, monkeypatch):
    """Trains by a recipe on the pretended device, which refuses to mix its tensors with those of the CPU."""

    def run(recipe, *, twinning=None, **options):
        module = load_recipe(RECIPES / f"{recipe}.py")
        small = {"episodes": 1, "unseen": 2, "figures": False, "threads": 1, "device": NAME, "log_dir": tmp_path}
        steps = dataclasses.replace(SMALL, **STEPS | (twinning or {}))
        with pretend_device():
            module.main(module.Config(**small | options, twinning=steps))
        return json.loads((tmp_path / "metrics.json").read_text())["episodes"]

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recipe", "options"),
    [
        ("pendulum", {"horizon": 0.5, "twinning": {"learner": TD3}}),
        # The physics that the twin believes are not those of the real system, and must be moved too.
        ("wind_turbine", {"horizon": 4.0, "unknown": ("pitch",), "policy": "scheduled"}),
        ("wind_turbine", {"horizon": 4.0, "figures": True, "episodes": 2, **NEURAL}),
        ("flapping_wing", {"horizon": 0.005, "figures": True, "twinning": {"assimilation": ESTIMATED}}),
    ],
)
def test_a_training(train, recipe, options):
    episodes = train(recipe, **options)
    last = episodes[-1]
    assert last["real_cost"] > 0.0 and last["critic_gradient"] > 0.0 and last["J_p"] <= last["J_p_before"]
    if "twinning" in options and "assimilation" in options["twinning"]:
        assert last["J_p"] < last["J_p_before"]
    if "episodes" in options:
        assert "clone" in [episode["event"] for episode in episodes]


@pytest.mark.slow
def test_resumed_training(train):
    first = train("cryogenic_tank", horizon=300.0)
    assert train("cryogenic_tank", horizon=300.0, episodes=2, resume=True)[:1] == first


def test_the_device_refuses_what_a_gpu_refuses():
    with pretend_device() as device:
        generator, here = torch.Generator(device=device), torch.ones(3, device=device)
        for mixes in (
            lambda: here + torch.ones(3),
            lambda: torch.randn(3, generator=generator),
            lambda: torch.randn(3, generator=torch.Generator(), device=device),
        ):
            with pytest.raises(RuntimeError):
                mixes()
        with pytest.raises(TypeError):
            here.numpy()
        # What a GPU takes: numbers, numbers in tensors, places and copies.
        assert (here * torch.tensor(2.0)).sum().item() == 6.0
        assert here[torch.tensor([0])].device == here.copy_(torch.ones(3)).device == device


def test_files_are_read_without_the_device(tmp_path):
    with pretend_device() as device:
        save_tensors(tmp_path / "weights.pt", {"w": torch.ones(2, device=device)})
    assert load_tensors(tmp_path / "weights.pt")["w"].tolist() == [1.0, 1.0]


@pytest.mark.parametrize("recipe", ["pendulum", "wind_turbine", "flapping_wing", "cryogenic_tank"])
@pytest.mark.parametrize("kind", ["plant", "mlp"])
def test_modules_hold_no_tensor_that_stays_behind(recipe, kind):
    """``module.to(device)`` moves parameters and buffers alone."""
    own = "plant" if recipe == "pendulum" else "paper"
    policy, closure = (kind if kind == "mlp" else own), (kind if kind == "mlp" and recipe != "pendulum" else own)
    config = load_recipe(RECIPES / f"{recipe}.py").Config(policy=policy, closure=closure)
    plant, generator = config.plant(), torch.Generator()
    made = [plant, config.make_closure(plant, generator), *config.make_policies(plant, generator).values()]
    left = [
        f"{type(module).__name__}.{name}"
        for whole in made
        for module in whole.modules()
        for name, value in vars(module).items()
        if any(isinstance(x, torch.Tensor) for x in tree_leaves(value)) and name not in ("_parameters", "_buffers")
    ]
    assert not left
