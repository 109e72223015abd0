"""The plant outputs of monitor beside a real broker: messages a second, latency, and a broker that dies and comes back.

    python benchmarks/plant.py [--seconds 30]
    python benchmarks/plant.py --clients

Needs mosquitto, and the extra "plant". Everything runs on this machine, over the loopback. Prints Markdown.

The stream is a force at 200 kHz with 50 impacts a second, written in real time. The broker is killed after a third and
starts again after two thirds. Latency of an answer is the time from writing the last sample of its block to reading its
row from stdout. The run with a short queue holds 200 messages instead of 10,000.

`--clients` measures what too many clients do to a monitor of at most 1024 descriptors: none, then 1,100 that say
nothing, then 1,300 that send nonsense, to the Modbus port and to the live page each, while the stream makes a decision
every second.
"""

import argparse
import contextlib
import json
import random
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import paho.mqtt.client as paho
from pymodbus.client import ModbusTcpClient

from cgid.plant import PlantOutputs

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
from tests.streams_of_pulses import RATE, stream  # noqa: E402
from tests.test_plant import free_port, impact, share  # noqa: E402

#: Samples are written in blocks of this time [s].
BLOCK = 0.01
SHORT_QUEUE = 200
MONITOR = "from cgid.plant.output import Outlet; Outlet.__init__.__defaults__ = ({queue},); "
MONITOR += "import sys; from cgid.cli.main import run; sys.exit(run(sys.argv[1:]))"


class Broker:
    """mosquitto on a free port."""

    def __init__(self, folder):
        self.port = free_port()
        self.file = Path(folder) / "mosquitto.conf"
        self.file.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\nmax_queued_messages 0\n")
        self.start()

    def start(self):
        """Start, and wait until it listens."""
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        program = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
        self.process = subprocess.Popen([program, "-c", str(self.file)], **quiet)
        while socket.socket().connect_ex(("127.0.0.1", self.port)):
            time.sleep(0.01)

    def kill(self):
        """End without a word."""
        self.process.kill()
        self.process.wait()


def subscriber(port):
    """Return a client, and the list of (time of arrival, topic, line) that it fills."""
    found = []
    client = paho.Client(paho.CallbackAPIVersion.VERSION2)
    client.reconnect_delay_set(1, 1)
    client.on_connect = lambda own, *_: own.subscribe("#", qos=1)
    client.on_message = lambda _c, _d, one: found.append((time.perf_counter(), one.topic, one.payload))
    client.connect("127.0.0.1", port)
    client.loop_start()
    time.sleep(0.5)
    return client, found


def queue_of(outputs):
    return outputs.plant.outputs[0]


def messages(port, n_messages=20_000):
    """Print the largest rate of messages, the latency at a hundred a second, and what a line costs the answers."""
    client, found = subscriber(port)
    with PlantOutputs(mqtt=f"mqtt://127.0.0.1:{port}/b", warn=print) as outputs:
        outputs.begin(source="s", channels=["1"], rows=["1"], unit="N", threshold=0.5, behind=lambda: 0.0)
        begun, spent = time.perf_counter(), 0.0
        for number in range(n_messages):
            while len(queue_of(outputs)._waiting) > 5000:
                time.sleep(0.001)
            record = impact(number)
            before = time.perf_counter()
            outputs(record)
            spent += time.perf_counter() - before
        while sum("/impact/" in topic for _, topic, _ in found[-50:]) == 0 or queue_of(outputs).passed < n_messages:
            time.sleep(0.001)
        print(f"| messages a second, acknowledged | {n_messages / (time.perf_counter() - begun):.0f} |")
        print(f"| a line to the outputs, while messages leave [us] | {spent / n_messages * 1e6:.1f} |")
        found.clear()
        sent = []
        for number in range(300):
            sent.append(time.perf_counter())
            outputs(impact(number))
            time.sleep(0.01)
        time.sleep(0.5)
        arrived = {json.loads(line)["impact"]: at for at, topic, line in found if "/impact/" in topic}
        delays = [1e3 * (arrived[number] - at) for number, at in enumerate(sent)]
        print(f"| line to subscriber at 100 a second, median and 99 % [ms] | {quantiles(delays)} |")
    client.disconnect()
    client.loop_stop()


