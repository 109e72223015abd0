"""The recording formats: one file of each, written by the format's own library; one measurement per column.

    python benchmarks/speed/formats.py

read to   largest difference from the written numbers     rate, unit   found in the file (otherwise the option needed)
streamed  growth of peak memory / growth of the file's samples in memory, from a tenth to the whole of it
cut       files cut off at 40 places: refused / warned / read silently      flipped   the same for 40 flipped bits
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

from benchmarks.safety.fuzz_recordings import RATE, Read, judge, read
from benchmarks.speed.recordings import timed
from cgid.errors import CgidError
from cgid.recordings import open_recording

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.recording_files import SPECIMENS, UNIT, Specimen, blows

TITLES = ("format", "written by", "read to", "rate", "unit", "streamed", "cut", "flipped")
#: Number of damaged files of each kind.
DAMAGED = 40


def row_of(specimen: Specimen, folder: Path, n_samples: int) -> tuple[str, ...]:
    path = folder / f"whole{specimen.suffix}"
    samples = blows(20_000)
    specimen.write(path, samples, RATE)
    expected = read(path, specimen.options)
    written = samples[: len(expected.samples)]
    is_whole = expected.samples.shape == written.shape and not expected.warnings
    error = np.abs(expected.samples - written).max() if is_whole else np.inf
    rate = open_recording(path, **specimen.options).sampling_rate
    assert abs(rate - RATE) < 1e-6 * RATE
    unit_option = "`--full-scale`" if "full_scale" in specimen.options else "`--unit`"
    return (
        specimen.name,
        specimen.writer,
        f"{error:.0e}" if error else "exact",
        "found" if _stated(path, specimen, "sampling_rate") else "`--rate`",
        "found" if _stated(path, specimen, "unit") else unit_option,
        f"{growth(specimen, folder, n_samples):.2f}",
        *damaged(path, specimen, expected),
    )


def _stated(path: Path, specimen: Specimen, name: str) -> bool:
    options = {key: value for key, value in specimen.options.items() if key != name}
    try:
        recording = open_recording(path, **options)
    except CgidError:
        return False
    return name == "sampling_rate" or all(channel.unit == UNIT for channel in recording.channels)


def growth(specimen: Specimen, folder: Path, n_samples: int) -> float:
    """Return the growth of peak memory per additional byte of samples (as float64) in a file."""
    peaks = []
    for count in (n_samples // 10, n_samples):
        path = folder / f"long{specimen.suffix}"
        specimen.write(path, np.tile(blows(20_000), count // 20_000), RATE)
        peaks.append(_peak(path, specimen))
        path.unlink()
    return (peaks[1] - peaks[0]) / (2 * 8 * (n_samples - n_samples // 10))


def _peak(path: Path, specimen: Specimen) -> int:
    program = (
        "import sys, ast, re; from cgid.recordings import open_recording\n"
        "for block in open_recording(sys.argv[1], **ast.literal_eval(sys.argv[2])).blocks(): pass\n"
        # The maximum of the resident set would start from the parent's.
        "print(re.search(r'VmHWM:\\s*(\\d+)', open('/proc/self/status').read())[1])"
    )
    run = timed(["-W", "ignore", "-c", program, str(path), repr(specimen.options)])
    return int(run.out.splitlines()[-1]) << 10


def damaged(path: Path, specimen: Specimen, expected: Read) -> tuple[str, str]:
    """Count the outcomes of truncated files, and of files with one flipped bit: refused / warned / read silently."""
    content, broken = path.read_bytes(), path.with_stem("broken")
    places = np.linspace(0, len(content) - 1, DAMAGED).astype(int).tolist()
    tallies = []
    for is_cut in (True, False):
        tally: Counter[str] = Counter()
        for place in places:
            mutant = bytearray(content[:place] if is_cut else content)
            if not is_cut:
                mutant[place] ^= 1 << place % 8
            broken.write_bytes(mutant)
            tally[judge(broken, specimen, expected).name] += 1
        silent = DAMAGED - tally["refused"] - tally["warned"] - tally["same"]
        tallies.append(f"{tally['refused']} / {tally['warned']} / {silent}")
    return tallies[0], tallies[1]


def table(titles: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in (titles, ("---",) * len(titles), *rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=2_000_000, help="a channel, of the files that show the memory")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        possible = [specimen for specimen in SPECIMENS if specimen.is_possible]
        print(table(TITLES, [row_of(specimen, Path(folder), arguments.samples) for specimen in possible]))


if __name__ == "__main__":
    main()
