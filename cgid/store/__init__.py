"""HDF5 datasets and tables. Only this package uses h5py; its names are loaded on first use."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)
