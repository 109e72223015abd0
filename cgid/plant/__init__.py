"""The outputs of `cgid monitor` and `cgid.Monitor`: what they tell, in the protocols of a plant."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import Any

from numpy.typing import NDArray

from cgid._lib.spelling import spelled
from cgid.errors import InvalidValue
from cgid.pages.server import Service
from cgid.plant.output import Output
from cgid.plant.state import PlantState, Waveform

__all__ = ["PlantOutputs"]

_LOGGER = logging.getLogger("cgid")


class PlantOutputs:
    """All outputs of one live stream: of `cgid monitor`, or of `cgid.Monitor`, which starts and ends them.

    Parameters
    ----------
    mqtt : str, optional
        Publish each record below ``mqtt://HOST[:PORT]/TOPIC``.
    modbus, prometheus, live : str, optional
        Serve registers, metrics or a page at ``[HOST]:PORT``; the page may be a file ``.html``.
    on_shut, on_open, on_blind : str, optional
        Commands that run at each SHUT, at each OPEN, and when a support is no longer seen.
    warn : callable
        Gets each line about an output, by default the logger ``cgid``.

    Raises
    ------
    InvalidValue, NoInput, BadData, CannotCreate, MissingExtra
        An address, a file or a command is of no use; ports are bound at once.
    """

    # Each output has its own threads and a queue that drops the oldest message, so predictions never wait for it.

    def __init__(
        self,
        *,
        mqtt: str | None = None,
        modbus: str | None = None,
        prometheus: str | None = None,
        live: str | None = None,
        on_shut: str | None = None,
        on_open: str | None = None,
        on_blind: str | None = None,
        warn: Callable[[str], None] = _LOGGER.warning,
    ) -> None:
        self.plant = plant = PlantState()
        given = {"shut": on_shut, "open": on_open, "blind": on_blind}
        self._commands = {kind: line for kind, line in given.items() if line is not None}
        self._services: list[Service] = []
        self._waveform: Waveform | None = None
        try:  # ports are bound here
            if mqtt is not None:
                from cgid.plant.mqtt import Mqtt

                self._services.append(Mqtt(mqtt, plant, warn))
            if self._commands:
                from cgid.plant.commands import Commands

                self._services.append(Commands(self._commands, plant, warn))
            self._queues = [one for one in self._services if isinstance(one, Output)]
            plant.outputs = [*self._queues]
            if prometheus is not None or live is not None:
                from cgid.plant.web import web_services

                self._services += web_services(prometheus, live, plant, warn)
                self._waveform = plant.waveform = None if live is None else Waveform()
            if modbus is not None:  # after the other ports, so that it sees them taken
                from cgid.plant.modbus import Modbus

                self._services.append(Modbus(modbus, plant, warn))
        except BaseException:
            self.close(0.0)
            raise

    def __enter__(self) -> PlantOutputs:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def start(self) -> None:
        """Start those that have not been."""
        for service in self._services:
            service.start()

    def close(self, grace: float = 3.0) -> None:
        """End all outputs, each within this time [s]; those that send what waits first, as the others show the end."""
        self.plant.ended = True
        for passing in (True, False):
            services = [service for service in self._services if isinstance(service, Output) is passing]
            for service in services:
                service.request_end()
            for service in services:
                service.wait(grace)

    def begin(self, *, threshold: float | None, **stream: Any) -> None:
        """Set the supports and the stream, as `PlantState.begin`."""
        decision = next((kind for kind in self._commands if kind != "blind"), None)
        if decision is not None and threshold is None:
            raise InvalidValue(
                f"{spelled(f'on_{decision}')} needs a model with gangue among its labels; name that of gangue by "
                f"{spelled('gangue', 'LABEL')}"
            )
        self.plant.begin(threshold=threshold, **stream)
        self.start()

    def listen(self, begun: Callable[[str], object]) -> None:
        """Call a function with each message about a caving cycle that begins, from the broker."""
        from cgid.plant.mqtt import Mqtt

        for service in self._services:
            if isinstance(service, Mqtt):
                service.listen(begun)

    def monitored_blocks(self, blocks: Iterable[NDArray[Any]], sampling_rate: float) -> Iterator[NDArray[Any]]:
        """Yield the blocks (n_channels, n_samples); each is a heartbeat, and a part of the waveform."""
        try:
            for block in blocks:
                if self._waveform is not None:
                    self._waveform.add(block, sampling_rate)
                self.plant.beat(block.shape[1] / sampling_rate)
                yield block
        finally:
            self.plant.ended = True

    def __call__(self, record: dict[str, Any]) -> None:
        """Queue one line of JSON; returns at once."""
        self.plant.take(record)
        for output in self._queues:
            output.put(record)
