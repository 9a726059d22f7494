"""A link over Modbus TCP, by pymodbus."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from rt_torchrl.systems.protocols.link import LateAnswerError, LinkLostError, RefusedRequestError, require_timeout

WIDTH = 4
"""Number of registers of a number in double precision."""
MOST = 120
"""Greatest number of registers in one request."""
REFUSALS = {1: "illegal function", 2: "illegal data address", 3: "illegal data value", 4: "device failure"}
"""Exceptions by which a server refuses a request; after the others, such as a busy device, it may take the next one."""
WRITTEN_AT = 1000
"""Address of the first register that a client of a served plant writes."""


def pymodbus() -> Any:
    """The package of the protocol.

    Raises:
        ValueError: if it is not installed.
    """
    try:
        import pymodbus
        import pymodbus.client
        import pymodbus.exceptions
        import pymodbus.server
        import pymodbus.simulator
    except ImportError as error:
        raise ValueError("Modbus needs pymodbus: install the extra, pip install 'rt_torchrl[modbus]'.") from error
    # A lost connection is an event of the link; the package would print it beside that.
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    return pymodbus


def own_registers(tags: Sequence[str], first: int = 0) -> dict[str, int]:
    """Addresses of the holding registers of a served plant, by tag: four for each number, in a row."""
    return {tag: first + WIDTH * k for k, tag in enumerate(tags)}


def block(what: str, addresses: Mapping[str, int]) -> tuple[int, int]:
    """First address and number of the registers that hold some tags.

    Raises:
        ValueError: if they do not fit one request.
    """
    if not addresses or min(addresses.values()) < 0:
        raise ValueError(f"{what}={dict(addresses)} must name registers from 0 on.")
    first = min(addresses.values())
    count = max(addresses.values()) + WIDTH - first
    if count > MOST:
        raise ValueError(
            f"{what} spans {count} registers from {first} on, and one request takes at most {MOST}; let the plant hold "
            "the tags beside each other."
        )
    return first, count


class ModbusLink:
    """A :class:`Link` to a Modbus TCP server; each number is a double in four holding registers, high word first.

    Args:
        host: name or address of the server.
        port: its port.
        read: addresses of the first register of each tag that is read.
        written: addresses of the first register of each tag that is written; one behind the other, in this order.
        timeout: longest time of an answer [s]; a fraction of the control period.
        device: number of the device behind the server.

    Raises:
        ValueError: if pymodbus is not installed, the time is not positive, the registers do not fit one request, or the
            written ones have gaps, which a request would overwrite.
    """

    def __init__(
        self,
        host: str,
        port: int,
        read: Mapping[str, int],
        written: Mapping[str, int],
        *,
        timeout: float,
        device: int = 1,
    ):
        require_timeout(timeout)
        self._package, self._device, self.address = pymodbus(), device, f"{host}:{port}"
        self._read, self._written = dict(read), dict(written)
        self._first, self._count = block("read", read)
        self._first_written, count = block("written", written)
        if sorted(written.values()) != list(range(self._first_written, self._first_written + count, WIDTH)):
            raise ValueError(f"written={dict(written)} must be addresses one behind the other, {WIDTH} apart.")
        self._client = self._package.client.ModbusTcpClient(host, port=port, timeout=timeout, retries=0)
        self._kind, self._joined = self._client.DATATYPE.FLOAT64, False

    def connect(self) -> None:
        self._client.close()
        self._joined = False
        if not self._asked("to connect", self._client.connect):
            raise LinkLostError(f"{self.address} does not answer.")
        self._joined = True

    def read(self) -> dict[str, float]:
        answer = self._asked(
            f"to read {', '.join(self._read)}",
            self._client.read_holding_registers,
            self._first,
            count=self._count,
            device_id=self._device,
        )
        words = answer.registers
        found = {}
        for tag, address in self._read.items():
            at = address - self._first
            found[tag] = float(self._client.convert_from_registers(words[at : at + WIDTH], self._kind))
        return found

    def write(self, values: Mapping[str, float]) -> None:
        order = sorted(self._written, key=self._written.__getitem__)
        missing = set(order) ^ set(values)
        if missing:
            raise ValueError(f"one request writes {order}; {sorted(missing)} is missing or unknown.")
        words: list[int] = []
        for tag in order:
            words += self._client.convert_to_registers(float(values[tag]), self._kind)
        what = "to write " + ", ".join(f"{tag} = {values[tag]:g}" for tag in order)
        self._asked(what, self._client.write_registers, self._first_written, words, device_id=self._device)

    def _asked(self, what: str, request: Any, *arguments: Any, **options: Any) -> Any:
        """The answer to a request.

        Args:
            what: the request in words.
            request: function of the package that makes it.
            arguments: its arguments, of which the first is the address of the first register.
            options: more arguments.

        Raises:
            LinkLostError: if it does not come in time.
            RefusedRequestError: if the server refuses.
        """
        try:
            if self._joined and not self._client.connected and not self._client.connect():
                raise LinkLostError(f"{self.address} does not answer.")
            answer = request(*arguments, **options)
        except self._package.exceptions.ModbusIOException as error:
            self._client.close()  # an answer that still comes would be taken for that of the next request
            raise LateAnswerError(f"{self.address}: {error}") from error
        except (OSError, self._package.ModbusException) as error:
            self._client.close()
            raise LinkLostError(f"{self.address}: {type(error).__name__}: {error}") from error
        if isinstance(answer, bool) or not answer.isError():
            return answer
        code = getattr(answer, "exception_code", None)
        if code in REFUSALS:
            count = options.get("count") or len(arguments[1])
            raise RefusedRequestError(
                f"{self.address} refuses {what}, registers {arguments[0]} to {arguments[0] + count - 1}: exception "
                f"{code}, {REFUSALS[code]}. Mend the addresses, or what the machine lets a client read and write."
            )
        raise LateAnswerError(f"{self.address} does not answer {what} now: {answer}")

    def close(self) -> None:
        self._joined = False
        self._client.close()
