"""The size of the package, and what one command walks through: of this checkout, and of others side by side.

python benchmarks/house.py [FOLDER ...]
python benchmarks/house.py --limits

The second one only counts what `.ci/run` limits: the functions that `cgid.predict` of one impact enters once it is
warm, and the modules of the longest chain of imports. Counts are the same on every machine.

A folder is another checkout (`git worktree add ../before 86b87a3`), measured by the same Python and libraries.
Code lines are no blank lines, comments and docstrings. Lines of logic are also no imports, signatures, decorators,
fields, constants, brackets and bare checks (`if` with nothing but `raise`). A jump is a pair of files where a function
of one has called one of the other. A command is followed twice in one process; the first run also fills tables and
caches. The bodies of classes and what an import runs do not count.
"""

import argparse
import ast
import io
import json
import os
import statistics
import subprocess
import sys
import tempfile
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TypeGuard

HERE = Path(__file__).resolve().parents[1]
WALKS = {
    "predict datasets/sample.csv": ["predict", "datasets/sample.csv"],
    "generate -n 200": ["generate", "datasets/reference.toml", "-n", "200", "-o", "made"],
    "calibrate": ["calibrate", "beam", "--scene", "tail_beam", "-o", "made"],  # 24 signals, generated first
    "train": ["train", "events", "-o", "made.npz"],  # a table of 24 labelled impacts, made first
    "predict of one impact in memory": [],
}
#: What `.ci/run` allows: functions that a second run enters, and modules in the longest chain of imports.
MOST_FUNCTIONS = {"predict of one impact in memory": 154, "predict datasets/sample.csv": 377}
LONGEST_CHAIN = 16
RUNS = ("first", "second")
COUNTED = "functions / files / jumps / calls deep / calls / of these checks"
#: Runs in a process of its own, in the checkout to be measured: prints what a command has walked through, twice over.
_WALK = """
import inspect, json, os, sys
package = os.path.join(os.getcwd(), "cgid") + os.sep
functions, jumps, depth, calls, importing = set(), set(), [0, 0], [0, 0], 0
def is_check(code):
    if code.co_qualname.lower().startswith("unchecked"):  # what makes objects without their checks
        return False
    return code.co_filename.endswith(("validation.py", "units.py")) or code.co_name.lstrip("_").startswith(
        ("require", "check_", "post_init"))
def is_function(code):  # the bodies of classes and modules have a namespace of their own instead
    inside = code.co_filename.startswith(package)
    return inside and code.co_flags & inspect.CO_OPTIMIZED and code.co_name[0] != "<"
def follow(frame, event, argument):
    global importing
    code = frame.f_code
    if code.co_name == "<module>" and event in ("call", "return"):
        importing += 1 if event == "call" else -1
    if importing or not is_function(code):
        return
    if event == "call":
        depth[0] += 1
        depth[1] = max(depth)
        functions.add((code.co_filename, code.co_qualname))
        calls[0] += 1
        calls[1] += is_check(code)
        caller = frame.f_back
        while caller is not None and not caller.f_code.co_filename.startswith(package):
            caller = caller.f_back
        if caller is not None and caller.f_code.co_filename != code.co_filename:
            jumps.add((caller.f_code.co_filename, code.co_filename))
    elif event == "return":
        depth[0] -= 1
from cgid.cli import main
def predicted():  # what `import cgid` gives, of one impact in memory
    import cgid, numpy
    time = numpy.arange(2000) / 200e3
    blow = 8e3 * numpy.sin(numpy.pi * numpy.clip((time - 4e-3) / 0.4e-3, 0, 1)) ** 1.5
    cgid.predict(blow + numpy.random.default_rng(0).normal(0, 50, 2000), 200e3, "N")
out = os.dup(1)
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
walks = []
for arguments in json.loads(sys.argv[1]):
    sys.argv[1:] = arguments
    walk = main if arguments else predicted
    functions.clear(), jumps.clear()
    depth[:] = calls[:] = 0, 0
    status = 0
    sys.setprofile(follow)
    try:
        status = walk()
    except SystemExit as end:
        status = end.code
    sys.setprofile(None)
    walks.append([status or 0, len(functions), len({file for file, _ in functions}), len(jumps), depth[1], *calls])
os.write(out, json.dumps(walks).encode())
"""
_IMPORT = "import time; t = time.process_time(); import cgid.cli; cgid.Model; print(time.process_time() - t)"


