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


@contextlib.contextmanager
def in_a_thread(server):
    """Enter an asynchronous context in a thread of its own; gives what it gives, and its event loop."""
    begun, found = threading.Event(), {}

    async def run():
        found.update(loop=asyncio.get_running_loop(), ended=asyncio.Event())
        async with server as found["value"]:
            begun.set()
            await found["ended"].wait()

    work = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    work.start()
    assert begun.wait(30.0)
    try:
        yield found["value"], found["loop"]
    finally:
        found["loop"].call_soon_threadsafe(found["ended"].set)
        work.join(30.0)
