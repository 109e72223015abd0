"""Which file or folder has a name: what is asked of it twice may have been replaced in between."""

from __future__ import annotations

from pathlib import Path

from cgid.errors import BadData


class Identity:
    """What has a name now.

    Parameters
    ----------
    path : Path

    Raises
    ------
    BadData
        It cannot be looked at.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found = self._look()

    def require(self) -> None:
        """Raise `BadData` if something else has the name by now, as after an overwriting run."""
        if self._look() != self._found:
            raise BadData(f"{self._path}: has been replaced by another while it was read; read it again")

    def _look(self) -> tuple[int, int]:
        try:
            found = self._path.stat()
        except OSError as error:
            raise BadData(f"{self._path}: cannot be looked at ({error.strerror}); read it again") from None
        return found.st_dev, found.st_ino
