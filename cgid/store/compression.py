"""Compression of signals: HDF5's own filters, those of an extra, and a fast deflate.

`gzip` is HDF5's shuffle and deflate, which h5dump, MATLAB and LabVIEW read. `zstd` and `blosc2` (filters 32015 and
32026 of HDF5's registry) need plugins, in Python hdf5plugin. A checksum (fletcher32) of the output follows each filter.
`python benchmarks/store.py` measures size and speed.

Our deflate exploits the structure of signals, and every zlib unpacks it. HDF5's byte shuffle groups the exponents of a
chunk, and each byte of the mantissas. In noise the lower mantissa bytes are incompressible and are stored. The other
bytes hold no repeated words, only frequent bytes and runs of zeros: Huffman coding and run lengths (zlib's strategy
Z_RLE) pack them as well as the search for words, which takes most of gzip's time.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import MissingExtra

COMPRESSIONS = ("none", "gzip", "zstd", "blosc2")
#: Compressions that need hdf5plugin.
BY_PLUGIN = ("zstd", "blosc2")


def keywords(compression: str) -> dict[str, Any]:
    """Return the arguments for h5py's `create_dataset`; raises as `require`."""
    if compression == "none":
        return {}
    if compression == "gzip":
        return {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    plugin = _plugin(compression)
    if compression == "zstd":
        return {"shuffle": True, **plugin.Zstd(clevel=1)}  # level 3 packs noise less well and takes longer
    return dict(plugin.Blosc2(cname="lz4", clevel=5, filters=plugin.Blosc2.BITSHUFFLE))


def require(compression: str) -> None:
    """Raise `MissingExtra` if the library of a compression is not installed."""
    if compression in BY_PLUGIN:
        _plugin(compression)


def library(compression: str) -> str:
    """Return name and version of the library that determines the packed bytes, "" if none."""
    if compression in BY_PLUGIN:
        return f"hdf5plugin {_plugin(compression).version}"
    return f"zlib {zlib.ZLIB_RUNTIME_VERSION}" if compression == "gzip" else ""


def _plugin(compression: str) -> Any:
    """Return hdf5plugin, which registers its filters with HDF5 on import."""
    try:
        import hdf5plugin
    except ImportError:
        raise MissingExtra(
            f"compression {compression!r} needs the library hdf5plugin, which is not installed: "
            "pip install 'cgid[compression]', or choose gzip"
        ) from None
    return hdf5plugin


#: zlib's window of 32 KiB, without a header, so that the parts form one stream.
_RAW = -15
_HEADER = b"\x78\x01"
#: zlib's default.
_MEMORY = 8
#: Number of samples of a plane, and their size [bytes].
_PLACES, _LOOK = 8, 256
#: A plane is packed if its samples shrink to at most this fraction.
_WORTH = 0.97


def deflated(planes: NDArray[np.uint8]) -> bytes:
    """Return the zlib stream (RFC 1950) of shuffled numbers, (itemsize, n) in C order; bytes depend on zlib's version.

    Row k holds byte k of every number, as after HDF5's byte shuffle.

    Examples
    --------
    >>> planes = np.zeros((4, 1000), np.uint8)
    >>> stream = deflated(planes)
    >>> len(stream) < 100, zlib.decompress(stream) == planes.tobytes()
    (True, True)
    """
    parts, last = [_HEADER], len(planes) - 1
    for number, plane in enumerate(planes):
        packer = zlib.compressobj(int(_is_worth_packing(plane)), zlib.DEFLATED, _RAW, _MEMORY, zlib.Z_RLE)
        parts.append(packer.compress(plane.data))
        # A full flush ends on a byte boundary, where the next part starts.
        parts.append(packer.flush(zlib.Z_FINISH if number == last else zlib.Z_FULL_FLUSH))
    parts.append(zlib.adler32(planes.data).to_bytes(4, "big"))
    return b"".join(parts)


def _is_worth_packing(plane: NDArray[np.uint8]) -> bool:
    if plane.size <= _PLACES * _LOOK:
        return True
    # The even spread takes them from different places of the signals.
    starts = np.linspace(0, plane.size - _LOOK, _PLACES).astype(int)
    seen = b"".join([plane[start : start + _LOOK].tobytes() for start in starts])
    packer = zlib.compressobj(1, zlib.DEFLATED, _RAW, _MEMORY, zlib.Z_RLE)
    return len(packer.compress(seen)) + len(packer.flush()) <= _WORTH * len(seen)
