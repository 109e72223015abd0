"""HDF5 datasets: the only room that knows h5py."""

from cgid.store.dataset import Dataset
from cgid.store.header import FORMAT, SCHEMA_VERSION
from cgid.store.table import Rows, Table, TableHeader, check_table_output, table_writer
from cgid.store.table_reading import is_table, read_table
from cgid.store.writing import DatasetWriter, check_output

__all__ = [
    "FORMAT",
    "SCHEMA_VERSION",
    "Dataset",
    "DatasetWriter",
    "Rows",
    "Table",
    "TableHeader",
    "check_output",
    "check_table_output",
    "is_table",
    "read_table",
    "table_writer",
]
