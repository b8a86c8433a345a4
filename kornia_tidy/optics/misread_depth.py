"""Depth maps in another unit: recognised by the camera that they are for."""

from __future__ import annotations

from torch import Tensor

from kornia_tidy.arrays import FARTHEST
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.optics.units import SAME_FOCUS, like_infinity, misread_metres


def misread_depth(camera: ThinLensCamera | DefocusRange, lowest: Tensor, highest: Tensor) -> str | None:
    """Return a warning if depths are probably in millimetres or centimetres instead of metres.

    Three conditions must hold. The nearest pixel is so far that its focus equals that of infinity or of the far end of
    the camera's range. No pixel is at infinity, as sky is. In the other unit the nearest depth lies in the camera's
    range.

    Args:
        camera: converts depth to defocus.
        lowest: defocus of the farthest pixel in radians.
        highest: defocus of the nearest pixel in radians.

    Returns:
        The warning, or None.

    Example:
        >>> import torch
        >>> camera = ThinLensCamera()
        >>> misread_depth(camera, *camera.defocus(torch.tensor([1500.0, 700.0])))
        'the nearest pixel is 700 m away, and this camera sees no difference beyond 23.8 m: are these \
millimetres? Multiply depth by 0.001 (on the command line: --depth-scale 0.001)'
        >>> misread_depth(camera, *camera.defocus(torch.tensor([1.5, 0.7]))) is None
        True
    """
    if float(highest) > camera.defocus_range[0] + SAME_FOCUS or isinstance(camera, DefocusRange):
        return None
    nearest, farthest = (float(camera.depth(psi).detach()) for psi in (highest, lowest))
    if farthest > FARTHEST:
        return None
    first, last = camera.depth_range
    remedy = "depth by {0:g} (on the command line: --depth-scale {0:g})"
    return misread_metres("the nearest pixel", nearest, first, min(last, like_infinity(camera.aperture_radius)), remedy)
