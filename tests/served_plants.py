"""A plant served in a thread of the test, at any pace."""

import asyncio
import contextlib
import socket
import threading

from rt_torchrl.systems.machine.rehearsal import SERVERS, ServedPlant, serve


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@contextlib.contextmanager
def served(plant, protocol, *, safe, period, seed=0):
    """The plant in operation; gives it and the port that its server listens on."""
    port, ended, started = free_port(), threading.Event(), threading.Event()
    running = ServedPlant(plant, safe, seed=seed)
    server = SERVERS[protocol](plant, port)
    serving = serve(running, server, period, ended=ended.is_set, begun=started.set)
    work = threading.Thread(target=lambda: asyncio.run(serving), daemon=True)
    work.start()
    assert started.wait(30.0)
    try:
        yield running, port
    finally:
        ended.set()
        work.join(30.0)
        assert not work.is_alive()
