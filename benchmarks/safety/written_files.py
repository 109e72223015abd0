"""Files of every format, as the format's own library writes them, read back: channels, unit, rate, peaks.

    python benchmarks/safety/written_files.py            # a file of each format at each rate; below a minute
    python benchmarks/safety/written_files.py --rates 250 48000

A row is wrong if the reader gives another number of channels, another unit or rate than what was written, or a sample
that is off by more than the resolution of the format. Some libraries refuse some rates.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from cgid.recordings import open_recording

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.recording_files import SPECIMENS, UNIT, Specimen, blows

RATES = (250.0, 2_560.0, 51_200.0, 2e6)
N_SAMPLES = 3_000
#: Above it the encoder of Vorbis crashes [Hz].
HIGHEST_OF_VORBIS = 192e3
#: Largest relative error of a rate that a file states by rounded digits.
RATE_ERROR = 1e-5


def told(specimen: Specimen, path: Path, rate: float) -> tuple[list[str], bool]:
    """Return the cells of a row, and whether they are what was written."""
    samples = blows(N_SAMPLES, rate)
    specimen.write(path, samples, rate)
    options: dict[str, Any] = {**specimen.options}
    if "sampling_rate" in options:
        options["sampling_rate"] = rate
    recording = open_recording(path, **options)
    found = np.concatenate(list(recording.blocks()), axis=1)
    units, peaks = [str(one.unit) for one in recording.channels], np.abs(found).max(axis=1)
    # A dataset of cgid holds one channel.
    samples = samples[:1] if specimen.name == "HDF5 of cgid" else samples
    off = np.abs(found - samples).max() if found.shape == samples.shape else np.inf
    is_right = units == [UNIT] * len(samples) and abs(recording.sampling_rate / rate - 1) < RATE_ERROR
    cells = [
        f"{len(units)}",
        "+".join(units),
        f"{recording.sampling_rate:.9g}",
        " ".join(f"{one:.4f}" for one in peaks),
    ]
    return [*cells, f"{off:.1e}"], bool(is_right and off <= specimen.resolution + 1e-12)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=RATES)
    rates, n_files, wrong = parser.parse_args().rates, 0, 0
    print("| format | written at [Hz] | channels | unit | rate [Hz] | peaks | largest error | |")
    print(f"|{'---|' * 8}")
    with tempfile.TemporaryDirectory() as folder:
        for specimen in (one for one in SPECIMENS if one.is_possible):
            for rate in rates:
                if specimen.name == "OGG" and rate > HIGHEST_OF_VORBIS:
                    continue
                path = Path(folder) / f"{n_files}{specimen.suffix}"
                try:
                    cells, is_right = told(specimen, path, rate)
                except Exception as error:
                    if path.exists() and path.stat().st_size and not isinstance(error, RuntimeError):
                        raise
                    print(f"| {specimen.name} | {rate:g} | | | | | | the library cannot write it |")
                    continue
                n_files, wrong = n_files + 1, wrong + (not is_right)
                print(
                    f"| {specimen.name} | {rate:g} | {' | '.join(cells)} | {'' if is_right else 'WRONG'} |", flush=True
                )
    print(f"\n{n_files} files, {wrong} read wrongly")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
