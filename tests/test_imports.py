"""Imports that the contracts of pyproject.toml cannot see: by the name of a module, as a string."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: A module of the package, as a string begins that names one.
NAMES = sorted(".".join(file.relative_to(ROOT).with_suffix("").parts) for file in (ROOT / "cgid").rglob("*.py"))
#: What imports the module that it is given: that of `errors` is for libraries of others.
IMPORTERS = {"import_module", "__import__", "optional", "find_spec", "run_module"}


def named(tree: ast.AST) -> Iterator[str]:
    """Yield the modules of the package that strings name: wherever they stand alone, or at the start in an import."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and node.value in NAMES:
            yield str(node.value)
        if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in IMPORTERS:
            for text in ast.walk(node):
                if isinstance(text, ast.Constant) and str(text.value).startswith("cgid."):
                    yield str(text.value)


def upwards(module: str, tree: ast.AST) -> list[str]:
    """Return the modules that strings of a module name outside of its own package."""
    package = module.removesuffix(".__init__") if module.endswith(".__init__") else module.rpartition(".")[0]
    return [name for name in named(tree) if not name.startswith(f"{package}.")]


@pytest.mark.parametrize(
    "code",
    [
        'import_module("cgid.plots.objects")',
        'getattr(importlib.import_module(f"cgid.plots.{name}"), "plot")',
        'PICTURES = {"signal": "cgid.plots.objects"}',
    ],
)
def test_an_import_by_a_string_is_seen(code: str) -> None:
    assert upwards("cgid._lib.lazy", ast.parse(code))
    assert not upwards("cgid.plots.report", ast.parse(code))


def test_strings_import_from_their_own_package_only() -> None:
    """Others are for an `import`, which the contracts see."""
    found = {
        name: upwards(name, ast.parse((ROOT / f"{name.replace('.', '/')}.py").read_text("utf-8"))) for name in NAMES
    }
    assert {name: others for name, others in found.items() if others} == {}


def test_names_that_are_loaded_on_first_use_are_of_their_own_package() -> None:
    """A stub of a package is a list of imports, too."""
    for stub in (ROOT / "cgid").rglob("__init__.pyi"):
        package = ".".join(stub.parent.relative_to(ROOT).parts)
        for line in stub.read_text(encoding="utf-8").splitlines():
            if line.startswith("from "):
                assert f"{line.split()[1]}.".startswith(f"{package}."), (package, line)
