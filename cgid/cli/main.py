"""The commands, and how errors end: with one line on stderr and an exit code, never with a traceback."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import warnings
from pathlib import Path
from typing import Any

import click

from cgid import __version__
from cgid._lib import spelling
from cgid.cli.help import CommandsOnDemand, Group
from cgid.cli.output import (
    drop,
    exit_code_of_interruption,
    interruptions_noted,
    is_interrupted,
    open_missing,
    say,
    say_error,
    show_compilation,
    warn,
)
from cgid.errors import CgidError, MissingExtra, installed_from

#: Number of threads for numba, whose import fails below 1.
_THREADS = "NUMBA_NUM_THREADS"
_INTERNAL, _OUTPUT_FAILED, _NO_INPUT, _BAD_DATA = 70, 74, 66, 65
#: Error messages of loaders, threads, C++ and HDF5 that mean a lack of memory.
_MEMORY_SHORT = (
    "failed to map segment",
    "cannot allocate memory",
    "can't start new thread",
    "bad_alloc",
    "memory allocation failed",
    "no space available for allocation",
)


@click.group(
    cls=Group,
    commands=CommandsOnDemand(),
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    example="cgid predict --sample",
)
@click.version_option(__version__, prog_name="cgid")
def cli() -> None:
    """Tell coal from gangue by the impact of falling rocks on steel."""


def run(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    warnings.showwarning = _one_line_warning
    open_missing()
    show_compilation()
    spoken, spelling.speak = spelling.speak, spelling.as_option
    try:
        with interruptions_noted():
            code = cli.main(args=arguments, prog_name="cgid", standalone_mode=False)
        if sys.stdout is not None:  # the caller may have closed it
            sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except click.exceptions.NoArgsIsHelpError as error:
        for line in error.format_message().splitlines():
            say(line, err=True)
        return error.exit_code
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f"; see {context.command_path} --help" if context is not None else ""
        say(f"cgid: error: {' '.join(error.format_message().split()).rstrip('.')}{hint}", err=True)
        return error.exit_code
    except CgidError as error:
        if isinstance(error, MissingExtra) and _memory_is_short(error):  # the library is installed
            return _report_memory(error)
        say_error(error)
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return _report_interruption()
    except (BrokenPipeError, SystemExit):
        # The reader of our output has closed it; click turns that into SystemExit.
        drop(sys.stdout)
        return 0
    except OSError as error:
        if _memory_is_short(error):
            return _report_memory(error)
        if _folder_is_gone():
            say("cgid: error: the current folder must exist, it has been removed; change to another one", err=True)
            return _NO_INPUT
        # Our own files raise a CgidError, so this is the standard output, which a closed terminal takes with it.
        if is_interrupted():
            return _report_interruption()
        with contextlib.suppress(OSError, AttributeError):
            sys.stdout.flush()
        drop(sys.stdout)
        hint = "free some space or choose another folder"
        if error.errno == errno.EBADF:
            hint = "standard output is closed, redirect it to a file or, to discard it, to the null device"
        say(f"cgid: error: output: writing failed ({error.strerror or error}); {hint}", err=True)
        return _OUTPUT_FAILED
    except Exception as error:
        if _memory_is_short(error):
            return _report_memory(error)
        if os.environ.get("CGID_DEBUG"):
            raise
        if isinstance(error, ModuleNotFoundError) and not (error.name or "cgid").startswith("cgid"):
            say(
                f"cgid: error: this needs {error.name}, which is not installed: pip install '{installed_from()}'",
                err=True,
            )
            return MissingExtra.exit_code
        if _asks_for_no_threads():
            say(f"cgid: error: {_THREADS} must be 1 or more, got {os.environ[_THREADS]}; unset it", err=True)
            return 65
        text = " ".join(f"{type(error).__name__}: {error}".split())
        say(f"cgid: internal error: {text}; please report it (CGID_DEBUG=1 shows where)", err=True)
        return _INTERNAL
    finally:
        spelling.speak = spoken


def _memory_is_short(error: BaseException | None) -> bool:
    """Return whether an error or one of its causes is a lack of memory, which libraries report in many ways."""
    while error is not None:
        if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
            return True
        if any(words in str(error).lower() for words in _MEMORY_SHORT):
            return True
        error = error.__cause__ or error.__context__
    return False


def _report_interruption() -> int:
    try:
        sys.stdout.flush()
    except (AttributeError, OSError):  # Python would fail again at its end
        drop(sys.stdout)
    say("cgid: interrupted; no partial files remain", err=True)
    return exit_code_of_interruption()


def _report_memory(error: BaseException) -> int:
    text = " ".join(str(error).split()) if isinstance(error, MemoryError) else ""
    say(
        f"cgid: error: out of memory{f' ({text})' if text else ''}; give a smaller input, ask for fewer signals or "
        "--jobs at once, or raise the limit (ulimit -v)",
        err=True,
    )
    return _BAD_DATA


def _asks_for_no_threads() -> bool:
    try:
        return int(os.environ.get(_THREADS, "1")) < 1
    except ValueError:
        return False  # numba ignores it


def _folder_is_gone() -> bool:
    """Return whether the current folder is gone; some libraries cannot be imported then."""
    try:
        Path.cwd()
    except OSError:
        return True
    return False


def _one_line_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    warn(" ".join(str(message).split()))
