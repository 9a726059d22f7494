"""A relay between a client and a server that loses connections on demand, for rehearsals."""

import contextlib
import socket
import threading
import time

SIZE = 65536


class Relay:
    """Passes TCP connections on, from a port of the local machine to another one, and can lose them.

    Args:
        target: port of the server.
        port: port of the relay; 0 for any that is free.

    The attribute ``port`` is the port that clients connect to.
    """

    def __init__(self, target: int, port: int = 0):
        self._target, self._until, self._stalled = target, 0.0, 0.0
        self._pairs: list[socket.socket] = []
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, seconds: float) -> None:
        """Close all connections, and refuse new ones for some time [s]."""
        self._until = time.monotonic() + seconds
        self._drop()

    def stall(self, seconds: float) -> None:
        """Pass nothing on for some time [s]; the connections stay, as with a cable that was pulled."""
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
        """Close all connections, and listen no more."""
        self._listener.close()
        self._drop()


def _close(one: socket.socket) -> None:
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)  # which also wakes the thread that reads from it
    one.close()
