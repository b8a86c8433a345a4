"""Memory during mixed training and rendering: `python -m tests.long_run --minutes 60`.

Rounds of training steps, captures, files, coded data sets, subcommands and refused files are repeated. After each round
the resident memory, the open files and the threads of the process are noted. With the C library of GNU, freed memory is
given back to the system before (``malloc_trim``), so that memory in use is measured and not how it is scattered. The
gradient of memory is that of the second half of the run, by the method of Theil and Sen, which a few outliers do not
change.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import gc
import math
import os
import resource
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from tests.long_run.load import MixedLoad

MOST = 32.0  # MiB per hour that count as flat


class Sample(NamedTuple):
    """What was noted after a round."""

    seconds: float
    memory: float
    """Resident, in MiB, after freed memory was given back."""
    mapped: float
    """Part of it that is pages of files: code of libraries, read when it is first run."""
    allocated: float
    """MiB that the C library has handed out and not got back."""
    blocks: int
    """Blocks of memory that Python holds."""
    files: int
    threads: int


def main() -> int:
    """Run, and return 0 if memory, open files and threads did not grow."""
    parser = argparse.ArgumentParser(prog="python -m tests.long_run", description="Memory during a long mixed load.")
    parser.add_argument("--minutes", type=float, default=60.0, help="(default: 60)")
    parser.add_argument("--seed", type=int, default=0, help="of sizes and scenes (default: 0)")
    parser.add_argument("--most", type=float, default=MOST, help=f"MiB per hour that count as flat (default: {MOST:g})")
    parser.add_argument("-o", "--output", type=Path, help="CSV file of the samples, written round by round")
    args = parser.parse_args()
    samples: list[Sample] = []
    with (
        tempfile.TemporaryDirectory() as place,
        tqdm(total=round(60 * args.minutes), unit="s") as bar,
        (args.output or Path(os.devnull)).open("w", newline="", buffering=1) as file,
    ):
        table = csv.writer(file)
        table.writerow(Sample._fields)
        load, begin = MixedLoad(Path(place), args.seed), time.monotonic()
        while not samples or samples[-1].seconds < 60 * args.minutes:
            load.round()
            samples.append(_sample(time.monotonic() - begin))
            table.writerow(samples[-1])
            bar.n = min(round(samples[-1].seconds), bar.total)
            bar.set_postfix_str(f"{samples[-1].memory:.0f} MiB")
    faults = report(samples, args.most)
    print(f"{len(samples)} rounds, {load.steps} training steps, {torch.get_num_threads()} thread(s) of torch")
    return int(bool(faults))


def report(samples: list[Sample], most: float) -> list[str]:
    """Print what the samples show, and return what grew."""
    late = samples[len(samples) // 2 :]
    gradient, low, high = memory_gradient(late)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"memory: {samples[0].memory:.0f} MiB after a round, {late[0].memory:.0f} half-way, {late[-1].memory:.0f} at")
    print(f"        the end, peak {peak:.0f}; gradient {gradient:+.1f} MiB per hour ({low:+.1f} to {high:+.1f})")
    print(f"open files: {late[0].files} half-way, {late[-1].files} at the end; threads: {late[0].threads}, then "
          f"{late[-1].threads}")  # fmt: skip
    faults = [f"memory grows by {gradient:.1f} MiB per hour"] if gradient > most else []
    faults += [f"{name} grow" for name in ("files", "threads") if getattr(late[-1], name) > getattr(late[0], name)]
    print("\n".join(faults) or "flat")
    return faults


def memory_gradient(samples: list[Sample]) -> tuple[float, float, float]:
    """Return the median of the gradients between all pairs of samples in MiB per hour, and its quartiles.

    Samples are thinned to at most 400. Source: Sen, Estimates of the regression coefficient based on Kendall's tau
    (1968).
    """
    chosen = samples[:: max(1, len(samples) // 400)]
    if len(chosen) < 2:
        return 0.0, 0.0, 0.0
    time_, memory = np.array([(sample.seconds / 3600, sample.memory) for sample in chosen]).T
    first, second = np.triu_indices(len(chosen), 1)
    gradients = (memory[second] - memory[first]) / (time_[second] - time_[first])
    low, middle, high = np.percentile(gradients, (25, 50, 75))
    return float(middle), float(low), float(high)


def _sample(seconds: float) -> Sample:
    gc.collect()
    library = ctypes.CDLL(None)
    if trim := getattr(library, "malloc_trim", None):
        trim(0)
    resident, mapped = (
        int(pages) * resource.getpagesize() / 2**20 for pages in Path("/proc/self/statm").read_text().split()[1:3]
    )
    files = len(os.listdir("/proc/self/fd"))
    return Sample(
        seconds, resident, mapped, _allocated(library), sys.getallocatedblocks(), files, threading.active_count()
    )


class _Mallinfo(ctypes.Structure):
    """What ``mallinfo2`` of the C library of GNU (2.33 or newer) returns."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks",
                     "keepcost")
    )  # fmt: skip


def _allocated(library: ctypes.CDLL) -> float:
    """Return the MiB allocated in arenas and in mappings; NaN with another C library."""
    if (mallinfo := getattr(library, "mallinfo2", None)) is None:
        return math.nan
    mallinfo.restype = _Mallinfo
    found = mallinfo()
    return (found.uordblks + found.hblkhd) / 2**20


if __name__ == "__main__":
    sys.exit(main())
