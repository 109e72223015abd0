"""Start-up: CPU time of `cgid predict` against `python -c "import numpy"`, and first uses of the impact engine.

    python benchmarks/speed/startup.py [--rounds 15]      # the sample, alternating with numpy, whole processes
    python benchmarks/speed/startup.py --first-use  # seconds of a first and a second process, content of the cache

Each line of the second table is a separate process, from start to exit. The first of each pair begins with an empty
cache of kernels, the second with the cache of the first. "import numpy" is the cost of any such process.
"""

import argparse
import os
import statistics
import tempfile
from pathlib import Path

from benchmarks.speed.recordings import timed

COMMANDS = {
    "python -c 'import numpy'": ["-c", "import numpy"],
    "cgid predict --sample": ["-m", "cgid", "predict", "--sample"],
}
START = """
import numpy as np
from cgid.physics import *
from cgid.physics import STEEL, YANG2018_SPHERES
def impact(loss, n):
    ball = Sphere(material=YANG2018_SPHERES[1], radius=0.025)
    speed = np.linspace(1, 5, n)
    return Impact(sphere=ball, target=HalfSpace(material=STEEL), velocity=speed, stiffness="hertz", dissipation=loss)
"""
USES = {
    "import numpy": "import numpy",
    "closed forms of a million impacts": f"{START}\nimpact(HuntCrossley(restitution=0.5), 1_000_000).peak_force",
    "one pulse": f"{START}\nimpact(HuntCrossley(restitution=0.5), 1).force(np.linspace(0, 1e-3, 1000))",
    "one frame": f"{START}\nimpact(HuntCrossley(restitution=0.5), 1).force_frames(2e5, 2048)",
    "2000 frames, float64": f"{START}\nimpact(HuntCrossley(restitution=0.5), 2000).force_frames(2e5, 2048)",
    "2000 frames, float32": f"{START}\nimpact(HuntCrossley(restitution=0.5), 2000).force_frames(2e5, 2048, "
    'dtype="float32")',
    "2000 viscoelastic frames": f"{START}\nimpact(Viscoelastic(time_constant=5e-6), 2000).force_frames(2e5, 2048)",
    "a viscoelastic pulse": f"{START}\nimpact(Viscoelastic(time_constant=5e-6), 1).force(np.linspace(0, 1e-3, 1000))",
}


def first_uses() -> None:
    """Print the time of each use, and what it leaves in the cache."""
    print("| use | first process [s] | second process [s] |\n|---|---|---|")
    held = {}
    for name, code in USES.items():
        with tempfile.TemporaryDirectory() as cache:
            cached = {**os.environ, "NUMBA_CACHE_DIR": cache}
            first, *others = (timed(["-c", code], environment=cached).wall for _ in range(4))
            files = [path for path in Path(cache).rglob("*") if path.is_file()]
            held[name] = f"{len(files)} files, {sum(path.stat().st_size for path in files) / 1e3:.0f} kB"
        print(f"| {name} | {first:.2f} | {min(others):.2f} |")
    print("\nThe cache afterwards (a file for each compiled kernel):\n")
    for name, text in held.items():
        print(f"* {name}: {text}")


def alternate(rounds: int) -> None:
    times: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for number in range(rounds + 1):
        for name, arguments in COMMANDS.items():
            seconds = timed(arguments, environment=dict(os.environ)).processor
            if number:  # the first round fills the disk cache
                times[name].append(seconds)
    print("| process | median CPU [s] | lowest | highest |\n|---|---|---|---|")
    for name, seconds_list in times.items():
        print(
            f"| `{name}` | {statistics.median(seconds_list):.3f} | {min(seconds_list):.3f} | {max(seconds_list):.3f} |"
        )
    base, predict = (statistics.median(values) for values in times.values())
    print(f"\nratio of the medians: {predict / base:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--first-use", action="store_true", help="first uses of the impact engine instead")
    options = parser.parse_args()
    if options.first_use:
        first_uses()
    else:
        alternate(options.rounds)


if __name__ == "__main__":
    main()
