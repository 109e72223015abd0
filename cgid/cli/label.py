"""`cgid label`: a page in the browser in which the impacts of recordings are labelled."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cgid._lib import validation
from cgid._lib.terminal import counted
from cgid.cli.events import cells_of, require_trainable
from cgid.cli.help import Command
from cgid.cli.options import MODEL, OUTPUT, PATH, require_no_input_written
from cgid.cli.output import say, warn
from cgid.cli.reading import CHAIN, ReadingOptions, reading_options
from cgid.errors import CannotCreate, CgidError, InvalidValue
from cgid.units import quantity_of

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.labelling.recording import LabelledRecording

#: Port that is tried first: labels that wait in a browser are kept for one address.
_PORT = 8062


@click.command(
    cls=Command,
    short_help="Label impacts on a page in the browser.",
    example="cgid label datasets/sample.csv -o labels.csv",
)
@click.argument("files", type=PATH, nargs=-1, required=True, metavar="RECORDING...")
@click.option(
    "-o",
    "--output",
    "written",  # not `output`, with which stdout may be closed: the address is printed there
    type=OUTPUT,
    default="labels.csv",
    show_default=True,
    help="Write the labels to this table (.csv), or go on with it if it exists.",
)
@click.option("--model", type=MODEL, help="Correct this model; by default the shipped one for the recordings.")
@click.option("--labels", default="coal,gangue", show_default=True, help="Offer these labels, separated by commas.")
@click.option("--port", type=click.IntRange(1, 65535), help="Serve the page on this port of this machine.")
@reading_options(*CHAIN, "same_beam")
def label(
    files: tuple[str, ...],
    written: str,
    model: str | None,
    labels: str,
    port: int | None,
    reading: ReadingOptions,
) -> int:
    """Label the impacts of RECORDINGs, or of those in a folder, on a page in the browser of this machine.

    Open the address that is printed. The page shows the recordings and their impacts, draws impacts at random to be
    labelled by keys, labels stretches, trains and corrects models while you label, and says how often they are right.
    With --same-beam, each beam and each other channel of a file is a recording of its own, and a model learns one row
    of an impact. Each label is saved to disk at once; the table is one for cgid train. Ctrl-C ends the page.
    """
    from cgid._lib.files import check_new
    from cgid.identification.training.manifest import recordings_of
    from cgid.labelling.page import Workbench, serve
    from cgid.labelling.table import LabelTable
    from cgid.pages.server import Address

    path = check_new(Path(written), "a table of impacts", (".csv",), overwrite=True)
    model_path = path.with_suffix(".npz")
    names = [validation.label("--labels", name.strip()) for name in labels.split(",")]
    every = recordings_of(files)
    if "-" in every:
        raise InvalidValue("stdin: a table of labels must name files, a stream has no name; save it first")
    require_no_input_written(every)
    reading.require_files(every)
    rates = require_trainable(every, reading, reading.has_beams)
    base = _base(model, every[0], reading)
    parts = [(file, *part) for file in every for part in _beams_of(file, reading)]
    recordings = [_opened(file, path.parent, of, beam, base, rates) for file, of, beam in parts]
    table = LabelTable(path)
    try:
        bench = Workbench(table, recordings, base, labels=names, saved_as=model_path)
        try:
            server, address = serve(bench, Address("127.0.0.1", port or _PORT), warn)
        except CannotCreate:
            if port is not None:
                raise
            server, address = serve(bench, Address("127.0.0.1", 0), warn)
    except BaseException:
        table.close()
        raise
    bench.start()
    try:
        say(address)
        say(f"cgid: open it in a browser of this machine; labels go to {path}; Ctrl-C ends the page", err=True)
        with suppress(KeyboardInterrupt):  # as a page ends
            threading.Event().wait()
    finally:
        server.request_end()
        bench.end()
        n = sum(bool(row.get("label")) for row in table.rows.values())
        say(f"cgid: {path} has {counted(n, 'label')}", err=True)
    return 0


def _base(model: str | None, file: str, reading: ReadingOptions) -> StoredModel | None:
    """Return the model to correct; None if none is given, and no shipped one is for this quantity."""
    from cgid.identification.prediction.prediction import default_model, read_model
    from cgid.identification.prediction.settings import PredictionSettings
    from cgid.identification.training.correction import require_correctable
    from cgid.identification.training.recordings import unit_of

    quantity = quantity_of(unit_of(reading.recording(file)))
    loaded = read_model(default_model(quantity, PredictionSettings()) if model is None else model)
    try:
        require_correctable(loaded)
    except InvalidValue:
        if model is not None:
            raise
        return None
    if loaded.quantity != quantity:
        if model is not None:
            raise InvalidValue(f"--model must be of {quantity}, like the recordings, got one of {loaded.quantity}")
        return None
    return loaded


def _beams_of(file: str, reading: ReadingOptions) -> list[tuple[ReadingOptions, str]]:
    """Return how to read each beam and each other channel of a file, and the channels of a beam; else all together."""
    from cgid.identification.prediction.same_beam import grouped

    if not reading.has_beams:
        return [(reading, "")]
    recording = reading.recording(file)
    names = [channel.name for channel in recording.channels]
    groups = [tuple(names[row] for row in rows) for rows in grouped(names, reading.beams(recording))]
    return [(replace(reading, channel=group), "+".join(group) if len(group) > 1 else "") for group in groups]


def _opened(
    file: str, folder: Path, reading: ReadingOptions, beam: str, base: StoredModel | None, rates: set[float]
) -> LabelledRecording:
    """Return an open recording, to be measured for a new model and for the one that is corrected."""
    from cgid.identification.training.manifest import annotation_of
    from cgid.identification.training.recordings import Cutting, default_names, opened
    from cgid.identification.training.recordings import Reading as Stated
    from cgid.identification.training.rows import Slicing, default_guards
    from cgid.labelling.learning import BASE, NEW
    from cgid.labelling.recording import LabelledRecording
    from cgid.measure.features.extraction import choose, kind_for, require_supported

    cells = {**cells_of(file, folder, reading), "same_beam": beam}
    annotation = annotation_of({**{name: cell for name, cell in cells.items() if cell}, "label": "x"}, folder)
    opened_file = opened((replace(annotation, label=""),), Stated(**reading.common), hashed=False)
    kind, slicing = kind_for(quantity_of(opened_file.unit)), Slicing(by="impact", dead_time=reading.dead_time)
    names = default_names(kind, sorted(rates), slicing)
    names += tuple(name for name in default_guards(names) if name not in names)
    cuttings = {NEW: Cutting(names, slicing, opened_file.unit)}
    if base is not None:
        try:
            require_supported(choose(base.measured), opened_file.recording.sampling_rate, 1 << 20)
            cuttings[BASE] = Cutting(base.measured, slicing, base.unit, model=base)
        except CgidError as error:
            warn(f"{file}: {error}; the model is not corrected")
    titled = {"rate": "rate_Hz"}
    row = {titled.get(name, name): cell for name, cell in cells.items() if cell}
    return LabelledRecording(opened_file, row, kind, cuttings, reading.dead_time)
