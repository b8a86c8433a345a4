"""Captures with compiled kernels over captures without a compiler, at every width of vectors that this processor has.

``python -m tests.benchmarks.vector_widths``; minutes. A hundred dead leaves of 512 x 512, five masks, 21 layers, one
thread; PSFs of 61 px, with occlusion of 23 px (larger ones go by transforms of torch, compiler or not). A process for
each width and one without a compiler take turns, so that what else the machine does meets all alike. Medians of
processor time, on empty caches: nothing was tuned.
"""

from __future__ import annotations

import argparse
import math
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import torch

from tests.kernels.widths import options, widths_here

ROOT = Path(__file__).resolve().parents[2]
SIDE, ROUNDS = 512, 5
CAPTURES, GRADIENTS = "capture", "gradient"
ROWS = tuple(" ".join(row) for row in product(("gather", "scatter", "occlusion"), (CAPTURES, GRADIENTS)))
PATIENCE = 60  # s, after which no more than two rounds are made
NONE = 0  # the width of vectors without a compiler
ALLOWED = {CAPTURES: 1e-6, GRADIENTS: 1e-5}  # of the largest value; gradients are float32 sums over all pixels


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
    parser.add_argument("--side", type=int, default=SIDE, help=f"of the scene in pixels ({SIDE})")
    args = parser.parse_args(arguments)
    print(heading(), flush=True)
    with processes(args.side) as workers:
        for name in ROWS:
            print(line(measure(workers, name, args.rounds)), flush=True)


def objection(row: Row) -> str | None:
    """Return what is wrong with a row: a width is slower than no compiler, or widths give other numbers; or None."""
    if slow := [width for width, ratio in row.ratios.items() if not ratio >= 1]:
        return f"{row.name} is slower than without a compiler at {' and '.join(map(str, slow))} bytes"
    if not row.off <= ALLOWED[row.name.split()[1]]:
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


def measure(workers: dict[int, Worker], name: str, rounds: int) -> Row:
    """Time a row in turns, after one round that nobody counts, and compare what the widths make."""
    results = {width: worker.result(name) for width, worker in workers.items()}
    times: dict[int, list[float]] = {width: [] for width in workers}
    start = time.perf_counter()
    for number in range(rounds):
        if number > 1 and time.perf_counter() - start > PATIENCE:
            break
        for width, worker in workers.items():
            times[width].append(worker.milliseconds(name))
    compiled = [result for width, result in results.items() if width != NONE]
    full = float(results[NONE].abs().max())
    off = max((float((one - other).abs().max()) / full for one in compiled for other in compiled), default=0.0)
    return Row(name, {width: statistics.median(own) for width, own in times.items()}, off)


# ---------------------------------------------------------------------- processes


class Worker:
    """A process that makes captures when it is told to."""

    def __init__(self, compiler: str, cache: str, side: int) -> None:
        environment = {**os.environ, "CC": compiler, "OMP_NUM_THREADS": "1", "XDG_CACHE_HOME": cache}
        code = f"from tests.benchmarks.vector_widths import serve; serve({side})"
        command = [sys.executable, "-W", "ignore:compiled code", "-c", code]
        self.cache = Path(cache)
        self.process = subprocess.Popen(
            command, env=environment, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def milliseconds(self, name: str, path: str = "") -> float:
        """Make a row of :data:`ROWS`, and return the processor time that it took."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(shlex.join([name, path]) + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"{name} ended its process with status {self.process.wait()}")
        return float(answer)

    def result(self, name: str) -> torch.Tensor:
        """Make a row, and return it."""
        path = self.cache / "result.pt"
        self.milliseconds(name, str(path))
        return torch.load(path)

    def end(self) -> None:
        """End the process and close what led to it."""
        self.process.communicate()


@contextmanager
def processes(side: int = SIDE) -> Iterator[dict[int, Worker]]:
    """Yield a process for each width of this processor, and one without a compiler, on empty caches."""
    compiler = os.environ.get("CC", "cc")
    with ExitStack() as stack:
        workers = {}
        for width in (NONE, *widths_here()):
            cache = stack.enter_context(tempfile.TemporaryDirectory())
            own = " ".join((compiler, *options(width))) if width != NONE else "false"
            workers[width] = Worker(own, cache, side)
            stack.callback(workers[width].end)
        yield workers


def serve(side: int) -> None:
    """Make captures of one scene as lines of standard input name them, and answer with milliseconds."""
    from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
    from kornia_tidy.data import dead_leaves

    image, depth = (part[None] for part in dead_leaves(side, side, num_leaves=100))
    cameras: dict[str, TiDyOptics] = {}
    for text in sys.stdin:
        name, path = shlex.split(text)
        compositing, what = name.split()
        if compositing not in cameras:
            torch.manual_seed(0)
            fidelity = Fidelity(window=23) if compositing == "occlusion" else "balanced"
            cameras[compositing] = TiDyOptics(PixelwiseMask(5), sensor=None, compositing=compositing, fidelity=fidelity)
        camera, start = cameras[compositing], time.process_time()
        with torch.set_grad_enabled(what == GRADIENTS):
            made = camera(image, depth)
            if what == GRADIENTS:
                (made,) = torch.autograd.grad(made.square().mean(), camera.masks.phase)
        took = 1e3 * (time.process_time() - start)
        if path:
            torch.save(made, path)
        print(took if math.isfinite(float(made.sum())) else math.nan, flush=True)


if __name__ == "__main__":
    main()
