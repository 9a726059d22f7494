"""A link over OPC UA, by a client of asyncua that the user prepares."""

import asyncio
import concurrent.futures
import contextlib
import math
import struct
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, TypeVar

from rt_torchrl.loading import of_extra
from rt_torchrl.options import require_range
from rt_torchrl.systems.machine.connected_plant import LONGEST, LateAnswerError, LinkLostError, RefusedRequestError

Result = TypeVar("Result")
CONNECT = 4.0
"""Longest time of an attempt to connect [s]."""
FORMATS = {"SByte": "b", "Byte": "B", "Int16": "h", "UInt16": "H", "Int32": "i", "UInt32": "I", "Int64": "q"}
FORMATS |= {"UInt64": "Q", "Float": "f", "Double": "d"}
"""Formats of ``struct`` of the types of numbers."""
PASSING = (
    "BadNoCommunication BadCommunicationError BadNotConnected BadServerNotConnected BadTimeout "
    "BadWaitingForInitialData BadServerHalted BadShutdown BadOutOfService"
).split()
"""Answers to a command that say that the machine behind the server is not there now; they do not refuse the command."""
UNTOLD = ("BadAttributeIdInvalid", "BadUserAccessDenied", "BadNotReadable")
"""Answers of a server that does not tell the type of a node; a double is written there."""


