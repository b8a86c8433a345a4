"""Raw validation: tests that decoded counts are a picture and that the white level fits them.

LibRaw decodes truncated files without an error, to zeros or to noise.
"""

from __future__ import annotations

import warnings

from torch import Tensor

LEAST_BITS = 0.05  # per pixel; lossy compression of an empty picture takes twice as many
MOST_ABOVE_WHITE = 1e-3  # share of the counts; hot pixels may lie above white
# (share, factor): a white level is rejected if more than this share of the counts is above this multiple of it. Noise
# and channels with different saturation levels stay within 10 % of white, and hot pixels are rare.
WHITE_LIMITS = ((1e-2, 1.1), (1e-3, 1.5))


def check_counts(name: str, counts: Tensor, black: Tensor, white: float, length: int) -> None:
    """Raise ``ValueError`` if counts and levels cannot come from a sensor.

    Args:
        name: of the file, for the message.
        counts: (C, H, W).
        black: levels without light.
        white: saturation count.
        length: of the file, in bytes.

    Raises:
        ValueError: if the file is too short for its picture, all counts are the same or below black, or white is not
            above black.
    """
    height, width = counts.shape[-2:]
    if 8 * length < LEAST_BITS * height * width:
        raise ValueError(f"cannot read {name}: its {length} bytes cannot hold its {width} x {height} pixels")
    low, high = (end.item() for end in counts.aminmax())
    if low == high:
        raise ValueError(f"cannot read {name}: all its {width} x {height} counts are {low:.7g}, so it holds no picture")
    least, most = (float(end) for end in black.aminmax())
    if not most < white < float("inf"):
        raise ValueError(
            f"cannot read {name}: its white level {white:g} is not above its black level {most:g}: give "
            "the right one (white=..., --white N)"
        )
    if high < least:
        raise ValueError(f"cannot read {name}: all its counts are below its black level {least:g}")


def validated_white(name: str, counts: Tensor, white: float, given: bool) -> float:
    """Return the white level, or the largest count if the white level of the file is too low.

    A white level that is too low would make most of the picture white. Floating-point samples may lie above white, as
    in merged exposures, so theirs is kept.

    Args:
        name: of the file, for the message.
        counts: (C, H, W).
        white: saturation count.
        given: whether the user gave the white level, which is then kept.

    Warns:
        UserWarning: if the level of the file is replaced, or more than one count in a thousand lies above white.
    """
    if counts.is_floating_point():
        return white
    high = int(counts.max())

    def share(level: float) -> float:
        return float((counts > level).float().mean()) if high > level else 0.0

    if not given and any(share(factor * white) > most for most, factor in WHITE_LIMITS):
        warnings.warn(
            f"{name}: its white level {white:g} is wrong, as its counts reach {high}, which is taken for white: "
            "if you know the right one, give it (white=..., --white N)",
            stacklevel=3,
        )
        return float(high)
    if (above := share(white)) > MOST_ABOVE_WHITE:
        warnings.warn(
            f"{name}: {100 * above:.2g} % of the counts lie above the white level {white:g}, up to {high}: "
            "it may be wrong; if so, give the right one (white=..., --white N)",
            stacklevel=3,
        )
    return white