def code_lines(text: str) -> tuple[int, int]:
    """Return how many lines are code, and how many of these are logic."""
    prose: set[int] = set()
    frame: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            prose |= lines_of(node)
        elif isinstance(node, (ast.Import, ast.ImportFrom, ast.Raise)) or is_bare_check(node):
            frame |= lines_of(node)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            frame |= set(range(first, max(node.body[0].lineno, node.lineno + 1)))
        if isinstance(node, (ast.Module, ast.ClassDef)):
            for statement in node.body:
                frame |= lines_of(statement) if isinstance(statement, (ast.Assign, ast.AnnAssign)) else set()
    silent = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    lines: set[int] = set()
    bracketed: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in silent:
            own = lines if token.string not in "()[]{},:" else bracketed
            own.update(range(token.start[0], token.end[0] + 1))
    return len((lines | bracketed) - prose), len(lines - prose - frame)


def lines_of(node: ast.stmt) -> set[int]:
    return set(range(node.lineno, (node.end_lineno or node.lineno) + 1))


def is_bare_check(node: ast.AST) -> TypeGuard[ast.If]:
    return isinstance(node, ast.If) and not node.orelse and all(isinstance(part, ast.Raise) for part in node.body)


def by_package(checkout: Path) -> dict[str, tuple[int, int, int, int]]:
    """Return files, lines, code lines and lines of logic of each package, and of what stands beside `cgid`."""
    sizes: dict[str, tuple[int, int, int, int]] = {}
    for path in sorted(checkout.glob("*/**/*.py")):
        parts = path.relative_to(checkout).parts
        if parts[0] not in ("cgid", "studies", "tests", "benchmarks"):
            continue
        text = path.read_text(encoding="utf-8")
        size = (1, text.count("\n"), *code_lines(text))
        for name in {parts[0], "/".join(parts[:2]) if len(parts) > 2 else parts[0] + "/*.py"}:
            if name == parts[0] or parts[0] == "cgid":
                sizes[name] = tuple(map(sum, zip(sizes.get(name, (0, 0, 0, 0)), size, strict=True)))  # type: ignore
    return dict(sorted(sizes.items()))


def modules(checkout: Path) -> dict[str, ast.Module]:
    found = {}
    for path in sorted((checkout / "cgid").rglob("*.py")):
        name = ".".join(path.relative_to(checkout).with_suffix("").parts).removesuffix(".__init__")
        found[name] = ast.parse(path.read_text(encoding="utf-8"))
    return found


def imports(tree: ast.AST, known: set[str]) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in known:
            for alias in node.names:
                below = f"{node.module}.{alias.name}"
                found.add(below if below in known else node.module)
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names if alias.name in known)
    return found


def at_import(tree: ast.Module) -> Iterator[ast.stmt]:
    for node in tree.body:
        typing_only = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        if not typing_only and not isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node


def longest_chain(graph: dict[str, set[str]]) -> int:
    """Return how many modules the longest chain of imports has; there are no cycles."""
    lengths: dict[str, int] = {}

    def length(name: str) -> int:
        if name not in lengths:
            lengths[name] = 1  # a package and its own module
            lengths[name] = 1 + max((length(other) for other in graph[name] if other != name), default=0)
        return lengths[name]

    return max(length(name) for name in graph)


