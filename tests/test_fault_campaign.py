"""The campaign of faults: kills, signals, damaged checkpoints, a full disk, faulty machines.

`uv run --group test pytest -m faults` runs it.
Its first tests of each kind run in the fast suite too. Trainings run in processes that a clean server forks, so that
each of them takes a second.
"""

import contextlib
import errno
import multiprocessing
import os
import pickle
import random
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from fault_counts import count
from fault_victim import EPISODES, QUICK, SHIPPED, victim
from faulty_system import OF_ACTUATORS, OF_SENSORS, OF_SYSTEMS, FaultySystem, Injection
from linear_quadratic import LinearQuadratic
from small_runs import SMALL, small_run
from tensordict.nn import TensorDictModule

from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.envs.cryogenic_tank.plant import CryogenicTank
from rt_torchrl.envs.flapping_wing.plant import FlappingWing
from rt_torchrl.envs.pendulum.plant import Pendulum
from rt_torchrl.envs.wind_turbine.plant import WindTurbine
from rt_torchrl.runs import run_folder
from rt_torchrl.runs.run_folder import load_tensors, save_tensors
from rt_torchrl.systems.config import OperationConfig, SafetyConfig
from rt_torchrl.systems.environment import PlantEnv
from rt_torchrl.systems.operation.operator import Crew
from rt_torchrl.systems.operation.simulated import SimulatedOperation
from rt_torchrl.systems.safety import SafetyLayer
from rt_torchrl.systems.sound_part import GREATEST
from rt_torchrl.trajectories.twin import DigitalTwin

LATER = ("sklearn.svm", "scipy.interpolate", "torch.utils.tensorboard", "rt_torchrl.trajectories.engines.native")
"""What a training imports when it first needs it."""
KILLS, KILLS_IN_WRITING, TERMINATIONS, DAMAGES = 40, 12, 20, 240
KILLS_OF_A_PLANT = 2
"""Kills of the training of each shipped plant, with and without acting while it learns."""


@pytest.fixture(scope="module")
def server():
    """A server of processes that has imported everything, and forks a clean process for each training."""
    with pytest.MonkeyPatch.context() as patched:
        # The server looks for what it loads in advance where Python itself looks.
        here, before = str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")
        patched.setenv("PYTHONPATH", os.pathsep.join(filter(None, (here, before))))
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["fault_victim", *LATER])
        started(context, None, {}).join()  # starts the server
        yield context


@pytest.fixture(scope="module")
def trained(tmp_path_factory, server):
    """A training that nothing disturbs: its folder, its episodes, and how long one in its own process takes [s]."""
    times = []
    for name in ("first", "whole"):
        folder = tmp_path_factory.mktemp(name)
        begin = time.perf_counter()
        process = started(server, folder, {})
        process.join()
        times.append(time.perf_counter() - begin)
    return folder, deterministic(folder), times[-1]


def started(server, folder, options, kill_at=None, plant=None):
    process = server.Process(target=victim, args=(folder, options, kill_at, plant))
    process.start()
    return process


def deterministic(folder):
    """The episodes of a run's checkpoint, without what depends on the clock."""
    return [{**record, "seconds": None} for record in load_tensors(folder / "checkpoint.pt")["episodes"]]


def require_resumed(server, folder, trained, options=None, plant=None):
    """The rest of the training: as if nothing had happened, to the bit, in its episodes and in its weights."""
    whole_folder, episodes, _ = trained
    begun = (folder / "config.json").exists()
    process = started(server, folder, {"resume": begun} | (options or {}), plant=plant)
    process.join()
    assert process.exitcode == 0 and deterministic(folder) == episodes
    assert not list(folder.glob(".*.partial"))
    one, other = (load_tensors(path / "weights.pt") for path in (folder, whole_folder))
    for role, weights in one.items():
        for name, weight in weights.items():
            assert torch.equal(weight, other[role][name])


def require_survived(server, folder, trained, number, what, stop, **of):
    """A training that ``stop`` ends at a random moment loses at most the episode under way."""
    moment = random.Random(number).uniform(0.05, 1.0) * trained[2]
    process = started(server, folder, of.get("options", {}), plant=of.get("plant"))
    time.sleep(moment)
    stop(process)
    process.join()
    done = len(deterministic(folder)) if (folder / "checkpoint.pt").exists() else 0
    try:
        require_resumed(server, folder, trained, **of)
    except BaseException:
        count(what, f"lost after {done} episodes", defect=True)
        raise
    count(what, "resumed to the bit" if done < EPISODES else "ended before")


