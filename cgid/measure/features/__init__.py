"""Features of impacts and windows: measurements on batches, and the table that names them."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)