def quantiles(values):
    middle, late = np.quantile(values, [0.5, 0.99])
    return f"{middle:.1f}, {late:.1f}"


def readers():
    """Print the times of a scrape, of a Modbus read and of the page's data, for eight supports."""
    http, modbus = free_port(), free_port()
    names = [str(number) for number in range(1, 9)]
    with PlantOutputs(prometheus=f":{http}", live=f":{http}", modbus=f":{modbus}", warn=print) as outputs:
        outputs.begin(source="s", channels=names, rows=names, unit="N", threshold=0.5, behind=lambda: 0.0)
        for name in names:
            outputs(impact(1, channel=name))
            outputs(share(1.0, 0.5, channel=name))
        rng = np.random.default_rng(0)
        blocks = [rng.normal(size=(8, 1280)) for _ in range(200)]
        begun = time.perf_counter()
        for _ in outputs.monitored_blocks(blocks, 25_600.0):
            pass
        spent = (time.perf_counter() - begun) / 200
        print(f"| waveform of a block of 50 ms, 8 channels at 25.6 kHz [us] | {1e6 * spent:.0f} |")
        client = ModbusTcpClient("127.0.0.1", port=modbus)
        while not client.connect():
            time.sleep(0.05)
        for what, ask in (
            ("Modbus read of 112 registers", lambda: client.read_input_registers(16, count=112)),
            ("scrape of /metrics", lambda: urllib.request.urlopen(f"http://127.0.0.1:{http}/metrics").read()),
            ("data of the page", lambda: urllib.request.urlopen(f"http://127.0.0.1:{http}/state.json").read()),
        ):
            times = []
            for _ in range(100):
                begun = time.perf_counter()
                ask()
                times.append(1e3 * (time.perf_counter() - begun))
            print(f"| {what}, 8 supports, median and 99 % [ms] | {quantiles(times)} |")
        client.close()


def monitored(force, seconds, more=(), queue=10_000, events=()):
    """Run monitor on a force in real time; return rows of stdout, their delays [s], and stderr.

    `events` are (time, function) to call meanwhile.
    """
    raw = ["--rate", str(RATE), "--channels", "1", "--sample-format", "f32le", "--unit", "N", "--window", "2"]
    command = [sys.executable, "-c", MONITOR.format(queue=queue), "monitor", "-", *raw, *more]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    process = subprocess.Popen(command, cwd=ROOT, **pipes)
    time.sleep(3.0)  # it is ready
    rows, notes = [], []
    begun = []

    def read():
        process.stdout.readline()  # the head
        for line in process.stdout:
            rows.append((time.perf_counter() - begun[0], line.decode()))

    readers_ = [threading.Thread(target=read), threading.Thread(target=lambda: notes.append(process.stderr.read()))]
    for reader in readers_:
        reader.start()
    left = list(events)
    step = round(BLOCK * RATE)
    begun.append(time.perf_counter())
    for number in range(round(seconds / BLOCK)):
        while left and (number + 1) * BLOCK >= left[0][0]:
            left.pop(0)[1]()
        time.sleep(max(begun[0] + (number + 1) * BLOCK - time.perf_counter(), 0.0))
        process.stdin.write(force[number * step : (number + 1) * step].tobytes())
        process.stdin.flush()
    process.stdin.close()
    for reader in readers_:
        reader.join()
    process.wait()
    delays = [at - float(line.split(",")[2]) for at, line in rows]
    return [line for _, line in rows], delays, notes[0].decode()


