"""A soak of the served wind turbine: hours of operation in which connections are lost."""

import contextlib
import dataclasses
import json
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from rt_torchrl import begin_loading

if __name__ == "__main__":
    begin_loading()

import numpy as np
import torch
from served_turbine import SAFE, server_of
from served_turbine import Config as Served

from rt_torchrl import check_options, main_of
from rt_torchrl.envs.wind_turbine.controllers import JonkmanController
from rt_torchrl.runs.results_file import make_folder, write_results

SEEN = 1.0
"""Time after its end within which a lost connection is in the log [s]."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Let the served wind turbine operate for hours while twin and policies learn, and lose its connection at random.

    The results hold, for each round of the learner, the cost and the memory and file handles of the processes: learner,
    acting process, server and relay. These are read from /proc, so that this needs Linux. They also hold every lost
    connection, how many of them the log of the safety layer has an event of, and the cost of the last policy on unseen
    episodes in simulation.

    Args:
        hours: length of the soak [h].
        faults: mean time between two lost connections [s]; 0 loses none.
        protocol: what the server speaks, opcua or modbus.
        port: port of the server on this machine; the next one is that of the relay, which loses the connections.
        pace: seconds of the turbine for each second.
        horizon: length of a window of operation [s of the turbine].
        seed: seed of the training and of the faults.
        threads: number of threads of the learner.
        log_dir: folder of the results, soak.json, and of the events of the safety layer, safety.jsonl.
    """

    hours: float = 2.0
    faults: float = 60.0
    protocol: Literal["opcua", "modbus"] = "modbus"
    port: int = 5020
    pace: float = 25.0
    horizon: float = 600.0
    seed: int = 0
    threads: int = 1
    log_dir: Path = Path("runs/soak")

    def __post_init__(self):
        check_options(self)
        if not self.hours > 0.0:
            raise ValueError(f"hours={self.hours} must be positive.")
        if not self.faults >= 0.0:
            raise ValueError(f"faults={self.faults} s must not be negative; 0 loses no connection.")

    def served(self) -> Served:
        """The training whose parts operate."""
        given = {"protocol": self.protocol, "port": self.port, "pace": self.pace, "horizon": self.horizon}
        options = {"seed": self.seed, "threads": self.threads, "log_dir": self.log_dir / "run", "overwrite": True}
        return dataclasses.replace(Served().defaults(), **given, **options)


class Faults:
    """Lost connections at random times from :meth:`begin` on: half of them are cut, half are silent.

    Args:
        relay: relay that loses them.
        mean: mean time between two [s].
        seed: seed of times and lengths.
    """

    def __init__(self, relay, mean: float, seed: int):
        self._relay, self._mean, self._draws = relay, mean, np.random.default_rng(seed)
        self.done: list[dict[str, float | str]] = []
        self._begun, self._ended = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Faults":
        if self._mean:
            self._thread.start()
        return self

    def begin(self) -> None:
        """Lose connections from now on: before the system operates, there is none that the log could miss."""
        self._begun.set()

    def __exit__(self, *raised: object) -> None:
        self._ended.set()
        self._begun.set()
        if self._mean:
            self._thread.join()

    def _run(self) -> None:
        self._begun.wait()
        while not self._ended.wait(self._draws.exponential(self._mean)):
            kind, seconds = str(self._draws.choice(["cut", "stall"])), float(self._draws.uniform(0.1, 2.0))
            self.done.append({"at": time.time(), "kind": kind, "seconds": seconds})
            getattr(self._relay, kind)(seconds)


