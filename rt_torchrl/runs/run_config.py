"""The options that every recipe has, and what they make: plant, policies, closure."""

import copy
import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, runtime_checkable

import torch
from pydantic import Field
from torch import nn

from rt_torchrl import options
from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.fit.log import LogConfig
from rt_torchrl.plants.plant import Plant
from rt_torchrl.plants.policies import SaturatedMLP
from rt_torchrl.steps.config import PAPER, Role, TwinningConfig
from rt_torchrl.systems.config import OperationConfig
from rt_torchrl.trajectories.rollout import Engine

if TYPE_CHECKING:  # only types: an option need not wait for Matplotlib
    from matplotlib.figure import Figure

    from rt_torchrl.figures.snapshot import Snapshot

Callback = Callable[[Sequence[dict[str, Any]]], str | None]
"""Function of the entries of all episodes so far, as in ``metrics.json``; it returns why the training should end, or
None to go on."""


Preset = Literal["default", "paper", "neural", "mpc"]
"""Name of what the options of a training are by default."""
STARTS = ("random", "controller", "mpc")
"""Values of the option ``start`` that name no file."""
NEURAL_HIDDEN = (16, 16)
"""Widths of the hidden layers of a closure with a perceptron."""
QUICK_EPISODES, QUICK_ITERATIONS, QUICK_UNSEEN = 3, 200, 5
GREATEST_SEED = 2**63 - 2
"""Greatest seed: torch takes signed integers of 64 bits, and the sensors of a simulated system take ``seed`` + 1."""


