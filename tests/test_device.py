"""Whole trainings on a device that is not the CPU: every tensor lies where the run's generator does."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from device_mode import RequireDevice
from pretend_device import NAME, pretend_device
from small_runs import SMALL
from torch.utils._pytree import tree_leaves

from rt_torchrl.contract.check import check_plant
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.runs.command_line import load_recipe
from rt_torchrl.runs.run import Run
from rt_torchrl.runs.tensor_file import load_tensors, save_tensors
from rt_torchrl.steps.config import PlannerConfig, ShortHorizonConfig
from rt_torchrl.twinning.assimilation import AssimilationConfig

RECIPES = Path(__file__).parent.parent / "recipes"
# One gradient of each kind makes every kind of tensor.
ONE_OF_EACH = dataclasses.replace(
    SMALL,
    assimilation=AssimilationConfig(iterations=1),
    planner=PlannerConfig(iterations=1),
    learner=dataclasses.replace(SMALL.learner, critic_iterations=2, actor_iterations=1),
)
ESTIMATED = AssimilationConfig(
    iterations=1, method="levenberg_marquardt", inputs="record", initial="estimated", prior=0.1, segment=2
)
WINDOWS = PlannerConfig(iterations=1, short_horizon=ShortHorizonConfig(window=3, critic_iterations=1))
NEURAL = {"closure": "mlp", "closure_hidden": (4,), "model_free_policy": "mlp", "hidden": (4,)}
TD3 = dataclasses.replace(SMALL.learner, algorithm="td3", critic_iterations=2, actor_iterations=1)


@pytest.fixture
def train(tmp_path, monkeypatch):
    """Trains by a recipe on the pretended device; gives the places where a tensor was made without one."""
    watch = RequireDevice()
    whole = Run._train

    def watched(run):
        with watch:
            return whole(run)

    def run(recipe, *, twinning=None, **options):
        module = load_recipe(RECIPES / f"{recipe}.py")
        small = {"episodes": 1, "unseen": 2, "untrained": 1, "compiled": False, "figures": False, "threads": 1}
        small |= {"device": NAME, "log_dir": tmp_path, "twinning": dataclasses.replace(ONE_OF_EACH, **(twinning or {}))}
        with pretend_device():
            module.main(module.Config(**small | options))
        return watch.found

    monkeypatch.setattr(Run, "_train", watched)
    return run


def test_real_system_short_horizon_and_td3(train):
    assert not train("pendulum", horizon=0.5, twinning={"planner": WINDOWS, "learner": TD3})


@pytest.mark.slow
def test_figures_perceptrons_and_distillation(train, tmp_path):
    assert not train("wind_turbine", horizon=4.0, figures=True, episodes=2, **NEURAL)
    assert "clone" in [episode["event"] for episode in json.loads((tmp_path / "metrics.json").read_text())["episodes"]]


@pytest.mark.slow
def test_estimated_initial_states_and_animation(train):
    assert not train("flapping_wing", horizon=0.005, figures=True, twinning={"assimilation": ESTIMATED})


@pytest.mark.slow
def test_resumed_training(train):
    assert not train("cryogenic_tank", horizon=300.0)
    assert not train("cryogenic_tank", horizon=300.0, episodes=2, resume=True)


def test_the_device_refuses_what_a_gpu_refuses():
    with pretend_device() as device:
        generator, here = torch.Generator(device=device), torch.ones(3, device=device)
        for mixes in (
            lambda: here + torch.ones(3),
            lambda: torch.cat([here, torch.ones(1)]),
            lambda: torch.ones(3)[torch.zeros(1, dtype=torch.long, device=device)],
            lambda: torch.ones(()).add_(here[0]),
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


def test_a_plant_elsewhere_is_checked_and_asked_there():
    with pretend_device() as device:
        plant = WindTurbine(horizon=5.0)
        expected = plant.time_constant(11.0)
        plant.to(device)
        check_plant(plant, steps=2, traced=False)
        assert plant.time_constant(11.0) == expected


def test_files_are_read_without_the_device(tmp_path):
    with pretend_device() as device:
        save_tensors(tmp_path / "weights.pt", {"w": torch.ones(2, device=device)})
    assert load_tensors(tmp_path / "weights.pt")["w"].tolist() == [1.0, 1.0]


@pytest.mark.parametrize("recipe", ["pendulum", "wind_turbine", "flapping_wing", "cryogenic_tank"])
@pytest.mark.parametrize("kind", ["plant", "mlp"])
def test_modules_hold_no_tensor_that_stays_behind(recipe, kind):
    """``module.to(device)`` moves parameters and buffers alone."""
    own = "plant" if recipe == "pendulum" else "paper"
    config = load_recipe(RECIPES / f"{recipe}.py").Config(
        policy="mlp" if kind == "mlp" else own, closure=kind if kind == "mlp" and recipe != "pendulum" else own
    )
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
