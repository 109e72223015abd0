"""Errors that a user can cause, each with the exit code of the command line.

Every message gives the object, the rule, the value with its unit, and a hint.
"""

from __future__ import annotations

import signal
from importlib import import_module
from pathlib import Path
from typing import Any

#: Signals that ask to end: Ctrl-C, a service manager, and a terminal that was closed (Windows lacks the last).
INTERRUPTIONS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class CgidError(Exception):
    """Base of all errors that cgid raises intentionally; each argument is one error on a line of its own."""

    exit_code = 70
    #: Whether the message begins with the name of the file, so that nobody adds it again.
    names_file = False

    def __str__(self) -> str:
        return "\n".join(map(str, self.args))


class InvalidValue(CgidError, ValueError):
    """A number or a choice breaks a rule (exit code 65)."""

    exit_code = 65


class BadData(CgidError, ValueError):
    """A file or a signal is unusable (exit code 65)."""

    exit_code = 65


class MissingOption(CgidError, ValueError):
    """The file lacks information that an option must give (exit code 2)."""

    exit_code = 2


class NoInput(CgidError, FileNotFoundError):
    """An input file does not exist or cannot be opened (exit code 66)."""

    exit_code = 66


class MissingExtra(CgidError, ImportError):
    """A required optional library is not installed (exit code 69)."""

    exit_code = 69


def optional(module: str, needs: str, extra: str, *, name: str = "", hint: str = "") -> Any:
    """Return a library that an extra of cgid installs; `MissingExtra` explains how to install it."""
    try:
        return import_module(module)
    except (ImportError, OSError):
        raise MissingExtra(
            f"{needs} {name or module}, which is not installed: pip install '{installed_from()}[{extra}]'{hint}"
        ) from None


def installed_from() -> str:
    """Return what pip installs cgid from: its checkout, or PATH for the wheel that only the user knows."""
    checkout = Path(__file__).parents[1]
    return str(checkout) if (checkout / "pyproject.toml").is_file() else "PATH"


class ClusterFailed(CgidError, ConnectionError):
    """A cluster does not respond, has no workers or lost them, or a worker process died (exit code 69)."""

    exit_code = 69


class Stopped(CgidError):
    """Work ended before its result because its caller asked for it (exit code 130)."""

    exit_code = 130


class CannotCreate(CgidError, OSError):
    """An output cannot be created (exit code 73)."""

    exit_code = 73


class WriteFailed(CgidError, OSError):
    """Writing failed; no partial output remains (exit code 74)."""

    exit_code = 74
