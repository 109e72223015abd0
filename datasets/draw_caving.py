"""Make datasets/caving.png: the recording of caving.toml with seed 0, its spectrogram and the shares of its labels.

python datasets/draw_caving.py [RECORDING.h5] [PICTURE.png]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from cgid.plots import recording_picture
from cgid.scene import generate_recordings, load_scene
from cgid.store.reading import Recording

FOLDER = Path(__file__).parent


def main(recording: str | None = None, picture: str = str(FOLDER / "caving.png")) -> None:
    """Draw a recording; without one make that of the scene first."""
    with tempfile.TemporaryDirectory() as folder:
        made = recording or generate_recordings(load_scene(FOLDER / "caving.toml"), Path(folder) / "caving.h5")
        opened = Recording(made)
        Path(picture).write_bytes(recording_picture(opened.signal(), opened.impacts()))


if __name__ == "__main__":
    main(*sys.argv[1:])
