"""What one episode of a default training calls: TorchRL's parts, torchdiffeq, and how much of this library."""

import sys
from pathlib import Path

import pytest
import torchdiffeq
from small_runs import small_run
from tensordict.nn import TensorDictSequential
from torchrl.collectors import BaseCollector
from torchrl.data import TensorDictPrioritizedReplayBuffer
from torchrl.objectives import DDPGLoss

from rt_torchrl import ReinforcementTwinning, Run
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.runs.command_line import from_command_line, load_recipe

pytestmark = pytest.mark.training

ROOT = Path(__file__).parents[1]
HERE = (str(ROOT / "rt_torchrl"), str(ROOT / "envs"))
RARE = {str(ROOT / "rt_torchrl" / name) for name in ("programs/tracer.py", "trajectories/anchored.py")}
"""Files of what few late episodes do: tracing, and the correction of a twin that a real episode contradicts."""
LATE = 4
"""Number of episodes after which a training hardly traces anything new, as plans, beliefs and fits have begun."""
FUNCTIONS, FILES = 266, 37
"""Greatest number of functions of this library in an episode, and of files that hold them; some twenty of them ask
whether the twin is unstable, where its errors are more than 1 % of what the readings scatter about their mean."""


def trained(folder, *words):
    """A default training of the turbine of two short episodes."""
    recipe = load_recipe(ROOT / "recipes" / "wind_turbine.py")
    short = ("--episodes", "2", "--horizon", "50", "--no-figures", "--unseen", "2")
    config = from_command_line(recipe.Config, [*short, "--log-dir", str(folder), *words])
    run = Run(config, config.plant(), first=JonkmanController)
    run.train()
    return run


def counted(monkeypatch, owner, name):
    """Number of calls of a method from now on, as the length of a list."""
    calls, method = [], getattr(owner, name)

    def counting(*arguments, **named):
        calls.append(name)
        return method(*arguments, **named)

    monkeypatch.setattr(owner, name, counting)
    return calls


def functions_of_episodes(monkeypatch):
    """Functions of this library that each late episode calls; sets of file and line by its number."""
    seen, episode = dict[int, set](), ReinforcementTwinning.episode

    def watched(algorithm, *arguments):
        called = seen.setdefault(algorithm.episodes_done, set())

        def note(frame, event, _):
            code = frame.f_code
            if event == "call" and code.co_filename.startswith(HERE) and not code.co_name.startswith("<"):
                called.add((code.co_filename, code.co_firstlineno))

        if algorithm.episodes_done >= LATE:
            sys.setprofile(note)
        try:
            return episode(algorithm, *arguments)
        finally:
            sys.setprofile(None)

    monkeypatch.setattr(ReinforcementTwinning, "episode", watched)
    return seen


@pytest.mark.filterwarnings("error:engine 'autograd' takes the place")
def test_torchrl_is_in_the_path_that_runs_by_default_which_goes_through_few_functions(tmp_path, monkeypatch):
    loss = counted(monkeypatch, DDPGLoss, "forward")
    sample = counted(monkeypatch, TensorDictPrioritizedReplayBuffer, "sample")
    refresh = counted(monkeypatch, TensorDictPrioritizedReplayBuffer, "update_tensordict_priority")
    adjoint, functions = counted(monkeypatch, torchdiffeq, "odeint_adjoint"), functions_of_episodes(monkeypatch)
    algorithm = trained(tmp_path, "--episodes", "6").algorithm
    assert isinstance(algorithm, TensorDictSequential) and isinstance(algorithm.collector, BaseCollector)
    # TD errors of seven flights, and one trace of the critic's iteration and of the policy's, replayed 800 times.
    assert len(loss) == 7 + 2
    assert len(sample) == 6 * 2 * 2  # of six episodes with two phases, fifty batches at once
    assert len(refresh) == 7 + 6 * 2
    assert not adjoint
    usual = [seen for seen in functions.values() if seen and not any(file in RARE for file, _ in seen)]
    assert usual
    for seen in usual:
        assert 150 < len(seen) <= FUNCTIONS and len({file for file, _ in seen}) <= FILES


def test_gradients_are_those_of_torchdiffeq_by_its_engine(tmp_path, monkeypatch):
    calls = counted(monkeypatch, torchdiffeq, "odeint_adjoint")
    small_run(tmp_path, 1, engine="odeint_adjoint").train()
    assert len(calls) > 20  # one for every control interval
