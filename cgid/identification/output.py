"""A trained model on disk: the model file, its card, its pictures."""

from __future__ import annotations

from pathlib import Path

from cgid.errors import CannotCreate
from cgid.files import check_new, write_together
from cgid.identification.card import write_card
from cgid.identification.training import Training

#: The pictures that go beside a model.
PICTURES = ("confusion", "reliability", "roc")


def check_model_output(path: Path, *, plots: bool = False, overwrite: bool = False) -> Path:
    """Return the path if a model may be written there, before any work is done.

    Raises
    ------
    CannotCreate
        The name does not end in .npz, the folder is missing, or there is a model already.
    MissingExtra
        Pictures are asked for and matplotlib is not installed.
    """
    if path.suffix != ".npz":
        raise CannotCreate(f"{path}: the name of a model must end in .npz, got {path.suffix or 'no ending'!r}")
    pictures = [f"{path.stem}-{name}.png" for name in PICTURES] if plots else []
    for name in (path.name, f"{path.stem}.md", *pictures):
        check_new(path.with_name(name), "a file beside a model", (Path(name).suffix,), overwrite=overwrite)
    if plots:
        from cgid.plots import require_matplotlib

        require_matplotlib()
    return path


def write_model(training: Training, path: Path, *, plots: bool = False, overwrite: bool = True) -> list[Path]:
    """Write pictures, card and the model, all or nothing; return the files written.

    Raises
    ------
    CannotCreate
        The folder is not writable, or a name was taken meanwhile and is not to be overwritten.
    WriteFailed
        The disk is full or broken; an old model and its card are there as before.
    """
    pictures: dict[str, bytes] = {}
    if plots:
        from cgid.plots import judgement_pictures

        labels, probabilities = training.test_labels, training.test_probabilities
        drawn = judgement_pictures(labels, probabilities, training.model.labels, training.metrics)
        pictures = {f"{path.stem}-{name}.png": picture for name, picture in drawn.items()}
    contents = {
        **pictures,
        f"{path.stem}.md": write_card(training.model, path.name, tuple(pictures)).encode(),
        path.name: training.model.to_bytes(),
    }
    files = {path.with_name(name): content for name, content in contents.items()}
    write_together(files, overwrite=overwrite)
    return list(files)
