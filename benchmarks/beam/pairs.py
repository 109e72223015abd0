"""Two impacts at once, on the model's beam and on foreign ones: how many are marked, and how many single impacts are.

    python benchmarks/beam/pairs.py                     # every beam, at noise of 1 and 5 %
    python benchmarks/beam/pairs.py --beams home -n 50  # one beam, fewer impacts

Rocks of `tail_beam` fall on beams of finite elements, one every quarter of a second or two 0 to 40 ms apart, and become
a stream with white noise, whose standard deviation is a share of the median peak of single impacts. "home" is the beam
that the package computes; "near" has a hundredth of its shear and rotary inertia, so that its upper modes are some
percent off; "foreign" has ribs that stand where they are, and hardly a mode in common. Nothing of `cgid` makes the
signals, and nothing was settled with these seeds.

An answer is marked if it is unknown or overlapping, and sure if it is not and says .8 or more. A pair is marked if all
of its answers are, and heard if the detector hears its fainter rock by itself. An answer is right if its label is that
of the larger of the forces within 4 ms. Corners, faces and rocks that break (forces of `rock_pulses`) touch a beam that
does not give.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from benchmarks.beam.independent_beam import (
    PRE_TRIGGER,
    RATE,
    SENSOR,
    VARIANTS,
    Rocks,
    damping_ratios,
    digitised,
    generate,
    laplace_points,
    modes_for,
    rocks,
    sampled,
    spectra,
    transfer,
)
from benchmarks.beam.independent_contact import Contact
from benchmarks.impact.rock_pulses import contact_of, stepped
from cgid import load_model
from cgid.identification.detection.detector import ImpactDetector
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import Answer
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.stream import identify_blocks

Floats = NDArray[np.float64]
SEED = 604_501
BEAMS = {"home": "0.001 mindlin", "near": "0.01 mindlin", "foreign": "plain"}
#: Delays of the second impact [s].
BANDS = (0.0, 0.3e-3, 1e-3, 3e-3, 10e-3, 40e-3)
PAIRS = tuple(f"{1e3 * low:g} to {1e3 * high:g} ms apart" for low, high in pairwise(BANDS))
CONTACTS = {"corners": "cone", "faces": "face", "breaking rock": "fragmentation"}
#: Single impacts over pairs of a band, and the confidence from which an answer is sure.
SINGLES, SURE = 10, 0.8
#: Time from one impact or pair to the next, the part of a frame that is faded out, how far before and after its onsets
#: the answers of an impact may begin, and how near the larger force is sought [s].
APART, FADE, BEFORE, AFTER, NEAR = 0.25, 20e-3, 6e-3, 15e-3, 4e-3
#: Samples of a force over those of the recorder.
_FINE = 64


def other_contacts(law: str, rock: Rocks, variant: str, seed: int) -> Floats:
    """Return the accelerations (n, n_samples) of contacts of `rock_pulses`, which the beam's give does not change."""
    chosen, rng = VARIANTS[variant], np.random.default_rng([seed, 5])
    modes = modes_for(chosen)
    omega, damping = 2 * np.pi * modes.frequency, damping_ratios(modes.frequency, chosen.damping)
    depth = (rock.mass * rock.speed**2 / rock.stiffness) ** 0.4
    number, softness = rng.random((len(depth), 7)), depth / rock.radius
    _, _, curves = stepped(law, number, rock.restitution, softness)
    step = 0.004 * contact_of(law, number, rock.restitution, softness)[1] * depth / rock.speed
    contacts = []
    for curve, own, force in zip(curves, step, rock.mass * rock.speed**2 / depth, strict=True):
        fine = np.arange(0, own * curve.size, 1 / (_FINE * RATE))
        contacts.append(Contact(force * np.interp(fine, own * np.arange(curve.size), curve), 1 / (_FINE * RATE), 0, 0))
    s, onset = laplace_points(), (PRE_TRIGGER + rng.random(len(depth))) / RATE
    table = transfer(s, omega, damping, modes.shape(*SENSOR)[0], np.zeros((0, omega.size)), ())
    parts = np.array_split(np.arange(len(depth)), max(len(depth) // 64, 1))
    found = [
        sampled(
            spectra([contacts[k] for k in part], onset[part], s) * (modes.shape(rock.x[part], rock.y[part]) @ table), s
        )
        for part in parts
    ]
    return np.concatenate(found)


@dataclass(frozen=True)
class Fall:
    """One impact or a pair: its kind, the onsets [s], labels, and peaks of the forces [N] of its rocks."""

    kind: str
    time: Floats
    label: NDArray[np.str_]
    peak: Floats


@dataclass(frozen=True)
class Stream:
    """Samples without noise, those of the fainter rocks of pairs alone, what fell, and the median peak of singles."""

    clean: Floats
    fainter: Floats
    falls: list[Fall]
    level: float

    @classmethod
    def of(cls, variant: str, n: int, seed: int) -> Stream:
        """Make a stream of n pairs of each band, n impacts of each other contact, and `SINGLES` n of spheres."""
        rng = np.random.default_rng([seed, 8])
        kinds = rng.permutation([kind for kind in (*["single"] * SINGLES, *CONTACTS, *PAIRS) for _ in range(n)])
        made = generate((SINGLES + 2 * len(PAIRS)) * n, seed, variant, noise=0.0)
        names = ("acceleration", "onset", "labels", "peak_force")
        parts = {"single": iter(zip(*(made[name] for name in names), strict=True))}
        given = rocks(len(CONTACTS) * n, np.random.default_rng([seed, 6]))
        for k, (kind, law) in enumerate(CONTACTS.items()):
            rock = Rocks(*(part[k * n : (k + 1) * n] for part in given))
            parts[kind] = iter([
                (frame, PRE_TRIGGER / RATE, label, np.nan)
                for frame, label in zip(other_contacts(law, rock, variant, seed + k), rock.labels, strict=True)
            ])  # fmt: skip
        fade = round(FADE * RATE)
        bell = np.cos(np.linspace(0, np.pi / 2, fade)) ** 2
        streams = np.zeros((2, round((kinds.size + 8) * APART * RATE)))
        falls, peaks = [], []
        for number, kind in enumerate(kinds.tolist()):
            begin = [round((4 + number + rng.uniform(0, 0.3)) * APART * RATE)]
            if kind in PAIRS:
                begin.append(begin[0] + round(rng.uniform(*BANDS[PAIRS.index(kind) :][:2]) * RATE))
            own = [next(parts[kind if kind in CONTACTS else "single"]) for _ in begin]
            fainter = int(np.argmin([np.square(frame).sum() for frame, *_ in own])) if kind in PAIRS else None
            for k, (at, (frame, *_)) in enumerate(zip(begin, own, strict=True)):
                faded = np.append(frame[:-fade], frame[-fade:] * bell)
                streams[: 1 + (k == fainter), at : at + faded.size] += faded
            _, touch, label, peak = zip(*own, strict=True)
            falls.append(Fall(kind, np.array(begin) / RATE + touch, np.array(label), np.array(peak)))
            if kind == "single":
                peaks.append(np.abs(own[0][0]).max())
        return cls(streams[0], streams[1], falls, float(np.median(peaks)))

    def recorded(self, noise: float, seed: int) -> tuple[Floats, Floats]:
        """Return what the recorder gives of all and of the fainter rocks, with white noise, a share of the level."""
        white = np.random.default_rng([seed, 9]).normal(0, noise * self.level, self.clean.size)
        return digitised(self.clean + white), digitised(self.fainter + white)

    def near(self, time: Floats) -> list[slice]:
        """Return which of some times, in order, are near the onsets of each fall."""
        low = np.searchsorted(time, [fall.time.min() - BEFORE for fall in self.falls])
        high = np.searchsorted(time, [fall.time.max() + AFTER for fall in self.falls])
        return [slice(one, other) for one, other in zip(low.tolist(), high.tolist(), strict=True)]


@dataclass(frozen=True)
class Judged:
    """The answers for each fall, whether its fainter rock is heard by itself, and processor time of an answer [s]."""

    answers: list[list[Answer]]
    heard: list[bool]
    spent: float

    @classmethod
    def of(cls, model: StoredModel, stream: Stream, noise: float, seed: int) -> Judged:
        """Answer for a stream."""
        samples, fainter = stream.recorded(noise, seed)
        detector = ImpactDetector(RATE, kind="vibration")
        events = [*detector.feed(fainter[None]), *detector.finish()]
        clock = time.process_time()
        steps = identify_blocks([samples[None]], RATE, model, ("1",), PredictionSettings())
        answers = [answer for step in steps for answer in step.answers]
        spent = (time.process_time() - clock) / max(len(answers), 1)
        found = [answers[own] for own in stream.near(np.array([answer.time for answer in answers]))]
        heard = [own.stop > own.start for own in stream.near(np.array([event.time for event in events]))]
        return cls(found, heard, spent)


def is_marked(answer: Answer) -> bool:
    return answer.overlapping or answer.label == "unknown"


def is_right(answer: Answer, fall: Fall) -> bool:
    near = np.abs(fall.time - answer.time)
    among = np.flatnonzero(near <= max(NEAR, near.min()))
    return bool(answer.label == fall.label[among[np.argmax(fall.peak[among])]])


def row(kinds: Sequence[str], stream: Stream, judged: Judged) -> str:
    """Return the cells of a line: number, and shares of those with an answer."""
    own = [one for one in zip(stream.falls, judged.answers, judged.heard, strict=True) if one[0].kind in kinds]
    answered = [(fall, some, heard) for fall, some, heard in own if some]
    marked = np.array([all(map(is_marked, some)) for _, some, _ in answered])
    others = [(fall, one) for fall, some, _ in answered for one in some if not is_marked(one)]
    confidence = [max(one.probabilities.values()) for _, one in others]
    sure = [
        any(not is_marked(one) and max(one.probabilities.values()) >= SURE for one in some) for _, some, _ in answered
    ]
    shares = [
        np.mean(marked),
        np.mean(marked[[heard for _, _, heard in answered]]) if kinds[0] in PAIRS else np.nan,
        np.mean([any(one.overlapping for one in some) for _, some, _ in answered]),
        np.mean(sure),
        np.mean([is_right(one, fall) for fall, one in others]) if others else np.nan,
        np.mean(confidence) if others else np.nan,
    ]
    return " | ".join([str(len(own)), *("-" if np.isnan(share) else f"{share:.3f}" for share in shares)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", default="default-acceleration")
    parser.add_argument("-n", "--pairs", type=int, default=150, help="pairs of each band, on each beam")
    parser.add_argument("--beams", nargs="+", choices=BEAMS, default=list(BEAMS))
    parser.add_argument("--noise", type=float, nargs="+", default=[1.0, 5.0], help="[%%] of the median peak")
    parser.add_argument("--seed", type=int, default=SEED)
    given = parser.parse_args()
    model = load_model(given.model)
    print(
        "| beam, noise | impacts | number | marked | fainter heard: marked | overlapping | sure | right of others | "
        "mean confidence | ms |\n|---|---|---|---|---|---|---|---|---|---|"
    )
    for number, beam in enumerate(given.beams):
        stream = Stream.of(BEAMS[beam], given.pairs, given.seed + number)
        for noise in given.noise:
            judged = Judged.of(model, stream, noise / 100, given.seed + number)
            rows = [(kind, [kind]) for kind in ("single", *CONTACTS, *PAIRS)]
            for name, kinds in [*rows, ("0.3 to 3 ms apart", list(PAIRS[1:3]))]:
                cells = f"{beam}, {noise:g} % | {name} | {row(kinds, stream, judged)} | {1e3 * judged.spent:.1f}"
                print(f"| {cells} |", flush=True)


if __name__ == "__main__":
    main()
