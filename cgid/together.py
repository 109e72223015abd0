"""Several files that get their names together or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from cgid.errors import WriteFailed
from cgid.files import whole_file
from cgid.lock import locked

#: Others that write into the same folder at this moment are waited for so long [s].
_PATIENCE = 5.0


def write_together(contents: Mapping[Path, bytes], *, overwrite: bool = True) -> None:
    """Write files of one folder so that all of them hold what they held before, or all hold the new.

    All are written and flushed before the first gets its name. If one cannot get it, the others are put back. Who kills
    the process between two renames, which take microseconds, may find some files new and some old, each of them whole.

    Parameters
    ----------
    contents : dict of bytes
        In the order in which they get their names.
    overwrite : bool
        Whether old files may be replaced.

    Raises
    ------
    CannotCreate
        The folder is missing or not writable, or a name was taken meanwhile and is not to be overwritten.
    WriteFailed
        The disk is full or broken; what was there before is there.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_together({Path(folder) / "card.md": b"# card", Path(folder) / "model": b"..."})
    ...     sorted(path.name for path in Path(folder).iterdir())
    ['card.md', 'model']
    """
    made: dict[Path, int] = {}
    with contextlib.ExitStack() as stack:
        # Where systems cannot tell of others, or these take too long, it goes on without.
        with contextlib.suppress(OSError):
            stack.enter_context(locked(next(iter(contents)).parent, patience=_PATIENCE))
        for path in contents:
            stack.enter_context(_put_back(path, made))
        _write(list(contents.items()), made, overwrite)


def _write(contents: Sequence[tuple[Path, bytes]], made: dict[Path, int], overwrite: bool) -> None:
    """Write all files, the last first, then give them their names, the first first; note their inodes before."""
    if not contents:
        return
    path, content = contents[-1]
    with whole_file(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(content)
        made[path] = temporary.stat().st_ino
        _write(contents[:-1], made, overwrite)


@contextlib.contextmanager
def _put_back(path: Path, made: Mapping[Path, int]) -> Iterator[None]:
    """Keep what bears a name, and give it back if something fails when what was `made` has the name already."""
    old = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    had, kept = path.is_file(), False
    try:
        if had:
            _second_name(path, old)
        yield
    except BaseException:
        try:
            # Not by a list of what was renamed: Ctrl-C may come between the renaming and the listing.
            if path.stat().st_ino == made.get(path):
                old.replace(path) if had else path.unlink()
        except OSError:
            kept = had  # what cannot be given back is not thrown away
        raise
    finally:
        if not kept:
            with contextlib.suppress(OSError):
                old.unlink()


def _second_name(path: Path, other: Path) -> None:
    try:
        os.link(path, other)
    except OSError:  # not every system has second names
        try:
            shutil.copy2(path, other)
        except OSError as error:
            raise WriteFailed(
                f"{path}: cannot be kept while it is replaced ({error.strerror}); it is as it was, free some space"
            ) from None
