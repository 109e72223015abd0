"""Every check of cgid, in the environment that nox runs in: `nox` for all, `nox -s lint` for one, `nox -l` to list."""

from __future__ import annotations

import sys
import tempfile
import tomllib
from pathlib import Path

import nox

nox.options.default_venv_backend = "none"
nox.options.sessions = ["lint", "docs", "wheel", "claims", "tests", "long"]
PYTHON = sys.executable


@nox.session
def tests(session: nox.Session) -> None:
    """Run the tests, or what is named after `--`."""
    session.run(PYTHON, "-m", "pytest", *session.posargs, external=True)


@nox.session
def long(session: nox.Session) -> None:
    """Run the long tests: sweeps, large samples, the pages of the documentation."""
    without = ("-o", "addopts=-q --strict-markers")  # examples in docstrings, none of which is long
    session.run(PYTHON, "-m", "pytest", "-m", "long", *without, *session.posargs, external=True)


@nox.session
def lint(session: nox.Session) -> None:
    """Check style, format, types, the contracts between rooms, and two counts of the structure."""
    session.run(PYTHON, "-m", "ruff", "check", ".", external=True)
    session.run(PYTHON, "-m", "ruff", "format", "--check", ".", external=True)
    session.run(PYTHON, "-m", "mypy", external=True)
    session.run(
        PYTHON, "-c", "from importlinter.cli import lint_imports_command as run; run(['--no-logo'])", external=True
    )
    session.run(PYTHON, "benchmarks/house.py", "--limits", external=True)


@nox.session
def claims(session: nox.Session) -> None:
    """Measure again what takes little time of the figures of README and docs; no times."""
    session.run(PYTHON, "-m", "benchmarks.claims", "--quick", external=True)


@nox.session
def docs(session: nox.Session) -> None:
    """Build the documentation into docs/_build; a warning is an error."""
    session.run(PYTHON, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", "docs/_build", external=True)


@nox.session
def wheel(session: nox.Session) -> None:
    """Build the wheel and identify the sample with nothing but what it holds, from another folder."""
    with tempfile.TemporaryDirectory() as folder:
        session.run(PYTHON, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ".", external=True)
        unpacked = Path(folder, "unpacked")
        session.run(PYTHON, "-m", "zipfile", "-e", str(next(Path(folder).glob("*.whl"))), str(unpacked), external=True)
        session.chdir(folder)
        code = (
            "import sys, cgid.cli; assert 'unpacked' in cgid.__file__; sys.exit(cgid.cli.main(['predict', '--sample']))"
        )
        session.run(PYTHON, "-c", code, external=True, env={"PYTHONPATH": str(unpacked)})


@nox.session(venv_backend="venv")
def constraints(session: nox.Session) -> None:
    """Write constraints.txt: the versions installed here, which passed the tests, and the hashes of their files."""
    folder = Path(session.create_tmp())
    tested, wanted = folder / "tested.txt", folder / "wanted.in"
    listed = session.run(PYTHON, "-m", "pip", "freeze", "--exclude-editable", external=True, silent=True)
    tested.write_text("\n".join(line for line in str(listed).splitlines() if "==" in line), encoding="utf-8")
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    named = [*project["dependencies"], *(one for name in extras["all"][0][5:-1].split(",") for one in extras[name])]
    wanted.write_text("\n".join(named), encoding="utf-8")
    session.install("pip-tools")
    options = "--generate-hashes --strip-extras --no-annotate --no-emit-index-url --no-emit-find-links"
    session.run(
        *("pip-compile", *options.split(), "--no-emit-trusted-host", "--constraint", str(tested), "--quiet"),
        *("-o", "constraints.txt", str(wanted)),
        env={"CUSTOM_COMPILE_COMMAND": "nox -s constraints"},
    )


@nox.session(venv_backend="venv")
def oldest(session: nox.Session) -> None:
    """Run the tests with the oldest versions that pyproject.toml allows, in an environment of their own."""
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    named = {*project["dependencies"], *(bound for name in extras for bound in extras[name])}
    bounds = sorted(bound for bound in named if not bound.startswith("cgid["))
    constraints = Path(session.create_tmp(), "oldest.txt")
    constraints.write_text("\n".join(bound.replace(">=", "==") for bound in bounds), encoding="utf-8")
    session.install("-c", str(constraints), "-e", ".[test]")
    # The oldest versions warn of each other; their successors no longer do.
    session.run("python", "-m", "pytest", "-W", "ignore::DeprecationWarning", *session.posargs)
