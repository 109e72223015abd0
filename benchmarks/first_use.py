"""First use of the impact engine after installation, and in a second process: seconds, and content of numba's cache.

    python benchmarks/first_use.py

Each line is a separate process, from start to exit. The first of each pair begins with an empty cache, the second with
the cache of the first. "import numpy" is the cost of any such process.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

START = """
import numpy as np
from cgid.physics import *
from cgid.physics.materials import STEEL, YANG2018_SPHERES
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


def seconds(code: str, cache: str) -> float:
    """Return the time of a process [s]."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"NUMBA_CACHE_DIR": cache})
    return time.perf_counter() - start


def main() -> None:
    """Print the table and the cache."""
    print("| use | first process [s] | second process [s] |\n|---|---|---|")
    held = {}
    for name, code in USES.items():
        with tempfile.TemporaryDirectory() as cache:
            first, second = seconds(code, cache), min(seconds(code, cache) for _ in range(3))
            files = [path for path in Path(cache).rglob("*") if path.is_file()]
            held[name] = f"{len(files)} files, {sum(path.stat().st_size for path in files) / 1e3:.0f} kB"
        print(f"| {name} | {first:.2f} | {second:.2f} |")
    print("\nThe cache afterwards (a file for each compiled kernel):\n")
    for name, text in held.items():
        print(f"* {name}: {text}")


if __name__ == "__main__":
    main()
