"""Plant outputs against real counterparts on the loopback: broker, Modbus client, Prometheus scrape, commands."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import socket
import socketserver
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cgid.cli.main import run
from cgid.errors import BadData, CannotCreate, InvalidValue, NoInput
from cgid.pages.server import MAX_CLIENTS
from cgid.plant import PlantOutputs, commands, mqtt
from cgid.plant.modbus import EACH, FINDINGS, HEAD, MAX_SUPPORTS, WIDTH, registers
from cgid.plant.output import Output
from cgid.plant.state import BIN_TIME, Waveform
from cgid.plant.web import page
from tests.streams_of_pulses import RATE, ROOT, stream

RAW = ["--rate", str(RATE), "--channels", "1", "--sample-format", "f32le", "--unit", "N", "--set", "window=0.24"]
LABELS = ["coal"] * 14 + ["gangue"] * 14


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def wait_for(holds: Callable[[], Any], seconds: float = 15.0) -> Any:
    until = time.monotonic() + seconds
    while not (found := holds()):
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.01)
    return found


def impact(number: int, label: str = "coal", channel: str = "1") -> dict[str, Any]:
    return {"kind": "impact", "channel": channel, "label": label, "time_s": float(number), "impact": number}


def state(
    at: float, decision: str = "none", ground: str = "seen", value: float | None = None, channel: str = "1", **more: Any
) -> dict[str, Any]:
    """Return a line with the record of a support."""
    ends = (0.0, 1.0) if value is None else (value - 0.1, value + 0.1)
    return {
        "kind": "state",
        "time_s": at,
        "channel": channel,
        "decision": decision,
        "ground": ground,
        "ground_since_s": 0.0,
        "reason": "" if ground == "seen" else "the cable",
        "gangue_share": value,
        "low": ends[0],
        "high": ends[1],
        "basis": "trained_seam",
        "impacts": 20,
        "unknown": 3,
        "last_sound_s": at,
        "last_identified_s": at,
        **more,
    }


def share(to: float, value: float | None, channel: str = "1", impacts: int = 20, **more: Any) -> dict[str, Any]:
    kind = {"kind": "share", "from_s": to - 1, "to_s": to, "impacts": impacts}
    return state(to, value=value, channel=channel, **kind | more)


def turn(kind: str, at: float, value: float = 0.6, channel: str = "1", **more: Any) -> dict[str, Any]:
    decision = "shut" if kind == "shut" else "draw"
    return state(at, decision, value=value, channel=channel, kind=kind, cost=0.2, **more)


def feed(own: PlantOutputs, *blocks: np.ndarray) -> None:
    """Pass blocks at 1 kHz through the outputs, after which the stream goes on."""
    list(own.monitored_blocks(blocks, 1000.0))
    own.plant.ended = False


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def outputs(said: list[str]) -> Iterator[Callable[..., PlantOutputs]]:
    made: list[PlantOutputs] = []

    def make(channels: tuple[str, ...] = ("1",), blind_after: float = 1000.0, **given: str) -> PlantOutputs:
        own = PlantOutputs(**given, warn=said.append)
        own.__enter__()
        made.append(own)
        more = {"threshold": 0.5, "behind": lambda: 0.25, "blind_after": blind_after}
        own.begin(source="s", channels=channels, rows=channels, unit="N", **more)
        return own

    yield make
    for own in made:
        own.__exit__(None, None, None)


# -- MQTT -------------------------------------------------------------------------------------------------


class Mosquitto:
    """A broker that can be killed and started again."""

    def __init__(self, folder: Path, *lines: str) -> None:
        self.port = free_port()
        self._file = folder / "mosquitto.conf"
        anonymous = [] if any(line.startswith("allow") for line in lines) else ["allow_anonymous true"]
        self._file.write_text("\n".join([f"listener {self.port} 127.0.0.1", "user root", *anonymous, *lines]) + "\n")
        self.start()

    def start(self) -> None:
        path = os.environ["PATH"] + ":/usr/sbin"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.process = subprocess.Popen([str(shutil.which("mosquitto", path=path)), "-c", str(self._file)], **quiet)
        wait_for(self._answers)

    def _answers(self) -> bool:
        with socket.socket() as found:
            return found.connect_ex(("127.0.0.1", self.port)) == 0

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Callable[..., Mosquitto]]:
    pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")
    if shutil.which("mosquitto", path=os.environ["PATH"] + ":/usr/sbin") is None:
        pytest.skip("the broker mosquitto is not installed")
    made: list[Mosquitto] = []

    def make(*lines: str) -> Mosquitto:
        made.append(Mosquitto(tmp_path, *lines))
        return made[-1]

    yield make
    for one in made:
        one.kill()


class Subscriber:
    """Everything that a broker passes on below "plant", in order."""

    def __init__(self, port: int) -> None:
        import paho.mqtt.client as paho

        self.messages: list[tuple[str, str, bool]] = []
        self.client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        self.client.reconnect_delay_set(1, 1)
        ready: list[int] = []
        self.client.on_subscribe = lambda *_: ready.append(1)
        self.client.on_connect = lambda client, *_: client.subscribe("plant/#", qos=1)
        self.client.on_message = lambda _c, _d, one: self.messages.append((one.topic, one.payload.decode(), one.retain))
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()
        wait_for(lambda: ready)

    def of(self, topic: str) -> list[str]:
        return [payload for name, payload, _ in self.messages if name == topic]

    def numbers(self) -> list[int]:
        lines = [payload for name, payload, _ in self.messages if "/impact/" in name]
        return [json.loads(line)["impact"] for line in lines]

    def __enter__(self) -> Subscriber:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.disconnect()
        self.client.loop_stop()


class CollectingBroker(socketserver.ThreadingTCPServer):
    """A broker that keeps what is published and passes nothing on, where mosquitto is not installed."""

    daemon_threads = True

    class Handler(socketserver.StreamRequestHandler):
        server: Any

        def handle(self) -> None:
            while head := self.rfile.read(1):
                size, shift, more = 0, 0, True
                while more:
                    (byte,) = self.rfile.read(1)
                    size, shift, more = size | (byte & 127) << shift, shift + 7, byte > 127
                body = self.rfile.read(size)
                if head[0] >> 4 == 3:  # PUBLISH, with QoS 1
                    end = 2 + int.from_bytes(body[:2], "big")
                    self.server.messages.append((body[2:end].decode(), body[end + 2 :].decode()))
                    self.wfile.write(b"\x40\2" + body[end : end + 2])
                else:
                    self.wfile.write({1: b"\x20\2\0\0", 12: b"\xd0\0"}.get(head[0] >> 4, b""))

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), self.Handler)
        self.messages: list[tuple[str, str]] = []
        self.url = f"mqtt://127.0.0.1:{self.server_address[1]}/plant"
        threading.Thread(target=self.serve_forever, args=(0.05,), daemon=True).start()

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()


def test_a_message_begins_a_cycle_only_where_that_is_asked_for(outputs, monkeypatch) -> None:
    pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")
    own = outputs(mqtt=f"mqtt://127.0.0.1:{free_port()}/plant/s7")
    (service,) = own._services
    asked: list[str] = []
    begun: list[str] = []
    monkeypatch.setattr(service._client, "subscribe", lambda topic, qos: asked.append(topic))
    reason = SimpleNamespace(is_failure=False)
    service._connected(None, None, None, reason, None)
    assert not asked
    own.listen(begun.append)
    assert asked == ["plant/s7/cycle"]
    service._connected(None, None, None, reason, None)
    assert len(asked) == 2
    for payload, retain in ((b"1", False), (b"old", True), (b"", False), (b"x" * 10_000, False)):
        service._received(None, None, SimpleNamespace(payload=payload, retain=retain))
    assert begun[:2] == ["1", ""] and len(begun) == 3 and len(begun[2]) <= 400


def test_each_line_is_a_message_and_the_state_is_retained(outputs, broker, said) -> None:
    port = broker().port
    with Subscriber(port) as found:
        own = outputs(channels=("1", "a/b#"), mqtt=f"mqtt://127.0.0.1:{port}/plant/s7")
        for number in range(1, 501):
            own(impact(number))
        own(share(10.0, 0.7, channel="a/b#"))
        own(turn("shut", 10.0, 0.7, channel="a/b#"))
        own({"kind": "warning", "message": "cable"})
        wait_for(lambda: found.of("plant/s7/warning"))
        assert found.numbers() == list(range(1, 501))
        assert json.loads(found.of("plant/s7/shut/a%2Fb%23")[0])["sequence"] == 502
        assert json.loads(found.of("plant/s7/warning")[0])["message"] == "cable"
        with Subscriber(port) as late:  # sees only what is retained
            wait_for(lambda: len(late.messages) >= 4)
            assert {name for name, _, _ in late.messages} == {
                "plant/s7/status",
                "plant/s7/wall_time",
                "plant/s7/state/1",
                "plant/s7/state/a%2Fb%23",
            }
            assert all(retained for _, _, retained in late.messages)
            record = json.loads(late.of("plant/s7/state/a%2Fb%23")[0])
            assert (record["decision"], record["gangue_share"], record["unknown"]) == ("shut", 0.7, 3)
            wanted = {"kind", "cost"} ^ {*turn("shut", 10.0), "wall_time", "findings"}
            assert {*record} == wanted
            none = json.loads(late.of("plant/s7/state/1")[0])
            assert (none["decision"], none["ground"], none["gangue_share"]) == ("none", "seen", None)
        own.__exit__(None, None, None)
        wait_for(lambda: len(found.of("plant/s7/status")) == 2)
        for channel in ("1", "a%2Fb%23"):
            record = json.loads(found.of(f"plant/s7/state/{channel}")[-1])
            assert (record["decision"], record["ground"]) == ("none", "stopped")
        assert found.of("plant/s7/status") == ["online", "offline"]
    assert said == []
    assert own.plant.outputs[0].passed == 503


def test_retained_records_are_written_again_and_a_decision_goes_with_its_stream(outputs, broker, monkeypatch) -> None:
    monkeypatch.setattr(mqtt, "_EVERY", 0.5)
    port = broker().port
    with Subscriber(port) as found:
        own = outputs(mqtt=f"mqtt://127.0.0.1:{port}/plant", blind_after=3.0)
        feed(own, np.zeros((1, 10_000)))
        own(turn("open", 9.0, last_identified_s=8.0))

        def records() -> list[dict[str, Any]]:
            return [json.loads(text) for text in found.of("plant/state/1")]

        wait_for(lambda: len([one for one in records() if one["decision"] == "draw"]) >= 3)
        wait_for(lambda: records()[-1]["ground"] == "stopped")  # no line, only no block
        assert records()[-1]["decision"] == "none"
        times = [(datetime.fromisoformat(one["wall_time"]).timestamp(), one["time_s"]) for one in records()]
        assert times == sorted(times)
        assert len(set(times)) == len(times)
        # The time in the stream goes on with the clock: a reader subtracts, and knows how old everything is.
        (first, began), (last, ended) = times[-3], times[-1]
        assert abs((ended - began) - (last - first)) < 0.2 * (last - first)
        assert abs(datetime.fromisoformat(found.of("plant/wall_time")[-1]).timestamp() - time.time()) < 60
        feed(own, np.zeros((1, 1000)))
        own(turn("open", 11.0))
        wait_for(lambda: records()[-1]["decision"] == "draw")
        own(state(11.0, ground="blind", reason="the cable"))
        wait_for(lambda: records()[-1]["ground"] == "blind")
        assert records()[-1]["reason"] == "the cable"
        assert own.plant.outputs[0]._number == 2  # a record alone is no further message


def test_broker_that_dies_and_comes_back(outputs, broker, said, monkeypatch) -> None:
    monkeypatch.setattr(Output.__init__, "__defaults__", (50,))
    daemon = broker()
    own = outputs(mqtt=f"mqtt://127.0.0.1:{daemon.port}/plant/s7")
    (queue,) = own.plant.outputs
    own(impact(1))
    wait_for(lambda: queue.passed == 1)
    daemon.kill()
    wait_for(lambda: not queue.up)
    begun = time.perf_counter()
    for number in range(2, 102):
        own(impact(number))
    assert time.perf_counter() - begun < 0.5  # nothing waits for the broker
    assert queue.dropped == 50
    own(turn("shut", 3.0))
    daemon.start()
    with Subscriber(daemon.port) as found:
        wait_for(lambda: found.of("plant/s7/shut/1"))
        assert found.numbers() == list(range(53, 102))  # the newest
        wait_for(lambda: json.loads(found.of("plant/s7/state/1")[-1])["decision"] == "shut")
    assert queue.dropped == 51
    assert len(said) >= 2
    assert "is gone" in said[0]
    assert "connected; 51 messages were dropped" in said[-1]


@pytest.mark.parametrize("how", ["away", "refuses", pytest.param("hangs", marks=pytest.mark.long)])
def test_broker_that_is_of_no_use_is_one_line(how, outputs, broker, said, monkeypatch) -> None:
    monkeypatch.setattr(mqtt, "_TIMEOUT", 0.5)
    monkeypatch.setattr(mqtt, "_GRACE", 0.2)
    port = broker("allow_anonymous false").port if how == "refuses" else free_port()
    with socket.socket() as silent:
        if how == "hangs":
            silent.bind(("127.0.0.1", port))
            silent.listen()
        own = outputs(mqtt=f"mqtt://127.0.0.1:{port}/plant")
        own(impact(1))
        wait_for(lambda: said)
        time.sleep(1.2)  # it tries again, and says no more
        own.__exit__(None, None, None)
    words = {"away": "cannot be reached (Connection refused)", "hangs": "does not answer", "refuses": "Not authorized"}
    assert len(said) == 2
    assert words[how] in said[0]
    assert "1 of 1 messages were not delivered" in said[1]


@pytest.mark.long
# paho leaves the socket of a failed handshake to the collector.
@pytest.mark.filterwarnings("ignore:Exception ignored in.*SSLSocket")
def test_password_and_tls(outputs, broker, said, tmp_path, monkeypatch) -> None:
    if shutil.which("openssl") is None or shutil.which("mosquitto_passwd") is None:
        pytest.skip("openssl or mosquitto_passwd is not installed")
    crt, key, users = (tmp_path / name for name in ("c.pem", "k.pem", "users"))
    own_name = ["-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"]
    make = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", crt, "-days", "2"]
    subprocess.run([*make, *own_name], check=True, capture_output=True)
    subprocess.run(["mosquitto_passwd", "-b", "-c", users, "seven", "se cret"], check=True, capture_output=True)
    users.chmod(0o644)
    key.chmod(0o644)
    lines = [f"cafile {crt}", f"certfile {crt}", f"keyfile {key}", "allow_anonymous false", f"password_file {users}"]
    port = broker(*lines).port
    url = f"mqtts://127.0.0.1:{port}/plant"
    (tmp_path / "word").write_text("se cret\n")
    monkeypatch.setenv("CGID_MQTT_USER", "seven")
    monkeypatch.setenv("CGID_MQTT_PASSWORD_FILE", str(tmp_path / "word"))
    unknown = outputs(mqtt=url)  # a certificate that nobody vouches for
    assert "certificate verify failed" in wait_for(lambda: said)[0].lower()
    unknown.__exit__(None, None, None)
    said.clear()
    monkeypatch.setenv("CGID_MQTT_CA", str(crt))
    own = outputs(mqtt=url)
    own(impact(1))
    wait_for(lambda: own.plant.outputs[0].passed == 1)
    assert said == []
    monkeypatch.setenv("CGID_MQTT_CA", str(tmp_path / "word"))
    with pytest.raises(BadData, match="CGID_MQTT_CA"):
        PlantOutputs(mqtt=url, warn=said.append)
    monkeypatch.setenv("CGID_MQTT_PASSWORD_FILE", str(tmp_path / "none"))
    with pytest.raises(NoInput, match="CGID_MQTT_PASSWORD_FILE"):
        PlantOutputs(mqtt=url, warn=said.append)


# -- Modbus -----------------------------------------------------------------------------------------------


def test_registers_are_what_a_client_reads(outputs) -> None:
    client_of = pytest.importorskip("pymodbus.client", reason="pymodbus is not installed")
    port = free_port()
    own = outputs(channels=("1", "2"), modbus=f"127.0.0.1:{port}")
    for number in range(70_000):
        own(impact(number, "unknown" if number % 7 == 0 else "gangue"))
    own(share(10.0, 0.7))
    own(turn("shut", 10.0, 0.7))
    own(share(10.0, None, channel="2", impacts=0, last_identified_s=None))
    feed(own, *[np.zeros((2, 50))] * 3)
    client = client_of.ModbusTcpClient("127.0.0.1", port=port)
    wait_for(client.connect)
    try:
        head = client.read_input_registers(0, count=HEAD, device_id=7).registers
        assert head[:2] == [2, 3]
        assert head[2] <= 20
        assert head[3:6] == [2, 2, 0]
        one = client.read_input_registers(HEAD, count=WIDTH).registers
        assert one[:8] == [2, 7000, 6000, 8000, 20, 3, 70_000 >> 16, 70_000 & 0xFFFF]
        assert one[8:10] == [0, 10_000]
        assert max(one[10:12]) <= 20
        assert one[12:14] == [1, 1]
        assert 100 <= one[14] <= 120
        assert one[15] <= 20
        again = client.read_holding_registers(HEAD, count=WIDTH).registers  # for those that know function 3 alone
        assert again[:10] == one[:10]
        two = client.read_input_registers(HEAD + WIDTH, count=14).registers
        assert two == [0, 65535, 0, 10_000, 0, 3, 0, 0, 0, 0, 65535, 65535, 0, 1]
        assert client.read_input_registers(HEAD + 2 * WIDTH, count=WIDTH).registers == [0] * WIDTH  # nobody there
        assert client.write_register(HEAD, 1).isError()
        assert client.read_input_registers(60_000, count=4).isError()
        assert client.read_input_registers(HEAD, count=1).registers == [2]
        for beat in range(4, 7):
            feed(own, np.zeros((2, 50)))
            assert client.read_input_registers(1, count=1).registers == [beat]
    finally:
        client.close()


GROUNDS = ["seen", "blind", "wrong_scale", "mostly_unknown", "stopped", "unproven", "fault"]


def test_each_ground_has_its_register_and_only_a_seen_support_a_decision(outputs) -> None:
    own = outputs(channels=tuple(GROUNDS), modbus=f"127.0.0.1:{free_port()}")
    feed(own, np.zeros((len(GROUNDS), 100_000)))
    times = {"ground_since_s": 60.0, "last_sound_s": 70.0, "last_identified_s": 20.0}
    for decision, number in (("draw", 1), ("shut", 2), ("unsure", 3), ("none", 0)):
        for ground in GROUNDS:
            own(turn("shut" if decision == "shut" else "open", 90.0, 0.25, channel=ground))
            own(state(99.0, decision, ground, 0.25, channel=ground, **times))
        known = own.plant.read(lambda supports: registers(own.plant, supports))
        by_ground = [known[HEAD + WIDTH * k : HEAD + WIDTH * (k + 1)] for k in range(len(GROUNDS))]
        assert [one[0] for one in by_ground] == [number, *[0] * (len(GROUNDS) - 1)]
        assert [one[13] for one in by_ground] == list(range(1, len(GROUNDS) + 1))
        for ground, one in zip(GROUNDS, by_ground, strict=True):
            assert one[1:6] == [2500, 1500, 3500, 20, 3]
            for register, age in ((10, 800), (11, 100), (14, 400), (15, 300)):
                assert age <= one[register] < age + 150, (ground, register)


@pytest.mark.parametrize("how", ["no block ever", "no block any more", "the end"])
def test_decision_does_not_outlive_its_stream(how: str, outputs) -> None:
    own = outputs(modbus=f"127.0.0.1:{free_port()}", blind_after=1000.0 if how == "the end" else 1.0)

    def one() -> list[int]:
        return own.plant.read(lambda supports: registers(own.plant, supports))[HEAD:]

    if how != "no block ever":
        feed(own, np.zeros((1, 20_000)))
    own(turn("shut", 10.0))
    if how == "the end":
        assert [one()[0], one()[13]] == [2, 1]
        list(own.monitored_blocks([np.zeros((1, 10))], 1000.0))  # the stream has no more
    wait_for(lambda: one()[13] == 5)
    assert one()[0] == 0
    assert one()[12] == 1
    (before,) = own.plant.page()["supports"]
    assert (before["decision"], before["ground"]) == ("none", "stopped")
    if how == "the end":
        own(turn("shut", 20.0))  # a last line changes nothing
        assert [one()[0], one()[13]] == [0, 5]
        return
    # All ages go on with the clock.
    ages = wait_for(lambda: (found := one())[14] > 20 and found)
    later = wait_for(lambda: (found := one())[14] > ages[14] + 5 and found)
    steps = [late - early for early, late in zip(ages, later, strict=True)]
    assert [steps[k] for k in range(16) if k not in (10, 11, 14, 15)] == [0] * 12
    assert max(steps[k] for k in (10, 11, 14, 15)) - min(steps[k] for k in (10, 11, 14, 15)) <= 1
    feed(own, np.zeros((1, 1)))
    assert [one()[0], one()[13]] == [2, 1]  # the stream goes on, and its last line holds until the next


def test_pause_is_no_blindness(outputs) -> None:
    """Without impacts there is no line; the samples are sound as long as none says otherwise."""
    own = outputs(modbus=f"127.0.0.1:{free_port()}", blind_after=5.0)
    feed(own, np.zeros((1, 10_000)))
    own(share(10.0, 0.5))
    feed(own, np.zeros((1, 90_000)))
    one = own.plant.read(lambda supports: registers(own.plant, supports))[HEAD:]
    assert 900 <= one[10] < 950
    assert 50 <= one[15] < 100
    own(state(100.0, ground="blind", last_sound_s=30.0))
    assert own.plant.read(lambda supports: registers(own.plant, supports))[HEAD + 15] >= 700


def asked(port: int, *frames: bytes) -> list[bytes]:
    """Return what a Modbus server answers to each frame over one connection, empty if it hangs up."""
    found = []
    with socket.create_connection(("127.0.0.1", port), timeout=5) as client:
        for frame in frames:
            client.sendall(frame)
            found.append(client.recv(300))
    return found


def modbus_frame(request: bytes, number: int = 7, protocol: int = 0, unit: int = 3) -> bytes:
    return struct.pack(">HHHB", number, protocol, len(request) + 1, unit) + request


def test_only_reads_of_registers_are_answered(outputs) -> None:
    port = free_port()
    outputs(modbus=f"127.0.0.1:{port}")
    requests = [bytes([function, 0, 0, 0, 1]) for function in range(256)]
    answers = asked(port, *map(modbus_frame, requests))
    for function, answer in enumerate(answers):
        body = bytes([function, 2, 0, 2]) if function in (3, 4) else bytes([function | 0x80, 1])
        assert answer == modbus_frame(body), function
    refused = {
        b"\4\0\0\0\0": 3,
        b"\4\0\0\0\x7e": 3,
        b"\4\0\0\0": 3,
        b"\4\xff\xff\0\2": 2,
        b"\x2b\x0e\1\0": 1,
        b"\x11": 1,
        struct.pack(">BHH", 4, FINDINGS + EACH * MAX_SUPPORTS, 1): 2,
    }
    for request, error in refused.items():
        assert asked(port, modbus_frame(request)) == [modbus_frame(bytes([request[0] | 0x80, error]))]
    assert asked(port, modbus_frame(b"\4\0\0\0\1", protocol=7)) == [b""]
    assert asked(port, b"\0\1\0\0\xff\xff\1") == [b""]


# -- too many, silent, slow and senseless clients ---------------------------------------------------------


@pytest.fixture
def two_servers(outputs) -> tuple[int, int]:
    ports = free_port(), free_port()
    outputs(modbus=f"127.0.0.1:{ports[0]}", live=f"127.0.0.1:{ports[1]}")
    return ports


def honest_reads(ports: tuple[int, int]) -> None:
    (answer,) = asked(ports[0], modbus_frame(b"\4\0\0\0\1"))
    assert answer == modbus_frame(b"\4\2\0\2")
    assert json.loads(get(ports[1], "/state.json")[1])["source"] == "s"


def test_nonsense_leaves_no_line_and_no_connection(two_servers, said, capfd) -> None:
    rng = random.Random(1)
    before = threading.active_count()
    for _ in range(60):
        for port, request in zip(
            two_servers, (modbus_frame(b"\4\0\0\0\1"), b"GET / HTTP/1.1\r\nHost: a\r\n\r\n"), strict=True
        ):
            content = bytearray(request if rng.random() < 0.7 else rng.randbytes(rng.randrange(1, 400)))
            for _ in range(rng.randrange(4)):
                content[rng.randrange(len(content))] = rng.randrange(256)
            with socket.create_connection(("127.0.0.1", port)) as client:
                client.sendall(content)
    honest_reads(two_servers)
    wait_for(lambda: threading.active_count() <= before)
    assert said == []
    assert capfd.readouterr() == ("", "")


def test_silent_clients_leave_room(two_servers, said, capfd) -> None:
    before = threading.active_count()
    silent = [socket.create_connection(("127.0.0.1", port)) for port in two_servers for _ in range(3 * MAX_CLIENTS)]
    try:
        honest_reads(two_servers)
        assert threading.active_count() <= before + 2 * MAX_CLIENTS
        # A client that asks is not the one that has to go.
        with socket.create_connection(("127.0.0.1", two_servers[0]), timeout=5) as steady:
            for _ in range(2 * MAX_CLIENTS):
                silent.append(socket.create_connection(("127.0.0.1", two_servers[0])))
                steady.sendall(modbus_frame(b"\4\0\0\0\1"))
                assert steady.recv(300) == modbus_frame(b"\4\2\0\2")
        wait_for(lambda: len(said) == 2)  # a line for each server, however many are displaced
        assert all(f"at most {MAX_CLIENTS} clients" in line for line in said)
        assert {line.split(":")[0].split()[0] for line in said} == {"modbus", "live"}
    finally:
        for client in silent:
            client.close()
    assert capfd.readouterr() == ("", "")


# -- HTTP -------------------------------------------------------------------------------------------------


def status(port: int, *hosts: str, method: str = "GET", path: str = "/state.json") -> tuple[int, bytes]:
    lines = [f"{method} {path} HTTP/1.0", *(f"Host: {host}" for host in hosts)]
    with socket.create_connection(("127.0.0.1", port), timeout=5) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode())
        head, _, content = b"".join(iter(lambda: client.recv(65536), b"")).partition(b"\r\n\r\n")
    assert b"frame-ancestors 'none'" in head
    return int(head.split()[1]), content


def test_loopback_server_answers_loopback_names_only(outputs) -> None:
    port = free_port()
    outputs(live=f":{port}")
    for host in ("localhost", f"LOCALHOST:{port}", "127.0.0.1", "127.0.0.1:9", "[::1]", f"[::1]:{port}"):
        assert status(port, host)[0] == 200, host
    for host in (
        "evil.example",
        f"evil.example:{port}",
        "",
        "localhost.evil.example",
        "127.0.0.1.evil.example",
        "10.0.0.1",
        "[::2]:80",
        "::1.evil",
        "127.0.0.1@evil",
        "[::1]evil",
    ):
        for path in ("/", "/state.json", "/none"):
            found, content = status(port, host, path=path)
            assert found == 421, host
            assert b"source" not in content
    assert status(port, "localhost", "evil.example")[0] == 421
    assert status(port, "localhost", method="HEAD") == (200, b"")
    everywhere = free_port()
    outputs(live=f"0.0.0.0:{everywhere}")
    assert status(everywhere, "recorder.plant")[0] == 200


def test_pages_of_errors_have_the_policy_of_the_others(outputs) -> None:
    port = free_port()
    outputs(live=f"127.0.0.1:{port}")
    requests = {
        404: b"GET /none HTTP/1.0\r\n\r\n",
        421: b"GET / HTTP/1.0\r\nHost: evil.example\r\n\r\n",
        400: b"GET / nonsense\r\n\r\n",
        414: b"GET /" + b"a" * 70_000 + b" HTTP/1.0\r\n\r\n",
        431: b"GET / HTTP/1.0\r\n" + b"a: b\r\n" * 200 + b"\r\n",
        501: b"DELETE / HTTP/1.0\r\n\r\n",
        505: b"GET / HTTP/9.0\r\n\r\n",
    }
    for code, request in requests.items():
        with socket.create_connection(("127.0.0.1", port), timeout=5) as client:
            client.sendall(request)
            head = client.recv(65536).decode().partition("\r\n\r\n")[0]
        assert head.split()[1] == str(code)
        for header in (
            "Content-Security-Policy: default-src 'none'",
            "X-Content-Type-Options: nosniff",
            "Cache-Control: no-store",
        ):
            assert head.count(header) == 1, (code, header)


def get(port: int, path: str) -> tuple[Any, str]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=5) as answer:
        return answer.headers, answer.read().decode()


def test_scrape_and_page_share_a_port(outputs, tmp_path) -> None:
    parser = pytest.importorskip("prometheus_client.parser", reason="prometheus-client is not installed")
    port = free_port()
    touched = f"touch {tmp_path}/x"
    own = outputs(channels=("1", 'a"b'), prometheus=f":{port}", live=f":{port}", on_shut=touched)
    own(impact(1))
    own(impact(2, "gangue"))
    own(share(2.0, 0.25))
    own(turn("shut", 2.0, 0.25))
    _, text = get(port, "/metrics")
    samples = {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in parser.text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert samples[("cgid_gangue_share", "1")] == 0.25
    assert np.isnan(samples[("cgid_gangue_share", 'a"b')])
    assert (samples[("cgid_gangue_share_low", "1")], samples[("cgid_gangue_share_high", "1")]) == (0.15, 0.35)
    assert samples[("cgid_shut", "1")] == 1
    assert np.isnan(samples[("cgid_shut", 'a"b')])
    assert [samples["cgid_decision", *sorted(("1", kind))] for kind in ("none", "draw", "shut")] == [0, 0, 1]
    assert [samples["cgid_decision", *sorted(('a"b', kind))] for kind in ("none", "draw", "shut")] == [1, 0, 0]
    assert samples[("cgid_ground", "1", "seen")] == 1
    assert samples[("cgid_ground", "1", "blind")] == 0
    assert samples[("cgid_last_sound_age_seconds", "1")] < 60
    assert np.isnan(samples[("cgid_last_identified_age_seconds", 'a"b')])
    assert samples[("cgid_answers_total", "1", "gangue")] == 1
    assert samples[("cgid_turns_total", "1", "shut")] == 1
    assert samples[("cgid_behind_seconds",)] == 0.25
    assert samples[("cgid_last_block_age_seconds",)] == np.inf
    assert samples[("cgid_outlet_up", "--on-shut")] == 1
    feed(own, np.arange(20.0).reshape(2, 10))
    _, text = get(port, "/state.json")
    data = json.loads(text)
    assert [one["decision"] for one in data["supports"]] == ["shut", "none"]
    assert abs(data["written"] - time.time()) < 60
    wave = data["waveform"]["channels"][1]
    assert wave["name"] == 'a"b'
    np.testing.assert_allclose(np.multiply([wave["low"], wave["high"]], wave["scale"]), [[10, 15], [14, 19]], rtol=1e-4)
    headers, text = get(port, "/?x=1")
    assert "default-src 'none'; script-src 'self'" in headers["Content-Security-Policy"]
    # Nothing stands in the page that its policy would not run, and the page of a file is all of its parts.
    assert not re.search(r"<style|<script>|\bstyle=|\bon[a-z]+=", text)
    whole = page()
    for part in re.findall(r'(?:src|href)="([^"]+)"', text):
        assert get(port, f"/{part}")[1] in whole
    assert not re.search(r"<link|<script src", whole)
    with pytest.raises(urllib.error.HTTPError, match="404"):
        get(port, "/../etc/passwd")
    with socket.create_connection(("127.0.0.1", port)) as odd:  # one that says nonsense and goes harms nobody
        odd.sendall(b"\0\xff\r\n\r\n")
    assert get(port, "/state.json")
    own.__exit__(None, None, None)
    with pytest.raises(OSError, match="refused"):
        get(port, "/")


def test_file_of_the_page_replaces_none_but_its_own(outputs, tmp_path) -> None:
    (tmp_path / "mine.html").write_text("my diary")
    with pytest.raises(CannotCreate, match="not a live page"):
        PlantOutputs(live=str(tmp_path / "mine.html"), warn=print)
    with pytest.raises(CannotCreate, match=r"p\.html"):
        PlantOutputs(live=str(tmp_path / "none" / "p.html"), warn=print)
    planted = tmp_path / ".p.html.part"
    planted.symlink_to(tmp_path / "mine.html")
    for _ in range(2):
        outputs(live=str(tmp_path / "p.html")).__exit__(None, None, None)
    assert (tmp_path / "mine.html").read_text() == "my diary"
    assert sorted(path.name for path in tmp_path.iterdir()) == [planted.name, "mine.html", "p.html"]


NOW = 1_000_000.0


def page_functions(script: str) -> Any:
    """Return what an expression of the page's own functions is worth, by node."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    functions = page().split("// Pure functions")[1].split("// The page.")[0].partition("\n")[2]
    shared = (ROOT / "cgid" / "pages" / "common.js").read_text(encoding="utf-8")
    shared += "const { percent, scale, labelColour } = common;"
    program = f"{shared} const LATE = 3; {functions}; console.log(JSON.stringify({script}))"
    return json.loads(subprocess.run([node, "-e", program], capture_output=True, text=True, check=True).stdout)


