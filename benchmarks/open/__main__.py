"""The open benchmark: make its sets, answer for them, enter predictions, print the table.

python -m benchmarks.open make -o sets                     # public sets; two to three minutes, 480 MB
python -m benchmarks.open make -o contest --private        # test parts of a seed that is drawn
python -m benchmarks.open answer defaults -d sets -o .     # predictions of one of our own entries
python -m benchmarks.open enter "my network" mine.csv -d sets --link https://example.org/mine --version 1.0
python -m benchmarks.open table
"""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path

from benchmarks.open.sets import HERE, draw_seed, make
from cgid.errors import CannotCreate, CgidError
from cgid.store.folder import SUMS

#: Results of the public sets.
RESULTS = HERE / "results.csv"


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.open", description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    made = commands.add_parser("make", help="make signals/, for entrants, and truth/, for the judge")
    made.add_argument("-o", "--output", type=Path, required=True, help="new folder")
    made.add_argument(
        "--private", type=int, nargs="?", const=-1, metavar="SEED", help="for a contest; drawn if left out"
    )
    made.add_argument("--most", type=int, help="at most this many signals of each part, for a trial")
    answer = commands.add_parser("answer", help="predict as one of our own entries does")
    answer.add_argument(
        "entry", choices=("constant", "statistics", "defaults", "trained", "limit", "real", "real-cgid")
    )
    answer.add_argument("-d", "--sets", type=Path, required=True, help="folder of make, for real of `cgid fetch`")
    answer.add_argument("-o", "--output", type=Path, required=True, help="folder of the predictions")
    enter = commands.add_parser("enter", help="judge predictions and put them into the results")
    enter.add_argument("name", help="of the entry in the table")
    enter.add_argument("files", type=Path, nargs="+", help="CSV of predictions of frames or streams")
    enter.add_argument("-d", "--sets", type=Path, help="folder that make has made")
    enter.add_argument("--real", type=Path, help="folder of what `cgid fetch` has fetched, for answers of real tracks")
    enter.add_argument("--version", default="", help="of the entry")
    enter.add_argument("--link", default="", help="https address of method and predictions")
    enter.add_argument("--date", default=datetime.datetime.now(datetime.UTC).date().isoformat(), help="default: today")
    enter.add_argument("--sums", type=Path, help="SHA256SUMS that came with the files; each must have its sum")
    table = commands.add_parser("table", help="print the table of all entries")
    for one in (enter, table):
        one.add_argument("--results", type=Path, default=RESULTS, help="CSV of results (default: the public ones)")
    return parser


def run(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code; an error is one line on stderr."""
    chosen = options().parse_args(arguments)
    try:
        return {"make": _make, "answer": _answer, "enter": _enter, "table": _table}[chosen.command](chosen)
    except CgidError as error:
        print(f"benchmarks.open: error: {error}", file=sys.stderr)
        return error.exit_code


def _make(chosen: argparse.Namespace) -> int:
    private = draw_seed() if chosen.private == -1 else chosen.private
    for folder in make(chosen.output, private=private, most=chosen.most):
        print(f"{folder}: {len(list(folder.iterdir())) - 1} files, sums in {folder / SUMS}")
    if private is not None:
        print(f"Publish the sums of both, give signals/ away and keep truth/, which holds the seed {private}.")
    return 0


def _answer(chosen: argparse.Namespace) -> int:
    from benchmarks.open.entries import ENTRIES, write_predictions
    from benchmarks.open.real import REAL, write_answers

    if not chosen.output.is_dir():  # before minutes of work
        raise CannotCreate(f"{chosen.output}: must be an existing folder; make it first")
    if chosen.entry in REAL:
        print(write_answers(chosen.output / f"{chosen.entry}.csv", REAL[chosen.entry](chosen.sets)))
        return 0
    name, predict = ENTRIES[chosen.entry]
    for path in write_predictions(predict(chosen.sets / "signals"), chosen.output, chosen.entry):
        print(f"{path}: {name}")
    return 0


def _enter(chosen: argparse.Namespace) -> int:
    from benchmarks.open.judge import Entry, Truth, enter, require_sums

    if chosen.sums is not None:
        require_sums(chosen.files, chosen.sums)
    truth = None if chosen.sets is None else Truth.read(chosen.sets / "truth")
    entry = Entry(chosen.name, chosen.date, chosen.version, chosen.link)
    n = enter(entry, chosen.files, truth, chosen.results, chosen.real)
    print(f"{chosen.results}: {chosen.name} entered with {n} sets")
    return 0


def _table(chosen: argparse.Namespace) -> int:
    from benchmarks.open.judge import markdown, read_results

    print(markdown(read_results(chosen.results)), end="")
    return 0


if __name__ == "__main__":
    sys.exit(run())
