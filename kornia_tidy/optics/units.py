"""Values in a wrong unit: what was probably meant, and the remedy in the same sentence."""

from __future__ import annotations

import math
import warnings
from collections.abc import Hashable
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor

from kornia_tidy.runtime.threads import CaptureNotes

if TYPE_CHECKING:
    from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera

# Noise and interpolation go a little beyond [0, 1], and no encoding of light beyond white goes above 2.39 (scRGB).
# An image normalised by ImageNet's statistics reaches -2.12 and 2.64, one in 8 bits 255.
BRIGHTEST_CODE, NONSENSE_CODE, DARKEST_CODE = 2.5, 16.0, -0.5
DARKEST_LIGHT = -1.0  # colours that no display has are below zero in linear light
LARGEST_LIGHT = 1e30  # sums over a PSF and over a tile stay finite in float32
SAME_FOCUS = 0.5  # radians at the pupil's edge, which take 2 % of the peak of a point (1 - psi^2 / 12): not to be seen
FARTHEST = 1e5  # m; beyond, a pixel is sky, which no map in millimetres holds
UNITS = ((1e-3, "millimetres"), (1e-2, "centimetres"))

_NOTES = CaptureNotes()  # of what is told once a process


def tell_once(notes: CaptureNotes | None, key: Hashable, sentence: str, stacklevel: int = 3) -> None:
    """Warn, unless the same was warned of before; threads that ask at once hear it once.

    Args:
        notes: of the camera that warns; None for what is told once a process.
        key: what the warning is about.
        sentence: the warning.
        stacklevel: of the caller to blame, as for ``warnings.warn``.
    """
    if (_NOTES if notes is None else notes).first_time(key):
        warnings.warn(sentence, stacklevel=stacklevel)


def check_image(image: Tensor, encoded: bool) -> str | None:
    """Refuse images without sense and return a sentence on those that probably are in another unit. One pass.

    Args:
        image: of any shape.
        encoded: whether 1 is white (sRGB codes), or light that may go beyond 1.

    Returns:
        What is to be told, or None.

    Raises:
        ValueError: if a value is NaN or infinite, a code is above 16, or light beyond 1e30.

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
    if (worst := max(highest, -lowest)) > LARGEST_LIGHT:
        raise ValueError(f"image must be within {LARGEST_LIGHT:g} to be summed in float32, got {worst:g}")
    darkest = DARKEST_CODE if encoded else DARKEST_LIGHT
    return normalised(lowest, highest, darkest) or (beyond if encoded and highest > BRIGHTEST_CODE else None)


def normalised(lowest: float, highest: float, darkest: float) -> str | None:
    """Return a sentence on an image whose extremes are those of a normalised one, else None, for NaN too.

    Args:
        lowest: least value.
        highest: greatest value.
        darkest: how far below zero values may be, and a tenth of the greatest in any case.
    """
    if not lowest < darkest or -lowest < 0.1 * highest:
        return None
    return (
        f"image holds values from {lowest:.3g} to {highest:.3g}, and light is not negative: if it was normalised by a "
        f"mean and a deviation, as ImageNet's, undo that first: image * std + mean"
    )


def check_head_image(image: Tensor) -> str | None:
    """Return a sentence on a network's input that is in 0..255 or normalised, else None."""
    if not image.numel():
        return None
    lowest, highest = (float(end) for end in torch.aminmax(image.detach()))
    if highest > NONSENSE_CODE and lowest > DARKEST_CODE:
        return f"image holds values up to {highest:.6g}, where networks expect captures in [0, 1]: divide by 255"
    return normalised(lowest, highest, DARKEST_CODE)


def misread_depth(camera: ThinLensCamera | DefocusRange, lowest: Tensor, highest: Tensor) -> str | None:
    """Return a sentence on depths that look like millimetres or centimetres taken for metres, else None.

    Told where the nearest pixel is too far for the camera to tell it from infinity or from the far end of its range,
    where no pixel is at infinity, as sky is, and where the nearest depth would suit the camera in the other unit.

    Args:
        camera: turns depth into defocus.
        lowest: defocus of the farthest pixel in radians.
        highest: defocus of the nearest pixel.

    Example:
        >>> from kornia_tidy import ThinLensCamera
        >>> camera = ThinLensCamera()
        >>> misread_depth(camera, *camera.defocus(torch.tensor([1500.0, 700.0])))
        'the nearest pixel is 700 m away, where this camera sees no difference from infinity: are these millimetres? \
Multiply depth by 0.001 (on the command line: --depth-scale 0.001)'
        >>> misread_depth(camera, *camera.defocus(torch.tensor([1.5, 0.7]))) is None
        True
    """
    if float(highest) > camera.defocus_range[0] + SAME_FOCUS or not hasattr(camera, "depth_range"):
        return None
    lens = cast("ThinLensCamera", camera)
    nearest, farthest = (float(lens.depth(psi).detach()) for psi in (highest, lowest))
    first, last = lens.depth_range
    alike = math.pi * lens.aperture_radius**2 / 530e-9 / SAME_FOCUS  # from here on all is as at infinity
    last = min(last, alike)
    if nearest <= last or farthest > FARTHEST:
        return None
    for factor, unit in UNITS:
        if first <= nearest * factor <= last:
            return (
                f"the nearest pixel is {nearest:.4g} m away, where this camera sees no difference from "
                f"{'infinity' if last == alike else f'{last:.3g} m'}: are these {unit}? Multiply depth by {factor:g} "
                f"(on the command line: --depth-scale {factor:g})"
            )
    return None


def layout_remedy(shape: tuple[int, ...], channels: int, name: str = "image") -> str:
    """Return how to lay out a tensor whose channels are wrong, to be put behind a message; empty where nobody knows.

    Args:
        shape: (B, C, H, W) or (C, H, W), as it was given.
        channels: that are wanted.
        name: of the tensor.

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