def usage(pid: int) -> tuple[float, int]:
    """Resident memory of a process [MiB], and its number of file handles."""
    (line,) = (line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return float(line.split()[1]) / 1024.0, len(os.listdir(f"/proc/{pid}/fd"))


def summary(rounds: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Growth of memory and handles of each process after the first quarter of the rounds."""
    found = {}
    kept = rounds[len(rounds) // 4 :]
    for process in ("learner", "acting", "server", "relay"):
        memory = np.array([each[f"{process}_MiB"] for each in kept])
        handles = [each[f"{process}_handles"] for each in kept]
        third = max(1, len(memory) // 3)
        found[process] = {
            "MiB": float(np.median(memory)),
            "growth": float(np.median(memory[-third:]) / np.median(memory[:third]) - 1.0),
            "handles_first": handles[0],
            "handles_last": handles[-1],
        }
    return found


def times_of(log: Path) -> np.ndarray:
    """Times of the events in the log of a safety layer [s]."""
    text = log.read_text(encoding="utf-8") if log.is_file() else ""
    return np.array([json.loads(line)["at"] for line in text.splitlines()])


def logged(faults: list[dict[str, float | str]], times: np.ndarray) -> int:
    """Number of lost connections of whose time there is an event; the last one may have come after the last step."""
    return sum(bool(((times >= each["at"]) & (times <= each["at"] + each["seconds"] + SEEN)).any()) for each in faults)


def operate(
    config: Config, algorithm, pids: dict[str, int], until: float, faults: Faults
) -> tuple[list[dict[str, float]], list[str]]:
    """Rounds of the learner until a time, and the reasons of those in which nothing could be learned."""
    rounds, refused, before = [], [], 0
    while time.monotonic() < until:
        try:
            report = algorithm.episode()
        except ValueError as error:  # several windows in a row were cut up by faults
            refused.append(str(error))
            continue
        pids = pids | {"acting": algorithm.operating.operation.pid}
        found = {"real_cost": report["real_cost"].item(), "windows": report["windows"].item()}
        faults.begin()
        found["lost_connections"], before = len(faults.done) - before, len(faults.done)
        for process, pid in pids.items():
            found[f"{process}_MiB"], found[f"{process}_handles"] = usage(pid)
        rounds.append(found | {"left": until - time.monotonic()})
        write_results(config.log_dir / "soak.json", {"config": config, "rounds": rounds})
    return rounds, refused


def main(config: Config) -> None:
    # Here, because --help need not wait for TorchRL.
    from rt_torchrl import Relay, Run, served_system

    if not Path("/proc/self/fd").is_dir():
        raise ValueError("the soak reads memory and file handles from /proc, which this system does not have.")
    torch.set_num_threads(config.threads)
    make_folder("log_dir", config.log_dir)
    log = config.log_dir / "safety.jsonl"
    log.unlink(missing_ok=True)
    served = config.served()
    plant = served.plant()
    with server_of(served) as server, contextlib.closing(Relay(config.port, config.port + 1)) as relay:
        env = partial(
            served_system,
            plant,
            safe=SAFE,
            protocol=config.protocol,
            port=relay.port,
            period=served.period,
            closure=plant.closure,
            log=log,
        )
        run = Run(served, plant, env=env, first=JonkmanController)
        try:
            with Faults(relay, config.faults, config.seed) as faults:
                until = time.monotonic() + 3600.0 * config.hours
                pids = {"learner": os.getpid(), "server": server.pid, "relay": relay.pid}
                rounds, refused = operate(config, run.algorithm, pids, until, faults)
        finally:
            run.algorithm.operating.operation.close()
    write(config, rounds, refused, faults.done, log, unseen_costs(run))


def unseen_costs(run) -> list[float]:
    """J_a of the policy that acts at the end, on unseen episodes in simulation."""
    live = run.algorithm.policies[run.algorithm.referee.live]
    costs: list[float] = run.unseen.control_costs(live).tolist()
    return costs


def mean_cost(costs: Sequence[float]) -> dict[str, float]:
    """Mean and standard error of costs."""
    return {
        "number": len(costs),
        "mean": float(np.mean(costs)),
        "standard_error": float(np.std(costs) / len(costs) ** 0.5),
    }


def write(config: Config, rounds, refused: list[str], faults, log: Path, unseen: list[float]) -> None:
    """Write the results, and say the most important ones."""
    if not rounds:
        raise ValueError(f"hours={config.hours} h are too short for one round of the learner; give more.")
    times = times_of(log)
    seen = logged(faults, times)
    # A window of operation may have begun one round before; a whole one is told by its neighbour, too.
    pairs = zip([rounds[0], *rounds[:-1]], rounds, strict=True)
    whole = [each for before, each in pairs if not each["lost_connections"] + before["lost_connections"]]
    kinds = {"all rounds": rounds, "rounds without a lost connection": whole}
    costs = {kind: [each["real_cost"] for each in some] for kind, some in kinds.items()} | {"unseen episodes": unseen}
    costs = {kind: mean_cost(some) for kind, some in costs.items() if some}
    found = {
        "processes": summary(rounds),
        "faults": faults,
        "faults_logged": seen,
        "refused": refused,
        "safety_events": len(times),
        "windows": sum(each["windows"] for each in rounds),
        "cost": costs,
        "rounds": rounds,
    }
    path = write_results(config.log_dir / "soak.json", {"config": config, **found})
    for process, values in found["processes"].items():
        told = ", ".join(f"{name.replace('_', ' ')} {value:.4g}" for name, value in values.items())
        print(f"{process}: {told}")
    print(f"{len(faults)} lost connections, {seen} of them in the log; {len(refused)} rounds refused")
    for kind, some in costs.items():
        print(f"mean cost of {some['number']} {kind}: {some['mean']:.4g} ± {some['standard_error']:.2g}")
    print(f"results in {path}")


if __name__ == "__main__":
    main_of(Config, main)
