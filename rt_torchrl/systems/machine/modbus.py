"""A link over Modbus, by a client of pymodbus that the user prepares."""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import field
from typing import Any, Literal

from rt_torchrl.options import Count, configuration, require_range
from rt_torchrl.systems.machine.connected_plant import LONGEST, LateAnswerError, LinkLostError, RefusedRequestError

WIDTHS = {"int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "int64": 4, "uint64": 4, "float32": 2, "float64": 4}
"""Number of registers of each type of numbers."""
MOST = 120
"""Greatest number of registers in one request."""
REFUSALS = {1: "illegal function", 2: "illegal data address", 3: "illegal data value", 4: "device failure"}
"""Exceptions by which a server refuses a request; after the others, such as a busy device, it may take the next one."""

Kind = Literal["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"]


@configuration
class Register:
    """A number in the registers of a Modbus device.

    Args:
        address: address of its first register.
        kind: type of the number.
        scale: one unit of the register in the unit of the tag, such as 0.1 for tenths. A command to a register of whole
            numbers is rounded to this resolution; with a scale of 1 it must be a whole number.
        word_order: big for the high word first, little for the low one.
        table: holding for registers that are read and written, input for those that are read alone.

    Raises:
        ValueError: if an option is none of its choices, the address is negative, or the scale is zero.
    """

    address: Count = field(kw_only=False)
    kind: Kind = field(default="float64", kw_only=False)
    scale: float = 1.0
    word_order: Literal["big", "little"] = "big"
    table: Literal["holding", "input"] = "holding"

    def __post_init__(self) -> None:
        if self.scale == 0.0:
            raise ValueError(f"scale={self.scale} of the register at address={self.address} must not be zero.")

    @property
    def end(self) -> int:
        """Address behind the last register."""
        return self.address + WIDTHS[self.kind]


class ModbusLink:
    """A :class:`Link` to a Modbus server.

    Args:
        client: client of pymodbus, such as ``ModbusTcpClient(host, timeout=0.02, retries=0)``. Its answers must come
            within a fraction of the control period.
        read: registers of the tags that are read, beside each other in one table: one request takes readings of one
            moment.
        written: holding registers of the tags that are written, one behind the other.
        device: number of the device behind the server.

    Raises:
        ValueError: if the registers do not fit one request, the written ones have gaps, which a request would
            overwrite, or the client tries again by itself or waits longer than any control loop.
    """

    def __init__(self, client: Any, read: Mapping[str, Register], written: Mapping[str, Register], *, device: int = 1):
        for what, registers in (("read", read), ("written", written)):
            if len({register.table for register in registers.values()}) != 1 or _span(registers.values())[1] > MOST:
                raise ValueError(
                    f"{what}={dict(registers)} must be registers of one table that one request takes, which spans at "
                    f"most {MOST}; let the plant hold the tags beside each other."
                )
        self._written = dict(sorted(written.items(), key=lambda item: item[1].address))
        ordered = list(self._written.values())
        gaps = any(first.end != second.address for first, second in zip(ordered, ordered[1:], strict=False))
        if gaps or ordered[0].table == "input":
            raise ValueError(f"written={dict(written)} must be holding registers one behind the other, without gaps.")
        if client.retries:
            raise ValueError(
                f"retries={client.retries} of the client must be 0: while it tries again, no command reaches the plant."
            )
        require_range("timeout", client.comm_params.timeout_connect, *LONGEST, unit="s", of="the client")
        self._client, self._device, self._read, self.quality = client, device, dict(read), dict[str, str]()
        self._address = f"{client.comm_params.host}:{client.comm_params.port}"

    def connect(self) -> None:
        self._client.close()
        if not self._client.connect():
            raise LinkLostError(f"{self._address} does not answer.")

    def read(self) -> dict[str, float]:
        registers = self._read.values()
        first, count = _span(registers)
        request = getattr(self._client, f"read_{next(iter(registers)).table}_registers")
        what = f"to read {', '.join(self._read)}"
        words = self._asked(what, request, first, count=count, device_id=self._device).registers
        reading = {}
        for tag, register in self._read.items():
            register_words = words[register.address - first : register.end - first]
            number = self._client.convert_from_registers(register_words, self._kind(register), register.word_order)
            reading[tag] = register.scale * number
        return reading

    def write(self, values: Mapping[str, float]) -> None:
        if set(self._written) != set(values):
            raise ValueError(f"one request writes {list(self._written)}, and not {list(values)}.")
        words = [word for tag, register in self._written.items() for word in self._words(tag, register, values[tag])]
        what = "to write " + ", ".join(f"{tag} = {values[tag]:g}" for tag in self._written)
        first, _ = _span(self._written.values())
        self._asked(what, self._client.write_registers, first, words, device_id=self._device)

    def _words(self, tag: str, register: Register, value: float) -> list[int]:
        """The registers of a command.

        Raises:
            RefusedRequestError: if it does not fit their type.
        """
        number: float = value / register.scale
        try:
            if "int" in register.kind:
                if register.scale == 1.0 and number != round(number):
                    raise ValueError("it takes whole numbers")
                number = round(number)
            words: list[int] = self._client.convert_to_registers(number, self._kind(register), register.word_order)
        except (ValueError, OverflowError, struct.error) as error:
            raise RefusedRequestError(f"{tag!r} = {value:g} does not fit {register}: {error}.") from error
        return words

    def _kind(self, register: Register) -> Any:
        return self._client.DATATYPE[register.kind.upper()]

    def _asked(self, what: str, request: Any, *arguments: Any, **options: Any) -> Any:
        """The answer to a request.

        Args:
            what: the request in words.
            request: method of the client that makes it.
            arguments: its arguments.
            options: more arguments.

        Raises:
            LinkLostError: if it does not come in time.
            RefusedRequestError: if the server refuses.
        """
        from pymodbus.exceptions import ModbusException, ModbusIOException  # here, because the package is an extra

        try:
            if not self._client.connected and not self._client.connect():
                raise LinkLostError(f"{self._address} does not answer.")
            answer = request(*arguments, **options)
        except ModbusIOException as error:
            self._client.close()  # an answer that still comes would be taken for that of the next request
            raise LateAnswerError(f"{self._address}: {error}") from error
        except (OSError, ModbusException) as error:
            self._client.close()
            raise LinkLostError(f"{self._address}: {type(error).__name__}: {error}") from error
        if not answer.isError():
            return answer
        code = getattr(answer, "exception_code", None)
        if code in REFUSALS:
            raise RefusedRequestError(
                f"{self._address} refuses {what}: exception {code}, {REFUSALS[code]}. Mend the addresses, or what the "
                "machine lets a client read and write."
            )
        raise LateAnswerError(f"{self._address} does not answer {what} now: {answer}")

    def close(self) -> None:
        self._client.close()


def _span(registers: Iterable[Register]) -> tuple[int, int]:
    """Address of the first of some registers, and their number with those between them."""
    first = min(register.address for register in registers)
    return first, max(register.end for register in registers) - first
