"""A plant served in a thread of the test, at any pace."""

import asyncio
import contextlib
import socket
import subprocess
import sys
import threading

import served_turbine
from served_turbine import HOST, ServedPlant, serve


def free_port():
    with socket.socket() as one:
        one.bind((HOST, 0))
        return one.getsockname()[1]


@contextlib.asynccontextmanager
async def in_operation(running, protocol, port, period):
    task = asyncio.create_task(serve(running, protocol, port, period))
    try:
        while not task.done():
            with contextlib.suppress(OSError):
                (await asyncio.open_connection(HOST, port))[1].close()
                break
            await asyncio.sleep(0.02)
        yield running, port
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@contextlib.contextmanager
def served(plant, protocol, *, safe, period, seed=0):
    """The plant in operation; gives it and the port that its server listens on."""
    running = ServedPlant(plant, safe, seed=seed)
    with in_a_thread(in_operation(running, protocol, free_port(), period)) as (found, _):
        yield found


@contextlib.contextmanager
def served_turbine_alone(**options):
    """The turbine in a process of its own, as the recipe serves it with these options; gives its port."""
    options = {"port": free_port()} | options
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    process = subprocess.Popen([sys.executable, served_turbine.__file__, "--serve", *words], stdout=subprocess.DEVNULL)
    try:
        yield options["port"]
    finally:
        process.terminate()
        process.wait(10.0)


@contextlib.contextmanager
def in_a_thread(server):
    """Enter an asynchronous context in a thread of its own; gives what it gives, and its event loop."""
    begun, found = threading.Event(), {}

    async def run():
        async with server as value:
            found.update(value=value, loop=asyncio.get_running_loop(), ended=asyncio.Event())
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
