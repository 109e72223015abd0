"""The pulse fit: processor time and accuracy, of this checkout and of others side by side.

    python benchmarks/impact/pulse_fit.py [FOLDER ...] [--rounds 5]

A folder is another checkout, measured by the same Python and libraries, in turn with this one. Pulses of the
damped-Hertz family, restitution .2 to .9, are fitted in white noise: 60 samples of contact, 600 ("long"), or 60 whose
upper half the sensor cuts off ("clipped"). Times are the least of all rounds, for 2048 signals at once and for 6. The
error is the root mean square of ln(fitted / true restitution). Prints Markdown.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parents[2]
FEW = 6
_FIT = """
import json, time
import numpy as np
from cgid.measure.fit import family
from cgid.measure.features.pulses import PulseBatch

N, FEW = 2048, 6
CASES = [("0.5 % noise", 60, 0.005), ("1 % noise", 60, 0.01), ("3 % noise", 60, 0.03), ("10 % noise", 60, 0.1)]
CASES += [("1 % noise, long", 600, 0.01), ("3 % noise, long", 600, 0.03), ("1 % noise, clipped", 60, 0.01)]
CASES += [("3 % noise, clipped", 60, 0.03)]

def fit_time(samples, before):
    batch = PulseBatch(samples, 2e5, before)
    batch.noise, batch.clip_level
    start = time.process_time()
    fit = batch.fit
    return time.process_time() - start, fit

found = {}
for name, contact, noise in CASES:
    rng = np.random.default_rng(7)
    e = np.exp(rng.uniform(np.log(0.2), np.log(0.9), N))
    lasts, peak_time, _ = family.times(e)
    before, after = max(64, contact // 2), 2 * contact
    times = np.arange(before + contact + after) - before - rng.uniform(size=N)[:, None]
    top = family.force(peak_time[:, None], e)
    samples = family.force(times * lasts[:, None] / contact, e) / top + noise * rng.normal(size=times.shape)
    if "clipped" in name:
        samples = np.minimum(samples, 0.5)
    fit_time(samples[:FEW], before)
    own, fit = fit_time(samples, before)
    few = min(fit_time(samples[:FEW], before)[0] for _ in range(20))
    error = np.log(np.maximum(fit.restitution, 1e-3) / e)
    found[name] = [own / N * 1e6, few / FEW * 1e6, float(np.sqrt(np.mean(error**2)))]
print(json.dumps(found))
"""


def run(checkout: Path) -> dict[str, list[float]]:
    """Return the time of a signal among many and among few [us], and the error, of every case."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    printed = subprocess.run([sys.executable, "-c", _FIT], cwd=checkout, env=environment, stdout=-1, check=True).stdout
    return dict(json.loads(printed))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    checkouts = [*(folder.resolve() for folder in options.folders), HERE]
    rounds = [[run(checkout) for checkout in checkouts] for _ in range(options.rounds)]
    columns = ("us of 2048", f"us of {FEW}", "rms of ln e")
    print("| | " + " | ".join(f"{one.name}: {column}" for column in columns for one in checkouts) + " |")
    print("|---" * (1 + len(columns) * len(checkouts)) + "|")
    for name in rounds[0][0]:
        least = [[min(part[k][name][column] for part in rounds) for k in range(len(checkouts))] for column in range(3)]
        cells = [f"{one:.0f}" for one in (*least[0], *least[1])] + [f"{one:.4f}" for one in least[2]]
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