@options.configuration
class RunConfig:
    """The options that every recipe has.

    Args:
        preset: what the other options are by default: ``default``; ``paper`` for the paper's algorithm with its random
            start; ``neural`` for a closure with a perceptron in it; ``mpc`` for model predictive control in the place
            of the model-based policy.
        policy: kind of both policies: plant for the plant's own policy, or mlp. A recipe may call its plant's own
            policy paper, and offer other policies.
        hidden: widths of the hidden layers of an mlp policy.
        closure: law in the twin: plant for the plant's own law, or mlp for a law with a perceptron in it. A recipe may
            call its plant's own law paper. An mlp has the defaults of the preset neural, but with the
            preset paper those of the paper.
        episodes: number n_e of real episodes.
        seed: seed of weights, disturbances, exploration and sampling; the same seed gives the same run.
        engine: gradient engine of steps 4 and 5: native (exact, machine code, for CPUs), parallel (exact, PyTorch, for
            GPUs), odeint_adjoint (the paper's continuous adjoint, slow) or autograd (exact, slow).
        device: device on which everything runs, such as cpu or cuda.
        threads: number of CPU threads; 0 leaves torch's default or, beside an acting process, takes the cores that it
            leaves. Updates of step 2 run on one.
        start: what the training begins with, so that the real system never flies a random policy; by default the
            controller that the run is given as its first one, and else random weights. controller: the
            controller that the real system has had so far flies one episode before all others, and twin and policies
            learn from it. mpc: model predictive control on the first twin flies that episode. The folder of a finished
            run: its policies and its closure go on. A log, as a .csv or .parquet file that identify.py reads: the twin
            is fitted to it, and the policies imitate the actions in it. random: random weights.
        log: how the log is read that the training begins with.
        config: file with options, such as config.json of a run, which then runs again, for a command line; options that
            are given beside it replace those of the file, and log_dir and resume are never taken from it.
        log_dir: run folder; by default runs/PLANT/TIME-seed-SEED.
        resume: whether to go on from the checkpoint in log_dir, with the options of its run.
        quick: whether to make a small run with all its parts: at most 3 episodes, 200 critic and actor iterations, 5
            unseen episodes and as many flights of a controller on a real system after the training.
        unseen: number of unseen episodes that twin and policies are judged on at the end, in simulation. Those of a
            real system whose closure is not known are flown on the twin alone.
        real_unseen: number of episodes that each controller flies at the end on the real system as it is, with noise
            of the sensors and limits: the live policy, if it was trained, and the controller of start. The run says how
            many flights of whom before the first one, and counts them as paid; after Ctrl-C nothing flies. Baselines
            that nothing but the real system can fly do so as many times, and are refused with 0.
        preflight: whether the first flight of a real system is compared with one-step predictions of the twin before
            anything is learned, and wiring that does not fit is refused; see :func:`check_real_system`.
        reference: whether to compute also the cost that exact gradients on the true plant reach with this policy on the
            unseen episodes.
        figures: whether to draw figures at the end, into figures/ and the dashboard; without them a training among many
            ends sooner.
        unseen_every: number of episodes after which the live policy is judged on the unseen episodes again; with 0 it
            is judged only at the end.
        noise: standard deviation of the real system's sensors, as a share of the value that they read.
        asynchronous: whether the real system operates on while the algorithm learns; docs/connect_your_machine.md.
        operation: how it operates then.
        twinning: hyper-parameters of the six steps.

    Raises:
        ValueError: if an option is out of its range, or is none of its choices.
    """

    preset: Preset = "default"
    policy: Literal["plant", "mlp"] = "plant"
    hidden: options.Widths = (32, 32)
    closure: Literal["plant", "mlp"] = "plant"
    episodes: options.AtLeastOne = 20
    seed: Annotated[int, Field(ge=0, le=GREATEST_SEED)] = 0
    engine: Engine = "native"
    device: str = "cpu"
    threads: options.Count = 0
    start: options.Text | None = None
    log: LogConfig = field(default_factory=LogConfig)
    config: options.File | None = None
    log_dir: options.File | None = None
    resume: bool = False
    quick: bool = False
    unseen: Annotated[int, Field(ge=2)] = 20
    real_unseen: options.Count = 0
    preflight: bool = True
    reference: bool = False
    figures: bool = True
    unseen_every: options.Count = 0
    noise: options.NotNegative = 0.0
    asynchronous: bool = False
    operation: OperationConfig = field(default_factory=OperationConfig)
    twinning: TwinningConfig = field(default_factory=TwinningConfig)

    def __post_init__(self) -> None:
        options.require_checked(type(self))
        for name, kind in (("log", LogConfig), ("operation", OperationConfig), ("twinning", TwinningConfig)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} of {type(self).__name__} hides an option of RunConfig; give it another name.")
        if self.log_dir == Path():
            raise ValueError("log_dir='' is the current folder; name a folder that is the run's own.")
        if self.policy != "mlp" and self.hidden != type(self).hidden:
            raise ValueError(f"hidden={self.hidden} are widths of an mlp, and policy={self.policy!r} has none.")
        if self.real_unseen == 1:  # no mean of one episode has a confidence interval
            raise ValueError("real_unseen=1 must be 0, or at least 2.")
        if self.log != LogConfig() and self.start in (None, *STARTS):
            raise ValueError(f"log.* says how a log is read, and start={self.start!r} names none; give its file.")
        if self.resume and self.log_dir is None:
            raise ValueError("resume needs log_dir, the folder of the run to go on with.")
        if not self.asynchronous and self.operation != OperationConfig():
            raise ValueError("operation.* says how an asynchronous run operates; give --asynchronous, too.")

    def make_policy(self, plant: Plant, generator: torch.Generator) -> nn.Module:
        """The policy that the options ask for, with random initial weights.

        Override this method, and the ``Literal`` that declares ``policy``, for policies of your own.
        """
        if self.policy == "mlp":
            return SaturatedMLP(len(plant.observations), plant.actions, hidden=self.hidden, generator=generator)
        return plant.make_policy(generator)

    def make_closure(self, plant: Plant, generator: torch.Generator) -> nn.Module:
        """The twin's closure that the options ask for, with its initial weights w_p⁰.

        Override this method, and the ``Literal`` that declares ``closure``, for closures of your own.

        Raises:
            ValueError: if the plant has no neural closure.
        """
        if self.closure == "mlp":
            return plant.make_neural_closure(generator, NEURAL_HIDDEN)
        return plant.make_closure(generator)

    def make_policies(self, plant: Plant, generator: torch.Generator) -> dict[Role, nn.Module]:
        """The policies π_mb and π_mf, with the same initial weights."""
        model_based = self.make_policy(plant, generator)
        return {"model_based": model_based, "model_free": copy.deepcopy(model_based)}

    def acting_policies(
        self, policies: dict[Role, nn.Module], physics: Plant, closure: nn.Module
    ) -> dict[Role, nn.Module]:
        """The policies of :meth:`make_policies`, or model predictive control in the place of π_mb if it is asked for.

        Args:
            policies: policies by role.
            physics: physics of the twin.
            closure: closure of the twin, on which model predictive control plans.
        """
        planner = self.twinning.planner
        if planner.method != "receding_horizon":
            return policies
        try:
            return policies | {"model_based": PredictiveControl(physics, closure, planner.receding_horizon)}
        except ValueError as error:
            raise ValueError(f"twinning.planner.receding_horizon: {error}") from error

    def believed(self) -> Plant | None:
        """The physics of a twin that is wrong about them; None if it has those of the real system.

        Override this method for a twin that is wrong, or does not know all states of the real system.
        """
        return None

    def plant_figures(self, snapshot: "Snapshot") -> dict[str, "Figure"]:
        """The figures by name that only this plant has; override this method to draw some."""
        return {}

    def presets(self) -> dict[Preset, dict[str, Any]]:
        """The options that each preset sets; ``mpc`` is ``default`` with another method of planning.

        Override this method where a plant has other ones, or where they depend on other options.
        """
        return {"default": {}, "paper": {"start": "random", "twinning": PAPER}, "neural": {"closure": "mlp"}}

    def defaults(self) -> "RunConfig":
        """The defaults of all options on a command line, given the preset, start and closure that it asks for.

        See :func:`rt_torchrl.runs.command_line.from_command_line`.
        """
        usual = type(self)()
        preset: Preset = "default" if self.preset == "mpc" else self.preset
        if self.closure == "mlp" and preset == "default":
            preset = "neural"
        defaults = dataclasses.replace(usual, preset=self.preset, **self.presets()[preset])
        if self.preset == "mpc":
            planner = defaults.twinning.planner
            planner = dataclasses.replace(planner, method="receding_horizon")
            defaults = dataclasses.replace(defaults, twinning=dataclasses.replace(defaults.twinning, planner=planner))
        return defaults

    def effective(self) -> "RunConfig":
        """The options that the run carries out, in which ``start`` and ``quick`` have replaced other options."""
        twinning, least = self.twinning, {}
        if self.start not in (None, "random"):
            twinning = dataclasses.replace(twinning, exploration=twinning.exploration.imitating())
        if self.quick:
            learner, names = twinning.learner, ("critic_iterations", "actor_iterations")
            iterations = {name: min(getattr(learner, name), QUICK_ITERATIONS) for name in names}
            twinning = dataclasses.replace(twinning, learner=dataclasses.replace(learner, **iterations))
            greatest = {"episodes": QUICK_EPISODES, "unseen": QUICK_UNSEEN, "real_unseen": QUICK_UNSEEN}
            least = {name: min(getattr(self, name), number) for name, number in greatest.items()}
        return dataclasses.replace(self, quick=False, twinning=twinning, **least)


