"""Speed of answers for long recordings and live streams: python benchmarks/speed/recordings.py [minutes].

A recording of 4 channels at 51.2 kHz, 16 bit, with some impacts per second in each, is predicted and, for comparison,
only read by the same blocks. Then live streams at 25.6 kHz are monitored, first at full speed, then in real time. Each
runs in a separate process with one thread; memory is its largest resident set.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import wave
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

#: Impacts per second in each channel; a caving window with its bounces has about ten.
IMPACT_RATE = 4.0
#: Sampling rates of the recording and of the streams [Hz].
RECORDING_RATE, STREAM_RATE = 51_200, 25_600
N_CHANNELS = 4
#: Full scale [m/s^2].
FULL_SCALE = 500.0
_ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_READ = "import sys; from cgid.recordings import open_recording\nfor _ in open_recording(sys.argv[1]).blocks(): pass"


def seconds_of(rate: int, n_channels: int, seed: int) -> Iterator[np.ndarray]:
    """Yield seconds of rocks on a beam, (rate, n_channels) int16: ringing modes and noise."""
    rng = np.random.default_rng(seed)
    times = np.arange(int(0.3 * rate)) / rate
    modes = [(180.0, 25.0), (640.0, 60.0), (1900.0, 150.0), (5200.0, 500.0)]
    rings = np.stack([np.exp(-decay * times) * np.sin(2 * np.pi * f * times) for f, decay in modes])
    rest = np.zeros((n_channels, rings.shape[1]))
    while True:
        samples = rng.normal(0.0, 0.5, (n_channels, rate + rings.shape[1]))
        samples[:, : rings.shape[1]] += rest
        ringing = np.zeros_like(samples)
        for channel in range(n_channels):
            for start in rng.integers(0, rate, rng.poisson(IMPACT_RATE)):
                strengths = rng.lognormal(3.0, 0.8, len(modes))
                ringing[channel, start : start + rings.shape[1]] += strengths @ rings
        samples += ringing
        rest = ringing[:, rate:]
        yield np.clip(samples[:, :rate] / FULL_SCALE * 32768, -32768, 32767).astype("<i2").T


@dataclass(frozen=True)
class Run:
    """Cost of a process: wall and processor time [s], largest resident set of a process [MB]; and its output."""

    wall: float
    processor: float
    memory: float
    out: bytes


def timed(arguments: list[str], stdin: int | None = None, environment: dict[str, str] = _ENVIRONMENT) -> Run:
    """Run Python with arguments; return what it cost and printed, or end with the end of its output if it fails."""
    begun = time.perf_counter()
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen([sys.executable, *arguments], stdin=stdin, stdout=out, stderr=out, env=environment)
        _, status, used = os.wait4(process.pid, 0)
        wall = time.perf_counter() - begun
        out.seek(0)
        content = out.read()
    if status:
        raise SystemExit(content.decode()[-2000:])
    return Run(wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, content)


def lines_of(run: Run, kind: str) -> list[dict]:
    rows = (json.loads(line) for line in run.out.splitlines() if line.startswith(b"{"))
    return [row for row in rows if row["kind"] == kind]


def recording(folder: Path, minutes: float) -> None:
    path, duration = folder / "long.wav", round(60 * minutes)
    with wave.open(str(path), "wb") as file:
        file.setnchannels(N_CHANNELS)
        file.setsampwidth(2)
        file.setframerate(RECORDING_RATE)
        for second, _ in zip(seconds_of(RECORDING_RATE, N_CHANNELS, 0), range(duration), strict=False):
            file.writeframes(second.tobytes())
    print(f"recording: {duration} s, {N_CHANNELS} channels, {RECORDING_RATE} Hz, {path.stat().st_size >> 20} MiB")
    arguments = ["-m", "cgid", "predict", str(path), "--full-scale", f"{FULL_SCALE:g} m/s^2", "--json"]
    for name, run in (("read", timed(["-c", _READ, str(path)])), ("predict", timed(arguments))):
        found = f", {len(lines_of(run, 'impact'))} impacts" if name == "predict" else ""
        print(
            f"  {name:8} {run.wall:6.1f} s wall, {run.processor:6.1f} s processor: "
            f"{duration / run.processor:.0f} times real time, {run.memory:.0f} MB{found}"
        )


def stream(folder: Path, n_channels: int, duration: int) -> float:
    """Print the speed of monitoring a stream from a file; return the processor time per second."""
    path = folder / f"{n_channels}.raw"
    with path.open("wb") as file:
        for second, _ in zip(seconds_of(STREAM_RATE, n_channels, 1), range(duration), strict=False):
            file.write(second.tobytes())
    with path.open("rb") as file:
        run = timed(_monitor(n_channels), file.fileno())
    share = (run.processor - _START) / duration
    print(
        f"  {n_channels:4} channels: {share:.3f} of a core, {n_channels / share:5.0f} channels a core, "
        f"{run.memory:.0f} MB, {len(lines_of(run, 'impact'))} impacts"
    )
    return share


def live(folder: Path, n_channels: int, duration: int) -> None:
    content = (folder / f"{n_channels}.raw").read_bytes()
    size = STREAM_RATE * n_channels * 2
    reading, writing = os.pipe()
    if os.fork() == 0:
        os.close(reading)
        begun = time.monotonic()
        step = size // 20 // (2 * n_channels) * 2 * n_channels
        for first in range(0, duration * size, step):
            time.sleep(max(begun + first / size - time.monotonic(), 0.0))
            view = memoryview(content)[first : first + step]
            while view:
                view = view[os.write(writing, view) :]
        os._exit(0)
    os.close(writing)
    run = timed(_monitor(n_channels), reading)
    os.close(reading)
    os.wait()
    late = [one["begin_s"] for one in lines_of(run, "finding") if one["finding"] == "behind"]
    late = f"1 s behind from {late[0]:.1f} s on" if late else "never 1 s behind"
    print(f"  {n_channels:4} channels live for {duration} s: {run.processor / duration:.2f} of a core, {late}")


def _monitor(n_channels: int) -> list[str]:
    how = ["--rate", str(STREAM_RATE), "--channels", str(n_channels), "--sample-format", "s16le"]
    return ["-m", "cgid", "monitor", "-", *how, "--unit", "m/s^2", "--full-scale", str(FULL_SCALE), "--json"]


_START = 0.0


def main() -> None:
    global _START
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording(folder, minutes)
        _START = timed(["-c", "import cgid.cli.main, numpy"]).processor
        print(f"monitor: {STREAM_RATE} Hz, {IMPACT_RATE:g} impacts a second and channel; {_START:.2f} s to start")
        share = 0.0
        for n_channels in (1, 8, 32):
            share = stream(folder, n_channels, 30)
        stream(folder, int(0.7 * 32 / share), 20)
        half = int(0.35 * 32 / share)
        stream(folder, half, 20)
        live(folder, half, 20)


if __name__ == "__main__":
    main()
