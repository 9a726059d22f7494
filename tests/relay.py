"""A relay between a client and a server that loses connections on demand, for rehearsals."""

import asyncio
import contextlib
import multiprocessing
import signal
import time


class Relay:
    """Passes TCP connections on, from a free port of the local machine to another one, and can lose them.

    It runs in a process of its own: a client that computes beside it would delay what a thread of its process passes.
    """

    def __init__(self, target):
        context = multiprocessing.get_context("spawn")
        self._orders, theirs = context.Pipe()
        self._process = context.Process(target=run_relay, args=(target, theirs), daemon=True)
        self._process.start()
        theirs.close()
        assert self._orders.poll(30.0)
        self.port = self._orders.recv()

    def cut(self, seconds):
        """Close all connections, and refuse new ones for some time [s]."""
        self._orders.send(("cut", seconds))

    def stall(self, seconds):
        """Pass nothing on for some time [s]; the connections stay, as with a cable that was pulled."""
        self._orders.send(("stall", seconds))

    def close(self):
        self._orders.close()  # which ends the process
        self._process.join(5.0)
        self._process.kill()


def run_relay(target, orders):
    """The main function of the relay's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that has started it says when to end
    asyncio.run(Connections(target).serve(orders))


class Connections:
    def __init__(self, target):
        self.target, self.until, self.writers = target, {"cut": 0.0, "stall": 0.0}, set()

    async def serve(self, orders):
        server = await asyncio.start_server(self.accept, "127.0.0.1", 0)
        orders.send(server.sockets[0].getsockname()[1])
        with contextlib.suppress(EOFError):
            while True:
                order, seconds = await asyncio.to_thread(orders.recv)
                self.until[order] = time.monotonic() + seconds
                for writer in self.writers if order == "cut" else ():
                    writer.transport.abort()

    async def accept(self, reader, writer):
        try:
            if time.monotonic() < self.until["cut"]:
                raise ConnectionRefusedError
            answers, server = await asyncio.open_connection("127.0.0.1", self.target)
        except OSError:
            writer.transport.abort()
            return
        self.writers |= {writer, server}
        await asyncio.gather(self.copy(reader, server), self.copy(answers, writer))

    async def copy(self, reader, writer):
        with contextlib.suppress(OSError):
            while data := await reader.read(65536):
                while time.monotonic() < self.until["stall"]:
                    await asyncio.sleep(1e-3)
                writer.write(data)
        self.writers.discard(writer)
        writer.close()
