"""A simulated plant server in a process of its own."""

import asyncio
import multiprocessing
import pickle
import signal
import sys
from collections.abc import Sequence
from typing import Any

import torch

from rt_torchrl.plants.plant import Plant
from rt_torchrl.systems.ended_process import end_process
from rt_torchrl.systems.protocols.plant_server import BOARDS, serve
from rt_torchrl.systems.protocols.served_plant import ServedPlant

START = 60.0
"""Longest time until the server listens [s]."""
END = 10.0
"""Longest time until the server has ended [s]."""


class ServerProcess:
    """A context in which a plant is in operation in another process, and answers on a port of this machine.

    Args:
        plant: the plant, with its own closure.
        safe: action that the plant's own watchdog brings, one number for each actuator.
        protocol: what the server speaks, opcua or modbus.
        port: port that the server listens on.
        period: wall-clock time of a control interval [s].
        seed: seed of the first state and of the inputs.

    Raises:
        ValueError: if the safe action does not fit, there is no such protocol or its package, or the server does not
            start, such as on a port that is in use.
    """

    def __init__(self, plant: Plant, safe: Sequence[float], *, protocol: str, port: int, period: float, seed: int = 0):
        if protocol not in BOARDS:
            raise ValueError(f"protocol={protocol!r} does not exist; choose {' or '.join(BOARDS)}.")
        if not 0 < port < 65536:
            raise ValueError(f"port={port} must lie in 1 ... 65535.")
        served = ServedPlant(plant, safe, seed=seed)
        BOARDS[protocol](served.tags, port)  # is the package there?
        self._arguments = pickle.dumps((plant, tuple(safe), protocol, port, period, seed))
        self._port = port
        self._context = multiprocessing.get_context("spawn")

    def __enter__(self) -> "ServerProcess":
        self._ended, self._started = self._context.Event(), self._context.Event()
        arguments = (self._arguments, self._started, self._ended)
        self._process: Any = self._context.Process(target=run_server, args=arguments, daemon=True)
        self._process.start()
        waited = 0.0
        while not self._started.wait(0.1) and self._process.is_alive() and waited < START:
            waited += 0.1
        if not self._started.is_set():
            self.__exit__()
            raise ValueError(f"the plant server does not start on port={self._port}; another program may have it.")
        return self

    @property
    def pid(self) -> int:
        """Number of the server's process."""
        return int(self._process.pid)

    def __exit__(self, *raised: object) -> None:
        self._ended.set()
        end_process(self._process, END)


def run_server(arguments: bytes, started: Any, ended: Any) -> None:
    """The main function of the server's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that has started it says when to end
    torch.set_num_threads(1)
    plant, safe, protocol, port, period, seed = pickle.loads(arguments)
    served = ServedPlant(plant, safe, seed=seed)
    parent = multiprocessing.parent_process()

    def over() -> bool:
        return bool(ended.is_set()) or (parent is not None and not parent.is_alive())

    try:
        board = BOARDS[protocol](served.tags, port)
        asyncio.run(serve(served, board, period, ended=over, begun=started.set))
    except (OSError, RuntimeError) as error:  # pymodbus raises a RuntimeError if it cannot listen
        sys.exit(f"the plant server has ended: {error}")
