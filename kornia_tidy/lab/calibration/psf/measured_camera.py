"""A camera whose PSFs were measured: the file of ``kornia-tidy raw calibrate-psf`` as a camera."""

from __future__ import annotations

import os
from typing import Any

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.lab.calibration.psf.measured_psfs import MeasuredPSFs
from kornia_tidy.masks.fresnel import FresnelLens


def measured_camera(psfs: MeasuredPSFs | str | os.PathLike[str], **options: Any) -> TiDyOptics:
    """Return a camera that takes pictures through measured PSFs, with the lens that they were measured with.

    Args:
        psfs: the measurement, or the file of one.
        options: of :class:`~kornia_tidy.TiDyOptics`, such as ``sensor`` or ``compositing``; not ``masks`` or
            ``camera``, which were measured.

    Returns:
        The camera. Its range of depth reaches from the nearest to the farthest distance that was measured; other depths
        are seen as the end of the range. Between two distances PSFs are mixed linearly.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file holds no measured PSFs, or the lens is unknown.

    Example:
        >>> import torch
        >>> from kornia_tidy import PSFBank, ThinLensCamera
        >>> lens, distances = ThinLensCamera(depth_range=(0.5, 0.8)), torch.tensor([0.8, 0.5])
        >>> bank = PSFBank.from_measured(torch.rand(2, 3, 5, 5), lens.defocus(distances))
        >>> optics = measured_camera(MeasuredPSFs(bank, torch.zeros(2, 3, 5, 5), distances, camera=lens))
        >>> optics.window, optics.camera.depth_range
        (5, (0.5, 0.8))
    """
    measured = psfs if isinstance(psfs, MeasuredPSFs) else MeasuredPSFs.load(psfs)
    camera = measured.known_camera()
    optics = TiDyOptics(FresnelLens(), **options).with_bank(measured.bank)
    optics.camera = camera  # not before: PSFs of this lens without its masks may be too wide to be computed
    return optics
