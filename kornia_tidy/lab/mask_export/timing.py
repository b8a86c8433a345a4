"""Timing sheet of an exposure: start and dwell time of each frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch

from kornia_tidy.files import csv_bytes
from kornia_tidy.modulator.modulator import DwellTimes
from kornia_tidy.modulator.switching import Switching


class FrameTime(NamedTuple):
    """One line of a timing sheet, with times in seconds."""

    frame: int
    """Index of the frame, from 0."""
    start: float
    """Time from the opening of the shutter until the frame is fully shown."""
    dwell: float
    """Time for which the frame is shown, without transitions."""
    weight: float
    """Dwell time as a fraction of the exposure."""
    swap: float
    """Duration of the transition to the next frame; 0 for the last frame, unless frames repeat."""


def frame_times(
    shares: Sequence[float], exposure: float, switching_time: float = 0.0, cyclic: bool = False
) -> list[FrameTime]:
    """Return the start and dwell time of each frame of an exposure.

    The shutter opens when the first frame is fully shown. Transitions are within the exposure, and the frames share the
    remaining time, as in :class:`~kornia_tidy.modulator.switching.Switching`.

    Args:
        shares: relative dwell time of each frame.
        exposure: in seconds.
        switching_time: duration of each transition in seconds.
        cyclic: whether the exposure includes the transition from the last frame back to the first.

    Returns:
        One line for each frame.

    Raises:
        ValueError: if the shares are negative or all zero, or the transitions take longer than the exposure.

    Example:
        >>> [round(line.start, 4) for line in frame_times((1, 1, 2), 0.1, switching_time=10e-3)]
        [0.0, 0.03, 0.06]
    """
    modulator = Switching(switching_time, exposure, "linear", DwellTimes(shares), cyclic, samples=1)
    weights = modulator(torch.zeros(len(shares), 1, 1, dtype=torch.float64))[1][: len(shares)].tolist()
    back = switching_time if cyclic and len(shares) > 1 else 0.0
    swaps = [switching_time] * (len(shares) - 1) + [back]
    lines, start = [], 0.0
    for frame, (weight, swap) in enumerate(zip(weights, swaps, strict=True)):
        lines.append(FrameTime(frame, start, weight * exposure, weight, swap))
        start += weight * exposure + swap
    return lines


def timing_sheet(lines: Sequence[FrameTime], files: Sequence[str]) -> bytes:
    """Return a timing sheet as CSV, with times in milliseconds rounded to nanoseconds.

    Args:
        lines: result of :func:`frame_times`.
        files: file name of each frame.

    Example:
        >>> print(timing_sheet(frame_times((1,), 0.1), ["frame_000.png"]).decode())
        frame,file,start_ms,dwell_ms,weight,swap_ms
        0,frame_000.png,0.000000,100.000000,1.000000000,0.000000
        <BLANKLINE>
    """
    rows: list[tuple[object, ...]] = [("frame", "file", "start_ms", "dwell_ms", "weight", "swap_ms")]
    for line, file in zip(lines, files, strict=True):
        start, dwell, swap = (f"{1e3 * seconds:.6f}" for seconds in (line.start, line.dwell, line.swap))
        rows.append((line.frame, file, start, dwell, f"{line.weight:.9f}", swap))
    return csv_bytes(rows)