def outage(folder, seconds):
    """Print what a broker that dies and comes back does to the answers and to the messages."""
    labels = (["coal"] * 200 + ["gangue"] * 200) * (int(seconds * 50) // 400 + 1)
    force = stream(labels, 0.02).astype("<f4")
    print(
        "\n| run | rows on stdout | row after its impact, median and 99 % [ms] | lines | delivered | missed | twice |"
    )
    print("|---|---|---|---|---|---|---|")
    alone, delays, _ = monitored(force, seconds)
    print(f"| without outputs | {len(alone)} | {quantiles(np.multiply(delays, 1e3))} | | | | |")
    for name, queue, dies in (
        ("all outputs", 10_000, False),
        ("broker away for a third of the time", 10_000, True),
        (f"the same, queue of {SHORT_QUEUE}", SHORT_QUEUE, True),
    ):
        broker = Broker(folder)
        client, found = subscriber(broker.port)
        ports = [free_port() for _ in range(2)]
        more = ["--mqtt", f"mqtt://127.0.0.1:{broker.port}/b", "--modbus", f":{ports[0]}"]
        more += ["--prometheus", f":{ports[1]}", "--live", f":{ports[1]}"]
        events = [(seconds / 3, broker.kill), (2 * seconds / 3, broker.start)] if dies else []
        rows, delays, notes = monitored(force, seconds, more, queue, events)
        time.sleep(1.0)
        numbers = [json.loads(line)["message"] for _, topic, line in found if b'"message"' in line]
        n_lines, once = max(numbers), len(set(numbers))
        same = "the same" if rows == alone else "OTHER"
        print(
            f"| {name} | {len(rows)}, {same} | {quantiles(np.multiply(delays, 1e3))} | {n_lines} | {once} | "
            f"{n_lines - once} | {len(numbers) - once} |"
        )
        for line in notes.splitlines():
            if "mqtt" in line:
                print(f"  {line}", file=sys.stderr)
        client.disconnect()
        client.loop_stop()
        broker.kill()


#: Clients that say nothing, and that send nonsense; descriptors of the monitor.
N_IDLE, N_FUZZED, N_DESCRIPTORS = 1100, 1300, 1024


def connected(port):
    """Return a new connection that does not wait, or None."""
    client = socket.socket()
    client.settimeout(0.2)
    try:
        client.connect(("127.0.0.1", port))
    except OSError:
        client.close()
        return None
    client.setblocking(False)
    return client


def idle(ports, until):
    """Open connections that say nothing, one in ten a byte every second."""
    clients = [client for _ in range(N_IDLE) for port in ports if (client := connected(port))]
    while time.perf_counter() < until:
        for client in clients[::10]:
            with contextlib.suppress(OSError):
                client.send(b"G")
        time.sleep(1.0)
    for client in clients:
        client.close()


def fuzzed(ports, until):
    """Send random bytes and damaged requests, some of them in halves, over short connections."""
    rng = random.Random(1)
    whole = (bytes([0, 1, 0, 0, 0, 6, 1, 4, 0, 16, 0, 16]), b"GET /state.json HTTP/1.1\r\nHost: localhost\r\n\r\n")
    for _ in range(N_FUZZED):
        for port, request in zip(ports, whole, strict=True):
            content = bytearray(request if rng.random() < 0.7 else rng.randbytes(rng.randrange(1, 400)))
            for _ in range(rng.randrange(4)):
                content[rng.randrange(len(content))] = rng.randrange(256)
            client = connected(port)
            if client is None:
                continue
            with contextlib.suppress(OSError):
                client.send(content[: rng.randrange(len(content) + 1)] if rng.random() < 0.3 else content)
            client.close()
        time.sleep(max(until - time.perf_counter(), 0.0) / N_FUZZED / 2)


def ask_modbus(port):
    """Read the head; return whether it arrived."""
    with socket.create_connection(("127.0.0.1", port), timeout=2.0) as client:
        client.sendall(bytes([0, 7, 0, 0, 0, 6, 1, 4, 0, 0, 0, 16]))
        return len(client.recv(300)) == 41


def ask_page(port):
    """Read the data of the page."""
    return urllib.request.urlopen(f"http://127.0.0.1:{port}/state.json", timeout=2.0).read().startswith(b"{")


def clients(folder, root=ROOT, seconds=20.0):
    """Print what too many clients do: commands run, descriptors, threads, bytes of stderr, and reads meanwhile."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    force = stream((["coal"] * 25 + ["gangue"] * 25) * round(seconds), 0.02).astype("<f4")
    raw = ["--rate", str(RATE), "--channels", "1", "--sample-format", "f32le", "--unit", "N", "--window", "0.24"]
    print("| clients | SHUT, commands run | descriptors | threads | stderr [bytes] | processor [s] | reads answered |")
    print("|---|---|---|---|---|---|---|")
    for name, attack in (("none", None), (f"{N_IDLE:,} idle", idle), (f"{N_FUZZED:,} fuzzed", fuzzed)):
        ports, log = (free_port(), free_port()), Path(folder) / f"{name.split()[-1]}.log"
        command = [sys.executable, "-c", MONITOR.format(queue=10_000), "monitor", "-", *raw, "--json"]
        command += ["--modbus", f":{ports[0]}", "--live", f":{ports[1]}", "--on-shut", f"sh -c 'echo run >> {log}'"]
        limited = ["sh", "-c", f'ulimit -n {N_DESCRIPTORS}; exec "$@"', "sh", *command]
        with (Path(folder) / "out").open("w+b") as out, (Path(folder) / "err").open("w+b") as err:
            process = subprocess.Popen(limited, cwd=root, stdin=subprocess.PIPE, stdout=out, stderr=err)
            time.sleep(3.0)
            begun, most, reads = time.perf_counter(), [0, 0], []
            if attack is not None:
                attacker = threading.Thread(target=attack, args=(ports, begun + seconds))
                attacker.start()
            step = round(BLOCK * RATE)
            for number in range(round(seconds / BLOCK)):
                time.sleep(max(begun + (number + 1) * BLOCK - time.perf_counter(), 0.0))
                process.stdin.write(force[number * step : (number + 1) * step].tobytes())
                process.stdin.flush()
                if number % 100 == 99:
                    about = Path(f"/proc/{process.pid}")
                    now = len(list((about / "fd").iterdir())), len(list((about / "task").iterdir()))
                    most = np.maximum(most, now)
                    for ask, port in ((ask_modbus, ports[0]), (ask_page, ports[1])):
                        try:
                            reads.append(ask(port))
                        except OSError:
                            reads.append(False)
            ticks = (about / "stat").read_text().rpartition(")")[2].split()[11:13]
            process.stdin.close()
            process.wait()
            if attack is not None:
                attacker.join()
            out.seek(0)
            n_shut = sum(b'"kind": "shut"' in line for line in out)
            n_run = log.read_text().count("run") if log.exists() else 0
            spent = sum(map(int, ticks)) / 100
            print(
                f"| {name} | {n_shut}, {n_run} | {most[0]} | {most[1]} | {err.seek(0, 2)} | {spent:.1f} | "
                f"{sum(reads)} of {len(reads)} |",
                flush=True,
            )
            err.seek(0)
            for line in err.read().decode().splitlines()[:3]:
                print(f"  {line}", file=sys.stderr)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--clients", action="store_true")
    arguments = parser.parse_args()
    seconds = arguments.seconds
    with tempfile.TemporaryDirectory() as folder:
        if arguments.clients:
            clients(folder)
            return
        broker = Broker(folder)
        print("| output | value |\n|---|---|")
        messages(broker.port)
        broker.kill()
        readers()
        outage(folder, seconds)


if __name__ == "__main__":
    main()
