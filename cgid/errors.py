"""The errors a user can cause, each with the exit code of the command line.

Every message names the thing, the rule, the value with its unit, and the cure.
"""

from __future__ import annotations


class CgidError(Exception):
    """Base of every error that cgid raises on purpose; `exit_code` is what the command line returns.

    Each argument is a mistake and stands on a line of its own: a name in it may hold line breaks, too.
    """

    exit_code = 70

    def __str__(self) -> str:
        return "\n".join(map(str, self.args))


class InvalidValue(CgidError, ValueError):
    """A number or a choice breaks a rule (exit code 65)."""

    exit_code = 65


class BadData(CgidError, ValueError):
    """A file or a signal cannot be used as it is (exit code 65)."""

    exit_code = 65


class MissingOption(CgidError, ValueError):
    """The file does not say something that an option must say (exit code 2)."""

    exit_code = 2


class NoInput(CgidError, FileNotFoundError):
    """An input file does not exist or cannot be opened (exit code 66)."""

    exit_code = 66


class MissingExtra(CgidError, ImportError):
    """An optional library is needed and not installed (exit code 69)."""

    exit_code = 69


class ClusterFailed(CgidError, ConnectionError):
    """A cluster does not answer, has no workers, or has lost them; a worker process has died (exit code 69)."""

    exit_code = 69


class CannotCreate(CgidError, OSError):
    """An output cannot be created (exit code 73)."""

    exit_code = 73


class WriteFailed(CgidError, OSError):
    """Writing broke off; nothing half-written is left (exit code 74)."""

    exit_code = 74
