"""Whether decoded counts can be a picture: header-only files decode without an error, to zeros or to anything."""

from __future__ import annotations

import warnings

from torch import Tensor

LEAST_BITS = 0.05  # a pixel; lossy compression of an empty picture takes twice as many
MOST_ABOVE_WHITE = 1e-3  # of the counts: hot pixels may lie there


def check_plausible(name: str, counts: Tensor, black: Tensor, white: float, length: int) -> None:
    """Refuse counts that no sensor wrote, and warn of a white level that the counts contradict.

    Args:
        name: of the file, for the sentence.
        counts: (C, H, W).
        black: levels without light.
        white: saturation count.
        length: of the file, in bytes.

    Raises:
        ValueError: if the file is too short for its picture, all counts are the same or below black, or white is not
            above black.

    Warns:
        UserWarning: if more than one count in a thousand lies above white.
    """
    height, width = counts.shape[-2:]
    if 8 * length < LEAST_BITS * height * width:
        raise ValueError(
            f"cannot read {name}: its {length} bytes cannot hold the {width} x {height} pixels it speaks of"
        )
    low, high = (int(end) for end in counts.aminmax())
    if low == high:
        raise ValueError(f"cannot read {name}: all its {width} x {height} counts are {low}, so it holds no picture")
    least, most = (float(end) for end in black.aminmax())
    if not most < white < float("inf"):
        raise ValueError(f"cannot read {name}: its white level {white:g} is not above its black level {most:g}")
    if high < least:
        raise ValueError(f"cannot read {name}: all its counts are below its black level {least:g}")
    if high > white and (share := float((counts > white).float().mean())) > MOST_ABOVE_WHITE:
        warnings.warn(
            f"{name}: {100 * share:.2g} % of the counts lie above the white level {white:g}, up to {high}: "
            "it may be wrong",
            stacklevel=2,
        )