def kill(process):
    process.kill()


def terminate(process):
    process.terminate()


@pytest.mark.slow
@pytest.mark.parametrize("stop", [kill, terminate])
def test_a_training_that_is_stopped_goes_on_to_the_bit(server, tmp_path, trained, stop):
    require_survived(server, tmp_path, trained, 0, f"stopped by {stop.__name__}", stop)


@pytest.mark.faults
@pytest.mark.parametrize("number", range(KILLS))
def test_a_kill_at_any_moment_loses_nothing(server, tmp_path, trained, number):
    require_survived(server, tmp_path, trained, number, "SIGKILL at a random moment", kill)


@pytest.fixture(scope="module")
def whole_runs(tmp_path_factory, server):
    """Trainings of the shipped plants that nothing disturbs, each made when it is first asked for."""
    made = {}

    def run(plant, options):
        key = plant, *options
        if key not in made:
            folder, begin = tmp_path_factory.mktemp("-".join(key)), time.perf_counter()
            started(server, folder, options, plant=plant).join()
            made[key] = folder, deterministic(folder), time.perf_counter() - begin
        return made[key]

    return run


@pytest.mark.faults
@pytest.mark.parametrize("number", range(KILLS_OF_A_PLANT))
@pytest.mark.parametrize("options", [{}, {"asynchronous": True}], ids=["synchronous", "asynchronous"])
@pytest.mark.parametrize("plant", SHIPPED)
def test_a_kill_of_a_shipped_plants_training_loses_nothing(server, tmp_path, whole_runs, plant, options, number):
    whole = whole_runs(plant, options)
    what = f"SIGKILL of the {'asynchronous ' if options else ''}training of {plant}"
    require_survived(server, tmp_path, whole, 2000 + number, what, kill, options=options, plant=plant)


@pytest.mark.faults
@pytest.mark.parametrize("number", range(TERMINATIONS))
def test_sigterm_at_any_moment_loses_nothing(server, tmp_path, trained, number):
    require_survived(server, tmp_path, trained, 1000 + number, "SIGTERM at a random moment", terminate)


@pytest.mark.faults
@pytest.mark.parametrize("number", range(KILLS_IN_WRITING))
def test_a_kill_inside_a_write_loses_nothing(server, tmp_path, trained, number):
    process = started(server, tmp_path, {}, kill_at=number % 8)
    process.join()
    assert process.exitcode in (-signal.SIGKILL, 0)
    require_resumed(server, tmp_path, trained)
    count("SIGKILL inside a write", "resumed to the bit" if process.exitcode else "ended before")


def test_sigterm_ends_a_training_with_its_results(tmp_path, monkeypatch):
    """As Ctrl-C: what was done before is judged and saved."""
    run = small_run(tmp_path, episodes=EPISODES, **QUICK)
    run_one = run.algorithm.episode

    def terminated(tell):
        if len(run.episodes) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return run_one(tell)

    monkeypatch.setattr(run.algorithm, "episode", terminated)
    assert len(run.train()["episodes"]) == 2 and (tmp_path / "weights.pt").exists()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


