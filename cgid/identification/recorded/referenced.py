"""The reference runs of a manifest: the spectra of its sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cgid.errors import BadData
from cgid.identification.recorded.annotated import AnnotatedFile, annotated_blocks
from cgid.identification.reference import MeanSpectrum
from cgid.identification.windows import windows_of
from cgid.units import quantity_of
from cgid.validation import Floats


def reference_spectra(files: Sequence[AnnotatedFile], labelled: AnnotatedFile, window_time: float) -> dict[str, Floats]:
    """Return the reference spectrum of each sensor, (n_channels, n_bands), from the runs of all of its files.

    Parameters
    ----------
    files : sequence of AnnotatedFile
        The reference runs.
    labelled : AnnotatedFile
        One of the recordings that they are for: what quantity, and how many channels.
    window_time : float
        Of the windows that are averaged [s].

    Raises
    ------
    BadData
        A run is of another quantity or number of channels, or holds nothing.
    """
    spectra: dict[str, list[MeanSpectrum]] = {}
    for file in files:
        source, n_channels = file.recording.source, len(labelled.recording.channels)
        if quantity_of(file.unit) != quantity_of(labelled.unit) or len(file.recording.channels) != n_channels:
            raise BadData(
                f"{source}: a reference run must be as the recordings, {quantity_of(labelled.unit)} in {n_channels} "
                f"channels, got {quantity_of(file.unit)} in {len(file.recording.channels)}; record it in the same way"
            )
        rate = file.recording.sampling_rate
        for annotation, blocks in annotated_blocks(file, labelled.unit):
            own = spectra.setdefault(annotation.sensor, [MeanSpectrum(rate) for _ in range(n_channels)])
            if own[0].sampling_rate != rate:
                raise BadData(f"{source}: the reference runs of a sensor must be sampled alike; take one out")
            for _, windows in windows_of(blocks, rate, window_time, window_time):
                for channel, spectrum in enumerate(own):
                    spectrum.feed(windows[:, channel])
    return {sensor: np.stack([spectrum.levels for spectrum in own]) for sensor, own in spectra.items()}
