"""Modbus TCP: the state of each support as registers, for function 3 or 4, for any unit identifier.

Addresses count from 0 (30001 in the notation of some vendors is address 0). All registers are unsigned, fractions are
in 1/10000, ages in 0.1 s; 65535 means "not known". The table is in docs/reference/plant.md.
"""

from __future__ import annotations

import socketserver
import struct
from collections.abc import Callable
from typing import Any

from cgid._lib.validation import UNKNOWN
from cgid.identification.prediction.support import Decision, Ground
from cgid.pages.server import Address, Server
from cgid.plant.state import PlantState, Record, Support, age

#: Version of the registers.
VERSION = 2
#: Registers of the head and of each support; maximum number of supports.
HEAD, WIDTH, MAX_SUPPORTS = 16, 16, 256
#: Behind those of the supports: the numbers of what stands of each, so many at most.
FINDINGS = HEAD + WIDTH * MAX_SUPPORTS
EACH = 4
_SIZE = FINDINGS + EACH * MAX_SUPPORTS
_NOT_KNOWN = 0xFFFF
_DECISIONS = {Decision.NONE: 0, Decision.DRAW: 1, Decision.SHUT: 2, Decision.UNSURE: 3}
_GROUNDS = {
    Ground.SEEN: 1,
    Ground.BLIND: 2,
    Ground.WRONG_SCALE: 3,
    Ground.MOSTLY_UNKNOWN: 4,
    Ground.STOPPED: 5,
    Ground.UNPROVEN: 6,
    Ground.FAULT: 7,
}
#: A client without requests for this time is disconnected [s].
TIMEOUT = 60.0
#: Supported functions, maximum number of registers in a response, and of bytes in a frame after its length.
_READS, _MAX_COUNT, _MAX_LENGTH = (3, 4), 125, 254
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3


class Modbus(Server):
    """A Modbus TCP server that only answers reads of registers."""

    def __init__(self, address: str, plant: PlantState, warn: Callable[[str], None]) -> None:
        class RegisterHandler(socketserver.StreamRequestHandler):
            server: Any

            def handle(self) -> None:
                """Answer requests until the client ends or sends something other than Modbus."""
                while len(head := self.rfile.read(7)) == 7:
                    transaction, protocol, length, unit = struct.unpack(">HHHB", head)
                    if protocol or not 2 <= length <= _MAX_LENGTH:
                        return
                    request = self.rfile.read(length - 1)
                    if len(request) < length - 1:
                        return
                    answer = answered(request, plant)
                    self.wfile.write(struct.pack(">HHHB", transaction, 0, len(answer) + 1, unit) + answer)
                    self.server.completed(self.request)

        super().__init__("modbus", Address.of("modbus", address), RegisterHandler, TIMEOUT, warn)


def answered(request: bytes, plant: PlantState) -> bytes:
    """Return the answer to a request, both from the function code on."""
    function, error = request[0], 0
    first, count = struct.unpack(">HH", request[1:]) if len(request) == 5 else (0, 0)
    if function not in _READS:
        error = _ILLEGAL_FUNCTION
    elif not 1 <= count <= _MAX_COUNT:
        error = _ILLEGAL_VALUE
    elif first + count > _SIZE:
        error = _ILLEGAL_ADDRESS
    if error:
        return bytes([function | 0x80, error])
    known = plant.read(lambda supports: registers(plant, supports))[first : first + count]
    return struct.pack(f">BB{count}H", function, 2 * count, *known, *[0] * (count - len(known)))


def registers(plant: PlantState, supports: list[tuple[Support, Record]]) -> list[int]:
    """Return all registers: the head, those of each support in the order of the channels, and what stands of each."""
    head = [VERSION, plant.beats & 0xFFFF, _tenths(plant.age), _tenths(plant.behind), len(supports), int(plant.ended)]
    values = head + [0] * (HEAD - len(head))
    for support, record in supports[:MAX_SUPPORTS]:
        total, unknown = support.labels.total(), support.labels[UNKNOWN]
        of_support = [
            _DECISIONS[record["decision"]],
            *(_share(record[name]) for name in ("gangue_share", "low", "high")),
            min(record["impacts"], _NOT_KNOWN),
            min(record["unknown"], _NOT_KNOWN),
            *_words(total),
            *_words(unknown),
            _tenths(age(record, record["last_identified_s"])),
            _tenths(age(record, support.turned)),
            support.turns["shut"] & 0xFFFF,
            _GROUNDS[record["ground"]],
            _tenths(age(record, record["ground_since_s"])),
            _tenths(age(record, record["last_sound_s"])),
        ]
        values += of_support + [0] * (WIDTH - len(of_support))
    values += [0] * (FINDINGS - len(values))
    for support, _ in supports[:MAX_SUPPORTS]:
        numbers = [one["number"] for one in support.findings.values()][:EACH]
        values += numbers + [0] * (EACH - len(numbers))
    return values


def _share(value: float | None) -> int:
    return _NOT_KNOWN if value is None else round(value * 10_000)


def _tenths(seconds: float) -> int:
    return max(int(seconds * 10), 0) if seconds * 10 < _NOT_KNOWN else _NOT_KNOWN  # so is nan


def _words(count: int) -> tuple[int, int]:
    """Return a count as two registers, the high word first."""
    return count >> 16 & 0xFFFF, count & 0xFFFF
