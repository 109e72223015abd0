"""`cgid train --from`: a model corrected by a few labelled impacts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cgid.cli.answering import prediction_by, warn_of_chance
from cgid.cli.output import accuracy_text, print_json, progress_bar, say, warn
from cgid.cli.reading import ReadingOptions
from cgid.shipped import model_path

if TYPE_CHECKING:
    from cgid.identification.training.manifest import Manifest
    from cgid.identification.training.recordings import Reading


def correct_model(
    manifest: Manifest, base: str, path: Path, reading: ReadingOptions, how: Reading, *, plots: bool, as_json: bool
) -> int:
    """Write a model corrected by labelled impacts, and report its accuracy."""
    from cgid.identification.model.model import StoredModel
    from cgid.identification.model.model_file import CONTROL
    from cgid.identification.training import Training
    from cgid.identification.training.card import correction_section, write_model
    from cgid.identification.training.control import control_notes
    from cgid.identification.training.correction import correct, require_correctable
    from cgid.identification.training.metrics import drawn_text
    from cgid.identification.training.recordings import record
    from cgid.identification.training.rows import Slicing

    model = StoredModel.load(model_path(base))
    require_correctable(model)
    slicing = Slicing(by="impact", dead_time=reading.dead_time)
    with progress_bar(manifest.n_intervals, "impacts", "measuring") as progress:
        rows = record(manifest, slicing=slicing, reading=how, model=model, progress=progress)
    for warning in rows.warnings:
        warn(warning)
    correction = correct(model, rows)
    for warning in correction.warnings:
        warn(warning)
    warn_of_chance(correction.model)
    training = Training(
        correction.model, dict(correction.after), correction.labels, correction.probabilities, None, correction.rows
    )
    written = write_model(
        training, path, plots=plots, further=[correction_section(correction.model.training["correction"])]
    )
    summary = correction.model.training["correction"]
    for note in control_notes(summary[CONTROL]):
        say(f"cgid: {note}", err=True)
    if as_json:
        print_json({"model": str(path), **summary})
    else:
        heard = "" if summary["n_rocks"] == summary["n"] else f" of {summary['n_rocks']} rocks"
        if "drawn" in summary:
            say(drawn_text(summary["drawn"]))
        say(f"accuracy {accuracy_text(summary)} on this beam, cross-validated over {summary['n']} impacts{heard}")
        say(f"before {accuracy_text(summary['before'])}")
        say(f"moved {correction.shift}")
        if summary["n_unknown"]:
            say(f"unknown {summary['n_unknown']} more, out of distribution for the model and not used")
        then = prediction_by(path, correction.model, manifest, reading)
        say(f"wrote {', '.join(map(str, written))}; now {then}", err=True)
    return rows.failures[0].exit_code if rows.failures else 0