class Bomb:
    """A pickle that would make a file."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


def broken(whole, number, trace):
    """A damaged or foreign checkpoint of one of six kinds."""
    generator = np.random.default_rng(number)
    kind = ("bit flipped", "truncated", "zeros", "foreign pickle", "foreign tensors", "appended")[number % 6]
    if kind == "bit flipped":
        found = bytearray(whole)
        for place in generator.integers(0, len(whole), 1 + number % 3):
            found[place] ^= 1 << int(generator.integers(8))
        return kind, bytes(found)
    if kind == "truncated":
        return kind, whole[: int(generator.integers(0, len(whole)))]
    if kind == "zeros":  # a page that a power cut has lost
        first = int(generator.integers(0, len(whole)))
        return kind, whole[:first] + bytes(min(4096, len(whole) - first)) + whole[first + 4096 :]
    if kind == "foreign pickle":
        if number % 4:
            return kind, pickle.dumps({"format": Bomb(trace)})
        torch.save({"format": run_folder.FORMAT, "episodes": [], "state": Bomb(trace)}, trace.with_suffix(".pt"))
        return kind, trace.with_suffix(".pt").read_bytes()
    if kind == "foreign tensors":
        save_tensors(trace.with_suffix(".pt"), {"weights": torch.zeros(3)})
        return kind, trace.with_suffix(".pt").read_bytes()
    return kind, whole[: len(whole) // 2] + generator.bytes(100) + whole[len(whole) // 2 :]


def leaves(value, place=""):
    if isinstance(value, dict):
        return {k: v for key, entry in value.items() for k, v in leaves(entry, f"{place}/{key}").items()}
    if isinstance(value, list | tuple):
        return {k: v for n, entry in enumerate(value) for k, v in leaves(entry, f"{place}/{n}").items()}
    return {place: value}


def same(one, other):
    one, other = leaves(one), leaves(other)
    return one.keys() == other.keys() and all(
        torch.equal(value, other[key]) if isinstance(value, torch.Tensor) else value == other[key]
        for key, value in one.items()
    )


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A run of which three checkpoints are kept, with the states in them."""
    folder = tmp_path_factory.mktemp("kept")
    small_run(folder, episodes=EPISODES, **QUICK).train()
    files = [folder / "checkpoint.pt", *run_folder.earlier(folder / "checkpoint.pt")]
    assert [file.name for file in files] == ["checkpoint.pt", "checkpoint-0004.pt", "checkpoint-0003.pt"]
    return files, [load_tensors(file)["state"]["algorithm"] for file in files]


def require_fallen_back(kept, number, folder, algorithm, capsys):
    files, states = kept
    trace = folder / "trace"
    path = folder / "checkpoint.pt"
    (folder / "checkpoint.pt.damaged").unlink(missing_ok=True)
    kind, content = broken(files[0].read_bytes(), number, trace)
    alone = number % 5 == 4
    for file in files[1:]:
        (folder / file.name).unlink(missing_ok=True)
        if not alone:
            (folder / file.name).write_bytes(file.read_bytes())
    path.write_bytes(content)
    what = f"checkpoint: {kind}"
    capsys.readouterr()
    try:
        episodes = run_folder.load_checkpoint(path, algorithm)
    except ValueError as error:
        said = str(error)
        assert alone and "checkpoint.pt" in said and "--overwrite" in said
        count(what, "refused, as no other was there")
    else:
        said, state = capsys.readouterr().out, algorithm.state_dict()
        if len(episodes) == EPISODES:
            assert same(plain(state), states[0]) and not said
            count(what, "without effect on the content")
        else:
            assert len(episodes) == EPISODES - 1 and same(plain(state), states[1])
            assert "goes on from checkpoint-0004.pt, after 4 episodes" in said
            assert (folder / "checkpoint.pt.damaged").read_bytes() == content and not path.exists()
            count(what, "fell back to the one before, and said so")
    assert not trace.exists()


def plain(state):
    from rt_torchrl.runs.run_folder import plain as of

    return of(state)


@pytest.fixture
def algorithm(tmp_path):
    return small_run(tmp_path / "run", episodes=EPISODES, **QUICK).algorithm


def test_a_damaged_checkpoint_is_replaced_by_the_one_before(kept, tmp_path, algorithm, capsys):
    for number in range(6):
        require_fallen_back(kept, number, tmp_path, algorithm, capsys)


@pytest.mark.faults
def test_no_damaged_checkpoint_is_taken(kept, tmp_path, algorithm, capsys):
    for number in range(DAMAGES):
        require_fallen_back(kept, number, tmp_path, algorithm, capsys)


def test_after_a_fall_back_the_training_is_the_same_to_the_bit(tmp_path, kept):
    files, _ = kept
    for file in files[0].parent.glob("c*"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "checkpoint.pt").write_bytes(files[0].read_bytes()[:-500])
    (tmp_path / "checkpoint-0004.pt").write_bytes(b"")
    small_run(tmp_path, episodes=EPISODES, resume=True, **QUICK).train()
    assert deterministic(tmp_path) == deterministic(files[0].parent)
    assert same(*(load_tensors(folder / "weights.pt") for folder in (tmp_path, files[0].parent)))
    assert len(list(tmp_path.glob("*.damaged"))) == 2


