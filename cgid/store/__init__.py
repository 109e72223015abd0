"""HDF5 datasets: the only room that knows h5py."""

from cgid.store.dataset import Dataset
from cgid.store.shard import FORMAT, SCHEMA_VERSION
from cgid.store.writing import DatasetWriter, check_output

__all__ = ["FORMAT", "SCHEMA_VERSION", "Dataset", "DatasetWriter", "check_output"]
