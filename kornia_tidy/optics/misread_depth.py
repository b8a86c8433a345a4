"""Depth maps in another unit: recognised by the camera that they are for."""

from __future__ import annotations

import math

from kornia_tidy.arrays import FARTHEST
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera, number_of
from kornia_tidy.optics.units import KILOMETRES, OTHER_FOCUS, UNITS, like_infinity


def misread_depth(camera: ThinLensCamera | DefocusRange, nearest: float, farthest: float) -> str | None:
    """Return a warning if depths are probably in another unit than metres.

    It is one of these. The nearest pixel is so far that its focus equals that of infinity, or beyond the camera's range
    or a hundred focus distances, and none is beyond 100 km, as sky is. All are beyond 100 km, and not all at infinity.
    The farthest pixel is within a hundredth of the focus distance. In the other unit the camera's range has the scene.

    Args:
        camera: that the map is for.
        nearest: least depth of the map.
        farthest: greatest depth of the map.

    Returns:
        The warning, or None.

    Example:
        >>> misread_depth(ThinLensCamera(), 700, 1500)
        "the nearest pixel is 700 m away, far from the camera's focus: are these millimetres? Multiply depth by 0.001 \
(on the command line: --depth-scale 0.001)"
        >>> misread_depth(ThinLensCamera(), 0.7, 1.5) is None
        True
    """
    if isinstance(camera, DefocusRange):
        return None
    first, last = camera.depth_range
    focus = number_of(camera.focus_distance)
    last = min(last, like_infinity(camera.aperture_radius), OTHER_FOCUS * focus)
    sky = FARTHEST < nearest < math.inf
    if sky or last < nearest <= farthest <= FARTHEST:
        which, away, units = "nearest", nearest, UNITS
    elif farthest < min(focus, 2 * first) / OTHER_FOCUS:
        which, away, units = "farthest", farthest, (KILOMETRES,)
    else:
        return None
    likely = [unit for unit in units if first / 4 <= away * unit[0] <= last]
    remedies = [
        f"are these {unit}? Multiply depth by {factor:g} (on the command line: --depth-scale {factor:g})"
        for factor, unit in likely[:1]
    ]
    if sky:
        remedies.append("give a sky as infinity")
    if not remedies:
        return None
    return f"the {which} pixel is {away:.4g} m away, far from the camera's focus: {'; '.join(remedies)}"
