"""The argument lens=: a real lens, or its name, for a camera that an augmentation makes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_part
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.thin_lens import ThinLensCamera


def lens_parts(lens: Lens | str | None, pixel_pitch: float | None = None) -> dict[str, Any]:
    """Return a lens with its camera, as :class:`~kornia_tidy.TiDyOptics` takes them.

    Args:
        lens: a lens; a name, made for the default camera's f-number and focus; or None.
        pixel_pitch: of the sensor in metres. Default: that of the default camera.

    Example:
        >>> lens_parts("double-gauss-50mm")["camera"].focal_length
        0.0514...
    """
    if lens is None:
        return {}
    check_part("lens", lens, (Lens, str), "a Lens or the name of one such as 'double-gauss-50mm'")
    usual = ThinLensCamera()
    own = Lens.named(lens, usual.f_number, float(usual.focus_distance)) if isinstance(lens, str) else lens
    return {"camera": own.camera(usual.pixel_pitch if pixel_pitch is None else pixel_pitch), "lens": own}


def lens_optics(
    optics: TiDyOptics | None, lens: Lens | str | None, make: Callable[[Lens | str | None], TiDyOptics]
) -> TiDyOptics:
    """Return the camera that was given, or one that is made behind a lens.

    Args:
        optics: the camera.
        lens: for a camera that is made.
        make: makes it.

    Raises:
        TypeError: if the camera is none.
        ValueError: if a camera and a lens are given.
    """
    if optics is None:
        return make(lens)
    check_part("optics", optics, TiDyOptics, "a camera such as TiDyOptics()")
    if lens is not None:
        raise ValueError("optics has its own lens: give lens to TiDyOptics, or leave optics out")
    return optics
