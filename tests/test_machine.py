"""Minutes of operation on the wall clock, by ``-m machine``: lost connections while it learns, and the kept period."""

import contextlib
import dataclasses
import json
import multiprocessing
import os
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from relay import Relay
from served_plants import served_turbine_alone
from served_turbine import SAFE, Config, machine
from tensordict import TensorDict
from test_export_recipe import recipe

from rt_torchrl import ExplorationConfig, OperationConfig, PlantEnv, Run
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.systems.operation import Operation, Operator

pytestmark = pytest.mark.machine
SECONDS = float(os.environ.get("SECONDS_OF_A_MACHINE_TEST", "120"))
PACE = 5.0  # a period of 0.1 s, for a machine that does other things too
SEEN = 1.0
"""Time after its end within which a lost connection is in the log [s]."""


def handles(pid):
    return len(os.listdir(f"/proc/{pid}/fd"))


def memory(pid):
    """Resident memory of a process [MiB]."""
    (line,) = (line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return float(line.split()[1]) / 1024.0


def lose(relay, ended, lost):
    """Lose connections at random times: half of them are cut, half are silent."""
    draws = np.random.default_rng(0)
    while not ended.wait(draws.exponential(10.0)):
        kind, seconds = str(draws.choice(["cut", "stall"])), float(draws.uniform(0.1, 2.0))
        lost.append((time.time(), seconds))
        getattr(relay, kind)(seconds)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="memory and file handles are read from /proc")
def test_a_soak_logs_every_lost_connection_and_keeps_memory_and_handles(tmp_path):
    pytest.importorskip("pymodbus")
    log, config = tmp_path / "safety.jsonl", Config().defaults()
    operation = {"asynchronous": True, "operation": OperationConfig(continuous=True)}
    config = dataclasses.replace(config, horizon=60.0, threads=1, log_dir=tmp_path / "run", **operation)
    plant, period, ended, lost, used = config.plant(), config.dt / PACE, threading.Event(), [], []
    with served_turbine_alone(pace=PACE, horizon=60.0) as port, contextlib.closing(Relay(port)) as relay:
        env = partial(machine, plant, SAFE, "modbus", relay.port, period, log=log)
        run = Run(config, plant, env=env, first=JonkmanController)
        algorithm, until = run.algorithm, float("inf")
        losing = threading.Thread(target=lose, args=(relay, ended, lost), daemon=True)
        try:
            while time.monotonic() < until:
                with contextlib.suppress(ValueError):  # several windows in a row may be cut up
                    assert algorithm.episode()["real_cost"].isfinite()
                if not used:  # the first round, which compiles, may take long
                    losing.start()
                    until = time.monotonic() + SECONDS
                pids = [os.getpid(), *sorted(process.pid for process in multiprocessing.active_children())]
                used.append([(memory(pid), handles(pid)) for pid in pids])
        finally:
            ended.set()
            algorithm.operating.operation.close()
            run._held.release()
    times = np.array([json.loads(line)["at"] for line in log.read_text().splitlines()])
    logged = [bool(((times >= at) & (times <= at + seconds + SEEN)).any()) for at, seconds in lost]
    assert len(lost) >= 3 and all(logged[:-1])  # the last one may outlive the run
    kept = np.array(used[len(used) // 4 :])
    assert (kept[-1, :, 1] <= kept[0, :, 1] + 2).all() and (kept[-1, :, 0] <= 1.1 * kept[0, :, 0]).all()


def lateness(operation, learn, seconds):
    """Lateness of the intervals of a turn [ms], with learning beside it or without."""
    end, late = time.monotonic() + seconds, []
    while operation.waiting():
        operation.rollout()  # windows that began before the turn
    operation.rollout()
    while time.monotonic() < end or not late:
        if learn is not None:
            learn()
        while learn is None or operation.waiting():
            late.append(1e3 * operation.rollout()["late"].flatten().numpy())
            if learn is None:
                break
    return np.concatenate(late)


def test_the_period_is_kept_beside_learning_as_without(tmp_path):
    """Steps 2 to 6 of a training whose real episode is over are taken again and again."""
    config = dataclasses.replace(recipe("wind_turbine").Config().defaults(), horizon=25.0, log_dir=tmp_path)
    plant, period = config.plant(), 0.02
    run = Run(config, plant, first=JonkmanController)
    episode, policy = run.algorithm(TensorDict({"number": 0})), run.algorithm.policies["model_free"]
    make_env, options = partial(PlantEnv, plant, seed=1), OperationConfig(speed=plant.dt / period)
    acting = Operator(make_env, plant, {"model_free": policy}, ExplorationConfig(episodes=0), options, seed=0)
    operation = Operation(acting, make_env())

    def learn():
        for name, step in run.algorithm.module.items():
            if name != "interact":
                step(episode)
        operation.hand_over("model_free", policy, strength=0.0)

    try:
        operation.hand_over("model_free", policy, strength=0.0)
        late = {name: lateness(operation, beside, SECONDS / 4) for name, beside in (("idle", None), ("busy", learn))}
    finally:
        operation.close()
        run._held.release()
    for name, times in late.items():
        print(name, len(times), *np.percentile(times, [50, 99, 100]).round(3), "missed", (times >= 1e3 * period).sum())
        assert np.median(times) < 2.0 and (times >= 1e3 * period).mean() < 0.1