def content(outputs: Callable[..., PlantOutputs], *records: dict[str, Any], **more: Any) -> str:
    """Return the data of a page as a reader gets them, written at `NOW`."""
    own = outputs(channels=tuple(GROUNDS))
    feed(own, np.zeros((5, 10_000)))
    for record in records:
        own(record)
    return json.dumps(own.plant.page() | {"written": NOW, "age": 0.1, **more})


@pytest.mark.parametrize("decision", ["none", "unsure", "draw", "shut", "constructor"])
def test_page_shows_a_decision_only_of_what_is_seen(decision: str, outputs) -> None:
    data = content(outputs, *(state(10.0, ground=ground, value=0.5, channel=ground) for ground in GROUNDS))
    cases = f"({data}).supports.map(one => (one.decision = '{decision}', one))"
    shown = page_functions(f"{cases}.map(one => [decisionOf(one, false), stateText(one, false)])")
    words = {"unsure": "NOT YET SURE", "draw": "GO ON", "shut": "SHUT"}
    known = decision if decision in words else "none"
    assert shown == [[known, words.get(decision, "NO EVIDENCE")], *[["none", "NO DECISION"]] * (len(GROUNDS) - 1)]
    void = page_functions(f"{cases}.map(one => [decisionOf(one, true), stateText(one, true)])")
    assert void == [["none", "NO DECISION"]] * len(GROUNDS)


