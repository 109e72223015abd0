"""Files shipped with the package: scenes, a sample, the default models.

A wheel has them inside the package; a checkout, and so an editable install, has them at its top level.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from cgid.errors import NoInput

_PACKAGE = Path(__file__).parent
DEFAULT_MODEL = "default.npz"
DROP_HEIGHT_MODEL = "default-drop-height.npz"
ACCELERATION_MODEL = "default-acceleration.npz"
SAMPLE = "sample.csv"
FINITE_ELEMENT_IMPACTS = "finite_element.npz"
SCENES = ("reference", "peers", "yang2018", "strangers", "lookalikes", "randomised", "tail_beam", "plate", "caving")


def path_of(kind: Literal["datasets", "models"], name: str) -> Path:
    """Return the path of a shipped file; raises `NoInput` if the installation is incomplete.

    Examples
    --------
    >>> path_of("datasets", "reference.toml").name
    'reference.toml'
    """
    for folder in (_PACKAGE / "shipped" / kind, _PACKAGE.parent / kind):
        if (folder / name).is_file():
            return folder / name
    raise NoInput(f"{kind}/{name}: must come with cgid and is missing: install it again")


def scene_path(scene: str) -> Path:
    """Return the path of a scene: a file, or a shipped scene such as "reference"."""
    return Path(scene) if scene not in SCENES else path_of("datasets", f"{scene}.toml")
