"""Bad recordings, streams, pictures and manifests, as cases of `tests/bad_input.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import wavfile

RATE = 25_600


def ringing(n_samples: int = 12_800) -> np.ndarray:
    """Return a blow in the middle of noise [m/s^2]."""
    times = np.arange(n_samples // 2) / RATE
    samples = np.random.default_rng(0).normal(0, 0.3, n_samples)
    samples[n_samples - times.size :] += 200 * np.exp(-60 * times) * np.sin(2 * np.pi * 900 * times)
    return samples


def make_recordings(folder: Path) -> None:
    """Write faulty recordings, and good ones for wrong uses."""
    blow = ringing()
    np.save(folder / "blow.npy", blow)
    np.save(folder / "sample.npy", np.array([3.0]))
    np.save(folder / "nothing.npy", np.zeros((2, 0)))
    np.save(folder / "limits.npy", np.where(np.random.default_rng(1).random(9000) > 0.5, 500.0, -500.0))
    np.save(folder / "begun.npy", blow[6500:])
    np.save(folder / "names.npy", np.array(["coal", "gangue"]))
    np.save(folder / "cube.npy", np.zeros((3, 4, 5)))
    np.savez(folder / "several.npz", a=blow, b=blow[:500], fs=float(RATE), unit="m/s^2")
    wavfile.write(folder / "blow.wav", RATE, (blow / 300).astype(np.float32))
    sound = (folder / "blow.wav").read_bytes()
    (folder / "copy.wav").write_bytes(sound)
    (folder / "head.wav").write_bytes(sound[: sound.index(b"data") + 8])
    (folder / "half.raw").write_bytes(b"abc")
    (folder / "old.html").write_text("my diary")
    (folder / "broken.raw").write_bytes(np.full(50, np.nan).astype("<f4").tobytes())
    for name, text in _MANIFESTS.items():
        (folder / f"{name}.csv").write_text(text)
    (folder / "long.toml").write_text(f"recording = {'9' * 2000}\n")
    _volts(folder, blow / 300)


def _volts(folder: Path, blow: np.ndarray) -> None:
    """Write recordings of sensors: in volts, in picocoulombs, in both m/s^2 and volts, in counts, as integer sound."""
    above = f"# sampling_rate: {RATE} Hz\n"
    for name, header in (
        ("volts", "beam (V)"),
        ("stated", "# sensitivity: 10.2 mV/g\nbeam (V)"),
        ("impossible", "# sensitivity: 0 mV/g\nbeam (V)"),
        ("gained", "# gain: 10\nbeam (V)"),
        ("charge", "beam (pC)"),
        ("measured", "beam (m/s^2)"),
        ("plain", "beam"),
    ):
        np.savetxt(folder / f"{name}.csv", blow, "%.6f", header=above + header, comments="")
    np.savetxt(folder / "two.csv", np.stack([blow, blow], 1), "%.6f", ",", header=f"{above}a (V),b (N)", comments="")
    wavfile.write(folder / "counts.wav", RATE, (blow * 2**15).astype(np.int16))
    np.save(folder / "unsigned.npy", (blow * 2**15 + 2**15).astype(np.uint16))


_MANIFESTS = {
    "alike": "path,label\nblow.wav,coal\n",
    "bare": "path,label\n",
    "lost": "path,label\ngone.wav,coal\n",
    "day": "path,label,group\nblow.wav,coal,day\nblow.npy,gangue,day\n",
    "colour": "path,label,colour\nblow.wav,coal,black\n",
    "label": "path,label\nblow.wav,\n",
    "script": "path,label\nblow.wav,<script>\n",
    "stranger": "path,label\nblow.wav,unknown\n",
    "interval": "path,label,start_s,end_s\nblow.wav,coal,3,2\n",
    "beyond": "path,label,start_s,end_s\nblow.wav,coal,100,101\n",
    "gain": "path,label,gain\nblow.wav,coal,loud\n",
    "channel": "path,label,channel\nblow.wav,coal,7\n",
    "unsensed": "path,label\nvolts.csv,coal\n",
    "deaf": "path,label,sensitivity\nvolts.csv,coal,10.2 g/mV\n",
    "rates": "path,label,start_s,end_s,rate_Hz,unit\nblow.npy,coal,0,0.1,25600,g\nblow.npy,gangue,0.1,0.2,51200,g\n",
    "turned": "path,label,start_s,end_s,invert\nblow.wav,coal,0,0.1,\nblow.wav,gangue,0.1,0.2,yes\n",
    "copied": "path,label,group\nblow.wav,coal,day\ncopy.wav,gangue,day\n",
    "ranges": "path,label,start_s,end_s,full_scale\ncounts.wav,coal,0,0.1,5 V\ncounts.wav,coal,0.1,0.2,10 V\n",
}
_SAID = ("--rate", "25600", "--unit", "m/s^2")
_RAW = ("--rate", "25600", "--channels", "1", "--sample-format", "f32le", "--unit", "m/s^2")
_SENSED = ("volts.csv", "--sensitivity")
_MODEL_FREE = ("-o", "new.npz")

#: Name, arguments, exit code, and expected text of the line.
RECORDING_CASES: tuple[tuple[str, tuple[str, ...], int, tuple[str, ...]], ...] = (
    ("a single sample", ("predict", "sample.npy", *_SAID), 65, ("sample.npy", "the only sample is 3", "cable")),
    ("channels of no length", ("predict", "nothing.npy", *_SAID), 65, ("nothing.npy", "(2, 0)")),
    ("clipped throughout", ("predict", "limits.npy", *_SAID), 65, ("clipped", "-500 and 500 m/s^2", "larger range")),
    (
        "begun within the blow",
        ("predict", "begun.npy", *_SAID),
        65,
        ("begun.npy", "cut off by its start", "before it"),
    ),
    ("words for numbers", ("predict", "names.npy", *_SAID), 65, ("names.npy", "real numbers", "<U")),
    ("three axes", ("features", "cube.npy", *_SAID), 65, ("cube.npy", "(3, 4, 5)")),
    ("several arrays", ("predict", "several.npz"), 65, ("a (12800), b (500)", "--set variable=NAME")),
    ("unknown array", ("predict", "several.npz", "--set", "variable=c"), 65, ("'c'", "a (12800), b (500)")),
    ("array of a format with one", ("info", "blow.wav", "--set", "variable=a"), 65, ("WAV", "leave out variable")),
    ("unit of a WAV not said", ("predict", "blow.wav"), 2, ("level [FS]", "'500 g'", "--unit N", "--unit m/s^2")),
    ("WAV without sound", ("predict", "head.wav", "--unit", "g"), 65, ("head.wav", "at least one sample")),
    ("unknown channel", ("predict", "blow.npy", *_SAID, "--channel", "2"), 65, ("channel '2'", "--channel")),
    (
        "sampled too slowly for the model",
        ("predict", "blow.npy", "--rate", "1000", "--unit", "m/s^2"),
        65,
        ("blow.npy: the sampling_rate must be at least 2000", "got 1000 Hz", "record faster"),
    ),
    (
        "sampled absurdly slowly",
        ("predict", "blow.npy", "--rate", "1e-5", "--unit", "N"),
        65,
        ("blow.npy: the sampling_rate must be at least 10 Hz", "got 1e-05 Hz", "check it"),
    ),
    (
        "sampled absurdly fast",
        ("predict", "blow.npy", "--rate", "1e12", "--unit", "g"),
        65,
        ("blow.npy: sampling_rate", "2e+07 Hz", "got 1e+12 Hz"),
    ),
    ("vote of impacts", ("predict", "blow.npy", *_SAID, "--set", "vote=1"), 65, ("vote", "left out", "impacts")),
    ("share over no time", ("predict", "blow.npy", *_SAID, "--set", "window=0"), 65, ("window", "0.05 or more", "0 s")),
    ("label that is no gangue", ("predict", "blow.npy", *_SAID, "--set", "gangue=ore"), 65, ("'gangue'", "'ore'")),
    ("report of another ending", ("predict", "blow.npy", *_SAID, "--report", "r.pdf"), 73, ("r.pdf", ".html")),
    ("report exists", ("predict", "blow.npy", *_SAID, "--report", "old.html"), 73, ("old.html", "--overwrite")),
    ("folder of the report", ("predict", "blow.npy", *_SAID, "--report", "no/r.html"), 73, ("no",)),
    ("plot of another ending", ("plot", "blow.npy", *_SAID, "-o", "new.jpg"), 73, (".png or .svg or .pdf", "'.jpg'")),
    ("plot exists", ("plot", "blow.npy", *_SAID, "-o", "old.png"), 73, ("old.png", "--overwrite")),
    ("plot without a name", ("plot", "blow.npy", *_SAID), 2, ("'-o'",)),
    ("plot of the time after the end", ("plot", "blow.npy", *_SAID, "-o", "new.png", "--from", "9"), 65, ("0.5 s",)),
    (
        "plot of less than a sample",
        ("plot", "blow.npy", *_SAID, "-o", "new.png", "--from", "0.1", "--to", "0.10001"),
        65,
        ("--from and --to", "0.1 to 0.10001 s at 25600 Hz", "further apart"),
    ),
    ("plot of an absurd rate", ("plot", "blow.npy", "--rate", "1e12", "-o", "new.png"), 65, ("2e+07 Hz",)),
    ("no stream", ("monitor", "none.raw", *_RAW), 66, ("none.raw", "No such file")),
    ("empty stream", ("monitor", "empty.csv", *_RAW), 65, ("empty.csv", "it is empty")),
    ("stream of less than a sample", ("monitor", "half.raw", *_RAW), 65, ("half.raw", "ended before the first")),
    ("stream of a head only", ("monitor", "head.wav", "--unit", "g"), 65, ("head.wav", "ended before the first")),
    ("stream of no readings", ("monitor", "broken.raw", *_RAW), 65, ("broken.raw", "finite", "sample format")),
    ("stream that is a file", ("monitor", "blow.npy", *_RAW), 65, ("this is an NPY file", "cgid predict")),
    ("stream that is text by its name", ("monitor", "volts.csv", *_RAW), 65, ("volts.csv", "text", "cgid predict")),
    ("stream that is text", ("monitor", "volts.csv"), 65, ("volts.csv", "text", "cgid predict")),
    ("stream of unknown numbers", ("monitor", "half.raw"), 2, ("--sample-format",)),
    ("stream of odd numbers", ("monitor", "half.raw", *_RAW[:5], "s17le"), 65, ("s16le", "'s17le'")),
    ("stream of no channels", ("monitor", "half.raw", "--channels", "0"), 65, ("--channels", "got 0")),
    ("stream of too many", ("monitor", "half.raw", "--channels", "5000"), 65, ("--channels", "at most 4096")),
    ("address of no port", ("monitor", "half.raw", *_RAW, "--modbus", "plc"), 65, ("--modbus", "HOST:PORT", "'plc'")),
    ("port too high", ("monitor", "half.raw", *_RAW, "--prometheus", ":70000"), 65, ("--prometheus", "1 to 65535")),
    ("page of another kind", ("monitor", "half.raw", *_RAW, "--live", "page.pdf"), 65, ("--live", "a file .html")),
    ("page over a file", ("monitor", "half.raw", *_RAW, "--live", "old.html"), 73, ("old.html", "not a live page")),
    ("page in no folder", ("monitor", "half.raw", *_RAW, "--live", "no/p.html"), 73, ("no/p.html",)),
    ("broker of no topic", ("monitor", "half.raw", *_RAW, "--mqtt", "mqtt://here"), 65, ("--mqtt", "'mqtt://here'")),
    ("broker of the web", ("monitor", "half.raw", *_RAW, "--mqtt", "http://a/b"), 65, ("--mqtt", "mqtt://HOST")),
    (
        "topic of a wildcard",
        ("monitor", "half.raw", *_RAW, "--mqtt", "mqtt://a/b/#"),
        65,
        ("without + and #",),
    ),
    ("password for all to read", ("monitor", "half.raw", *_RAW, "--mqtt", "mqtt://a:b@c/d"), 65, ("CGID_MQTT_USER",)),
    (
        "command of nothing",
        ("monitor", "half.raw", *_RAW, "--on-shut", ""),
        65,
        ("--on-shut", "program that can"),
    ),
    ("command of odd quotes", ("monitor", "half.raw", *_RAW, "--on-open", "a 'b"), 65, ("--on-open", "quotes")),
    ("command of nobody", ("monitor", "half.raw", *_RAW, "--on-open", "shut-it"), 65, ("'shut-it'", "full path")),
    ("blind without eyes", ("monitor", "half.raw", *_RAW, "--on-blind", "call-x"), 65, ("--on-blind", "'call-x'")),
    ("clock of a table", ("monitor", "half.raw", *_RAW, "--set", "clock=true"), 2, ("clock", "--json")),
    ("no manifest", ("train", "none.csv", *_MODEL_FREE), 66, ("none.csv", "No such file")),
    ("manifest of nothing", ("train", "bare.csv", *_MODEL_FREE), 65, ("bare.csv", "there is none")),
    ("recordings that are gone", ("train", "lost.csv", *_MODEL_FREE), 65, ("lost.csv", "gone.wav")),
    ("one group only", ("train", "day.csv", "--rate", "25600", "--unit", "FS", *_MODEL_FREE), 65, ("2 groups",)),
    (
        "recording without a label",
        ("train", "label.csv", *_MODEL_FREE),
        65,
        ("label.csv", "some row must have a label"),
    ),
    ("label of a page in a manifest", ("train", "script.csv", *_MODEL_FREE), 65, ("row 2", "letters", "'<script>'")),
    ("label reserved", ("train", "stranger.csv", *_MODEL_FREE), 65, ("row 2", "must not be 'unknown'")),
    ("interval that ends first", ("train", "interval.csv", *_MODEL_FREE), 65, ("row 2", "3 and 2 s")),
    ("interval beyond the end", ("train", "beyond.csv", *_MODEL_FREE), 65, ("beyond.csv", "start must be inside")),
    ("gain that is no number", ("train", "gain.csv", *_MODEL_FREE), 65, ("row 2", "gain", "dB", "'loud'")),
    ("channel that is not there", ("train", "channel.csv", *_MODEL_FREE), 65, ("channel '7'",)),
    ("two manifests that overlap", ("train", "alike.csv", "alike.csv", *_MODEL_FREE), 65, ("must not overlap",)),
    ("sensitivity of another file", ("predict", *_SENSED, "x.wav:1=1 mV/g"), 65, ("name one of the files", "'x.wav'")),
    ("number of too many digits", ("train", "long.toml", *_MODEL_FREE), 65, ("long.toml", "digits")),
    (
        "volts without a sensitivity",
        ("predict", "volts.csv"),
        2,
        ("volts.csv", "voltage [V]", "--set sensitivity='10.2 mV/g'"),
    ),
    ("volts without a sensitivity, measured", ("features", "volts.csv"), 2, ("--set sensitivity='10.2 mV/g'",)),
    ("volts without a sensitivity, live", ("monitor", "half.raw", *_RAW[:-1], "V"), 2, ("half.raw", "--set sens")),
    ("volts without a sensitivity, labelled", ("train", "unsensed.csv", *_MODEL_FREE), 65, ("volts.csv", "--set sens")),
    ("charge without a sensitivity", ("predict", "charge.csv"), 2, ("charge [pC]", "--set sensitivity='3.1 pC/g'")),
    ("charge without a gain", ("predict", *_SENSED, "3.1 pC/g"), 2, ("3.1 pC/g", "--set gain='1 mV/pC'")),
    ("gain of charge without a sensitivity", ("predict", "volts.csv", "--set", "gain=1 mV/pC"), 2, ("'3.1 pC/g'",)),
    ("sensitivity of another dimension", ("predict", *_SENSED, "10.2 g/mV"), 65, ("'10.2 mV/g'", "'10.2 g/mV'")),
    ("sensitivity without a unit", ("predict", *_SENSED, "10.2"), 65, ("'10.2 mV/g'", "got '10.2'")),
    ("sensitivity zero", ("predict", *_SENSED, "0 mV/g"), 65, ("sensitivity must be above 0", "0 mV/g")),
    ("sensitivity negative", ("info", *_SENSED, "-10 mV/g"), 65, ("above 0", "-10 mV/g", "--set", "invert=true")),
    ("sensitivity nan", ("info", *_SENSED, "nan mV/g"), 65, ("sensitivity must be", "'nan mV/g'")),
    ("sensitivity infinite", ("predict", *_SENSED, "1e999 mV/g"), 65, ("sensitivity must be above 0 and finite",)),
    ("sensitivity beyond reason", ("predict", *_SENSED, "1e-99 mV/g"), 65, ("factor between 1e-30 and 1e+30",)),
    ("two sensitivities", ("predict", *_SENSED, "1 mV/g", "--sensitivity", "2 mV/g"), 65, ("1 mV/g and 2 mV/g",)),
    ("two of a channel", ("predict", *_SENSED, "1=1 mV/g", "--sensitivity", "1=2 mV/N"), 65, ("channel 1", "one sens")),
    ("sensitivity of no channel", ("predict", *_SENSED, "7=1 mV/g"), 65, ("channel '7'", "choose one of")),
    ("sensitivity of a nameless channel", ("predict", *_SENSED, "=1 mV/g"), 65, ("before =", "2=VALUE")),
    (
        "sensitivity beside that of the file",
        ("predict", "stated.csv", "--sensitivity", "100 mV/g"),
        65,
        ("agree with the file to 0.1 %", "100 mV/g", "10.2 mV/g"),
    ),
    ("impossible sensitivity in a file", ("predict", "impossible.csv"), 65, ("above 0", "0 mV/g", "in the file")),
    ("gain in a file", ("predict", "gained.csv", "--sensitivity", "10 mV/g"), 2, ("gain (10)", "--set gain=1")),
    (
        "sensitivity of what is measured already",
        ("predict", "measured.csv", "--sensitivity", "10.2 mV/g"),
        65,
        ("in m/s^2 (acceleration)", "leave"),
    ),
    (
        "sensitivity of a channel in newtons",
        ("predict", "two.csv", "--sensitivity", "b=10.2 mV/g"),
        65,
        ("channel b", "in N (force)"),
    ),
    ("sensitivity of no unit", ("predict", "plain.csv", "--sensitivity", "10 mV/g"), 2, ("does not state", "--unit V")),
    ("sensitivity of a sound", ("predict", "counts.wav", "--sensitivity", "1 V/N"), 2, ("--set full_scale='10 V'",)),
    ("voltage sensitivity of a charge", ("predict", "charge.csv", "--sensitivity", "1 mV/g"), 65, ("'3.1 pC/g'",)),
    (
        "gain of charge of a voltage sensor",
        ("predict", *_SENSED, "10 mV/g", "--set", "gain=1 mV/pC"),
        65,
        ("1 mV/pC", "leave the gain out"),
    ),
    ("gain of charge of newtons", ("predict", "measured.csv", "--set", "gain=1 mV/pC"), 65, ("leave it out",)),
    ("gain zero", ("predict", "volts.csv", "--set", "gain=0"), 65, ("gain must be above 0",)),
    ("gain in words", ("predict", "volts.csv", "--set", "gain=loud"), 65, ("dB", "'1 mV/pC'", "'loud'")),
    ("gain nan", ("predict", "volts.csv", "--set", "gain=nan"), 65, ("gain must be a number", "nan")),
    ("gain of too many dB", ("predict", "volts.csv", "--set", "gain=1e6 dB"), 65, ("between -400 and 400 dB",)),
    ("full scale zero", ("predict", "counts.wav", "--full-scale", "0 V"), 65, ("--full-scale must be above 0",)),
    ("full scale of 99 bits", ("predict", "volts.csv", "--full-scale", "10 V at 99 bit"), 65, ("--full-scale", "99")),
    ("full scale in words", ("predict", "counts.wav", "--full-scale", "10 stone"), 65, ("'10 V'", "'10 stone'")),
    ("full scale without a unit", ("predict", "counts.wav", "--full-scale", "10"), 2, ("unit", "full_scale=")),
    ("full scale of floats", ("predict", "volts.csv", "--full-scale", "10 V"), 65, ("leave it out", "10 V at 24 bit")),
    (
        "full scale of unsigned",
        ("predict", "unsigned.npy", *_SAID[:2], "--full-scale", "5 V"),
        65,
        ("signed integers of 16 bit",),
    ),
    (
        "bits of a sound file",
        ("predict", "counts.wav", "--full-scale", "10 V at 16 bit"),
        65,
        ("leave out the bits", "states them"),
    ),
    (
        "full scale of another quantity",
        ("predict", "counts.wav", "--unit", "N", "--full-scale", "10 V"),
        65,
        ("quantity of the samples", "N (force)"),
    ),
    ("sensitivity of a dataset", ("predict", "two.h5", "--sensitivity", "1 V/N"), 65, ("--sensitivity", "two.h5")),
    ("sensitivity of a signal", ("predict", "two.h5", "--set", "index=0", "--set", "gain=2"), 65, ("gain", "two.h5")),
    ("sensitivity of a scene", ("train", "reference", "--set", "gain=2", *_MODEL_FREE), 65, ("gain", "no manifest")),
    ("sensitivity in a manifest", ("train", "deaf.csv", *_MODEL_FREE), 65, ("row 2", "'10.2 g/mV'")),
    ("two rates in a manifest", ("train", "rates.csv", *_MODEL_FREE), 65, ("one rate", "25600.0 and 51200.0")),
    ("half turned over", ("train", "turned.csv", *_MODEL_FREE), 65, ("one invert", "no and yes")),
    ("a copy with another label", ("train", "copied.csv", *_MODEL_FREE), 65, ("must differ", "blow.wav")),
    ("bits in other digits", ("predict", "counts.wav", "--full-scale", "1 V at ٢٤ bit"), 65, ("--full-scale must be",)),
    ("two ranges in a manifest", ("train", "ranges.csv", *_MODEL_FREE), 65, ("one full_scale", "5 V and 10 V")),
    ("hop of nothing", ("train", "day.csv", "--set", "hop=1e-9", *_MODEL_FREE), 65, ("hop", "1e-09 s")),
    ("groups of a scene", ("train", "reference", "--by", "impact", *_MODEL_FREE), 65, ("--by", "no manifest")),
)