@contextlib.contextmanager
def small_disk(folder, kilobytes):
    """A file system of this size at a folder, if this machine lets us mount one."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("a small file system cannot be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.faults
@pytest.mark.parametrize("share", [0.2, 0.4, 0.6, 0.8, 0.9, 1.0])
def test_a_disk_that_is_full_leaves_what_was_done(server, tmp_path, trained, share):
    """A disk of a share of what the run needs; then there is room, and the run goes on."""
    needs = sum(file.stat().st_size for file in trained[0].rglob("*") if file.is_file()) // 1024
    with small_disk(tmp_path, max(40, int(share * needs))):
        process = started(server, tmp_path, {})
        process.join()
        done = deterministic(tmp_path) if (tmp_path / "checkpoint.pt").exists() else []
        assert done == trained[1][: len(done)]
        subprocess.run(["mount", "-o", "remount,size=64m", str(tmp_path)], check=True)
        require_resumed(server, tmp_path, trained)
    count("full disk (tmpfs)", f"{len(done)} episodes saved, resumed to the bit")


class Full:
    """A disk that is full from a file on, until room is made by removing files."""

    def __init__(self, monkeypatch, after, room):
        self.left, self.room = after, room
        self.sync, self.unlink = os.fsync, Path.unlink
        monkeypatch.setattr(os, "fsync", self.full)
        monkeypatch.setattr(Path, "unlink", self.removed)

    def full(self, descriptor):
        self.left -= 1
        if self.left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.sync(descriptor)

    def removed(self, path, missing_ok=False):
        if path.match("checkpoint-*.pt") and self.left < 0:
            self.left = self.room
        return self.unlink(path, missing_ok=missing_ok)


@pytest.mark.parametrize("room", [0, 10**9], ids=["none", "that of earlier checkpoints"])
def test_a_full_disk_stops_with_what_was_done_saved_and_says_so(tmp_path, monkeypatch, capsys, room):
    whole = deterministic_of(small_run(tmp_path / "whole", episodes=4, **QUICK).train())
    run = small_run(tmp_path / "run", episodes=4, **QUICK)
    with monkeypatch.context() as patched:
        full = Full(patched, after=2 * 4, room=room)  # the options and three checkpoints, with their folders
        patched.setattr(Path, "unlink", lambda path, missing_ok=False: full.removed(path, missing_ok))
        with pytest.raises(OSError, match="No space left|is full; . earlier checkpoints went to save the present one"):
            run.train()
    done = 4 if room else 3
    said = f"stopped: {done} episodes done are in {tmp_path / 'run'}; --resume goes on with them"
    assert said in capsys.readouterr().out
    assert deterministic(tmp_path / "run") == whole[:done]
    resumed = small_run(tmp_path / "run", episodes=4, resume=True, **QUICK).train()
    assert deterministic_of(resumed) == whole
    count("full disk (injected)", "stopped in words, resumed to the bit")


def deterministic_of(metrics):
    return [{**record, "seconds": None} for record in metrics["episodes"]]


def test_a_log_on_a_full_disk_does_not_stop_a_machine_that_moves():
    if not Path("/dev/full").exists():
        pytest.skip("this machine has no /dev/full")
    plant = LinearQuadratic(horizon=2.0)
    config = SafetyConfig(interval=plant.dt, rates=(0.1,), rest=(0.0,), log=Path("/dev/full"))
    layer = SafetyLayer(PlantEnv(plant, seed=0), config, fallback=(0.0,))
    asked = TensorDictModule(lambda seen: seen[..., :1].clamp(-2.0, 2.0), ["observation"], ["action"])
    episode = layer.rollout(20, asked)
    assert episode.shape[-1] == 20 and layer.report.counts["rate"] > 0
    with pytest.raises(OSError, match="No space left"):
        layer.reset()
    layer.reset()  # once is enough


N = 40
PLANTS = {
    "linear_quadratic": lambda: LinearQuadratic(horizon=0.1 * N),
    "pendulum": lambda: Pendulum(dt=0.05, horizon=0.05 * N),
    "wind_turbine": lambda: WindTurbine(dt=0.25, horizon=0.25 * N),
    "flapping_wing": lambda: FlappingWing(dt=0.002, horizon=0.002 * N),
    "cryogenic_tank": lambda: CryogenicTank(dt=30.0, horizon=30.0 * N),
}
EXPECTED = {
    "dropped": {"missing"},
    "late": {"late"},
    "repeated": {"clock"},
    "frozen": {"frozen"},
    "out_of_range": {"out of range"},
    "nan": {"not finite"},
    "clock_jump": {"clock"},
    "raises": {"ended"},
    "ends_early": {"ended"},
}
LOST = {"dropped": 2, "repeated": 2, "frozen": 6, "out_of_range": 2, "nan": 2, "clock_jump": 2}
"""Control intervals that a fault of a sensor in one of them costs; the frozen one lasts five."""


def machine(plant, kind):
    """A plant with this fault in its second episode, behind a layer that watches for it."""
    value = {"out_of_range": 1e9, "late": 10.0, "clock_jump": -1e4, "slow_actuator": 0.1}.get(kind, 0.0)
    first, last = {"frozen": (8, 12), "raises": (30, 30), "ends_early": (30, 30)}.get(kind, (8, 8))
    last = 39 if kind in OF_ACTUATORS else last
    fault = Injection(kind=kind, episode=1, first=first, last=last, value=value)
    slept = []
    watched = (3, *[0] * (len(plant.readings) - 1))  # other components may rest
    system = FaultySystem(PlantEnv(plant, seed=0), [fault], interval=plant.dt, sleep=slept.append)
    config = SafetyConfig(
        interval=plant.dt,
        clock="time",
        frozen={"state": watched},
        ranges={"state": (-1e8, 1e8)},
        deadline=5.0,
    )
    middle = tuple(0.5 * (action.low + action.high) for action in plant.actions)
    return SafetyLayer(system, config, fallback=middle, clock=lambda: float(sum(slept)))


def require_faults_survived(name, kind, *, asynchronous=False):
    plant = PLANTS[name]()
    generator = torch.Generator().manual_seed(0)
    layer = machine(plant, kind)
    policies = {role: plant.make_policy(generator) for role in ("model_based", "model_free")}
    twin = DigitalTwin(plant, plant.make_closure(generator))
    system = operated(layer, plant, policies) if asynchronous else layer
    found = ReinforcementTwinning(system, twin, **policies, config=SMALL, generator=generator)
    reports = [found.episode() for _ in range(3)]
    injected = {k for episode, k, _ in layer.injected if episode == 1}
    assert injected
    assert [name for name in reports[0].keys() if name.startswith("faults/")] == []  # noqa: SIM118
    kinds = {key.removeprefix("faults/") for key in reports[1].keys() if key.startswith("faults/")}  # noqa: SIM118
    assert EXPECTED.get(kind, set()) <= kinds
    stored = found.learner.memory.buffer[:]
    kept = len(stored) - 2 * N
    if kind in OF_SYSTEMS:
        assert kept == 30 + (kind == "ends_early")
    else:
        assert kept == N - LOST.get(kind, 0)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        assert (stored[key].abs() < GREATEST).all()
    states = found.short_term[-1].states
    assert (states.abs() < 1e8).all() and reports[2]["real_cost"].isfinite()
    # Transitions of the second episode are those of the plant under what its actuators have done.
    require_true(plant, found, kind)
    of = "actuator" if kind in OF_ACTUATORS else "system" if kind in OF_SYSTEMS else "sensor"
    count(
        f"{'asynchronous, ' if asynchronous else ''}{of} faults: {kind}",
        "sound part kept, training went on",
    )


def operated(layer, plant, policies):
    """The system in operation, in which learning takes no time, so that its second window is the second episode."""
    crew = Crew(lambda: layer, plant, policies, SMALL.exploration, OperationConfig(), seed=1)
    return SimulatedOperation(crew.operator(layer), learning=0)


def require_true(plant, found, kind):
    for flown in (one.trajectory for one in found.belief.flown):
        n = len(flown.actions)
        t = plant.dt * torch.arange(n, dtype=torch.float64)
        ends = plant.step(t, flown.states[:-1], flown.actions, flown.exogenous, plant.closure).state
        error = (ends - flown.states[1:]).abs() / (1.0 + flown.states[1:].abs())
        # Rounding, and what the actuators' own limits do twice to an action that was applied.
        assert error.max() < 1e-6


@pytest.mark.faults
@pytest.mark.parametrize("kind", [*OF_SENSORS, *OF_ACTUATORS, *OF_SYSTEMS])
@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("asynchronous", [False, True], ids=["synchronous", "asynchronous"])
def test_every_fault_is_survived_on_every_plant(name, kind, asynchronous):
    try:
        require_faults_survived(name, kind, asynchronous=asynchronous)
    except BaseException:
        count(f"faults of the system: {kind}", "failed", defect=True)
        raise
