"""MQTT: every line as a message, the record of each support retained, "offline" as last will; cycles, if asked for."""

from __future__ import annotations

import json
import os
import re
import ssl
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, unquote, urlsplit

from cgid._lib.spelling import spelled
from cgid.errors import BadData, InvalidValue, NoInput
from cgid.pages.server import since
from cgid.plant.output import FIRST_PAUSE, MAX_PAUSE, Output, library
from cgid.plant.state import RECORDS, PlantState, Record, stamped

#: Maximum number of messages that the broker has not acknowledged.
_MAX_IN_FLIGHT = 200
#: A broker without messages for this time hangs [s]; interval of pings [s].
_TIMEOUT, _KEEPALIVE = 10.0, 15
#: Time for pending messages at the end [s].
_GRACE = 2.0
#: The retained records are written anew after this time [s], so that a reader sees how old they are.
_EVERY = 5.0
#: Longest name of a support in a message [bytes].
_MAX_NAME = 400
_HANGS = "the broker does not answer; predictions continue, messages are queued"
_PORTS = {"mqtt": 1883, "mqtts": 8883}
_LOOPBACK = re.compile(r"localhost|127\.|::1$")


class Broker(NamedTuple):
    """Address and topic of the messages."""

    host: str
    port: int
    topic: str
    secure: bool

    @classmethod
    def of(cls, text: str) -> Broker:
        """Return the broker and topic of a URL; raises `InvalidValue`."""
        try:
            url = urlsplit(text)
            host, port = url.hostname, url.port
            if url.username is not None or url.password is not None:
                raise InvalidValue(
                    f"{spelled('mqtt')} must not contain a user or a password, which others can read there; set "
                    "CGID_MQTT_USER and CGID_MQTT_PASSWORD, or CGID_MQTT_PASSWORD_FILE"
                )
            topic = unquote(url.path.strip("/"), errors="strict")
        except (UnicodeDecodeError, ValueError) as error:
            if isinstance(error, InvalidValue):
                raise
            host, port, topic = None, None, ""
        bad = host is None or url.scheme not in _PORTS or port == 0 or "?" in text
        if bad or not topic or re.search(r"[+#\0]", topic + url.fragment) or "#" in text or len(topic) > 200:
            raise InvalidValue(
                f"{spelled('mqtt')} must be mqtt://HOST[:PORT]/TOPIC (mqtts:// with TLS), the topic without + and #, "
                f"got {text!r}; such as mqtt://127.0.0.1:1883/plant/support7"
            )
        return cls(str(host), port or _PORTS[url.scheme], topic, url.scheme == "mqtts")


