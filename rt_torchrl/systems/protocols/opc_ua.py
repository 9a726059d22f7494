"""A link over OPC UA, by asyncua."""

import asyncio
import concurrent.futures
import contextlib
import logging
import math
import threading
from collections.abc import Coroutine, Mapping, Sequence
from typing import Any, TypeVar

from rt_torchrl.systems.protocols.link import LateAnswerError, LinkLostError, RefusedRequestError, require_timeout

Result = TypeVar("Result")
CONNECT = 4.0
"""Longest time of an attempt to connect [s]."""
NAMESPACE = 2
"""Index of the namespace of a served plant."""
WHOLE = {
    "SByte": (-(2**7), 2**7 - 1),
    "Byte": (0, 2**8 - 1),
    "Int16": (-(2**15), 2**15 - 1),
    "UInt16": (0, 2**16 - 1),
    "Int32": (-(2**31), 2**31 - 1),
    "UInt32": (0, 2**32 - 1),
    "Int64": (-(2**63), 2**63 - 1),
    "UInt64": (0, 2**64 - 1),
}
"""Least and greatest number of each type of whole numbers."""
SINGLE = 3.4028234663852886e38
"""Greatest number in single precision."""
PASSING = frozenset(
    {
        *("BadNoCommunication", "BadCommunicationError", "BadNotConnected", "BadServerNotConnected", "BadTimeout"),
        *("BadWaitingForInitialData", "BadServerHalted", "BadShutdown", "BadOutOfService"),
    }
)
"""Answers to a command that say that the machine behind the server is not there now; they do not refuse the command."""
UNTOLD = ("BadAttributeIdInvalid", "BadUserAccessDenied", "BadNotReadable")
"""Answers of a server that does not tell the type of a node; a double is written there."""


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
    """A :class:`Link` to an OPC UA server, whose nodes hold numbers of any type.

    A command takes the type of its node, which is read when connecting; whole numbers are not rounded to. A reading
    whose status is not Good, or that holds no value, is NaN; the attribute ``quality`` has its status.

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
        self.quality: dict[str, str] = {}
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
        self._types = {tag: self._within(self._type_of(tag, node), CONNECT) for tag, node in self._targets.items()}

    async def _type_of(self, tag: str, node: Any) -> Any:
        """The type of the number that a node takes.

        Raises:
            RefusedRequestError: if there is no such node, or it takes no number.
        """
        ua = self._package.ua
        try:
            found = await node.read_data_type_as_variant_type()
        except ua.UaStatusCodeError as error:
            name = ua.StatusCode(error.code).name
            if name in ("BadNodeIdUnknown", "BadNodeIdInvalid"):
                raise RefusedRequestError(f"{self._of(tag)}: {name}; name a node that the server has.") from error
            if name not in UNTOLD:
                raise
            return ua.VariantType.Double
        if found == ua.VariantType.Variant:  # any number
            return ua.VariantType.Double
        if found.name not in ("Double", "Float", *WHOLE):
            raise RefusedRequestError(
                f"{self._of(tag)}: it holds {found.name}, and a command is a number; give the machine a node of a "
                "numeric type, such as Double."
            )
        return found

    def _of(self, tag: str) -> str:
        return f"{self.url} cannot take tag {tag!r} at node {self._written[tag]!r}"

    def _typed(self, tag: str, value: float) -> Any:
        """A command in the type of its node, which changes it by the rounding of single precision at most.

        Raises:
            RefusedRequestError: if it does not fit the type.
        """
        kind = self._types[tag]
        if kind.name in WHOLE:
            low, high = WHOLE[kind.name]
            if not (math.isfinite(value) and value == round(value) and low <= value <= high):
                raise RefusedRequestError(
                    f"{self.url}: {tag!r} = {value:g} does not fit node {self._written[tag]!r} of type {kind.name}, "
                    f"which takes whole numbers from {low} to {high}; give the machine a node of type Double."
                )
            return self._package.ua.Variant(round(value), kind)
        if kind.name == "Float" and math.isfinite(value) and abs(value) > SINGLE:
            raise RefusedRequestError(
                f"{self.url}: {tag!r} = {value:g} does not fit node {self._written[tag]!r} of type Float."
            )
        return self._package.ua.Variant(float(value), kind)

    def read(self) -> dict[str, float]:
        client = self._connected()
        rows = self._within(client.read_attributes(self._sources), self.timeout)
        found, quality = {}, {}
        for (tag, identifier), row in zip(self._read.items(), rows, strict=True):
            value = None if row.Value is None else row.Value.Value
            good = row.StatusCode is None or row.StatusCode.is_good()
            if not good or value is None:
                found[tag], quality[tag] = math.nan, "no value" if good else row.StatusCode.name
            elif isinstance(value, bool) or not isinstance(value, int | float):
                raise RefusedRequestError(
                    f"{self.url} has no number behind tag {tag!r} at node {identifier!r}, but {value!r}; name a "
                    "node of a numeric type."
                )
            else:
                found[tag] = float(value)
        self.quality = quality
        return found

    def write(self, values: Mapping[str, float]) -> None:
        client = self._connected()
        nodes = [self._targets[tag] for tag in values]
        typed = [self._typed(tag, value) for tag, value in values.items()]
        answers = self._within(client.write_values(nodes, typed, raise_on_partial_error=False), self.timeout)
        for (tag, value), status in zip(values.items(), answers, strict=True):
            if status.name in PASSING:
                raise LateAnswerError(f"{self.url}: {tag!r} = {value:g} was not taken: {status.name}, {status.doc}")
            if not status.is_good() or status.name == "GoodClamped":
                raise RefusedRequestError(
                    f"{self.url} refuses {tag!r} = {value:g} at node {self._written[tag]!r} of type "
                    f"{self._types[tag].name}: {status.name}, {status.doc} Mend type, range or rights of the "
                    "node, or the range of the action."
                )

    def _connected(self) -> Any:
        if self._client is None:
            raise LinkLostError(f"there is no connection to {self.url}.")
        return self._client

    def _within(self, work: Coroutine[Any, Any, Result], timeout: float) -> Result:
        """The result of a request, if it comes in time.

        Raises:
            LinkLostError: if it does not come, or the server refuses the request as a whole.
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