def test_page_names_the_ground_its_reason_and_its_age(outputs) -> None:
    data = content(outputs, *(state(10.0, ground=ground, value=0.5, channel=ground) for ground in GROUNDS))
    last = page_functions(f"({data}).supports.map(one => groundText(one, 600, true))")
    assert all(text.startswith("last known: ") and "sample 10 min ago" in text for text in last)
    texts = page_functions(f"({data}).supports.map(one => groundText(one, 600, false))")
    names = (
        "sensor in order for",
        "BLIND for",
        "WRONG SCALE for",
        "MOSTLY UNKNOWN for",
        "STREAM STOPPED for",
        "MODEL UNPROVEN for",
        "FAULTY for",
    )
    for text, name in zip(texts, names, strict=True):
        assert text.startswith(f"{name} 10 min")
        assert ("the cable" in text) is (name != "sensor in order for")
        assert "last valid sample 10 min ago" in text
        assert "last identified impact 10 min ago" in text


# Time of day of the browser less that of writing, time since new data (of a served page), what the alarm says.
AGES = [
    (0.0, 0.1, ""),
    (2.9, 2.9, ""),
    (-2.9, 0.1, ""),
    (2.9, None, ""),
    (3.1, 3.1, "NO DECISION: no data from monitor for 3 s"),
    (7000.0, 7000.0, "NO DECISION: no data from monitor for 2 h"),
    (0.5, 3.5, "NO DECISION: no data from monitor for 4 s"),  # a slow clock hides nothing
    (3.1, None, "NO DECISION: no data from monitor for 3 s (or the clock"),
    (50.0, 0.1, "NO DECISION: the clock of this machine is 50 s ahead"),
    (-50.0, 0.1, "NO DECISION: the clock of this machine is 50 s behind"),
    (-50.0, None, "NO DECISION: the clock of this machine is 50 s behind"),
]


