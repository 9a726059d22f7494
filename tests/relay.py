"""A relay between a client and a server that loses connections on demand, for rehearsals."""

import contextlib
import multiprocessing
import signal
import socket
import threading
import time
from typing import Any

SIZE = 65536
START = 30.0
"""Longest time until the relay listens [s]."""
END = 5.0
"""Longest time until the relay's process has ended [s]."""


class Relay:
    """Passes TCP connections on, from a port of the local machine to another one, and can lose them.

    It runs in a process of its own: a client that computes beside it would delay what a thread of its process passes.

    Args:
        target: port of the server.
        port: port of the relay; 0 for any that is free.

    The attribute ``port`` is the port that clients connect to.

    Raises:
        ValueError: if the relay does not start, such as on a port that is in use.
    """

    def __init__(self, target: int, port: int = 0):
        context = multiprocessing.get_context("spawn")
        self._orders, theirs = context.Pipe()
        self._process: Any = context.Process(target=run_relay, args=(target, port, theirs), daemon=True)
        self._process.start()
        theirs.close()
        try:
            self.port = int(self._orders.recv()) if self._orders.poll(START) else 0
        except EOFError:
            self.port = 0
        if not self.port:
            self.close()
            raise ValueError(f"the relay does not start on port={port}; another program may have it.")

    @property
    def pid(self) -> int:
        """Number of the relay's process."""
        return int(self._process.pid)

    def cut(self, seconds: float) -> None:
        """Close all connections, and refuse new ones for some time [s]."""
        self._orders.send(("cut", seconds))

    def stall(self, seconds: float) -> None:
        """Pass nothing on for some time [s]; the connections stay, as with a cable that was pulled."""
        self._orders.send(("stall", seconds))

    def close(self) -> None:
        """Close all connections, and listen no more."""
        self._orders.close()  # which ends the process
        self._process.join(END)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def run_relay(target: int, port: int, orders: Any) -> None:
    """The main function of the relay's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that has started it says when to end
    try:
        connections = Connections(target, port)
    except OSError:
        return  # the process that has started it says so
    orders.send(connections.port)
    with contextlib.suppress(EOFError, OSError), contextlib.closing(connections):
        while True:
            order, seconds = orders.recv()
            getattr(connections, order)(seconds)


class Connections:
    """The connections of a relay, passed on by threads, and how they are lost; see :class:`Relay`."""

    def __init__(self, target: int, port: int):
        self._target, self._until, self._stalled = target, 0.0, 0.0
        self._pairs: list[socket.socket] = []
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, seconds: float) -> None:
        self._until = time.monotonic() + seconds
        self._drop()

    def stall(self, seconds: float) -> None:
        self._stalled = time.monotonic() + seconds

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return  # closed
            try:
                if time.monotonic() < self._until:
                    raise ConnectionRefusedError
                server = socket.create_connection(("127.0.0.1", self._target), timeout=5.0)
                server.settimeout(None)
            except OSError:
                client.close()
                continue
            for one in (client, server):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                self._pairs += [client, server]
            for source, sink in ((client, server), (server, client)):
                threading.Thread(target=self._pass, args=(source, sink), daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(SIZE):
                while time.monotonic() < self._stalled:
                    time.sleep(1e-3)
                sink.sendall(data)
        with self._lock:
            self._pairs = [one for one in self._pairs if one not in (source, sink)]
        for one in (source, sink):
            _close(one)

    def _drop(self) -> None:
        with self._lock:
            dropped, self._pairs = self._pairs, []
        for one in dropped:
            _close(one)

    def close(self) -> None:
        self._listener.close()
        self._drop()


def _close(one: socket.socket) -> None:
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)  # which also wakes the thread that reads from it
    one.close()