def data_types(tree: ast.Module) -> int:
    words = ("dataclass", "NamedTuple", "TypedDict", "BaseModel", "Enum", "Section")
    classes = (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    said = (" ".join(map(ast.unparse, [*node.decorator_list, *node.bases])) for node in classes)
    return sum(any(word in text for word in words) for text in said)


def n_long_functions(tree: ast.Module) -> int:
    return sum(isinstance(node, ast.FunctionDef) and len(lines_of(node)) > 70 for node in ast.walk(tree))


def walks(name: str, checkout: Path, environment: dict[str, str]) -> list[list[int]]:
    """Return the counts of a command in its first and its second run."""
    with tempfile.TemporaryDirectory() as folder:
        made = {"beam": f"{folder}/beam", "events": f"{folder}/events.csv"}
        places = [made | {"made": f"{folder}/{run}.toml", "made.npz": f"{folder}/{run}.npz"} for run in RUNS]
        commands = [[place.get(word, word) for word in WALKS[name]] for place in places]
        if name == "calibrate":
            commands.insert(0, ["generate", "tail_beam", "-n", "24", "-o", made["beam"]])
        elif name == "train":
            label_impacts(checkout, Path(made["events"]), environment)
        printed = subprocess.run(
            [sys.executable, "-c", _WALK, json.dumps(commands)], cwd=checkout, env=environment, capture_output=True
        )
    found = json.loads(printed.stdout or b"[[1]]")
    if any(status for status, *_ in found):
        raise SystemExit(f"{checkout}: cgid {name} failed: {printed.stderr.decode()[-500:]}")
    return [counts for _, *counts in found[-2:]]


def label_impacts(checkout: Path, table: Path, environment: dict[str, str]) -> None:
    """Write a table of the impacts of two recordings, each the sample twice over, with labels."""
    rate, title, *rows = (checkout / "datasets" / "sample.csv").read_text(encoding="utf-8").splitlines()
    recordings = [table.with_name(f"day{day}.csv") for day in (1, 2)]
    for day, recording in enumerate(recordings, 1):
        recording.write_text("\n".join([rate, title, *rows * 2, *rows[:day]]) + "\n", encoding="utf-8")
    command = [sys.executable, "-m", "cgid", "events", *map(str, recordings), "-o", str(table)]
    subprocess.run(command, cwd=checkout, env=environment, check=True, capture_output=True)
    head, *events = table.read_text(encoding="utf-8").splitlines()
    place = head.split(",").index("label")
    labelled = [event.split(",") for event in events]
    for number, event in enumerate(labelled):
        event[place] = ("coal", "gangue")[number % 2]
    table.write_text("\n".join([head, *map(",".join, labelled)]) + "\n", encoding="utf-8")


def check_limits() -> None:
    """Exit with an error if the counts of this checkout are above their limits."""
    trees = modules(HERE)
    known = set(trees)
    first = {name: set().union(*(imports(node, known) for node in at_import(tree))) for name, tree in trees.items()}
    environment = {**os.environ, "PYTHONPATH": str(HERE)}
    counts = {
        f"functions that a second {name} enters": (walks(name, HERE, environment)[1][0], most)
        for name, most in MOST_FUNCTIONS.items()
    } | {"modules in the longest chain of imports": (longest_chain(first), LONGEST_CHAIN)}
    for what, (count, most) in counts.items():
        print(f"{what}: {count} (at most {most})")
    if any(count > most for count, most in counts.values()):
        raise SystemExit(
            "a count is above its limit: put the new code in a room that exists, or skip what is not needed"
        )


def figures(checkout: Path) -> dict[str, str]:
    trees = modules(checkout)
    known = set(trees)
    texts = [path.read_text(encoding="utf-8") for path in sorted((checkout / "cgid").rglob("*.py"))]
    lengths = [text.count("\n") for text in texts]
    anywhere = {name: imports(tree, known) - {name} for name, tree in trees.items()}
    first = {name: set().union(*(imports(node, known) for node in at_import(tree))) for name, tree in trees.items()}
    importers = Counter(other for others in anywhere.values() for other in others)
    largest = max(zip(lengths, sorted(known), strict=True))
    result = {
        "files of `cgid`": f"{len(trees)}",
        "lines": f"{sum(lengths):,}",
        "code lines": f"{sum(code_lines(text)[0] for text in texts):,}",
        "lines of logic": f"{sum(code_lines(text)[1] for text in texts):,}",
        "functions above 70 lines": f"{sum(map(n_long_functions, trees.values()))}",
        "median file [lines]": f"{statistics.median(lengths):.0f}",
        "largest file [lines]": f"{largest[0]}",
        "modules in the longest chain of imports": f"{longest_chain(first)}",
        "modules with one importer": f"{sum(count == 1 for count in importers.values())}",
        "data types": f"{sum(map(data_types, trees.values()))}",
        "words of README.md": f"{len((checkout / 'README.md').read_text(encoding='utf-8').split()):,}",
    }
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    for name in WALKS:
        for run, counts in zip(RUNS, walks(name, checkout, environment), strict=True):
            result[f"`cgid {name}`, {run} run: {COUNTED}"] = " / ".join(map(str, counts))
    seconds = [
        float(
            subprocess.run([sys.executable, "-c", _IMPORT], cwd=checkout, env=environment, capture_output=True).stdout
        )
        for _ in range(7)
    ]
    result["import of what predicts [ms of processor time]"] = f"{1e3 * statistics.median(seconds):.0f}"
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--limits", action="store_true", help="Only check the counts that are limited.")
    arguments = parser.parse_args()
    if arguments.limits:
        check_limits()
        return
    checkouts = [*(folder.resolve() for folder in arguments.folders), HERE]
    tables = [figures(checkout) for checkout in checkouts]
    print("| | " + " | ".join(checkout.name for checkout in checkouts) + " |\n|---" * 1 + "|---" * len(checkouts) + "|")
    for row in tables[-1]:
        print(f"| {row} | " + " | ".join(table[row] for table in tables) + " |")
    sizes = [by_package(checkout) for checkout in checkouts]
    print("\nFiles / lines / code lines / lines of logic:\n\n| | " + " | ".join(one.name for one in checkouts) + " |")
    print("|---" * (1 + len(checkouts)) + "|")
    for name in sorted({name for size in sizes for name in size}):
        cells = (" / ".join(f"{n:,}" for n in size.get(name, ())) or "-" for size in sizes)
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
