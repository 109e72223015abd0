"""Start-up: CPU time of `cgid predict` against `python -c "import numpy"`, whole processes in turn.

python benchmarks/startup.py [--rounds 15]
"""

import argparse
import os
import statistics
import sys

COMMANDS = {
    "python -c 'import numpy'": ["-c", "import numpy"],
    "cgid predict --sample": ["-m", "cgid", "predict", "--sample"],
}


def cpu_seconds(arguments: list[str]) -> float:
    quiet = [(os.POSIX_SPAWN_OPEN, descriptor, os.devnull, os.O_WRONLY, 0) for descriptor in (1, 2)]
    pid = os.posix_spawn(sys.executable, [sys.executable, *arguments], os.environ, file_actions=quiet)
    _, status, usage = os.wait4(pid, 0)
    if status:
        raise SystemExit(f"{arguments} failed")
    return usage.ru_utime + usage.ru_stime


def alternate(rounds: int) -> None:
    times: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for number in range(rounds + 1):
        for name, arguments in COMMANDS.items():
            seconds = cpu_seconds(arguments)
            if number:  # the first round fills the disk cache
                times[name].append(seconds)
    print("| process | median CPU [s] | lowest | highest |\n|---|---|---|---|")
    for name, seconds_list in times.items():
        print(
            f"| `{name}` | {statistics.median(seconds_list):.3f} | {min(seconds_list):.3f} | {max(seconds_list):.3f} |"
        )
    base, predict = (statistics.median(values) for values in times.values())
    print(f"\nratio of the medians: {predict / base:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    alternate(parser.parse_args().rounds)


if __name__ == "__main__":
    main()