class OpcUaLink:
    """A :class:`Link` to an OPC UA server, whose nodes hold numbers of any type.

    A command takes the type of its node, which is read when connecting; whole numbers are not rounded to. A reading
    whose status is not Good, or that holds no value, is NaN; the attribute ``quality`` has its status.

    Args:
        client: function of ``tloop=`` that makes a client, an ``asyncua.sync.Client`` with this loop. Address, user,
            security policy and certificates are its own: ``partial(Client, "opc.tcp://localhost:4840")`` has none.
            Each connection is one of a new client.
        read: identifiers of the nodes that are read, by tag, such as ``{"state.speed": "ns=2;s=Drive.Speed"}``.
        written: identifiers of the nodes that are written, by tag.
        timeout: longest time of an answer [s]; a fraction of the control period.

    Raises:
        ValueError: if asyncua is not installed, or the time is none of an answer.
    """

    def __init__(
        self, client: Callable[..., Any], read: Mapping[str, str], written: Mapping[str, str], *, timeout: float
    ):
        require_range("timeout", timeout, *LONGEST, unit="s", of="the link")
        self._ua: Any = of_extra("asyncua.ua", "machine")
        self._thread, self._make_client = of_extra("asyncua.sync", "machine").ThreadLoop, client
        self._read, self._written, self.timeout = dict(read), dict(written), timeout
        self.quality: dict[str, str] = {}
        self._loop: Any = None  # asyncua's thread with its event loop
        self._client: Any = None
        self._broken = False

    def connect(self) -> None:
        if self._loop is None:
            self._loop = self._thread()
            self._loop.daemon = True  # a program that ends by an error does not wait for it
            self._loop.start()
        self._disconnect()
        self._loop.timeout = CONNECT  # of what is asked of the server to make a client, such as its certificate
        try:
            self._client, self._broken = self._make_client(tloop=self._loop), False
        except (OSError, self._ua.UaError, concurrent.futures.TimeoutError) as error:
            raise LinkLostError(f"the OPC UA client cannot be made: {type(error).__name__}: {error}") from error
        client = self._client.aio_obj
        self.url = client.server_url.geturl()
        try:
            self._within(client.connect(), CONNECT)
            self._sources = [client.get_node(identifier) for identifier in self._read.values()]
            self._targets = {tag: client.get_node(identifier) for tag, identifier in self._written.items()}
            self._types = {tag: self._within(self._type_of(tag, node), CONNECT) for tag, node in self._targets.items()}
        except (LinkLostError, RefusedRequestError):
            self._disconnect()
            raise

    async def _type_of(self, tag: str, node: Any) -> Any:
        """The type of the number that a node takes.

        Raises:
            RefusedRequestError: if there is no such node, or it takes no number.
        """
        ua, where = self._ua, f"{self.url} cannot take tag {tag!r} at node {self._written[tag]!r}"
        try:
            kind = await node.read_data_type_as_variant_type()
        except ua.UaStatusCodeError as error:
            name = ua.StatusCode(error.code).name
            if name in UNTOLD:
                return ua.VariantType.Double
            if name in ("BadNodeIdUnknown", "BadNodeIdInvalid"):
                raise RefusedRequestError(f"{where}: {name}; name a node that the server has.") from error
            raise
        if kind == ua.VariantType.Variant:  # any number
            return ua.VariantType.Double
        if kind.name not in FORMATS:
            raise RefusedRequestError(f"{where}: it holds {kind.name}; name a node of a numeric type, such as Double.")
        return kind

    def _typed(self, tag: str, value: float) -> Any:
        """A command in the type of its node, which changes it by the rounding of single precision at most.

        Raises:
            RefusedRequestError: if it does not fit the type.
        """
        kind, number = self._types[tag], value
        try:
            if kind.name not in ("Double", "Float"):
                number = round(value)
                if number != value:
                    raise ValueError("it takes whole numbers")
            struct.pack(f"<{FORMATS[kind.name]}", number)
        except (ValueError, OverflowError, struct.error) as error:
            raise RefusedRequestError(
                f"{self.url}: {tag!r} = {value:g} does not fit node {self._written[tag]!r} of type {kind.name}: "
                f"{error}; give the machine a node of type Double."
            ) from error
        return self._ua.Variant(number, kind)

    def read(self) -> dict[str, float]:
        rows = self._within(self._connected().read_attributes(self._sources), self.timeout)
        reading, self.quality = {}, {}
        for (tag, identifier), row in zip(self._read.items(), rows, strict=True):
            value = None if row.Value is None else row.Value.Value
            good = row.StatusCode is None or row.StatusCode.is_good()
            if not good or value is None:
                reading[tag], self.quality[tag] = math.nan, "no value" if good else row.StatusCode.name
            elif isinstance(value, bool) or not isinstance(value, int | float):
                raise RefusedRequestError(
                    f"{self.url} has no number behind tag {tag!r} at node {identifier!r}, but {value!r}; name a "
                    "node of a numeric type."
                )
            else:
                reading[tag] = float(value)
        return reading

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
            raise LinkLostError("there is no connection to the OPC UA server.")
        return self._client.aio_obj

    def _within(self, work: Coroutine[Any, Any, Result], timeout: float) -> Result:
        """The result of a request, if it comes in time.

        Raises:
            LinkLostError: if it does not come, or the server refuses the request as a whole.
        """
        self._loop.timeout = timeout
        try:
            result: Result = self._loop.post(asyncio.wait_for(work, timeout))
            return result
        except (TimeoutError, concurrent.futures.TimeoutError) as error:
            self._broken = True
            raise LateAnswerError(f"{self.url} has not answered within {timeout:g} s.") from error
        except (OSError, self._ua.UaError, asyncio.CancelledError, concurrent.futures.CancelledError) as error:
            self._broken = True
            raise LinkLostError(f"{self.url}: {type(error).__name__}: {error}") from error

    def _disconnect(self) -> None:
        client, self._client = self._client, None
        if client is None:
            return
        if self._broken:
            # Without a socket, the package ends its tasks at once instead of waiting for a server's farewell.
            self._loop.loop.call_soon_threadsafe(client.aio_obj.disconnect_socket)
        with contextlib.suppress(LinkLostError):  # which is what is wanted
            self._within(client.aio_obj.disconnect(), CONNECT)

    def close(self) -> None:
        if self._loop is not None:
            self._disconnect()
            self._loop.stop()
            self._loop = None
