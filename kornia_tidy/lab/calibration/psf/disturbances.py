"""Disturbances of a PSF measurement that its own data reveal, each told in one sentence before the computation."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence

import torch

from kornia_tidy.lab.calibration.psf.point_images import PointImage
from kornia_tidy.optics.thin_lens import ThinLensCamera

MOST_AROUND = 0.1  # share of the light between the window and the annulus; with more, the background is a guess
MOST_DIAMETER = 0.5  # pixels, of a point's image, whose blur can be corrected to second order
LEAST_MOVEMENT = 4.0  # pixels, about the size of a grain of dust
LEAST_CHANCE = 1e-3  # that brightest values are alike without being clipped


def check_diameter(diameter: float, distances: Sequence[float], camera: ThinLensCamera) -> None:
    """Refuse a point of light with a large image.

    Raises:
        ValueError: if the diameter is negative or not a number, or the image is wider than half a pixel.
    """
    if not diameter >= 0:
        raise ValueError(f"diameter must be metres, 0 or more, got {diameter:g}")
    sizes = {z: image_diameter(diameter, z, camera) for z in distances}
    nearest = max(sizes, key=sizes.__getitem__)
    if sizes[nearest] > MOST_DIAMETER:
        raise ValueError(
            f"the image of a point of {1e6 * diameter:g} um at {nearest:g} m is {sizes[nearest]:.2g} pixels wide, at "
            f"most {MOST_DIAMETER:g} are allowed: take a pinhole of "
            f"{1e6 * diameter * MOST_DIAMETER / sizes[nearest]:.2g} um or less"
        )


def image_diameter(diameter: float, distance: float, camera: ThinLensCamera) -> float:
    """Return the diameter of an object's image in pixels.

    Example:
        >>> round(image_diameter(20e-6, 0.5, ThinLensCamera()), 2)
        0.27
    """
    return diameter * float(camera.image_distance) / distance / camera.pixel_pitch


def check_clipping(images: Mapping[float, Sequence[PointImage]]) -> None:
    r"""Refuse captures that are clipped below the stated saturation.

    Shot noise makes the brightest values of captures differ. Clipped values differ by the read noise only. Of N normal
    values of standard deviation :math:`\sigma`, k lie within d of the highest with a chance of about

    .. math:: p = (1 - e^{-d \sqrt{2 \ln N} / \sigma})^{k - 1}

    or less, as the point's place between the pixels also makes them differ.

    Raises:
        ValueError: if at one distance the chance is below one in a thousand that so many brightest values are alike.

    Source: David and Nagaraja, Order Statistics (2003), section 10.5, for the spacings next to the highest.
    """
    for distance, at_distance in images.items():
        good = [image for image in at_distance if image.fault is None and image.peaks.ndim > 1]
        if len({image.peaks.shape for image in good}) != 1:
            continue
        peaks, shot = (torch.stack([getattr(image, name) for image in good]) for name in ("peaks", "peak_shot"))
        highest, near = peaks.amax(0), 3 * good[0].peak_noise
        alike = (peaks >= highest - near).sum(0)
        spacing = shot.mean(0).clamp(min=1e-12) / math.sqrt(2 * math.log(max(2, len(good))))
        chance = (1 - torch.exp(-near / spacing)).pow(alike - 1)
        if float(chance.min()) < LEAST_CHANCE:
            worst = int(chance.argmin())
            raise ValueError(
                f"{int(alike.flatten()[worst])} of {len(good)} captures at {distance:g} m have the same brightest "
                f"value, {float(highest.flatten()[worst]):.3f} of full scale, but for the read noise: the sensor "
                f"saturates there. Expose less, or correct the full scale or the saturation"
            )


def warn_of_still_point(images: Mapping[float, Sequence[PointImage]]) -> None:
    """Warn of a point that moves less than a grain of dust is wide, so that dust would look like a part of the PSF."""
    movements = {}
    for distance, at_distance in images.items():
        places = torch.tensor([image.place for image in at_distance if image.fault is None], dtype=torch.float64)
        tile = at_distance[0].tile if at_distance else None
        if len(places) > 1:
            movements[distance] = (1 if tile is None else len(tile)) * float((places.amax(0) - places.amin(0)).max())
    if movements and min(movements.values()) < LEAST_MOVEMENT:
        distance = min(movements, key=movements.__getitem__)
        warnings.warn(
            f"the point at {distance:g} m moves by {movements[distance]:.1f} pixels between the captures, so that dust "
            f"on the sensor would be taken for a part of the PSF: move it by {LEAST_MOVEMENT:g} or more",
            stacklevel=3,
        )


def warn_of_light_around(shares: Mapping[float, float], window: int) -> None:
    """Warn of light beyond the window, since an unknown part of it was subtracted with the background.

    Args:
        shares: for each distance, the share of the light between the window and the circle of radius P.
        window: side P in pixels.
    """
    distance = max(shares, key=shares.__getitem__)
    if shares[distance] > MOST_AROUND:
        warnings.warn(
            f"{shares[distance]:.0%} of the light at {distance:g} m lies around the window of {window} pixels, at most "
            f"{MOST_AROUND:.0%} are allowed, as some of it is taken for background: take a wider window",
            stacklevel=3,
        )


def share_around(mean: float, window: int) -> float:
    """Return the light between a window and the circle of radius P, from its mean in units of the window's light.

    Example:
        >>> round(share_around(1 / 441, 21), 2)
        0.68
    """
    around = (math.pi - 1) * window**2 * mean
    return around / (1 + around)
