"""How the signals of a shard may be packed: by filters of HDF5 that everything reads, or by those of an extra.

`gzip` is HDF5's own shuffle and deflate: h5dump, MATLAB and LabVIEW read it as they are. `zstd` and `blosc2` (filters
32015 and 32026 of HDF5's registry) are read where their plugins are, in Python by hdf5plugin. Whatever the filter, a
checksum (fletcher32) of what it leaves comes after it. `python benchmarks/store.py` measures size and speed of each.
"""

from __future__ import annotations

import zlib
from typing import Any

from cgid.errors import MissingExtra

COMPRESSIONS = ("none", "gzip", "zstd", "blosc2")
#: Those whose filters hdf5plugin brings.
BY_PLUGIN = ("zstd", "blosc2")


def keywords(compression: str) -> dict[str, Any]:
    """Return what h5py's `create_dataset` is told; raises as `require`."""
    if compression == "none":
        return {}
    if compression == "gzip":
        return {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    plugin = _plugin(compression)
    if compression == "zstd":
        return {"shuffle": True, **plugin.Zstd(clevel=1)}  # level 3 leaves more of noise, and takes longer
    return dict(plugin.Blosc2(cname="lz4", clevel=5, filters=plugin.Blosc2.BITSHUFFLE))


def require(compression: str) -> None:
    """Raise `MissingExtra` if the library that packs so is not installed."""
    if compression in BY_PLUGIN:
        _plugin(compression)


def library(compression: str) -> str:
    """Return name and version of the library that the packed bytes depend on, "" if on none."""
    if compression in BY_PLUGIN:
        return f"hdf5plugin {_plugin(compression).version}"
    return f"zlib {zlib.ZLIB_RUNTIME_VERSION}" if compression == "gzip" else ""


def _plugin(compression: str) -> Any:
    """Return hdf5plugin, which registers its filters with HDF5 when it is loaded."""
    try:
        import hdf5plugin
    except ImportError:
        raise MissingExtra(
            f"compression {compression!r} needs the library hdf5plugin, which is not installed: "
            "pip install 'cgid[compression]', or choose gzip"
        ) from None
    return hdf5plugin
