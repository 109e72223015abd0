"""The table that is labelled: each label is on the disk at once, and nothing that somebody else wrote is lost.

A label is appended to a journal beside the table before it is answered. The table is written whole, a moment later; the
journal says which of its lines that table has. After a crash, the lines behind are given to the table again.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import hashlib
import io
import json
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from threading import RLock
from typing import Any

from cgid._lib.files import read_regular, write_whole
from cgid._lib.terminal import spreadsheet_cell, text_of_cell
from cgid.errors import BadData, CannotCreate, CgidError, WriteFailed
from cgid.identification.training.manifest import MAX_FILE_SIZE

#: Columns of a new table, in the order of `cgid events`.
_COLUMNS = ("path", "start_s", "end_s", "label", "time_s", "peak", "peak_unit", "flags", "by", "chosen")
#: Columns of numbers.
_NUMBERS = ("start_s", "end_s", "time_s", "peak", "rate_Hz")
#: Most rows of a table.
MAX_ROWS = 200_000

Cells = dict[str, str]


def number_of(cell: str) -> float | None:
    """Return the number of a cell, with a decimal point or comma; None without one."""
    try:
        return float(cell.strip().replace(",", "."))
    except ValueError:
        return None


def key_of(row: Mapping[str, str]) -> tuple[str, str, str, str]:
    """Return what identifies a row: path, channel, and its time, or of a stretch its start and end to 1 us."""
    times = [number_of(row.get(name, "")) for name in ("time_s", "start_s", "end_s")]
    texts = ["" if one is None else f"{one:.6f}" for one in times]
    return row["path"], row.get("channel", ""), *(("", texts[0]) if texts[0] else (texts[1] or "0.000000", texts[2]))


class LabelTable:
    """A table of impacts and stretches, which one process labels at a time; methods may be called from any thread."""

    def __init__(self, path: Path) -> None:
        self.path, self.journal = path, path.with_name(f"{path.name}.journal")
        self.lock = RLock()
        self.rows: dict[tuple[str, str, str, str], Cells] = {}
        self.version = 0  # grows with each label
        self.problem = ""  # why the table on the disk does not have all labels
        self._columns, self._head, self._separator, self._comma, self._mark = list(_COLUMNS), "", ",", False, False
        self._seen, self._stat = b"", (0, 0)  # the table as last read or written
        self._before: dict[tuple[str, str, str, str], set[str]] = {}  # labels that a row had in this session
        self._dirty = False
        self._stream = self._opened_journal()
        try:
            self._read()
            self._replay()
        except BaseException:
            self.close()
            raise

    # -- the table ----------------------------------------------------------------------------------------

    def _read(self) -> None:
        """Read the table on the disk, if there is one, over the rows of this one."""
        if not self.path.exists():
            return
        content = read_regular(self.path, "a table of impacts", MAX_FILE_SIZE)
        stat = self.path.stat()
        if content.strip():
            self._take(content)
        self._seen, self._stat = content, (stat.st_mtime_ns, stat.st_size)

    def _take(self, content: bytes) -> None:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            raise BadData(f"{self.path}: a table must be UTF-8 text, it is not; save it as CSV UTF-8") from None
        lines = re.split("\r\n?|\n", text)
        n_head = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), 0)
        separator = max(",;\t", key=lines[n_head].count)
        kept = [line for line in lines[n_head:] if line.strip() and not line.lstrip().startswith("#")]
        try:
            table = list(csv.reader(io.StringIO("\n".join(kept)), delimiter=separator))
        except csv.Error as error:
            raise BadData(f"{self.path}: a table must be CSV ({error}); save it again") from None
        titles = {title.lower(): title for title in (*_COLUMNS, "channel", "rate_Hz")}
        columns = [titles.get(cell.strip().lower(), cell.strip()) for cell in table[0]]
        if not {"path", "label"} <= set(columns):
            raise BadData(f"{self.path}: a table must have the columns path and label, got {', '.join(columns)[:200]}")
        if len(table) > MAX_ROWS:
            raise BadData(f"{self.path}: a table must have {MAX_ROWS} rows at most, got {len(table) - 1}; divide it")
        rows: dict[tuple[str, str, str, str], Cells] = {}
        for number, cells in enumerate(table[1:], 2):
            if len(cells) > len(columns):
                raise BadData(f"{self.path}: row {number}: must have {len(columns)} cells like the header")
            row = {name: text_of_cell(cell.strip()) for name, cell in zip(columns, cells, strict=False) if name}
            if not row.get("path"):
                raise BadData(f"{self.path}: row {number}: path must be the name of a file, it is empty")
            key = key_of(row)
            while key in rows:  # rows that somebody wrote twice stay two
                key = (*key[:3], f"{key[3]}'")
            rows[key] = row
        self._columns = [name for name in dict.fromkeys([*columns, "label", "by", "chosen"]) if name]
        self._head, self._separator = "".join(f"{line}\n" for line in lines[:n_head] if line.strip()), separator
        numbers = [row.get(name, "") for row in rows.values() for name in _NUMBERS]
        self._comma = separator != "," and any("," in cell for cell in numbers)
        self._mark = content.startswith(b"\xef\xbb\xbf")
        self._merge(rows)

    def _merge(self, rows: dict[tuple[str, str, str, str], Cells]) -> None:
        """Take rows as they stand in a table that somebody else has written; labels of this session prevail."""
        for key in [*self.rows, *(self._before.keys() - self.rows.keys())]:
            row, theirs, known = self.rows.get(key), rows.get(key), self._before.get(key)
            # A spreadsheet that was opened before writes what stood there then.
            is_stale = theirs is not None and known is not None and theirs.get("label", "") in known | {""}
            if row is None:
                if is_stale:
                    del rows[key]
            elif theirs is None:
                if known is not None or not key[2]:
                    rows[key] = row
            elif is_stale:
                theirs |= {name: row.get(name, "") for name in ("label", "by", "chosen")}
        self.rows = rows
        self.version += 1

    def text(self) -> str:
        """Return the content of the table."""
        own = [name for name in ("channel", "rate_Hz") if name not in self._columns]
        columns = self._columns + [name for name in own if any(row.get(name) for row in self.rows.values())]
        columns += sorted({name for row in self.rows.values() for name, cell in row.items() if cell} - set(columns))
        stream = io.StringIO()
        writer = csv.writer(stream, delimiter=self._separator, lineterminator="\n")
        writer.writerow(columns)
        for row in self.rows.values():
            cells = {name: spreadsheet_cell(row.get(name, "")) for name in columns}
            if self._comma:
                cells |= {name: cells[name].replace(".", ",") for name in _NUMBERS if name in cells}
            writer.writerow(cells.values())
        return self._head + stream.getvalue()

    def add(self, rows: Iterable[Cells]) -> None:
        """Add rows that the table does not have, without a label."""
        with self.lock:
            for row in rows:
                if self.rows.setdefault(key_of(row), row) is row:
                    self._dirty = True

    def flush(self, *, force: bool = False) -> None:
        """Write the table if it lacks labels; what somebody else wrote in the meantime is taken first."""
        with self.lock:
            try:
                self.refresh()
                if not (self._dirty or force):
                    return
                text = self.text()
                content = text.encode("utf-8-sig" if self._mark or not text.isascii() else "utf-8")
                write_whole(self.path, content, check=self._require_unchanged)
                stat = self.path.stat()
                self._seen, self._stat, self._dirty = content, (stat.st_mtime_ns, stat.st_size), False
                self._append({"written": hashlib.sha256(content).hexdigest()})
                self.problem = ""
            except (CgidError, OSError) as error:
                self.problem = f"{error}; the labels are safe in {self.journal.name}"

    def _require_unchanged(self) -> None:
        with contextlib.suppress(FileNotFoundError):
            stat = self.path.stat()
            if (stat.st_mtime_ns, stat.st_size) != self._stat:
                raise WriteFailed(f"{self.path}: was changed in the meantime; it is read again")

    def refresh(self) -> None:
        """Take the table on the disk if somebody else has written it."""
        with self.lock:
            try:
                stat = self.path.stat()
            except OSError:
                self._dirty = self._dirty or bool(self._seen)  # it is gone: written again
                return
            if (stat.st_mtime_ns, stat.st_size) == self._stat:
                return
            content = read_regular(self.path, "a table of impacts", MAX_FILE_SIZE)
            if content != self._seen:
                self._take(content)
                self._dirty = True
            self._seen, self._stat = content, (stat.st_mtime_ns, stat.st_size)

    @property
    def is_open_elsewhere(self) -> bool:
        """Whether LibreOffice has the table open."""
        return self.path.with_name(f".~lock.{self.path.name}#").exists()

    # -- labels -------------------------------------------------------------------------------------------

    def label(self, row: Cells, label: str, by: str, chosen: str) -> None:
        """Label a row, added if it is not there; on the disk when this returns. Without `label`, take one away."""
        with self.lock:
            given = {"label": label, "by": by, "chosen": chosen}
            self._append({"row": {name: cell for name, cell in row.items() if cell} | given})
            self._apply(row | given)

    def _apply(self, row: Cells) -> None:
        key = key_of(row)
        own = self.rows.setdefault(key, dict(row))
        self._before.setdefault(key, set()).add(own.get("label", ""))
        own |= {name: row.get(name, "") for name in ("label", "by", "chosen")}
        if key[2] and not own["label"]:
            del self.rows[key]  # a stretch
        self.version += 1
        self._dirty = True

    def _opened_journal(self) -> int:
        try:
            stream = os.open(self.journal, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0), 0o666)
        except OSError as error:
            raise CannotCreate(
                f"{self.journal}: cannot be created ({error.strerror}); choose a folder you may write to"
            ) from None
        with contextlib.suppress(ImportError):  # Windows
            import fcntl

            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(stream)
                raise CannotCreate(
                    f"{self.path}: must be labelled by one cgid label at a time, another one has it; open the address "
                    "of that one, or end it"
                ) from None
        return stream

    def _append(self, line: Mapping[str, Any]) -> None:
        """Append a line to the journal and flush it to the disk; raises `WriteFailed` with the journal as before."""
        size = os.fstat(self._stream).st_size
        content = (json.dumps(line, ensure_ascii=False, separators=(",", ":")) + "\n").encode()
        try:
            written = os.write(self._stream, content)
            if written < len(content):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(self._stream)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._stream, size)
            raise WriteFailed(f"{self.journal}: writing failed ({error.strerror}); free some space") from None

    def _replay(self) -> None:
        """Give the lines of the journal that no table has to the rows."""
        size = os.fstat(self._stream).st_size
        lines = os.pread(self._stream, size, 0).split(b"\n") if size else []
        if lines and lines[-1]:  # a line was cut off by a crash; it was not answered
            os.ftruncate(self._stream, size - len(lines[-1]))
        read = []
        for line in lines[:-1]:
            with contextlib.suppress(ValueError, RecursionError):
                read.append(json.loads(line))
        read = [one for one in read if isinstance(one, dict)]
        behind = next((k for k in range(len(read), 0, -1) if isinstance(read[k - 1].get("written"), str)), 0)
        for one in read[behind:]:
            row = one.get("row")
            if isinstance(row, dict) and row.get("path") and all(isinstance(cell, str) for cell in row.values()):
                self._apply(row)

    def close(self) -> None:
        """Write the table and let others have it."""
        with self.lock:
            if self._stream < 0:
                return
            if self._dirty:
                self.flush()
            if not os.fstat(self._stream).st_size:
                self.journal.unlink(missing_ok=True)
            os.close(self._stream)
            self._stream = -1
