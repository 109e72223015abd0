"""Files shipped with the package: scenes, a sample, the default models, the results of the open benchmark.

A wheel has them inside the package; a checkout, and so an editable install, has them at its top level.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cgid.errors import NoInput

if TYPE_CHECKING:
    import pandas

#: Maximum number of files of a folder searched for a suggestion.
_MAX_FILES = 10_000
_PACKAGE = Path(__file__).parent
DEFAULT_MODEL = "default.npz"
ACCELERATION_MODEL = "default-acceleration.npz"
SAMPLE, ACCELERATION_SAMPLE = "sample.csv", "sample_acceleration.csv"
MODELS = ("default", "default-acceleration")
SCENES = (
    "reference",
    "peers",
    "yang2018",
    "strangers",
    "lookalikes",
    "randomised",
    "tail_beam",
    "plate",
    "caving",
    "rock",
    "corners",
    "anything",
)


def path_of(kind: Literal["datasets", "models", "benchmarks/open"], name: str) -> Path:
    """Return the path of a shipped file; raise `NoInput` if the installation is incomplete."""
    for folder in (_PACKAGE / "shipped" / kind, _PACKAGE.parent / kind):
        if (folder / name).is_file():
            return folder / name
    raise NoInput(f"{kind}/{name}: must be part of cgid and is missing: install it again")


def scene_path(scene: str | Path) -> Path:
    """Return the path of a scene: a file, or a shipped scene such as "reference"."""
    return _resolve(scene, "datasets", SCENES, ".toml", "scene", "cgid check --list names the shipped ones")


def model_path(model: str | Path) -> Path:
    """Return the path of a model: a file, or a shipped model such as "default"; raises as `scene_path`.

    A name with a version, such as "default@2", is that model in this version; another one raises `NoInput`.
    """
    name, at, version = str(model).partition("@")
    if isinstance(model, str) and at and name in MODELS:
        here = next(row for row in model_versions() if row["name"] == name)
        if version != here["version"]:
            raise NoInput(
                f"{model}: this cgid has version {here['version']} of it, of {here['date']}: {name}@{here['version']}; "
                "for another version keep its file and give that"
            )
        model = name
    return _resolve(model, "models", MODELS, ".npz", "model", f"those that come with cgid are {', '.join(MODELS)}")


def model_versions() -> list[dict[str, str]]:
    """Return name, version, date and SHA-256 of each shipped model."""
    import csv

    with path_of("models", "versions.csv").open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def open_results() -> pandas.DataFrame:
    """Return the results of the open benchmark: all entries, sets and metrics, with what others have sent.

    Returns
    -------
    DataFrame
        A row for each metric of an entry on a set: `entry`, `date`, `version`, `link`, `set`, `metric`, `value`, `low`
        and `high` of its 95 % interval, `n` (rocks, recordings or streams behind it) and `truth`, the digest of the
        sets. The unit of a metric is in `attrs["units"]`; the others are fractions.

    Raises
    ------
    NoInput
        The installation is incomplete.

    Examples
    --------
    >>> table = open_results()
    >>> accuracy = table[(table["metric"] == "accuracy") & (table["set"] == "reference")]
    >>> accuracy.set_index("entry")["value"].idxmax()
    'limit, who knows the scene'
    """
    import pandas as pd

    table = pd.read_csv(path_of("benchmarks/open", "results.csv"), dtype=str, keep_default_na=False)
    numbers = {name: pd.to_numeric(table[name]).round(12) for name in ("value", "low", "high", "n")}
    table = table.assign(date=pd.to_datetime(table["date"]), **numbers)
    rocks = ("cost of the wrong time", "gangue let through", "coal lost")
    table.attrs["units"] = {**dict.fromkeys(rocks, "rocks"), "delay": "s"}
    return table


def scene_descriptions() -> dict[str, str]:
    """Return the one-line description of each shipped scene."""
    import tomllib

    texts = {name: path_of("datasets", f"{name}.toml").read_text(encoding="utf-8") for name in SCENES}
    return {name: tomllib.loads(text)["description"] for name, text in texts.items()}


def _resolve(
    given: str | Path, kind: Literal["datasets", "models"], names: tuple[str, ...], ending: str, what: str, hint: str
) -> Path:
    from cgid._lib import validation

    validation.instance(what, given, str, Path)
    if given in names:
        return path_of(kind, f"{given}{ending}")
    path = Path(given)
    try:
        if path.exists():
            return path
        siblings = [str(path.with_name(one.name)) for one in islice(path.parent.iterdir(), _MAX_FILES)]
    except (OSError, ValueError):  # opening the path will report the error
        return path
    others = [name for name in siblings if name.endswith(ending)]
    similar = validation.suggestion(path.stem, names) or validation.suggestion(str(path), others)
    raise NoInput(f"{path}: no such {what}{similar or f'; {hint}'}")
