"""All outputs of a live stream beside each other: four faults that begin and end, told by each at the same seconds.

    python benchmarks/plant/side_by_side.py [--seconds 150] [--seed 1]

Needs mosquitto and the extra "plant"; with chromium, its driver and selenium the page is read in a browser, too. Prints
Markdown, and ends with 1 where an output differs.

Five channels of `caving` at .4 of gangue arrive in real time: one sound, one whose sensor is dead, one that is upside
down, one ten times too large and one drowned in noise, each for a third of the time. `cgid monitor` has all outputs at
once; `cgid.Monitor` gets the same blocks in another process, with MQTT of its own. Records of stdout and MQTT are
compared field by field; those of Python by kind, channel, times, finding, decision and ground, as impacts that are
measured together in blocks of other lengths have other last digits. Modbus, Prometheus and the page are read several
times a second: when a finding stands there, beside when its line came on stdout.
"""

import argparse
import contextlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import paho.mqtt.client as paho
from pymodbus import ModbusException
from pymodbus.client import ModbusTcpClient

from cgid import Monitor, read_recording, shipped
from cgid.plant import PlantOutputs
from cgid.plant.modbus import EACH, FINDINGS

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
from tests.test_plant import Mosquitto, free_port  # noqa: E402

RATE, BLOCK = 25_600, 1280
NAMES = ("sound", "dead", "upside down", "ten times", "noise")
#: What a message does not share with its line.
OWN = {"source", "wall_time", "sequence"}
#: An output that is read shows a finding at most this much earlier or later than its line on stdout [s].
LATE = 1.5


def samples(seconds, seed, folder):
    """Return five channels (n, 5) of a stream of caving, four of them with a fault in the middle."""
    text = shipped.scene_path("caving").read_text(encoding="utf-8")
    text = re.sub(r'duration = "60 s"', f'duration = "{seconds} s"', text)
    text = re.sub(r"mixture = .*", f'mixture = {{ times = ["0 s", "{seconds} s"], gangue = [0.4, 0.4] }}', text)
    (folder / "s.toml").write_text(text, encoding="utf-8")
    made = [sys.executable, "-m", "cgid", "generate", folder / "s.toml", "-o", folder / "s.h5", "--seed", str(seed)]
    subprocess.run(made, check=True, capture_output=True, cwd=ROOT)
    sound = read_recording(str(folder / "s.h5"))[0].samples.ravel().astype("f4")[: seconds * RATE]
    both, rng = np.repeat(sound[:, None], len(NAMES), axis=1), np.random.default_rng(seed)
    for row, shift in enumerate((0, 2, 4, 6), start=1):
        part = slice(int((seconds / 3 + shift) * RATE), int((2 * seconds / 3 + shift) * RATE))
        x = sound[part]
        both[part, row] = (0 * x, -x, 10 * x, x + rng.normal(0, 300, x.size).astype("f4"))[row - 1]
    return both


class Seen:
    """What an output shows of (channel, finding): when it was first and last there."""

    def __init__(self):
        self.first, self.last = {}, {}

    def take(self, standing):
        """Note what stands now."""
        now = time.monotonic()
        for one in standing:
            self.first.setdefault(one, now)
            self.last[one] = now


def polled(seen, read, until, every=0.2):
    """Read an output until the end; what is not there yet is no finding."""
    while not until.is_set():
        with contextlib.suppress(OSError, ModbusException):
            seen.take(read())
        time.sleep(every)


def browser(port):
    """Return a page in a browser, None without one."""
    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    try:
        from selenium import webdriver
    except ImportError:
        return None
    if None in programs:
        return None
    options = webdriver.ChromeOptions()
    options.binary_location = programs[0]
    for switch in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking"):
        options.add_argument(switch)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(programs[1]))
    driver.get(f"http://127.0.0.1:{port}/")
    return driver


def subscriber(port):
    """Return a client, and the lists of records below "command" and "python" that it fills."""
    found = {"command": [], "python": []}

    def take(_client, _data, message):
        top, kind = message.topic.split("/")[:2]
        if kind not in ("state", "status", "wall_time"):
            found[top].append(json.loads(message.payload))

    client = paho.Client(paho.CallbackAPIVersion.VERSION2)
    client.on_connect = lambda own, *_: own.subscribe("#", qos=1)
    client.on_message = take
    client.connect("127.0.0.1", port)
    client.loop_start()
    return client, found


