"""The plant outputs of monitor beside a real broker: messages a second, latency, and a broker that dies and comes back.

    python benchmarks/plant/outputs.py [--seconds 30]
    python benchmarks/plant/outputs.py --commands

Needs mosquitto, and the extra "plant". Everything runs on this machine, over the loopback. Prints Markdown.

The stream is a force at 200 kHz with 50 impacts a second, written in real time. The broker is killed after a third and
starts again after two thirds. Latency of an answer is the time from writing the last sample of its block to reading its
row from stdout. The run with a short queue holds 200 messages instead of 10,000.

With --commands, each of 5 and 64 supports shuts, opens after 5 s, and shuts again after 10 s, while its commands take
3 s, or hang until they are ended after 30 s. The command itself writes when it starts; its lock shows two at once.
"""

import argparse
import json
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

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
from tests.streams_of_pulses import RATE, stream  # noqa: E402
from tests.test_plant import Mosquitto, free_port, impact, share, turn  # noqa: E402

#: Samples are written in blocks of this time [s].
BLOCK = 0.01
SHORT_QUEUE = 200
MONITOR = "from cgid.plant.output import Output; Output.__init__.__defaults__ = ({queue},); "
MONITOR += "import sys; from cgid.cli.main import run; sys.exit(run(sys.argv[1:]))"


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
    raw = ["--rate", str(RATE), "--channels", "1", "--sample-format", "f32le", "--unit", "N", "--set", "window=2"]
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
        broker = Mosquitto(folder, "max_queued_messages 0")
        client, found = subscriber(broker.port)
        ports = [free_port() for _ in range(2)]
        more = ["--mqtt", f"mqtt://127.0.0.1:{broker.port}/b", "--modbus", f":{ports[0]}"]
        more += ["--prometheus", f":{ports[1]}", "--live", f":{ports[1]}"]
        events = [(seconds / 3, broker.kill), (2 * seconds / 3, broker.start)] if dies else []
        rows, delays, notes = monitored(force, seconds, more, queue, events)
        time.sleep(1.0)
        numbers = [json.loads(line)["sequence"] for _, topic, line in found if b'"sequence"' in line]
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


def commands(folder, n_supports, run_time):
    """Print which decisions of each support had a command, in which order, and how late each started."""
    names = [str(number) for number in range(1, n_supports + 1)]
    log = f"{folder}/$CGID_CHANNEL"
    script = f"exec 9> {log}.lock; flock -n 9 || echo two at once >> {log}; "
    script += f'date "+%s.%N $CGID_TURN $CGID_TIME" >> {log}; exec sleep {run_time}'
    told, issued, begun = [], {}, time.time()
    with PlantOutputs(on_shut=f"sh -c '{script}'", on_open=f"sh -c '{script}'", warn=told.append) as outputs:
        plain = {"unit": "N", "threshold": 0.5, "behind": lambda: 0.0, "blind_after": 1e9}
        outputs.begin(source="s", channels=names, rows=names, **plain)
        for second, kind in ((0, "shut"), (5, "open"), (10, "shut")):
            time.sleep(max(begun + second - time.time(), 0.0))
            for name in names:
                issued[name, second] = time.time()
                outputs(turn(kind, float(second), channel=name))
        while queue_of(outputs)._turns or queue_of(outputs)._running:
            time.sleep(0.05)
    orders, delays, overlaps = set(), {0: [], 5: [], 10: []}, 0
    for name in names:
        rows = [row.split() for row in (Path(folder) / name).read_text().splitlines()]
        overlaps += sum(row[0] == "two" for row in rows)
        starts = [(float(at), kind, round(float(second))) for at, kind, second in rows if at != "two"]
        orders.add(", ".join(f"{kind.upper()} {second} s" for _, kind, second in starts))
        for at, _, second in starts:
            delays[second].append(at - issued[name, second])
    late = " | ".join(f"{np.median(one):.2f}, {max(one):.2f}" if one else "-" for one in delays.values())
    counts = " | ".join(str(sum(word in text for text in told)) for word in ("waits", "replaced", "was ended"))
    print(f"| {n_supports} | {run_time} | {'; '.join(sorted(orders))} | {overlaps} | {late} | {counts} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--commands", action="store_true")
    given = parser.parse_args()
    seconds = given.seconds
    if given.commands:
        print(
            "| supports | command takes [s] | commands of each support, in order | two at once | SHUT at 0 s starts "
            "later by, median, most [s] | OPEN at 5 s | SHUT at 10 s | lines: waits | replaced | ended |"
        )
        print("|---|---|---|---|---|---|---|---|---|---|")
        for n_supports in (5, 64):
            for run_time in (3, 60):
                with tempfile.TemporaryDirectory() as folder:
                    commands(folder, n_supports, run_time)
        return
    with tempfile.TemporaryDirectory() as folder:
        broker = Mosquitto(Path(folder))
        print("| output | value |\n|---|---|")
        messages(broker.port)
        broker.kill()
        readers()
        outage(Path(folder), seconds)


if __name__ == "__main__":
    main()
