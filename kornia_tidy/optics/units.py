"""Checks of units and value ranges: a message names the unit that was probably meant and the conversion."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Hashable, Sequence

import torch
from torch import Tensor

# Noise and interpolation go a little beyond [0, 1], and no encoding of highlights goes above 2.39 (scRGB).
# An image normalised by ImageNet's statistics spans -2.12 to 2.64, and an 8-bit image reaches 255.
BRIGHTEST_CODE, NONSENSE_CODE, DARKEST_CODE = 2.5, 16.0, -0.5
DARKEST_LIGHT = -1.0  # out-of-gamut colours are negative in linear light
LARGEST_LIGHT = 1e30  # sums over a PSF and over a tile stay finite in float32
SAME_FOCUS = 0.5  # rad; lowers the peak of a PSF by only 2 % (1 - psi^2 / 12), so two depths look equally sharp
OTHER_FOCUS = 100.0  # times the focus distance or a part of it; a scene that is all beyond is probably in another unit
LEAST_MILLIMETRES = 100.0  # m; to this distance a setting is taken for metres, as few lenses focus at 100 mm
UNITS = ((1e-3, "millimetres"), (1e-2, "centimetres"), (1e-6, "micrometres"), (1e-9, "nanometres"))
KILOMETRES = (1e3, "kilometres")
_PREFIXES = (("", "", 1.0), ("k", "kilo", 1e3), ("c", "centi", 1e-2), ("m", "milli", 1e-3), ("u", "micro", 1e-6),
             ("\u00b5", "micro", 1e-6), ("\u03bc", "micro", 1e-6), ("n", "nano", 1e-9))  # fmt: skip
_METRES = {f"{short}m": metres for short, _, metres in _PREFIXES}
_METRES |= {long + metre: metres for _, long, metres in _PREFIXES for metre in ("meter", "metre")}
_METRES |= {"micron": 1e-6, "in": 0.0254, "inch": 0.0254, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048}
_INVERSE_METRES = re.compile(r"1 ?/ ?m(et(er|re)s?)?|m(et(er|re)s?)? ?\^? ?-1|diopt(er|re)s?|dpt")

_TOLD: set[Hashable] = set()  # warnings that were given in this process


def warn_once(told: set[Hashable] | None, key: Hashable, sentence: str, stacklevel: int = 3) -> None:
    """Give a warning the first time that its key occurs.

    Args:
        told: keys of earlier warnings; this one is added. None: those of the whole process.
        key: identifies the warning.
        sentence: text of the warning.
        stacklevel: as for ``warnings.warn``.
    """
    told = _TOLD if told is None else told
    if key not in told:
        told.add(key)
        warnings.warn(sentence, stacklevel=stacklevel)


def metres_in(unit: str) -> float:
    """Return the metres in a unit of length that a file names; 1 for other texts, such as pixels.

    Raises:
        ValueError: if it is that of inverse depth.

    Example:
        >>> metres_in("Millimeters"), metres_in("mm"), metres_in("")
        (0.001, 0.001, 1.0)
    """
    unit = unit.strip().lower()
    if _INVERSE_METRES.fullmatch(unit):
        raise ValueError(f"its numbers are inverse depth by their unit, {unit!r}: save 1 / depth in its place")
    return _METRES.get(unit, _METRES.get(unit.removesuffix("s"), 1.0))


def check_image(image: Tensor, encoded: bool) -> str | None:
    """Check an image's range of values: raise for impossible ones and return a warning for improbable ones.

    Args:
        image: of any shape. Its values are read once.
        encoded: whether the values are sRGB codes, with white at 1, or linear light, which may exceed 1.

    Returns:
        A warning for values that probably are in another unit or normalised, or None.

    Raises:
        ValueError: if a value is NaN or infinite, a code is above 16, or light is beyond 1e30.

    Example:
        >>> check_image(torch.tensor([0.0, 1.0]), encoded=True) is None
        True
        >>> check_image(torch.tensor([0.0, 255.0]), encoded=True)
        Traceback (most recent call last):
        ValueError: image must hold values from 0 to 1, got 255: divide 8-bit values by 255 and 16-bit ones by 65535, \
