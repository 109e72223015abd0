"""Response of the readers to flipped bits and truncated files.

    python benchmarks/safety/bit_flips.py  # every bit and every length of a small shard, and more: some minutes
    python benchmarks/safety/bit_flips.py --bits 300 --lengths 100 --large-bits 100

Every damaged file is read to its end: a single shard, a shard of 1 MB, and a shard, the description and the sums in a
folder. The outcomes are

    refused   with a one-line error message
    same      all numbers, labels and attributes are unchanged: the flipped bit has no meaning
    CHANGED   other content without a message          ERROR, CRASH, HANG   no answer

Only the first two are allowed. `cgid verify` must also find all damage in a folder, which has the SHA-256 of its files.
A separate process reads the files, so that crashes and hangs are counted.
"""

from __future__ import annotations

import argparse
import os
import random
import select
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from cgid.errors import BadData, NoInput
from cgid.scene import generate, parse_scene
from cgid.store import Dataset
from cgid.store.verification import verify

#: Time limit of an answer [s].
TIME_LIMIT = 20.0
OUTCOMES = ("same", "refused", "CHANGED", "ERROR", "CRASH", "HANG")
#: Allowed outcomes of a damaged file.
SOUND = frozenset(("same", "refused"))

Damage = Callable[[bytes], bytes]


def flipped(content: bytes, bit: int) -> bytes:
    damaged = bytearray(content)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


def some(numbers: int, wanted: int | None, seed: int = 2018) -> Iterable[int]:
    if wanted is None or wanted >= numbers:
        return range(numbers)
    return sorted(random.Random(seed).sample(range(numbers), wanted))


def flips(file: Path, wanted: int | None = None) -> list[Damage]:
    return [partial(flipped, bit=bit) for bit in some(8 * file.stat().st_size, wanted)]


def cuts(file: Path, wanted: int | None = None) -> list[Damage]:
    return [itemgetter(slice(length)) for length in some(file.stat().st_size, wanted)]


def small_scene(samples: int = 16) -> Any:
    rock = {"youngs_modulus": 3e9, "poisson_ratio": 0.3, "restitution": 0.5, "drop_height": 1, "radius": 0.02}
    return parse_scene(
        {
            "name": "small",
            "impact": {"stiffness": "hertz", "dissipation": "hunt-crossley", "target": "rigid"},
            "sampling": {"sampling_rate": 1e5, "samples": samples, "pre_trigger": 4},
            "populations": [{**rock, "label": "coal", "density": 1400}, {**rock, "label": "gangue", "density": 2400}],
        }
    )


def everything_in(path: Path) -> dict[str, Any]:
    dataset = Dataset(path)
    batches = list(dataset.batches())
    found = {name: np.concatenate([getattr(b, name) for b in batches]) for name in ("signals", "labels", "specimen")}
    for name in dataset.header.parameter_units:
        found[f"parameters/{name}"] = np.concatenate([batch.parameters[name] for batch in batches])
    about = (dataset.sampling_rate, dataset.unit, dataset.pre_trigger, dict(dataset.header.parameter_units))
    return found | {"about": about, "attributes": dict(dataset.header.attributes)}


def is_same(found: dict[str, Any], expected: dict[str, Any]) -> bool:
    if found.keys() != expected.keys():
        return False
    for name, value in expected.items():
        other = found[name]
        if isinstance(value, np.ndarray):
            if value.dtype != other.dtype or value.shape != other.shape or value.tobytes() != other.tobytes():
                return False
        elif value != other:
            return False
    return True


def judge(target: Path, read: Callable[[], dict[str, Any]], damages: Sequence[Damage]) -> Counter[str]:
    """Count the outcomes of damage to `target`, which `read` reads directly or as part of a folder.

    The file is restored at the end.
    """
    whole, expected = target.read_bytes(), read()
    try:
        outcomes: Counter[str] = Counter()
        done = 0
        while done < len(damages):
            for outcome in _outcomes(target, whole, read, expected, damages[done:]):
                outcomes[outcome] += 1
                done += 1
        return outcomes
    finally:
        target.write_bytes(whole)


def _outcomes(
    target: Path, whole: bytes, read: Callable[[], dict[str, Any]], expected: dict[str, Any], damages: Sequence[Damage]
) -> Iterator[str]:
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.close(reading)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # hides HDF5's own messages
        for damage in damages:
            target.write_bytes(damage(whole))
            os.write(writing, bytes([OUTCOMES.index(_outcome(read, expected))]))
        os._exit(0)
    os.close(writing)
    try:
        for _ in damages:
            if not select.select([reading], [], [], TIME_LIMIT)[0]:
                yield "HANG"
                return
            told = os.read(reading, 1)
            yield OUTCOMES[told[0]] if told else "CRASH"
            if not told:
                return
    finally:
        os.close(reading)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _outcome(read: Callable[[], dict[str, Any]], expected: dict[str, Any]) -> str:
    try:
        return "same" if is_same(read(), expected) else "CHANGED"
    except (BadData, NoInput):
        return "refused"
    except BaseException:
        return "ERROR"


def verified(path: Path) -> dict[str, Any]:
    damage = verify(path).damage
    if damage:
        raise BadData(damage[0].what)
    return {}


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A file to damage and to read.

    file : the file to damage
    read : returns the content that readers receive, or raises
    sound : allowed outcomes
    """

    name: str
    file: Path
    read: Callable[[], dict[str, Any]]
    damages: list[Damage]
    sound: frozenset[str] = SOUND


def subjects(
    folder: Path, bits: int | None, lengths: int | None, large_bits: int, verified_bits: int
) -> Iterator[Subject]:
    """Make the subjects in an empty folder and yield them; None stands for every bit and every length."""
    small = generate(small_scene(), folder / "small.h5", 8)
    damages = [*flips(small, bits), *cuts(small, lengths)]
    yield Subject(name="small shard", file=small, read=lambda: everything_in(small), damages=damages)
    large = generate(small_scene(2048), folder / "large.h5", 128)
    yield Subject(name="shard of 1 MB", file=large, read=lambda: everything_in(large), damages=flips(large, large_bits))
    whole = generate(small_scene(), folder / "folder", 16, shard_signals=8)
    shard = whole / "shard-00001.h5"
    found = frozenset(("refused",))
    damages = [*flips(shard, verified_bits), *cuts(shard, verified_bits)]
    yield Subject(name="shard, by verify", file=shard, read=lambda: verified(whole), damages=damages, sound=found)
    for name in ("description.json", "SHA256SUMS"):
        damages = [*flips(whole / name, bits), *cuts(whole / name, lengths)]
        yield Subject(name=name, file=whole / name, read=lambda: everything_in(whole), damages=damages)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--bits", type=int, help="of small files; all by default")
    parser.add_argument("--lengths", type=int, help="of small files; all by default")
    parser.add_argument("--large-bits", type=int, default=2000)
    parser.add_argument("--verified-bits", type=int, default=5000)
    sizes = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        for subject in subjects(Path(folder), sizes.bits, sizes.lengths, sizes.large_bits, sizes.verified_bits):
            size = subject.file.stat().st_size
            outcomes = judge(subject.file, subject.read, subject.damages)
            failed += sum(count for name, count in outcomes.items() if name not in subject.sound)
            told = ", ".join(f"{name} {outcomes[name]}" for name in OUTCOMES if outcomes[name])
            print(f"{subject.name:<17}{size:>9} bytes, {outcomes.total():>6} damages: {told}")
    print(f"silent changes, errors, crashes, hangs: {failed}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
