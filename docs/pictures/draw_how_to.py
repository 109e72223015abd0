"""The pictures of the how-to pages, each by what its page describes: `python docs/pictures/draw_how_to.py`."""

from __future__ import annotations

import base64
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

from cgid import Elastic, HalfSpace, HuntCrossley, Impact, Sphere, Viscoelastic
from cgid.physics import STEEL, YANG2018_SPHERES
from cgid.plots.figure import COLOURS, picture

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def command(*words: str, folder: Path) -> None:
    """Run cgid in a folder."""
    program = [sys.executable, "-P", "-m", "cgid", *words]
    paths = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run(program, cwd=folder, env=paths, check=True, capture_output=True)


def recording(folder: Path) -> bytes:
    """Return what `cgid plot` draws of a recording with twenty rocks."""
    file = ROOT / "datasets" / "labelled" / "monday.wav"
    command("plot", str(file), "--set", "full_scale=10000 m/s^2", "-o", "recording.png", folder=folder)
    return (folder / "recording.png").read_bytes()


def taps(folder: Path) -> bytes:
    """Return what `cgid tap --plot` draws of the taps of its page."""
    page = (HERE.parent / "how-to" / "field-kit.md").read_text(encoding="utf-8")
    block = next(text for text in re.findall(r"```python\n(.*?)```", page, re.S) if "taps.csv" in text)
    subprocess.run([sys.executable, "-c", block], cwd=folder, check=True)
    words = "tap taps.csv --hammer hammer --band 50 700 -o modes.csv --plot modes.png"
    command(*words.split(), folder=folder)
    return (folder / "modes.png").read_bytes()


def fraction(folder: Path) -> bytes:
    """Return the gangue fraction as the report of a minute of caving shows it."""
    command("generate", "caving", "-o", "caving.h5", folder=folder)
    words = "predict caving.h5 -o answers.csv --coal-until 15s --report page.html"
    command(*words.split(), folder=folder)
    page = (folder / "page.html").read_text(encoding="utf-8")
    found = re.findall(r'alt="[^"]*raction[^"]*" src="data:image/png;base64,([^"]+)"', page)
    return base64.b64decode(found[0])


def laws(folder: Path) -> bytes:  # noqa: ARG001
    """Return the force of one rock by three laws."""
    rock = Sphere(material=YANG2018_SPHERES[1], radius=0.025)
    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.subplots()
    names = {
        "elastic": Elastic(),
        "Hunt-Crossley, restitution .5": HuntCrossley(restitution=0.5),
        "Kuwabara-Kono, restitution .5": Viscoelastic(restitution=0.5),
    }
    for law in names.values():
        Impact(sphere=rock, target=HalfSpace(material=STEEL), velocity=2.0, stiffness="hertz", dissipation=law).plot(
            axes
        )
    for line, name, colour in zip(axes.lines, names, COLOURS[2:5], strict=True):
        line.set(label=name, color=colour)
    axes.legend()
    return picture(figure, ".png", dpi=100)


def main() -> None:
    """Draw all of them."""
    for draw in (recording, taps, fraction, laws):
        with tempfile.TemporaryDirectory() as folder:
            (HERE / f"{draw.__name__}.png").write_bytes(draw(Path(folder)))


if __name__ == "__main__":
    main()