def plain(records):
    """Return records without what is their process's own, in order, floats to nine digits."""

    def rounded(value):
        if isinstance(value, dict):
            return {name: rounded(one) for name, one in value.items() if name not in OWN}
        if isinstance(value, list):
            return [rounded(one) for one in value]
        return float(f"{value:.9g}") if isinstance(value, float) else value

    return sorted(json.dumps(rounded(one), sort_keys=True) for one in records if is_of_stream(one))


def marks(records):
    """Return what two processes must agree on of their records."""
    names = ("kind", "channel", "time_s", "finding", "channels", "begin_s", "end_s", "decision", "ground")
    return sorted(str([one.get(name) for name in names]) for one in records if is_of_stream(one))


def labels(records):
    return {(one["channel"], one["time_s"]): one["label"] for one in records if one["kind"] == "impact"}


def is_of_stream(record):
    """Return whether a record is a message, and does not tell of a process that it is late."""
    return record["kind"] != "state" and record.get("finding") != "behind"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=150)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        stream = samples(given.seconds, given.seed, Path(folder))
        broker = Mosquitto(Path(folder), "max_queued_messages 0")
        try:
            sys.exit(beside(stream, broker.port))
        finally:
            broker.kill()


def beside(stream, broker):
    client, sent = subscriber(broker)
    modbus, http = free_port(), free_port()
    raw = ["--rate", str(RATE), "--channels", str(len(NAMES)), "--sample-format", "f32le", "--unit", "m/s^2", "--json"]
    outputs = ["--mqtt", f"mqtt://127.0.0.1:{broker}/command", "--modbus", f":{modbus}", "--prometheus", f":{http}"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    command = [sys.executable, "-m", "cgid", "monitor", "-", *raw, *outputs, "--live", f":{http}"]
    process = subprocess.Popen(command, cwd=ROOT, **pipes)
    lines, over = [], threading.Event()

    def read_stdout():
        for line in process.stdout:
            lines.append((time.monotonic(), json.loads(line)))
        over.set()

    words, numbers = {}, {}  # of findings: (channel, words) or number -> kind

    def standing():
        for _, one in lines:
            if one["kind"] == "finding" and one["end_s"] is None:
                numbers[one["number"]] = one["finding"]
                words.update({(channel, one["message"]): one["finding"] for channel in channels_of(one)})

    def page_of():
        standing()
        with urllib.request.urlopen(f"http://127.0.0.1:{http}/state.json", timeout=5) as answer:
            supports = json.load(answer)["supports"]
        return [(one["channel"], words[one["channel"], text]) for one in supports for text in one["findings"]
                if (one["channel"], text) in words]  # fmt: skip

    def metrics():
        with urllib.request.urlopen(f"http://127.0.0.1:{http}/metrics", timeout=5) as answer:
            return re.findall(r'cgid_finding\{channel="(.+?)",finding="(.+?)"\} 1', answer.read().decode())

    reader = ModbusTcpClient("127.0.0.1", port=modbus)

    def registers():
        standing()
        if not reader.connect():
            return []
        values = reader.read_input_registers(FINDINGS, count=EACH * len(NAMES)).registers
        return [(str(at // EACH + 1), numbers[one]) for at, one in enumerate(values) if one in numbers]

    seen = {"Modbus": Seen(), "Prometheus": Seen(), "page, its data": Seen()}
    tasks = [
        threading.Thread(target=read_stdout),
        *(threading.Thread(target=polled, args=(seen[name], read, over)) for name, read in
          (("Modbus", registers), ("Prometheus", metrics), ("page, its data", page_of))),
    ]  # fmt: skip
    while True:  # its server is there
        with contextlib.suppress(OSError):
            metrics()
            break
        time.sleep(0.1)
    for task in tasks:
        task.start()
    driver = browser(http)
    if driver is not None:
        seen["page in a browser"] = Seen()

        def shown():
            standing()
            text = driver.execute_script("return document.body.innerText")
            return [(channel, kind) for (channel, message), kind in words.items() if message in text]

        tasks.append(threading.Thread(target=polled, args=(seen["page in a browser"], shown, over, 0.3)))
        tasks[-1].start()
    python, told = PlantOutputs(mqtt=f"mqtt://127.0.0.1:{broker}/python"), []

    def fed(start):
        with Monitor(RATE, len(NAMES), "m/s^2", outputs=python, batch=1) as watch:
            for at in range(0, len(stream), BLOCK):
                time.sleep(max(start + at / RATE - time.monotonic(), 0.0))
                told.extend(watch.feed(stream[at : at + BLOCK]).findings)
            told.extend(watch.finish().findings)

    start = time.monotonic()
    tasks.append(threading.Thread(target=fed, args=(start,)))
    tasks[-1].start()
    for at in range(0, len(stream), BLOCK):
        time.sleep(max(start + at / RATE - time.monotonic(), 0.0))
        process.stdin.write(stream[at : at + BLOCK].tobytes())
        process.stdin.flush()
    process.stdin.close()
    for task in tasks:
        task.join()
    process.wait()
    time.sleep(2.0)
    if driver is not None:
        driver.quit()
    client.disconnect()
    client.loop_stop()
    return compared(lines, sent, told, seen, start)


def channels_of(record):
    return record["channels"] or [str(number + 1) for number in range(len(NAMES))]


def compared(lines, sent, told, seen, start):
    """Print what each output says beside stdout; return the number of those that differ."""
    printed, n_wrong = [one for _, one in lines], 0
    findings = [one for one in printed if one["kind"] == "finding"]
    print("| finding | channel | begins [s] | ends [s] |\n|---|---|---|---|")
    for one in findings:
        if one["moves_answers"] and one["end_s"] is not None:
            channels = ", ".join(NAMES[int(name) - 1] for name in channels_of(one))
            print(f"| {one['finding']} | {channels} | {one['begin_s']} | {one['end_s']} |")
    own = [(one.kind, one.channels, one.content()["begin_s"], one.content()["end_s"]) for one in told]
    of_stream = filter(is_of_stream, findings)
    theirs = [(one["finding"], tuple(one["channels"]), one["begin_s"], one["end_s"]) for one in of_stream]
    n_impacts, n_same = len(labels(printed)), len(labels(printed).items() & labels(sent["python"]).items())
    n_other = f"{n_impacts - n_same} of {n_impacts} impacts with another label"
    print("\n| output | compared | the same |\n|---|---|---|")
    for name, what, is_same in (
        ("MQTT", f"{len(sent['command'])} records of stdout", plain(sent["command"]) == plain(printed)),
        (
            "MQTT of `cgid.Monitor`",
            f"{len(sent['python'])} records, {n_other}",
            marks(sent["python"]) == marks(printed),
        ),
        ("`cgid.Monitor`, its news", f"{len(own)} findings", sorted(own, key=str) == sorted(theirs, key=str)),
    ):
        n_wrong += not is_same
        print(f"| {name} | {what} | {'yes' if is_same else 'NO'} |")
    began, ended, opened = {}, {}, {}
    for at, one in [*lines, (lines[-1][0], None)]:
        if one is None or (one["kind"] == "finding" and not one["note"]):
            for channel in channels_of(one or {"channels": []}):
                for kind in [kind for name, kind in opened if name == channel] if one is None else [one["finding"]]:
                    if one is not None and one["end_s"] is None:
                        opened[channel, kind] = at
                    elif at - (begun := opened.pop((channel, kind))) > LATE / 3:
                        began.setdefault((channel, kind), begun)  # else who looks now and then may miss it
                        ended[channel, kind] = at
    for name, one in seen.items():
        lacking = began.keys() - one.first.keys()
        late = [one.first[key] - began[key] for key in began.keys() & one.first.keys()]
        long = [one.last[key] - ended[key] for key in ended.keys() & one.last.keys()]
        is_same = not lacking and max(map(abs, late + long), default=0.0) <= LATE
        n_wrong += not is_same
        times = f"begins {min(late):+.2f} to {max(late):+.2f} s, ends {min(long):+.2f} to {max(long):+.2f} s beside it"
        print(f"| {name} | {len(late)} findings, {times} | {'yes' if is_same else f'NO: {lacking}'} |")
    return int(n_wrong > 0)


if __name__ == "__main__":
    main()
