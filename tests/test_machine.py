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
import torch
from relay import Relay
from served_plants import free_port
from test_export_recipe import recipe
from test_operation import QUIET

from rt_torchrl import OperationConfig, PlantEnv, Run, ServerProcess, served_system
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.systems.operation.operator import Crew
from rt_torchrl.systems.operation.process import ProcessOperation

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
    module, port, log = recipe("served_turbine"), free_port(), tmp_path / "safety.jsonl"
    config = module.Config().defaults()
    config = dataclasses.replace(config, pace=PACE, horizon=60.0, port=port, threads=1, log_dir=tmp_path / "run")
    plant, ended, lost, used = config.plant(), threading.Event(), [], []
    with ServerProcess(plant, **config.served()), contextlib.closing(Relay(port)) as relay:
        served = config.served() | {"port": relay.port}
        run = Run(config, plant, env=partial(served_system, plant, **served, log=log), first=JonkmanController)
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


class Learner:
    """Steps 2 to 6 of a training whose real episode is over, over and over."""

    def __init__(self):
        from tensordict import TensorDict
        from wind_turbine import DEFAULT

        from rt_torchrl import DigitalTwin, ReinforcementTwinning
        from rt_torchrl.envs.wind_turbine.plant import WindTurbine

        generator = torch.Generator().manual_seed(0)
        self.plant = WindTurbine(horizon=25.0)
        self.policies = {role: self.plant.make_policy(generator) for role in ("model_free", "model_based")}
        twin = DigitalTwin(self.plant, self.plant.make_closure(generator))
        env = PlantEnv(self.plant)
        self.algorithm = ReinforcementTwinning(env, twin, **self.policies, config=DEFAULT, generator=generator)
        self.episode = self.algorithm(TensorDict({"number": 0}))

    def learn(self):
        for name, step in self.algorithm.module.items():
            if name != "interact":
                step(self.episode)


def lateness(operation, learner, seconds):
    """Lateness of the intervals of a turn [ms], with a learner beside it or without."""
    end, late = time.monotonic() + seconds, []
    while operation.waiting():
        operation.rollout()  # windows that began before the turn
    operation.rollout()
    while time.monotonic() < end or not late:
        if learner is not None:
            learner.learn()
            operation.hand_over("model_free", learner.policies["model_free"], strength=0.0)
        while learner is None or operation.waiting():
            late.append(1e3 * operation.rollout()["late"].flatten().numpy())
            if learner is None:
                break
    return np.concatenate(late)


def test_the_period_is_kept_beside_learning_as_without():
    recipe("wind_turbine")
    learner, period = Learner(), 0.02
    make_env, policies = partial(PlantEnv, learner.plant, seed=1), {"model_free": learner.policies["model_free"]}
    options = OperationConfig(clock="wall", speed=learner.plant.dt / period, continuous=True)
    operation = ProcessOperation(Crew(make_env, learner.plant, policies, QUIET, options, seed=0), make_env())
    try:
        operation.hand_over("model_free", policies["model_free"], strength=0.0)
        late = {name: lateness(operation, beside, SECONDS / 4) for name, beside in (("idle", None), ("busy", learner))}
    finally:
        operation.close()
    for name, times in late.items():
        print(name, len(times), *np.percentile(times, [50, 99, 100]).round(3), "missed", (times >= 1e3 * period).sum())
        assert np.median(times) < 2.0 and (times >= 1e3 * period).mean() < 0.1
