"""Cameras of the experiments: one lens with masks, or without them at any f-number, with equal exposure time."""

from __future__ import annotations

from typing import Any

import torch

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.masks.base import PhaseMasks
from kornia_tidy.reconstruction.tasks import metres
from kornia_tidy.reconstruction.trained import fix_window
from kornia_tidy.sensor.exposure import exposed_sensor

ELECTRONS, F_NUMBER = 2000.0, 17.6
"""Electrons of a white pixel at f/17.6. Other f-numbers have the same exposure time.

The noise at a fifth of full scale is then 0.01, which is that of PhaseCam3D; TiDy-PSFs states none.
"""
REFERENCE = ThinLensCamera()  # depths of all scenes are painted for it, and stretched to the range of other cameras


def sensor_at(f_number: float) -> SensorNoise:
    """Return the sensor of a camera, with shot and read noise, for the same exposure time at every f-number."""
    return exposed_sensor(f_number, ELECTRONS, F_NUMBER)


def camera_with(masks: PhaseMasks, fidelity: Fidelity, lens: ThinLensCamera = REFERENCE, **parts: Any) -> TiDyOptics:
    """Return a camera with masks and the sensor of equal exposure time; its PSF window stays as it is now."""
    parts = {"sensor": sensor_at(lens.f_number), **parts}
    return fix_window(TiDyOptics(masks, lens, fidelity=fidelity, **parts))


def flat_lens(f_number: float, focus: float, fidelity: Fidelity) -> TiDyOptics:
    """Return a lens without masks over the depths of :data:`REFERENCE`.

    Args:
        f_number: focal length over aperture.
        focus: in focus, in parts of the range of inverse depth: 0 is the far end.
        fidelity: by which PSFs are computed.
    """
    distance = float(metres(REFERENCE, torch.tensor(focus, dtype=torch.float64)))
    lens = ThinLensCamera(
        REFERENCE.focal_length,
        REFERENCE.focal_length / f_number,
        distance,
        REFERENCE.pixel_pitch,
        REFERENCE.depth_range,
    )
    return camera_with(PixelwiseMask(1, initial="flat"), fidelity, lens).requires_grad_(requires_grad=False)


def pinhole(fidelity: Fidelity) -> TiDyOptics:
    """Return a camera with captures in focus everywhere: a small aperture, and pixels wider than its PSF."""
    lens = ThinLensCamera(50e-3, 0.5e-3, REFERENCE.focus_distance, 300e-6, REFERENCE.depth_range)
    optics = camera_with(PixelwiseMask(1, initial="flat"), fidelity, lens, sensor=sensor_at(F_NUMBER))
    return optics.requires_grad_(requires_grad=False)
