"""Cost of a computation: median and spread of its time, and peak memory of its tensors."""

from __future__ import annotations

import gc
import json
import os
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from kornia_tidy.checks import check_choice

DEVICES = ("cpu", "cuda")
LONG = 5.0  # seconds after which no further run starts


class Timing(NamedTuple):
    """Time of a computation in seconds: median over the repeats, and their interquartile range."""

    median: float
    spread: float


def checked_device(name: str) -> torch.device:
    """Return the device to measure on, before any work.

    Raises:
        ValueError: if it is neither a processor nor a CUDA GPU that PyTorch finds.

    Example:
        >>> checked_device("cpu")
        device(type='cpu')
    """
    check_choice("device", name.partition(":")[0], DEVICES)
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"device {name}: PyTorch finds no CUDA GPU here")
    try:
        return torch.device(name)
    except RuntimeError:
        raise ValueError(f"device must be cpu, cuda or cuda:N, got {name!r}") from None


def seconds(action: Callable[[], Any], repeats: int, device: torch.device) -> Timing:
    """Time an action after one warm-up run, with the device synchronised before the clock is read.

    Args:
        action: called without arguments; its result is discarded.
        repeats: timed runs, 1 or more. No further run starts after ``LONG`` seconds. If the first run takes as long, it
            is the only one. The spread of a single run is 0.
        device: on which the action runs.

    Raises:
        ValueError: if ``repeats`` is not positive.

    Example:
        >>> timing = seconds(lambda: time.sleep(0.002), 3, torch.device("cpu"))
        >>> timing.median > 0.002 and timing.spread >= 0
        True
    """
    if repeats < 1:
        raise ValueError(f"repeats must be 1 or more, got {repeats}")
    times: list[float] = []
    while len(times) <= repeats and sum(times) < LONG:
        synchronize(device)
        start = time.perf_counter()
        action()
        synchronize(device)
        times.append(time.perf_counter() - start)
    low, median, high = np.quantile(times[1:] or times, (0.25, 0.5, 0.75)).tolist()
    return Timing(median, high - low)


def synchronize(device: torch.device) -> None:
    """Wait until the device has finished all queued work.

    Raises:
        ValueError: if the device is neither a CPU nor a CUDA GPU.
    """
    check_choice("device", device.type, DEVICES)
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def peak_bytes(action: Callable[[], Any], device: torch.device) -> int:
    """Run an action once and return the peak memory of its tensors in bytes, beyond the memory allocated before.

    Allocations of PyTorch are counted, including temporaries inside operators, but not memory allocated by other
    libraries. On CUDA the peak is ``torch.cuda.max_memory_allocated``. On a CPU the allocations recorded by PyTorch's
    profiler are summed, which is the same on every run. (A capture of 512 x 512 pixels takes 33.7 MiB by this count; a
    fresh process grew by 33.3 MiB.)

    Args:
        action: called without arguments. It should not free memory that was allocated before.
        device: on which the action runs.

    Example:
        >>> def two_of_a_megabyte():
        ...     a = torch.zeros(2**18)
        ...     b = a + a
        ...     del a
        ...     return b.sum()
        >>> peak_bytes(two_of_a_megabyte, torch.device("cpu")) // 2**20
        2
    """
    gc.collect()  # garbage freed during the action would be subtracted from its memory
    synchronize(device)
    if device.type == "cuda":
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        action()
        synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    with _quiet_profiler(), profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        action()
    with tempfile.TemporaryDirectory() as folder:
        trace = Path(folder) / "trace.json"
        profiler.export_chrome_trace(str(trace))
        events = json.loads(trace.read_bytes())["traceEvents"]
    memory = sorted((e for e in events if e.get("name") == "[memory]"), key=lambda event: event["ts"])
    return max(0, *np.cumsum([0] + [event["args"]["Bytes"] for event in memory]).tolist())


@contextmanager
def _quiet_profiler() -> Generator[None]:
    """Silence the messages of PyTorch's profiler on the terminal by an environment variable."""
    told = "KINETO_LOG_LEVEL" in os.environ
    os.environ.setdefault("KINETO_LOG_LEVEL", "6")
    try:
        yield
    finally:
        if not told:
            del os.environ["KINETO_LOG_LEVEL"]
