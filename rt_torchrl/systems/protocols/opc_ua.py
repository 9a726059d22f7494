"""A link over OPC UA, by asyncua."""

import asyncio
import concurrent.futures
import contextlib
import logging
import threading
from collections.abc import Coroutine, Mapping, Sequence
from typing import Any, TypeVar

from rt_torchrl.systems.protocols.link import LateAnswerError, LinkLostError, require_timeout

Result = TypeVar("Result")
CONNECT = 4.0
"""Longest time of an attempt to connect [s]."""
NAMESPACE = 2
"""Index of the namespace of a served plant."""


def asyncua() -> Any:
    """The package of the protocol.

    Raises:
        ValueError: if it is not installed.
    """
    try:
        import asyncua
    except ImportError as error:
        raise ValueError("OPC UA needs asyncua: install the extra, pip install 'rt_torchrl[opcua]'.") from error
    # A lost connection is an event of the link; the package would print tracebacks beside it.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    return asyncua


def own_nodes(tags: Sequence[str]) -> dict[str, str]:
    """Identifiers of the nodes of a served plant, by tag."""
    return {tag: f"ns={NAMESPACE};s={tag}" for tag in tags}


class OpcUaLink:
    """A :class:`Link` to an OPC UA server; all values are doubles.

    Args:
        url: address of the server, such as opc.tcp://localhost:4840.
        read: identifiers of the nodes that are read, by tag, such as ``{"state.speed": "ns=2;s=Drive.Speed"}``.
        written: identifiers of the nodes that are written, by tag.
        timeout: longest time of an answer [s]; a fraction of the control period.

    Raises:
        ValueError: if asyncua is not installed, or the time is not positive.
    """

    def __init__(self, url: str, read: Mapping[str, str], written: Mapping[str, str], *, timeout: float):
        require_timeout(timeout)
        self._package, self.url, self.timeout = asyncua(), url, timeout
        self._read, self._written = dict(read), dict(written)
        self._client: Any = None
        self._broken = False
        self._loop: asyncio.AbstractEventLoop | None = None

    def connect(self) -> None:
        if self._loop is None:
            self._loop = asyncio.new_event_loop()
            threading.Thread(target=self._loop.run_forever, daemon=True).start()
        self._disconnect()
        client = self._package.Client(self.url, timeout=CONNECT)
        try:
            self._within(client.connect(), CONNECT)
        except LinkLostError:
            self._client = client  # whose tasks end with the next attempt
            self._disconnect()
            raise
        self._client, self._broken = client, False
        self._sources = [client.get_node(identifier) for identifier in self._read.values()]
        self._targets = {tag: client.get_node(identifier) for tag, identifier in self._written.items()}

    def read(self) -> dict[str, float]:
        client = self._connected()
        values = self._within(client.read_values(self._sources), self.timeout)
        if any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
            wrong = {tag: value for tag, value in zip(self._read, values, strict=True) if not isinstance(value, float)}
            raise LinkLostError(f"{self.url} has no number behind {wrong}.")
        return dict(zip(self._read, map(float, values), strict=True))

    def write(self, values: Mapping[str, float]) -> None:
        client = self._connected()
        nodes = [self._targets[tag] for tag in values]
        self._within(client.write_values(nodes, [float(value) for value in values.values()]), self.timeout)

    def _connected(self) -> Any:
        if self._client is None:
            raise LinkLostError(f"there is no connection to {self.url}.")
        return self._client

    def _within(self, work: Coroutine[Any, Any, Result], timeout: float) -> Result:
        """The result of a request, if it comes in time.

        Raises:
            LinkLostError: if it does not come, or the server refuses.
        """
        assert self._loop is not None
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(timeout)
        except (TimeoutError, concurrent.futures.TimeoutError, asyncio.TimeoutError) as error:
            future.cancel()
            self._broken = True
            raise LateAnswerError(f"{self.url} has not answered within {timeout:g} s.") from error
        except (OSError, self._package.ua.UaError, asyncio.CancelledError, concurrent.futures.CancelledError) as error:
            self._broken = True
            raise LinkLostError(f"{self.url}: {type(error).__name__}: {error}") from error

    def _disconnect(self) -> None:
        client, self._client = self._client, None
        if client is None or self._loop is None:
            return
        if self._broken:
            # Without a socket, the package ends its tasks at once instead of waiting for a server's farewell.
            self._loop.call_soon_threadsafe(client.disconnect_socket)
        with contextlib.suppress(LinkLostError):  # which is what is wanted
            self._within(client.disconnect(), CONNECT)

    def close(self) -> None:
        if self._loop is not None:
            self._disconnect()
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._loop = None