@pytest.mark.parametrize(("old", "waited", "alarm"), AGES)
def test_page_judges_the_age_of_its_data_by_the_clock_of_its_reader(old, waited, alarm, outputs) -> None:
    arguments = f"{content(outputs, behind=0.0)}, {NOW + old}, {json.dumps(waited)}"
    void, said = page_functions(f"[voidText({arguments}), alarmText({arguments})]")
    assert bool(void) is bool(alarm)
    assert said.startswith(alarm)
    assert bool(said) is bool(alarm)


def test_page_tells_the_end_and_what_is_no_ground_to_hide_a_decision(outputs) -> None:
    ended = f"{content(outputs, ended=True)}, {NOW + 600}, null"
    assert page_functions(f"[voidText({ended}), alarmText({ended})]") == [
        "monitor ended 10 min ago",
        "NO DECISION: monitor ended 10 min ago",
    ]
    assert page_functions("[voidText(null, 1, null), alarmText(null, 1, null)]") == ["no connection to monitor"] * 2
    for more, alarm in (
        ({"age": None}, "no samples yet"),
        ({"age": 4.2}, "no samples taken for 4 s"),
        ({"behind": 1.5}, "1.5 s behind"),
    ):
        arguments = f"{content(outputs, **{'behind': 0.0} | more)}, {NOW}, 0.1"
        assert page_functions(f"[voidText({arguments}), alarmText({arguments})]") == ["", alarm]