or give linear light with color_space='linear'
    """
    if not image.numel():
        return None
    lowest, highest = (float(end) for end in torch.aminmax(image.detach()))  # NaN if any value is
    if not (math.isfinite(lowest) and math.isfinite(highest)):
        bad = image[~torch.isfinite(image)][0].item()
        raise ValueError(f"image must be finite, got {bad}")
    beyond = (
        f"image must hold values from 0 to 1, got {highest:.6g}: divide 8-bit values by 255 and 16-bit ones by 65535, "
        f"or give linear light with color_space='linear'"
    )
    if encoded and highest > NONSENSE_CODE:
        raise ValueError(beyond)
    if (worst := max(highest, -lowest)) > (1 + 1e-6) * LARGEST_LIGHT:  # float32 rounds it up
        raise ValueError(f"image must be within {LARGEST_LIGHT:g} to be summed in float32, got {worst:g}")
    darkest = DARKEST_CODE if encoded else DARKEST_LIGHT
    return normalised(lowest, highest, darkest) or (beyond if encoded and highest > BRIGHTEST_CODE else None)


def normalised(lowest: float, highest: float, darkest: float) -> str | None:
    """Return a warning if the extremes of an image are those of one normalised by mean and deviation.

    Args:
        lowest: least value.
        highest: greatest value.
        darkest: least value that raises no warning. Nor does any value above minus a tenth of ``highest``.

    Returns:
        The warning, or None. A NaN gives None.
    """
    if not lowest < darkest or -lowest < 0.1 * highest:
        return None
    return (
        f"image holds values from {lowest:.3g} to {highest:.3g}, and light is not negative: if it was normalised by a "
        f"mean and a deviation, as ImageNet's, undo that first: image * std + mean"
    )


def check_head_image(image: Tensor) -> str | None:
    """Return a warning if a network's input is in 0..255 or normalised by mean and deviation, else None."""
    if not image.numel():
        return None
    lowest, highest = (float(end) for end in torch.aminmax(image.detach()))
    if highest > NONSENSE_CODE and lowest > DARKEST_CODE:
        return f"image holds values up to {highest:.6g}, where networks expect captures in [0, 1]: divide by 255"
    return normalised(lowest, highest, DARKEST_CODE)


def like_infinity(aperture_radius: float) -> float:
    """Return the depth in metres beyond which all depths have one focus, behind a pupil of this radius in metres."""
    return math.pi * aperture_radius**2 / 530e-9 / SAME_FOCUS


def warn_of_metres(names: Sequence[str], metres: Sequence[float], first: float, last: float) -> None:
    """Warn once of the first of some distances that a camera sees as infinity, and would not in another unit.

    Args:
        names: of the distances.
        metres: the distances; infinity gives no warning.
        first: nearest distance that is plausible, in metres.
        last: distance in metres beyond which the camera sees no difference.

    Example:
        >>> warn_of_metres(["focus_distance"], [0.595], 0.05, 24.0)
    """
    last = max(last, LEAST_MILLIMETRES)
    for name, far in zip(names, metres, strict=True):
        likely = [unit for unit in UNITS if first <= far * unit[0] <= last]
        if last < far < math.inf and likely:
            factor, unit = likely[0]
            said = (
                f"{name} is {far:.4g} m away, and this camera sees no difference beyond {last:.3g} m: are these "
                f"{unit}? Multiply it by {factor:g}, or give inf"
            )
            warn_once(None, ("metres", name), said, stacklevel=4)
            return


def check_depth_fits(depth: Tensor, image: Tensor) -> None:
    """Raise ``ValueError`` unless a depth map, (B, 1, H, W) or (1, 1, H, W), has the image's size and batch.

    Example:
        >>> check_depth_fits(torch.ones(1, 1, 8, 9), torch.ones(1, 8, 9, 3))
        Traceback (most recent call last):
        ValueError: depth must have shape (1, 1, 9, 3) to fit the image, got (1, 1, 8, 9): put channels first with \
image.permute(0, 3, 1, 2)
    """
    if depth.shape[1:] == (1, *image.shape[-2:]) and depth.shape[0] in (1, image.shape[0]):
        return
    wanted, remedy = (image.shape[0], 1, *image.shape[-2:]), ""
    if depth.shape[1] != 1:
        remedy = layout_remedy(tuple(depth.shape), 1, "depth")
    elif depth.shape[-2:] == image.shape[1:3]:
        remedy = layout_remedy(tuple(image.shape), 3)
    raise ValueError(f"depth must have shape {wanted} to fit the image, got {tuple(depth.shape)}{remedy}")


def layout_remedy(shape: tuple[int, ...], channels: int, name: str = "image") -> str:
    """Return the indexing or permutation that gives a tensor the expected channels, as the end of an error message.

    Args:
        shape: (B, C, H, W) or (C, H, W), the shape that was given.
        channels: the expected number of channels.
        name: name of the tensor in the message.

    Returns:
        The remedy, or an empty string if none is known.

    Example:
        >>> layout_remedy((1, 4, 8, 8), 3)
        ': drop alpha with image[:, :3]'
        >>> layout_remedy((8, 9, 4), 3)
        ': put channels first with image.permute(2, 0, 1)[:3]'
    """
    batched = len(shape) == 4
    colours, alpha = "[:, :3]" if batched else "[:3]", channels == 3
    if shape[-3] == 4 and alpha:
        return f": drop alpha with {name}{colours}"
    if shape[-1] in (channels, 1) or (shape[-1] == 4 and alpha):
        axes = "0, 3, 1, 2" if batched else "2, 0, 1"
        return f": put channels first with {name}.permute({axes}){colours if shape[-1] == 4 != channels else ''}"
    return ""
