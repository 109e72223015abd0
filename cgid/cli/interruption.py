"""An interruption (Ctrl-C) that is never lost.

Python raises KeyboardInterrupt wherever it stands, and swallows it where nothing can be raised: in the callbacks of
weak references, of which h5py has many. So the wish is noted as well, and long work asks for it.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_noted = threading.Event()


@contextmanager
def heard() -> Iterator[None]:
    """Note interruptions within this context; does nothing outside of the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _noted.clear()
    before, hook = signal.signal(signal.SIGINT, _note), sys.unraisablehook
    sys.unraisablehook = lambda found: None if found.exc_type is KeyboardInterrupt else hook(found)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook = hook


def stop_if_asked() -> None:
    """Raise KeyboardInterrupt if somebody has asked for it since, however long ago."""
    if _noted.is_set():
        raise KeyboardInterrupt


def _note(_number: int, _frame: FrameType | None) -> None:
    _noted.set()
    raise KeyboardInterrupt