def test_waveform_is_the_least_and_largest_of_each_bin() -> None:
    rng = np.random.default_rng(1)
    samples = rng.normal(size=(3, 20_000))
    waveform, rate = Waveform(), 3000.0
    length = round(BIN_TIME * rate)
    for block in np.split(samples, np.sort(rng.choice(np.arange(1, 20_000), 300, replace=False)), axis=1):
        waveform.add(block, rate)
    content = waveform.content(["a", "b", "c"])
    first = round(content["start"] / content["step"])
    assert first == -(-20_000 // length) - 1000
    for row, channel in enumerate(content["channels"]):
        parts = [samples[row, at : at + length] for at in range(first * length, 20_000, length)]
        for name, wanted in (("low", np.min), ("high", np.max)):
            found = np.multiply(channel[name], channel["scale"])
            np.testing.assert_allclose(found, [wanted(part) for part in parts], atol=1e-3)


# -- commands ---------------------------------------------------------------------------------------------


def test_command_gets_the_turn(outputs, said, tmp_path) -> None:
    program = "import os, sys; print(sys.stdin.read(), os.environ['CGID_SHARE'], os.environ['CGID_CHANNEL'], "
    program += f"sep='|', file=open(r'{tmp_path / 'log'}', 'a'))"
    own = outputs(on_shut=f'"{sys.executable}" -c "{program}"')
    for one in (impact(1), share(1.0, 0.5), turn("shut", 2.0, 0.625)):
        own(one)
    own.__exit__(None, None, None)  # waits for it
    line, share_text, channel = (tmp_path / "log").read_text().strip().split("|")
    assert json.loads(line)["time_s"] == 2.0
    assert (share_text, channel) == ("0.6250", "1")
    assert said == []


def test_command_that_fails_or_hangs_is_one_line(outputs, said, monkeypatch) -> None:
    monkeypatch.setattr(commands, "MAX_RUN_TIME", 0.3)
    own = outputs(on_shut=f'"{sys.executable}" -c "raise SystemExit(3)"', on_open="sleep 60")
    own(turn("shut", 1.0))
    own(turn("open", 2.0, channel="2"))
    wait_for(lambda: len(said) == 2)
    first, second = sorted(said)
    assert "on_open: the command took longer than 0.3 s and was ended (channel 2, 2 s)" in first
    assert "on_shut: the command failed with exit code 3 (channel 1, 1 s)" in second


def waiting_script(folder: Path, word: str) -> str:
    """Return a command that writes its start, waits for the file "go-CHANNEL", and writes its end."""
    program = (
        "import os, sys, time; from pathlib import Path\n"
        "word, channel, folder = sys.argv[1], os.environ['CGID_CHANNEL'], Path(sys.argv[2])\n"
        "def note(text):\n"
        "    with open(folder / ('log-' + channel), 'a') as file: file.write(text + ' ')\n"
        "note('<' + word)\n"
        "while not (folder / ('go-' + channel)).exists(): time.sleep(0.01)\n"
        "note(word + '>')\n"
    )
    (folder / "waiting.py").write_text(program)
    return f'"{sys.executable}" "{folder / "waiting.py"}" {word} "{folder}"'


def test_supports_run_side_by_side_and_the_newest_decision_last(outputs, said, tmp_path) -> None:
    commands = {f"on_{word}": waiting_script(tmp_path, word) for word in ("shut", "open", "blind")}
    channels = tuple("123456789")
    own = outputs(channels=channels, **commands)
    for channel in channels:
        own(turn("shut", 1.0, channel=channel))

    def log(channel: str) -> list[str]:
        path = tmp_path / f"log-{channel}"
        return path.read_text().split() if path.exists() else []

    wait_for(lambda: all(log(channel) == ["<shut"] for channel in channels), 60)  # all run at once
    for channel in "123":  # nothing of these runs before the first ends
        for number, kind in enumerate(["open", "shut", "open"]):
            own(turn(kind, 2.0 + number, channel=channel))
    own(state(6.0, ground="blind", channel="2"))
    own(turn("shut", 6.0, channel="3"))
    wait_for(lambda: sum("waits for the command before it" in line for line in said) == 3)
    assert all(log(channel) == ["<shut"] for channel in channels)
    names = [(one["name"], one["waiting"], one["dropped"]) for one in own.plant.page()["outlets"]]
    assert names == [("--on-shut", 1, 3), ("--on-open", 1, 5), ("--on-blind", 1, 0)]
    assert "on_open: not run: replaced by BLIND before it could start (channel 2, 4 s)" in said
    for channel in channels:
        (tmp_path / f"go-{channel}").touch()
    wait_for(lambda: [len(log(channel)) for channel in channels] == [4] * 3 + [2] * 6, 60)
    for channel, last in zip("123", ("open", "blind", "shut"), strict=True):
        assert log(channel) == ["<shut", "shut>", f"<{last}", f"{last}>"]
    assert len(said) == 11  # eight replaced, three late


def test_command_of_blindness_runs_when_a_support_is_lost(outputs, said, tmp_path) -> None:
    program = (
        "import os, sys, json; line = json.loads(sys.stdin.read()); print(*(os.environ['CGID_' + name] for name in "
    )
    program += "('TURN', 'CHANNEL', 'GROUND', 'SHARE')), line['reason'] != '', line['decision'], "
    program += f"sep=',', file=open(r'{tmp_path / 'log'}', 'a'))"
    (tmp_path / "note.py").write_text(program)
    own = outputs(channels=("1", "2"), on_blind=f'"{sys.executable}" "{tmp_path / "note.py"}"', blind_after=2.0)

    def log() -> list[str]:
        return sorted((tmp_path / "log").read_text().split()) if (tmp_path / "log").exists() else []

    feed(own, np.zeros((2, 100)))
    own(state(1.0, ground="wrong_scale", value=0.5))  # it is seen, though wrongly
    own(state(2.0, ground="blind", value=0.5))
    own(share(3.0, 0.5, ground="blind", reason="the cable"))  # still the same
    blind = "blind,1,blind,0.5000,True,none"
    wait_for(lambda: log() == [blind])
    wait_for(lambda: len(log()) == 2)  # nothing is fed any more; channel 1 was blind before
    assert log() == [blind, "blind,2,stopped,nan,True,none"]
    feed(own, np.zeros((2, 100)))
    own(state(4.0))
    own.plant.ended = True  # no loss, but the end
    own(state(5.0, ground="stopped"))
    own.__exit__(None, None, None)
    assert len(log()) == 2
    assert said == []


def test_pending_open_is_no_longer_run_when_its_ground_is_gone(outputs, said, tmp_path) -> None:
    own = outputs(on_shut=waiting_script(tmp_path, "shut"), on_open=waiting_script(tmp_path, "open"))
    own(turn("shut", 1.0))
    wait_for(lambda: (tmp_path / "log-1").exists())
    own(turn("open", 2.0))
    own(state(3.0, ground="blind"))
    own(turn("shut", 4.0))
    own(state(5.0, ground="blind"))  # this SHUT is the safe side, and runs
    (tmp_path / "go-1").touch()
    own.__exit__(None, None, None)
    wait_for(lambda: (tmp_path / "log-1").read_text().split() == ["<shut", "shut>", "<shut", "shut>"])
    assert any("on_open: not run: replaced by BLIND" in line for line in said)


def test_commands_run_without_descriptors(tmp_path) -> None:
    """Many at once, each with the descriptors in reserve; in a process of its own, whose limit is low."""
    script = f"""
import os, resource, sys, time
sys.path.insert(0, {str(ROOT)!r})
from tests.test_plant import turn
from cgid.plant import PlantOutputs
names = [str(k) for k in range(20)]
own = PlantOutputs(on_shut={f"sh -c 'sleep 1; cat > {tmp_path}/$CGID_CHANNEL'"!r}, warn=print)
own.__enter__()
own.begin(source="s", channels=names, rows=names, unit="N", threshold=0.5, behind=lambda: 0.0)
while not own.plant.outputs[0].reserved:
    time.sleep(0.01)
resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
taken = []
try:
    while True:
        taken.append(os.open(os.devnull, os.O_RDONLY))
except OSError:
    pass
for name in names:
    own(turn("shut", 1.0, channel=name))
while own.plant.outputs[0].statuses()[0]["passed"] < 20:
    time.sleep(0.05)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert sorted(int(path.name) for path in tmp_path.iterdir()) == list(range(20))
    assert all(json.loads(path.read_text())["channel"] == path.name for path in tmp_path.iterdir())


def test_equal_line_is_repeated_after_an_hour(outputs, said, monkeypatch) -> None:
    own = outputs(modbus=f"127.0.0.1:{free_port()}")
    (service,) = own._services
    for _ in range(3):
        service.report("gone")
    assert len(said) == 1
    service._reported_at -= 3601.0
    for _ in range(3):
        service.report("gone")
    assert len(said) == 2


# -- what is refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["modbus", "prometheus", "live"])
def test_port_in_use_is_said_before_anything_starts(option, tmp_path, capsys) -> None:
    if option == "prometheus":
        pytest.importorskip("prometheus_client", reason="prometheus_client is not installed")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert run(["monitor", str(tmp_path / "none.raw"), *RAW, f"--{option}", address]) == 73
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith(f"cgid: error: --{option} {address}: the address must be free")


def test_password_in_the_url_is_not_repeated() -> None:
    with pytest.raises(InvalidValue, match="CGID_MQTT_PASSWORD") as found:
        PlantOutputs(mqtt="mqtt://me:s3cret@host/t", warn=print)
    assert "s3cret" not in str(found.value)


# -- the command ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("streams") / "s.raw"
    path.write_bytes(stream(LABELS, 0.02).astype("<f4").tobytes())
    return path


def test_table_is_the_same_with_outlets(raw, tmp_path, capsys) -> None:
    assert run(["monitor", str(raw), *RAW]) == 0
    alone = capsys.readouterr()
    more = ["--live", str(tmp_path / "p.html"), "--on-shut", f"{sys.executable} --version"]
    assert run(["monitor", str(raw), *RAW, *more]) == 0
    assert capsys.readouterr() == alone
    data = json.loads((tmp_path / "p.html").read_text().split("EMBEDDED = ")[1].split(";\n")[0])
    (support,) = data["supports"]
    assert support["labels"] == {"coal": 14, "gangue": 14}
    assert (support["decision"], support["ground"]) == ("none", "stopped")
    assert support["turns"] == []  # of fewer than sixty impacts in the first seconds
    assert data["ended"]
    assert data["outlets"][0]["passed"] == 0
    wave = data["waveform"]["channels"][0]
    samples = np.fromfile(raw, "<f4")
    found = np.multiply([min(wave["low"]), max(wave["high"])], wave["scale"])
    np.testing.assert_allclose(found, [samples.min(), samples.max()], atol=1e-3 * samples.max())


def test_lost_sensor_is_seen_in_every_output(raw, tmp_path, capsys) -> None:
    """The whole command: a channel that dies has no decision, and its command runs once."""
    (tmp_path / "lost.raw").write_bytes(raw.read_bytes() + np.zeros(round(2 * RATE), "<f4").tobytes())
    note = tmp_path / "note.py"
    note.write_text("import os, sys; print(os.environ['CGID_GROUND'], sys.stdin.read(), file=open(sys.argv[1], 'a'))")
    more = ["--set", "blind_after=0.5", "--live", str(tmp_path / "p.html")]
    more += ["--on-blind", f'"{sys.executable}" "{note}" "{tmp_path / "log"}"']
    assert run(["monitor", str(tmp_path / "lost.raw"), *RAW, *more, "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    lost = [row for row in rows if row.get("ground") == "blind"]
    assert {row["decision"] for row in lost} == {"none"}
    (line,) = wait_for(lambda: (tmp_path / "log").exists() and (tmp_path / "log").read_text().splitlines())
    ground, _, record = line.partition(" ")
    record = json.loads(record)
    assert (ground, record["ground"], record["decision"]) == ("blind", "blind", "none")
    assert record["reason"] == lost[0]["reason"] != ""
    assert record["last_sound_s"] == lost[0]["last_sound_s"]
    data = json.loads((tmp_path / "p.html").read_text().split("EMBEDDED = ")[1].split(";\n")[0])
    assert [(one["decision"], one["ground"]) for one in data["supports"]] == [("none", "stopped")]


@pytest.mark.long
def test_killed_monitor_leaves_its_last_will(raw, broker) -> None:
    port = broker().port
    arguments = ["monitor", "-", *RAW, "--mqtt", f"mqtt://127.0.0.1:{port}/plant"]
    with Subscriber(port) as found:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen([sys.executable, "-m", "cgid", *arguments], cwd=ROOT, **pipes)
        assert process.stdin is not None
        try:
            process.stdin.write(raw.read_bytes())
            process.stdin.flush()
            wait_for(lambda: found.of("plant/impact/1"))
            process.kill()
            wait_for(lambda: "offline" in found.of("plant/status"))
        finally:
            process.kill()
            process.communicate()


def test_no_decision_has_not_the_colour_of_shut() -> None:
    style = (Path(commands.__file__).parent / "live.css").read_text(encoding="utf-8")
    assert not [rule for rule in re.findall(r"#alarm[^{]*\{([^}]*)\}", style) if "--shut" in rule or "--draw" in rule]
