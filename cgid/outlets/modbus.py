"""Modbus TCP: the state of each support as registers, for function 3 or 4, whatever the unit identifier.

Addresses count from 0 (30001 in the notation of some vendors is address 0). All registers are unsigned, shares are
1/10000, ages 0.1 s; 65535 is "not known". The table is in docs/how-to/plant.md.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

from cgid.outlets.outlet import Address, Service, library, since
from cgid.outlets.plant import Plant, Support
from cgid.validation import UNKNOWN

#: Version of the registers.
VERSION = 1
#: Registers of the head and of each support; most supports.
HEAD, WIDTH, MOST_SUPPORTS = 16, 16, 256
_NOT_KNOWN = 0xFFFF


class Modbus(Service):
    """A Modbus TCP server that only answers reads."""

    def __init__(self, address: str, plant: Plant, warn: Callable[[str], None]) -> None:
        own = Address.of("--modbus", address)
        super().__init__(f"modbus {own}", warn)
        # Simulated devices are how pymodbus serves registers.
        self._server = library("pymodbus.server", "--modbus", "pymodbus").ModbusTcpServer
        self._simulator = library("pymodbus.simulator", "--modbus", "pymodbus")
        self._codes = library("pymodbus.constants", "--modbus", "pymodbus").ExcCodes
        own.bound("--modbus").close()  # the library binds by itself, and tells no reason
        self._address, self._plant = own, plant

    def run(self) -> None:
        """Serve until the end."""
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        size = HEAD + WIDTH * MOST_SUPPORTS
        data = self._simulator.SimData(0, values=[0] * size, datatype=self._simulator.DataType.REGISTERS)
        device = self._simulator.SimDevice(0, simdata=[data], action=self._answer)
        server = self._server(device, address=tuple(self._address))
        await server.serve_forever(background=True)
        while not self._ending:
            await asyncio.sleep(0.1)
        await server.shutdown()

    async def _answer(
        self, function: int, start: int, address: int, count: int, current: list[int], values: Any
    ) -> Any:
        """Fill in the registers that are read; refuse to write."""
        if values is not None or function not in (3, 4):
            return self._codes.ILLEGAL_FUNCTION
        now = self._plant.read(lambda supports: registers(self._plant, supports))
        first = address - start
        wanted = now[address : address + count]
        current[first : first + count] = wanted + [0] * (count - len(wanted))
        return None


def registers(plant: Plant, supports: dict[str, Support]) -> list[int]:
    """Return all registers: the head, then those of each support in the order of the channels."""
    head = [VERSION, plant.beats & 0xFFFF, _tenths(plant.age), _tenths(plant.behind), len(supports), int(plant.ended)]
    found = head + [0] * (HEAD - len(head))
    for support in list(supports.values())[:MOST_SUPPORTS]:
        total, unknown = support.labels.total(), support.labels[UNKNOWN]
        own = [
            support.state,
            *(_share(value) for value in (support.share, support.low, support.high)),
            min(support.impacts, _NOT_KNOWN),
            min(support.unknown, _NOT_KNOWN),
            *_words(total),
            *_words(unknown),
            _tenths(since(support.shared_at)),
            _tenths(since(support.turned_at)),
            support.turns["shut"] & 0xFFFF,
        ]
        found += own + [0] * (WIDTH - len(own))
    return found


def _share(value: float) -> int:
    return _NOT_KNOWN if math.isnan(value) else round(value * 10_000)


def _tenths(seconds: float) -> int:
    return _NOT_KNOWN if seconds * 10 >= _NOT_KNOWN else max(int(seconds * 10), 0)


def _words(count: int) -> tuple[int, int]:
    """Return a count as two registers, the high word first."""
    return count >> 16 & 0xFFFF, count & 0xFFFF