@runtime_checkable
class MakesPlant(Protocol):
    """A configuration whose options say all that its plant needs."""

    def plant(self) -> Plant:
        """The real system in simulation, new."""
        ...


def plant_of(config: RunConfig) -> Plant:
    """The real system in simulation, as the configuration makes it.

    Raises:
        ValueError: if the configuration has no method ``plant()``.
    """
    if not isinstance(config, MakesPlant):
        raise ValueError(
            f"{type(config).__qualname__} has no method plant() that makes the plant from its options; write one, as "
            "docs/own_plant.md shows, or give load_run the plant, load_run(folder, plant=...)."
        )
    return config.plant()


def physics_of(config: RunConfig) -> Plant:
    """The physics of the twin, by which policies and controllers are made: what is believed, or the real system's."""
    return config.believed() or plant_of(config)


def require_plant(argument: str, given: object) -> None:
    """Refuse what is no plant, such as a class of plants.

    Raises:
        ValueError: if it is none; the message names the argument.
    """
    if not isinstance(given, Plant):
        raise ValueError(f"{argument}={given!r} must be a plant; if this is a class, give an instance of it.")


def require_device(name: str) -> torch.device:
    """The device of this name.

    Raises:
        ValueError: if this machine has no such device.
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device={name!r} cannot be used on this machine ({error}); use cpu.") from error
    return device
