"""WAV files; scipy reads them, and what it passes over silently is checked here."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData
from cgid.recordings.contents import Contents


def read_wav(path: Path, source: str, variable: str | None) -> Contents:
    """Return the channels of a WAV file.

    Parameters
    ----------
    path : Path
        The file: RIFF, RIFX or RF64 with integers of 8, 16, 24 or 32 bits or floats of 32 or 64.
    source : str
        Its name in messages.
    variable : str or None
        Not used: such a file holds one recording.

    Returns
    -------
    Contents
        Integers scaled to a full scale of 1.0, floats as they are; both in "FS" if nobody says otherwise.

    Raises
    ------
    BadData
        The file is cut off or damaged, or its encoding is none of the above.
    """
    # scipy returns what is there of a data chunk that ends too early if the outer size is wrong as well.
    raw = path.read_bytes()
    declared, held = _data_size(raw)
    if declared > held:
        raise BadData(
            f"{source}: the header declares {declared} bytes of sound and {held} follow; "
            "the file looks cut off, copy it again"
        )
    rate, data = _parsed(raw, source)
    samples = data[np.newaxis] if data.ndim == 1 else data.T
    return Contents.of_array(
        _scaled(samples), sampling_rate=float(rate), rate_from="header of the WAV file", fallback_unit="FS"
    )


def _parsed(raw: bytes, source: str) -> tuple[int, NDArray[Any]]:
    from scipy.io import wavfile

    with warnings.catch_warnings():
        # Metadata chunks that scipy does not know are none of our business, a missing end is.
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="Reached EOF prematurely", category=wavfile.WavFileWarning)
        try:
            rate, data = wavfile.read(io.BytesIO(raw))
            return int(rate), np.asarray(data)
        except wavfile.WavFileWarning:
            raise BadData(f"{source}: the WAV file ends too early; it looks cut off, copy it again") from None
        # On damaged headers scipy fails with struct.error, UnboundLocalError, ZeroDivisionError and others.
        except Exception as error:
            reason = " ".join(str(error).split()) if isinstance(error, ValueError) else "damaged header"
            raise BadData(
                f"{source}: WAV must be PCM or float of a known width, it cannot be read ({reason}); export it again"
            ) from None


def _data_size(raw: bytes) -> tuple[int, int]:
    """Return the size of the data chunk as declared and what follows of it [bytes]; (0, 0) without one."""
    order: Literal["big", "little"] = "big" if raw.startswith(b"RIFX") else "little"
    start = 12
    while start + 8 <= len(raw):
        size = int.from_bytes(raw[start + 4 : start + 8], order)
        if raw[start : start + 4] == b"data":
            if raw.startswith(b"RF64"):
                # The chunk ds64, always the first, holds the sizes that do not fit into 32 bits.
                size = int.from_bytes(raw[28:36], "little")
            return size, len(raw) - start - 8
        start += 8 + size + size % 2
    return 0, 0


def _scaled(samples: NDArray[Any]) -> NDArray[Any]:
    if samples.dtype.kind == "f":
        kept = samples.dtype.newbyteorder("=")
        return np.array(samples, dtype=kept if kept.itemsize in (4, 8) else np.float64, order="C")
    # scipy puts the highest bit of any width at the top of its type, so the type alone gives full scale.
    half = 2.0 ** (8 * samples.dtype.itemsize - 1)
    centre = half if samples.dtype.kind == "u" else 0.0
    scaled = samples.astype(np.float64, order="C")
    scaled -= centre
    scaled /= half
    return scaled
