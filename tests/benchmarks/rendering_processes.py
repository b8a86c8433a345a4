"""How much faster two processes render a data set than one: ``python -m tests.benchmarks.rendering_processes``.

One process with one thread, and two such processes that share the work by RANK and WORLD_SIZE, in turns, each in an
empty folder. The time is that of the commands on the clock, their start included. It needs two idle cores.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COMMAND = [sys.executable, "-m", "kornia_tidy", "render", "--masks", "5", "--shard-items", "4"]


def seconds(processes: int, scenes: int, size: int) -> float:
    """Return the seconds that a number of processes take to render the scenes."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*COMMAND, "--scenes", str(scenes), "--size", str(size), "-o", str(Path(folder, "captures"))]
        start = time.perf_counter()
        places = [{"RANK": str(rank), "WORLD_SIZE": str(processes)} for rank in range(processes)]
        running = [
            subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1", **place}, stdout=subprocess.DEVNULL)
            for place in places
        ]
        codes = [process.wait() for process in running]
        assert codes == [0] * processes, codes
        return time.perf_counter() - start


def main() -> None:
    """Print the seconds of each turn and the median of the ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=80, help="painted scenes (default: 80)")
    parser.add_argument("--size", type=int, default=384, help="side of a scene in pixels (default: 384)")
    parser.add_argument("--turns", type=int, default=3, help="repetitions (default: 3)")
    options = parser.parse_args()
    ratios = []
    for _ in range(options.turns):
        one, two = (seconds(processes, options.scenes, options.size) for processes in (1, 2))
        ratios.append(one / two)
        print(f"one process {one:.1f} s, two {two:.1f} s: {one / two:.2f} times as fast", flush=True)
    print(f"median of {options.turns}: {statistics.median(ratios):.2f}")


if __name__ == "__main__":
    main()
