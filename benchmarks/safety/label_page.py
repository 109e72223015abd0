"""What `cgid label` loses, how long it takes, and how often the accuracy that it shows holds.

    python benchmarks/safety/label_page.py --crashes 1000  # labels of two people, kill -9 at random moments
    python benchmarks/safety/label_page.py --hour 60       # minutes of four channels at 51.2 kHz
    python benchmarks/safety/label_page.py --draws 40      # recordings, of which 60 impacts are labelled

The recordings are made here, by ring-downs that share no code with the package.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import wave
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
RATE = 10_000


def ringing(labels: np.ndarray, spread: float, generator: np.random.Generator) -> np.ndarray:
    """Return impacts every .4 s [g]; those of gangue ring higher, by less than they differ among themselves."""
    n = round((0.4 * len(labels) + 0.6) * RATE)
    out = 0.02 * generator.standard_normal(n)
    time_ = np.arange(round(0.15 * RATE)) / RATE
    for k, label in enumerate(labels.tolist()):
        first = round((0.3 + 0.4 * k + generator.uniform(0, 0.05)) * RATE)
        hardness = 3.0 * label + spread * generator.standard_normal()
        levels = 10 ** (0.3 + 0.15 * np.array([generator.standard_normal(), generator.standard_normal() + hardness]))
        for tone, level in zip((700.0, 1900.0), levels, strict=True):
            out[first : first + len(time_)] += level * np.exp(-time_ / 0.02) * np.sin(2 * np.pi * tone * time_)
    return out


class Page:
    """A page in a process of its own."""

    def __init__(self, folder: Path, file: str, *options: str) -> None:
        command = [sys.executable, "-m", "cgid", "label", file, *options]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        self.begun = time.perf_counter()
        self.process = subprocess.Popen(
            command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline().strip()
        self.address_after = time.perf_counter() - self.begun
        self.port, self.key = int(line.split(":")[2].split("/")[0]), line.split("#")[1]

    def ask(self, path: str, body: dict[str, Any] | None = None) -> tuple[int, Any]:
        """Return the status and the content of an answer."""
        client = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        headers = {"X-Cgid-Key": self.key} | ({} if body is None else {"Content-Type": "application/json"})
        client.request("GET" if body is None else "POST", f"/api/{path}", body and json.dumps(body), headers)
        answer = client.getresponse()
        content = answer.read()
        client.close()
        return answer.status, json.loads(content) if content[:1] in b"{[" else content

    def wait(self) -> float:
        """Wait until the impacts are listed, and return the time since the start [s]."""
        while not all(one["ended"] for one in self.ask("state")[1]["recordings"]):
            time.sleep(0.05)
        return time.perf_counter() - self.begun

    def end(self, how: int) -> None:
        """End the page by a signal."""
        self.process.send_signal(how)
        self.process.wait()


def crashes(n_labels: int) -> None:
    """Label by two people while the page is killed at random moments."""
    generator, n_impacts = np.random.default_rng(62), 100
    answered: dict[int, list[str]] = {}
    every: list[str] = []
    counts = {"answered": 0, "kills": 0}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.save(folder / "a.npy", ringing(generator.integers(0, 2, n_impacts), 1.0, generator))

        def label(page: Page, mine: np.ndarray, who: str) -> None:
            for k in mine.tolist():
                word = f"{who}{counts['kills']}-{counts['answered']}"
                answered.setdefault(k, []).append(word)
                try:
                    if page.ask("label", {"r": 0, "k": k, "label": word, "by": who, "chosen": "random"})[0] == 200:
                        answered[k] = [word]  # what came before is overwritten
                        counts["answered"] += 1
                        every.append(word)
                except (OSError, http.client.HTTPException):
                    return

        while counts["answered"] < n_labels:
            page = Page(folder, "a.npy", "--rate", str(RATE), "--unit", "g")
            page.wait()
            orders = (generator.permutation(np.arange(odd, n_impacts, 2)) for odd in (0, 1))
            people = [threading.Thread(target=label, args=(page, *one)) for one in zip(orders, "ab", strict=True)]
            for one in people:
                one.start()
            time.sleep(generator.uniform(0.0, 0.8))
            page.end(signal.SIGKILL)
            for one in people:
                one.join()
            counts["kills"] += 1
        page = Page(folder, "a.npy", "--rate", str(RATE), "--unit", "g")
        page.wait()
        found = {one[0]: one[5] for one in page.ask("impacts?r=0")[1]["impacts"]}
        page.end(signal.SIGINT)
        journal = (folder / "labels.csv.journal").read_text(encoding="utf-8")
    gone = sum(f'"label":"{word}"' not in journal for word in every)
    lost = sum(found[k] not in words for k, words in answered.items())
    print(f"{counts['answered']} labels answered, {counts['kills']} kills: {gone} not in the journal")
    print(f"{lost} of {len(answered)} impacts have another label than the last that was answered")


def hour(minutes: float) -> None:
    """Open a long recording of four channels."""
    rate, generator = 51_200, np.random.default_rng(62)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name, "long.wav")
        with wave.open(str(path), "wb") as file:
            file.setnchannels(4), file.setsampwidth(2), file.setframerate(rate)
            time_ = np.arange(round(0.1 * rate)) / rate
            for _ in range(round(minutes * 60)):
                second = 60 * generator.standard_normal((rate, 4), dtype=np.float32)
                first = generator.integers(0, rate - len(time_))
                blow = np.exp(-time_ / 0.01) * np.sin(2 * np.pi * generator.uniform(1200, 2500) * time_)
                second[first : first + len(time_)] += generator.uniform(2000, 9000) * blow[:, None]
                file.writeframes(second.astype("<i2").tobytes())
        page = Page(Path(name), "long.wav", "--full-scale", "50 g")
        listed = page.wait()
        status = Path(f"/proc/{page.process.pid}/status").read_text() if Path("/proc").exists() else ""
        memory = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")]
        times: dict[str, list[float]] = {"view": [], "impact": [], "key": []}
        n = page.ask("state")[1]["recordings"][0]["n"]
        for _ in range(60):
            width = 60 * minutes * 10 ** generator.uniform(-5, 0)
            start = generator.uniform(0, 60 * minutes - width)
            asked = {
                "view": (f"view?r=0&from={start}&to={start + width}&n=1200", None),
                "impact": (f"impact?r=0&k={generator.integers(n)}", None),
                "key": ("label", {"r": 0, "k": int(generator.integers(n)), "label": "coal", "chosen": "random"}),
            }
            for kind, (what, body) in asked.items():
                begun = time.perf_counter()
                assert page.ask(what, body)[0] == 200
                times[kind].append(1e3 * (time.perf_counter() - begun))
        page.end(signal.SIGINT)
    spans = ", ".join(
        f"{kind} {np.median(one):.0f} ms (95 %: {np.quantile(one, 0.95):.0f})" for kind, one in times.items()
    )
    print(f"{minutes:g} min: address after {page.address_after:.1f} s, {n} impacts after {listed:.0f} s")
    print(f"{spans}; {int(memory[0]) >> 10} MB")


def coverage(n_draws: int) -> None:
    """Compare the accuracy that is shown with that on the other impacts of the recording."""
    from cgid.identification.training import train_on_groups
    from cgid.identification.training.manifest import Annotation, Manifest
    from cgid.identification.training.recordings import Reading, labelled, record
    from cgid.identification.training.rows import Slicing

    n_impacts, batch = 600, 10
    held: dict[str, list[tuple[bool, float, float, float]]] = {"random": [], "stretch": []}
    for draw in range(n_draws):
        generator = np.random.default_rng([62, draw])
        truth = np.repeat(generator.permutation(np.arange(n_impacts // batch) % 2), batch)
        with tempfile.TemporaryDirectory() as name:
            path = Path(name, "a.npy")
            np.save(path, ringing(truth, 1.0, generator))
            row = {"path": path, "written": "a.npy", "group": "a"}
            rows = record(
                Manifest(source="a.npy", annotations=(Annotation(**row),)),
                slicing=Slicing(by="impact"),
                reading=Reading(sampling_rate=float(RATE), unit="g"),
            )
        number = np.round((rows.time - 0.32) / 0.4).astype(int)
        names = np.array(["coal", "gangue"])[truth]
        chosen = generator.choice(n_impacts, 60, replace=False)
        batches = [generator.choice(np.flatnonzero(truth[::batch] == label), 3, replace=False) for label in (0, 1)]
        tables = {
            "random": [(0.2 + 0.4 * k, 0.55 + 0.4 * k, names[k], "random") for k in chosen.tolist()],
            "stretch": [
                (0.2 + 0.4 * batch * k, 0.2 + 0.4 * batch * (k + 1), names[batch * k], "stretch")
                for k in np.concatenate(batches).tolist()
            ],
        }
        for kind, table in tables.items():
            spans = [
                Annotation(**row, start=a, end=b, label=str(label), chosen=how) for a, b, label, how in sorted(table)
            ]
            some = labelled(rows, Manifest(source="a.npy", annotations=tuple(spans)))
            training = train_on_groups(some)
            others = ~np.isin(rows.time, some.time)
            model = training.model
            said = np.array(model.labels)[model.probabilities(rows.columns(model.features)).argmax(axis=1)]
            true = float(np.mean(said[others] == names[number[others]]))
            shown = training.metrics.get("drawn", training.metrics)
            low, high = shown["accuracy_interval_95"]
            held[kind].append((low <= true <= high, shown["accuracy"], true, high - low))
    for kind, found in held.items():
        inside, shown_, true_, width = np.array(found, float).T
        print(
            f"{kind}: interval holds {inside.mean():.2f} of {n_draws}; shown {shown_.mean():.3f}, "
            f"true {true_.mean():.3f}, difference {np.std(shown_ - true_):.3f} (std), width {width.mean():.2f}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--crashes", type=int, metavar="LABELS")
    parser.add_argument("--hour", type=float, metavar="MINUTES")
    parser.add_argument("--draws", type=int)
    given = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for value, run in ((given.crashes, crashes), (given.hour, hour), (given.draws, coverage)):
        if value:
            run(value)
