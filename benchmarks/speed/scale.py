"""How cost grows with signals, channels, hours and workers: python benchmarks/speed/scale.py [--large] [--plot FILE].

Each row is a process of its own, start-up included; memory is the largest resident set of one process. Rows of the
model follow from `a + b x` through the measured rows, which are fitted by least squares of relative errors; memory does
not grow with signals and hours, so it has no model. With `--large` a million signals and an hour are measured, too.
Recordings are those of `recordings.py`, one channel at 25.6 kHz where hours grow, five seconds where channels do.
Workers make `tail_beam`; those of the cluster are two processes of dask on this machine, whose processor time is not
seen. Times of a busy machine: compare processor times.
"""

from __future__ import annotations

import argparse
import tempfile
import wave
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.speed.recordings import FULL_SCALE, STREAM_RATE, Run, seconds_of, timed

#: What grows: unit of the table, measured sizes, those of `--large`, sizes of the model.
GROWTH = {
    "signals": ((1_000, 10_000, 100_000), (1_000_000,), (10_000_000,)),
    "channels": ((1, 4, 16, 64, 256), (), ()),
    "hours": ((1 / 60, 0.1, 1 / 3), (1,), (10, 100)),
}
COLUMNS = ("processor [s]", "disk [MB]", "memory [MB]")
N_WORKERS = 8192
Costs = dict[str, dict[float, tuple[float, ...]]]


def wav(path: Path, n_channels: int, seconds: int) -> Path:
    """Write a recording in a process of its own: what is measured inherits the peak memory of this one."""
    maker = get_context("spawn").Process(target=_wav, args=(path, n_channels, seconds))
    maker.start()
    maker.join()
    return path


def _wav(path: Path, n_channels: int, seconds: int) -> None:
    """Write a recording; after a minute it repeats."""
    each = zip(seconds_of(STREAM_RATE, n_channels, 0), range(min(seconds, 60)), strict=False)
    pieces = [piece.tobytes() for piece, _ in each]
    with wave.open(str(path), "wb") as file:
        file.setnchannels(n_channels)
        file.setsampwidth(2)
        file.setframerate(STREAM_RATE)
        for second in range(seconds):
            file.writeframes(pieces[second % len(pieces)])


def generated(folder: Path, scene: str, n: int, *more: str) -> tuple[Run, float]:
    """Return the cost of a dataset, and its size [MB]."""
    output = folder / "made"
    run = timed(["-m", "cgid", "generate", scene, "-n", str(n), "-o", str(output), "--overwrite", *more])
    return run, sum(path.stat().st_size for path in output.iterdir()) / 1e6


def predicted(path: Path) -> tuple[Run, float]:
    """Return the cost of the answers to a recording, and the size of its file [MB]."""
    run = timed(["-m", "cgid", "predict", str(path), "--full-scale", f"{FULL_SCALE:g} m/s^2", "--json"])
    return run, path.stat().st_size / 1e6


def cost(folder: Path, what: str, size: float) -> tuple[float, ...]:
    """Return the figures of `COLUMNS`."""
    if what == "signals":
        run, disk = generated(folder, "reference", int(size))
    elif what == "channels":
        run, disk = predicted(wav(folder / "long.wav", int(size), 5))
    else:
        run, disk = predicted(wav(folder / "long.wav", 1, round(3600 * size)))
    return run.processor, disk, run.memory


def model_of(costs: dict[float, tuple[float, ...]], size: float) -> tuple[float, ...]:
    """Return what `a + b x` says of the processor and the disk for a size."""
    x, y = np.array(list(costs)), np.array(list(costs.values()))[:, :2]
    columns = np.stack([np.ones_like(x), x], axis=1)
    return tuple(
        max(float(np.linalg.lstsq(columns / one[:, None], np.ones_like(x), rcond=None)[0] @ (1, size)), 0.0)
        for one in np.maximum(y.T, 1e-9)
    )


def workers(folder: Path) -> Iterator[tuple[str, Run]]:
    """Yield the cost of the same dataset by more and more workers."""
    from distributed import LocalCluster

    generated(folder, "tail_beam", 256)  # compiles
    for jobs in (1, 2):
        yield f"--jobs {jobs}", generated(folder, "tail_beam", N_WORKERS, "--jobs", str(jobs))[0]
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        for _ in range(2):  # the first loads the kernels in each worker
            run = generated(folder, "tail_beam", N_WORKERS, "--set", f"scheduler={cluster.scheduler_address}")[0]
        yield "2 workers of dask", run


def draw(path: str, costs: Costs) -> None:
    """Draw processor time and memory over size: rings are measured, the line is the model."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(costs), figsize=(9, 5), sharex="col", sharey="row", layout="constrained")
    for (above, below), (what, measured) in zip(axes.T, costs.items(), strict=True):
        sizes = np.geomspace(min(measured), max(*measured, *GROWTH[what][1], *GROWTH[what][2]), 60)
        above.loglog(sizes, [model_of(measured, size)[0] for size in sizes], color="0.6")
        for one, number in ((above, 0), (below, 2)):
            one.loglog(list(measured), [each[number] for each in measured.values()], "o", mfc="none", color="C0")
            one.grid(alpha=0.3)
        below.set_xlabel(what)
    axes[0, 0].set_ylabel(COLUMNS[0])
    axes[1, 0].set_ylabel(COLUMNS[2])
    axes[1, 0].set_ylim(50, 2000)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--large", action="store_true", help="a million signals and an hour, too")
    parser.add_argument("--plot", metavar="FILE", help="draw processor time and memory")
    options = parser.parse_args()
    costs: Costs = {}
    print(f"| | size | {' | '.join(COLUMNS)} |\n|---|---|" + "---|" * len(COLUMNS))
    with tempfile.TemporaryDirectory() as name:
        generated(Path(name), "reference", 256)  # compiles
        for what, (sizes, large, beyond) in GROWTH.items():
            measured = costs.setdefault(what, {})
            for size in (*sizes, *(large if options.large else ())):
                measured[size] = cost(Path(name), what, size)
                _show(what, size, measured[size])
            for size in (*(() if options.large else large), *beyond):
                _show(f"{what}, by the model", size, model_of(measured, size))
        print(f"\n| {N_WORKERS} signals of `tail_beam` | s | processor [s] |\n|---|---|---|")
        for label, run in workers(Path(name)):
            seen = "" if "dask" in label else f"{run.processor:.1f}"
            print(f"| {label} | {run.wall:.1f} | {seen} |", flush=True)
    if options.plot:
        draw(options.plot, costs)


def _show(what: str, size: float, figures: tuple[float, ...]) -> None:
    cells = [f"{figure:.3g}" for figure in figures] + [""] * (len(COLUMNS) - len(figures))
    print(f"| {what} | {size:.3g} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
