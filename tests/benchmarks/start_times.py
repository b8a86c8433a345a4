"""Processor seconds until help stands and packages are imported, beyond what Python and kornia take.

    python -m tests.benchmarks.start_times --rounds 3

Each round starts every process once, so that they share the machine's other work; the least time counts.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys

KORNIA = "import kornia, kornia.augmentation"
STARTED = {  # a process, the one it is compared with, and the seconds beyond it that are wanted at most
    "python": (["-c", "pass"], None, None),
    "kornia-tidy --version": (["-m", "kornia_tidy", "--version"], "python", 0.5),
    "kornia-tidy --help": (["-m", "kornia_tidy", "--help"], "python", 0.5),
    "kornia-tidy train --help": (["-m", "kornia_tidy", "train", "--help"], "python", 0.5),
    "import kornia": (["-c", KORNIA], "python", None),
    "import kornia_tidy": (["-c", f"{KORNIA}, kornia_tidy; kornia_tidy.TiDyOptics"], "import kornia", 0.3),
    "import kornia_tidy.augmentation": (["-c", f"{KORNIA}, kornia_tidy.augmentation"], "import kornia", 0.3),
    "kornia-tidy info": (["-m", "kornia_tidy", "info"], "import kornia_tidy", 0.5),
}


def processor_seconds(words: list[str]) -> float:
    """Return user and system time of a process of this Python."""
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.DEVNULL) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, words
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    taken: dict[str, list[float]] = {name: [] for name in STARTED}
    for _ in range(rounds):
        for name, (words, _, _) in STARTED.items():
            taken[name].append(processor_seconds(words))
    print("| process | processor seconds | beyond | seconds beyond | wanted |\n|---|---|---|---|---|")
    for name, (_, base, wanted) in STARTED.items():
        least = min(taken[name])
        beyond = "" if base is None else f"{least - min(taken[base]):.2f}"
        print(f"| `{name}` | {least:.2f} | {base or ''} | {beyond} | {wanted or ''} |")


if __name__ == "__main__":
    main()
