"""Recorders of other rates: what `cgid predict` says of the same rocks on the same beam.

The scene `caving` at each rate, with the anti-alias filter at the same share of it and the same modes. Rates within one
in 10,000 are stated of the recording of 25.6 kHz. Right is of all impacts of which the truth knows one within 2 ms.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from cgid.scene import load_scene
from cgid.scene.output.recordings import generate_recordings
from cgid.scene.synthesis import impacts, plan, through_beam
from cgid.store.reading import Recording

OWN = 25_600.0
TEXT = (Path(__file__).parents[2] / "datasets" / "caving.toml").read_text()


def recorded(
    rate: float, n: int, seed: int, limit: str, folder: Path, seconds: float = 60.0, *, hum: bool = True
) -> list[Path]:
    """Make recordings at a rate [Hz] up to a limit, with the modes that the scene has at its own."""
    text = re.sub('"25.6 kHz"', f'"{rate!r} Hz"', TEXT)
    text = text.replace('"10 kHz", order', f'"{10_000 * rate / OWN!r} Hz", order')
    text = text.replace('"500 g"', f'"{limit}"').replace('duration = "60 s"', f'duration = "{seconds} s"')
    text = text if hum else re.sub(r"(?ms)^hum = \[.*?^\]$", "", text)
    scene = folder / f"{rate:g}-{hum}.toml"
    scene.write_text(text)
    highest = plan.highest_frequency(load_scene("caving"))
    for module in (impacts, plan, through_beam):
        module.highest_frequency = lambda _: highest
    out = scene.with_suffix("")
    generate_recordings(scene, out, n, seed)
    return sorted(out.glob("*.h5"))


def judged(paths: list[Path], ratio: float = 1.0) -> tuple[float, float, str]:
    """Return what is right and what unknown of all, and when each recording says SHUT [s]."""
    right = unknown = n = 0
    shut = []
    for path in paths:
        stated = [] if ratio == 1 else ["--rate", repr(OWN * ratio)]
        command = [sys.executable, "-m", "cgid", "predict", str(path), "--json", *stated]
        lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
        rows = [json.loads(line) for line in lines]
        found = [row for row in rows if row["kind"] == "impact"]
        truth = Recording(path).impacts()
        times = np.array([row["time_s"] for row in found]) * ratio
        at = np.abs(times[:, None] - truth["time"]).argmin(axis=1)
        known = np.abs(times - truth["time"][at]) < 2e-3
        labels = np.array([row["label"] for row in found])
        right += int((labels == truth["label"][at])[known].sum())
        unknown += int((labels == "unknown")[known].sum())
        n += int(known.sum())
        shut.append(next((f"{ratio * row['time_s']:.0f}" for row in rows if row["kind"] == "shut"), "never"))
    return right / n, unknown / n, " ".join(shut)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=4, help="recordings of a minute")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--range", default="500 g", help="of the recorder")
    parser.add_argument("--rates", type=float, nargs="+", default=[25_600, 51_200, 48_000, 40_000, 32_000, 20_000])
    parser.add_argument("--off", type=float, nargs="+", default=[3e-5, 9e-5], help="errors of the clock")
    given = parser.parse_args()
    print("| sampling rate | right | unknown | SHUT [s] |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for rate in given.rates:
            paths = recorded(float(rate), given.n, given.seed, given.range, Path(folder))
            of_rate = [(f"{rate / 1e3:g} kHz", 1.0)]
            if rate == OWN:
                of_rate += [(f"{rate / 1e3:g} kHz, stated {off:g} faster", 1 + off) for off in given.off]
            for name, ratio in of_rate:
                right, unknown, shut = judged(paths, ratio)
                print(f"| {name} | {right:.3f} | {unknown:.3f} | {shut} |", flush=True)


if __name__ == "__main__":
    main()