class Mqtt(Output):
    """Messages below one topic: KIND/CHANNEL for each line; state/CHANNEL, status and wall_time retained."""

    # Messages need an acknowledgement (QoS 1) and may arrive twice; their field `sequence` counts them.

    def __init__(self, url: str, plant: PlantState, warn: Callable[[str], None]) -> None:
        self._broker = broker = Broker.of(url)
        super().__init__(f"mqtt {broker.host}:{broker.port}", warn)
        paho = library("paho.mqtt.client", spelled("mqtt"), "paho-mqtt")
        self._plant = plant
        self._on_cycle: Callable[[str], object] | None = None
        self._number = self._on_the_way = 0
        # Messages in flight, by paho's number: whether they count; and those acknowledged before `publish` returned.
        self._pending: dict[int, bool] = {}
        self._early: set[int] = set()
        self._disconnected_at = time.monotonic()
        self._written_at: float | None = None  # when the records were written
        self._was_stopped = False
        self._client = client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        client.reconnect_delay_set(FIRST_PAUSE, MAX_PAUSE)
        client.max_inflight_messages_set(2 * _MAX_IN_FLIGHT)
        client.will_set(self._topic("status"), "offline", qos=1, retain=True)
        client.on_connect, client.on_disconnect = self._connected, self._disconnected
        client.on_connect_fail, client.on_publish = self._failed, self._acknowledged
        client.on_message = self._received
        self._secure()

    def listen(self, begun: Callable[[str], object]) -> None:
        """Subscribe to TOPIC/cycle, and call a function with the text of each message."""
        self._on_cycle = begun
        if self.up:
            self._client.subscribe(self._topic("cycle"), qos=1)

    def _secure(self) -> None:
        """Take user, password and certificates from the environment."""
        user, password = os.environ.get("CGID_MQTT_USER"), os.environ.get("CGID_MQTT_PASSWORD")
        if (file := os.environ.get("CGID_MQTT_PASSWORD_FILE")) and password is None:
            password = _text_of("CGID_MQTT_PASSWORD_FILE", file).rstrip("\r\n")
        if password is not None and user is None:
            raise InvalidValue("CGID_MQTT_USER must be set with a password, it is not")
        if user is not None:
            self._client.username_pw_set(user, password)
        if self._broker.secure:
            self._client.tls_set_context(_tls())
        elif password is not None and not _LOOPBACK.match(self._broker.host):
            self.report("the password travels unencrypted; use mqtts://")

    def put(self, record: dict[str, Any]) -> None:
        """Queue a message with its number; a line that is a record alone becomes the retained message."""
        if record["kind"] != "state":
            self._number += 1
            record = record | {"sequence": self._number}
        super().put(record)

    def run(self) -> None:
        """Connect and publish pending messages; at the end publish the others and "offline"."""
        self._client.connect_async(self._broker.host, self._broker.port, _KEEPALIVE)
        self._client.loop_start()
        while not self._ending:
            # All records are written by this thread, so that none follows a newer one.
            if self._is_ready() and (
                since(self._written_at) >= _EVERY or self._was_stopped != bool(self._plant.stopped)
            ):
                self._publish_records()
            elif (record := self._next(self._is_ready)) is not None:
                self._publish_line(record)
            elif not self.up and since(self._disconnected_at) > _TIMEOUT and self._last_message in ("", _HANGS):
                self.report(_HANGS)
        self._end()

    def _is_ready(self) -> bool:
        return self.up and self._on_the_way < _MAX_IN_FLIGHT

    def _end(self) -> None:
        """Publish pending messages, disconnect, and report how many messages are lost."""
        until = time.monotonic() + _GRACE
        if self._waiting and not self._last_message:  # a short stream: still connecting
            with self._changed:
                self._changed.wait_for(lambda: self.up or self._last_message, _GRACE)
        while self.up and self._waiting and time.monotonic() < until:
            with self._changed:
                self._changed.wait_for(lambda: not self.up or self._is_ready(), until - time.monotonic())
            if self._is_ready():
                self._publish_line(self._waiting.popleft())
        if self.up:
            self._publish_records()
            self._publish(self._topic("status"), "offline", retain=True)
            with self._changed:
                self._changed.wait_for(lambda: not self.up or not self._on_the_way, until - time.monotonic())
        if lost := self._number - self.passed:
            self.report(f"{lost} of {self._number} messages were not delivered")
        self._client.disconnect()
        self._client.loop_stop()

    def _publish_line(self, record: dict[str, Any]) -> None:
        """Publish one line and the resulting record."""
        channel = record.get("channel")
        kind = record["kind"]
        if kind != "state":
            self._publish(self._topic(kind, channel), json.dumps(record), ours=True)
        if kind in RECORDS:
            self._publish_record(self._plant.record(record["channel"]))
        elif kind == "finding":
            self._publish_records()

    def _publish_records(self) -> None:
        """Publish the records of all channels, and the time of day."""
        self._written_at, self._was_stopped = time.monotonic(), bool(self._plant.stopped)
        for record in self._plant.records():
            self._publish_record(record)
        self._publish(self._topic("wall_time"), stamped({})["wall_time"], retain=True)

    def _publish_record(self, record: Record) -> None:
        self._publish(self._topic("state", record["channel"]), json.dumps(stamped(record)), retain=True)

    def _publish(self, topic: str, payload: str, *, retain: bool = False, ours: bool = False) -> None:
        # paho acknowledges under a lock that `publish` also takes: do not call it while holding ours.
        with self._changed:
            self._on_the_way += 1
        number = self._client.publish(topic, payload, qos=1, retain=retain).mid
        with self._changed:
            if number in self._early:
                self._early.discard(number)
                self.passed += ours
            else:
                self._pending[number] = ours

    def _topic(self, kind: str, channel: str | None = None) -> str:
        channel_topic = "" if channel is None else "/" + quote(channel, safe=" ")
        return f"{self._broker.topic}/{kind}{channel_topic}"

    def _connected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self.report(f"the broker refuses ({reason}); predictions continue, messages are queued")
            return
        self._publish(self._topic("status"), "online", retain=True)
        if self._on_cycle is not None:
            self._client.subscribe(self._topic("cycle"), qos=1)
        with self._changed:
            self.up, self._written_at = True, None
            self._changed.notify_all()
        if self._last_message:
            self.report(f"connected; {self.dropped} messages were dropped so far")
            self._last_message = ""

    def _received(self, _client: Any, _data: Any, message: Any) -> None:
        # A retained message is of an earlier cycle.
        if self._on_cycle is not None and not message.retain:
            self._on_cycle(message.payload[:_MAX_NAME].decode(errors="replace"))

    def _disconnected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        with self._changed:
            was, self.up, self._disconnected_at = self.up, False, time.monotonic()
            self._changed.notify_all()
        if was and not self._ending:
            self.report(f"the broker is gone ({reason}); predictions continue, messages are queued")

    def _failed(self, _client: Any, _data: Any) -> None:
        error = sys.exc_info()[1]  # paho calls this while it handles the error
        reason = " ".join(str(getattr(error, "strerror", None) or error).split())
        self.report(f"the broker cannot be reached ({reason}); predictions continue, messages are queued")

    def _acknowledged(self, _client: Any, _data: Any, number: int, _reason: Any, _properties: Any) -> None:
        with self._changed:
            self._on_the_way -= 1
            if number in self._pending:
                self.passed += self._pending.pop(number)
            else:
                self._early.add(number)
            self._changed.notify_all()


def _tls() -> ssl.SSLContext:
    """Return the TLS settings of the environment; by default, the system's certificates are trusted."""
    names = {name: os.environ.get(f"CGID_MQTT_{name}") for name in ("CA", "CERT", "KEY")}
    for name, file in names.items():
        if file:
            _text_of(f"CGID_MQTT_{name}", file)
    try:
        context = ssl.create_default_context(cafile=names["CA"] or None)
        if names["CERT"]:
            context.load_cert_chain(names["CERT"], names["KEY"] or None)
    except (OSError, ValueError) as error:
        raise BadData(
            f"CGID_MQTT_CA, CGID_MQTT_CERT and CGID_MQTT_KEY must name PEM files that belong together ({error}); check "
            "them"
        ) from None
    return context


def _text_of(name: str, file: str) -> str:
    try:
        return Path(file).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise NoInput(f"{name}: {file} cannot be read ({reason}); check the name") from None
