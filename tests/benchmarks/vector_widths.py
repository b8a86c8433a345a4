"""Captures with compiled kernels over captures without a compiler, at every width of vectors that this processor has.

``python -m tests.benchmarks.vector_widths``; minutes. 512 x 512 pixels, five masks, 21 layers, one thread; PSFs of 61
px, with occlusion of 23 px (larger ones go by transforms of torch, compiler or not). A process for each width and one
without a compiler take turns, so that what else the machine does meets all alike. Medians of processor time, on empty
caches: nothing was tuned.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from tests.benchmarks.beside_commit import ALLOWED, LARGE, ROOT, Worker
from tests.kernels.widths import options, widths_here

ROUNDS = 5
ROWS = tuple(LARGE)
PATIENCE = 60  # s, after which no more than two rounds are made
NONE = 0  # the width of vectors without a compiler


@dataclass(frozen=True)
class Row:
    """One thing that was timed.

    Args:
        name: compositing, and what was made.
        milliseconds: by the width of vectors in bytes, 0 without a compiler.
        off: largest difference between two widths, as a share of the largest value.
    """

    name: str
    milliseconds: dict[int, float]
    off: float

    @property
    def ratios(self) -> dict[int, float]:
        """How many times as long it takes without a compiler, by width."""
        return {width: self.milliseconds[NONE] / own for width, own in self.milliseconds.items() if width != NONE}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.vector_widths", description=__doc__)
    parser.add_argument("--rounds", type=int, default=ROUNDS, help=f"times of which medians are taken ({ROUNDS})")
    args = parser.parse_args(arguments)
    print(heading(), flush=True)
    with processes() as workers:
        for name in ROWS:
            print(line(measure(workers, name, args.rounds)), flush=True)


def objection(row: Row) -> str | None:
    """Return what is wrong with a row: a width is slower than no compiler, or widths give other numbers; or None."""
    if slow := [width for width, ratio in row.ratios.items() if not ratio >= 1]:
        return f"{row.name} is slower than without a compiler at {' and '.join(map(str, slow))} bytes"
    if not row.off <= ALLOWED[row.name.split()[0]]:
        return f"{row.name} differs by {row.off:.0e} between widths"
    return None


def check(rounds: int = 3) -> list[str]:
    """Print the table, and return the objections that a second look, three times as long, has confirmed."""
    print(heading(), flush=True)
    found = []
    with processes() as workers:
        for name in ROWS:
            row = measure(workers, name, rounds)
            if objection(row):
                row = measure(workers, name, 3 * rounds)
            print(line(row), flush=True)
            found.append(objection(row))
    return [one for one in found if one]


def heading() -> str:
    """Return the head of the table in Markdown."""
    widths = widths_here()
    names = ["without a compiler, ms", *(f"{width} bytes" for width in widths), *(f"ratio at {n}" for n in widths)]
    return f"| | {' | '.join(names)} | widths differ by |\n|---|{'---|' * (len(names) + 1)}"


def line(row: Row) -> str:
    """Return a row of the table."""
    times = [f"{own:.0f}" for own in row.milliseconds.values()]
    return f"| {' | '.join([row.name, *times, *(f'{ratio:.2f}' for ratio in row.ratios.values())])} | {row.off:.0e} |"


def measure(workers: dict[int, tuple[Worker, Path]], name: str, rounds: int) -> Row:
    """Time a row in turns, after one round that nobody counts, and compare what the widths make."""
    times: dict[int, list[float]] = {width: [] for width in workers}
    start = time.perf_counter()
    for number in range(1 + rounds):
        if number > 2 and time.perf_counter() - start > PATIENCE:
            break
        for width, (worker, path) in workers.items():
            times[width].append(worker.milliseconds(name, path))
    results = {width: torch.load(path) for width, (_, path) in workers.items()}
    compiled = [result for width, result in results.items() if width != NONE]
    full = float(results[NONE].abs().max())
    off = max((float((one - other).abs().max()) / full for one in compiled for other in compiled), default=0.0)
    return Row(name, {width: statistics.median(own[1:]) for width, own in times.items()}, off)


@contextmanager
def processes() -> Iterator[dict[int, tuple[Worker, Path]]]:
    """Yield a process for each width of this processor, and one without a compiler, on empty caches; files for results.

    The first result of a row in each process is kept.
    """
    compiler = os.environ.get("CC", "cc")
    with ExitStack() as stack:
        workers = {}
        for width in (NONE, *widths_here()):
            cache = stack.enter_context(tempfile.TemporaryDirectory())
            own = " ".join((compiler, *options(width))) if width != NONE else "false"
            worker = Worker(ROOT, own, XDG_CACHE_HOME=cache)
            stack.callback(worker.end)
            workers[width] = worker, Path(cache) / "result.pt"
        yield workers


if __name__ == "__main__":
    main()
