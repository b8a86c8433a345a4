"""How long decoding and demosaicing take, beside rawpy's own, in turns in one process.

Not named ``test_``: it times the largest real raw file for a minute, which the check that every suite runs once must
not. ``python -m tests.benchmarks.developing_against_libraw [algorithm ...]`` prints a table: medians of 5 turns, of the
processor's time of this process and its children, which other programs hardly change, and of the clock's.

Ours starts a process for each file. What that one takes to start and to import NumPy and rawpy is measured beside the
others, told, and left out of the ratio, as is the import of rawpy here; writing is left out of both.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import rawpy
import torch

from kornia_tidy.lab.raw.capture import RawCapture
from kornia_tidy.lab.raw.develop import develop
from tests.base import DATA

LARGEST = DATA / "raw/imageio+test_images/Blackmagic.dng"
TURNS = 5
START = "import io, json, math, os, sys\nsys.path[:] = json.loads(sys.argv[1])\nimport numpy, rawpy"


def by_rawpy(path: str, algorithm: str) -> np.ndarray:
    with rawpy.imread(path) as raw:
        return raw.postprocess(
            demosaic_algorithm=rawpy.DemosaicAlgorithm[algorithm.upper()],
            use_camera_wb=True,
            gamma=(1, 1),
            no_auto_bright=True,
            adjust_maximum_thr=0.0,
            output_bps=16,
        )


def by_us(path: str, algorithm: str) -> torch.Tensor:
    return develop(RawCapture.open(path), f"libraw_{algorithm}", encoded=False)


def start() -> None:
    """Start-up work of the decoder process before it decodes."""
    subprocess.run(
        [sys.executable, "-I", "-S", "-c", START, json.dumps(sys.path)],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        check=True,
    )


def seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Time of the processor, children's included, and of the clock."""
    before, began = os.times(), time.perf_counter()
    call()
    after, ended = os.times(), time.perf_counter()
    return sum(after[:4]) - sum(before[:4]), ended - began


def medians(calls: dict[str, Callable[[], object]]) -> dict[str, list[float]]:
    """Of every call, all in turn."""
    for call in calls.values():
        call()
    turns = [{name: seconds(call) for name, call in calls.items()} for _ in range(TURNS)]
    return {name: [statistics.median(turn[name][clock] for turn in turns) for clock in (0, 1)] for name in calls}


def main(algorithms: list[str]) -> None:
    path = str(LARGEST)
    print(
        f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads, rawpy {rawpy.__version__}\n"
    )
    print("| algorithm | time | rawpy, ms | ours, ms | of it the start of the decoder, ms | ours without it / rawpy |")
    print("|---|---|---|---|---|---|")
    for algorithm in algorithms or ["ahd", "ppg", "linear"]:
        theirs = by_rawpy(path, algorithm).astype(np.float32) / 65535
        off = np.abs(by_us(path, algorithm).clamp(0, 1).permute(1, 2, 0).numpy() - theirs).mean()
        if off > 2e-4:
            raise AssertionError(f"the two pictures by {algorithm} differ by {off:.1e} on average")
        found = medians(
            {"rawpy": lambda a=algorithm: by_rawpy(path, a), "us": lambda a=algorithm: by_us(path, a), "start": start}
        )
        for clock, name in enumerate(("processor", "clock")):
            peer, own, begin = (1e3 * found[who][clock] for who in ("rawpy", "us", "start"))
            ratio = (own - begin) / peer
            print(f"| {algorithm} | {name} | {peer:.0f} | {own:.0f} | {begin:.0f} | {ratio:.2f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
