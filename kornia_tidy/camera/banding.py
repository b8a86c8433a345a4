"""Captures of large images, some rows at a time, so that they fit the memory allowed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.camera.bank_pieces import image_budget
from kornia_tidy.camera.capture_psfs import capture_psfs
from kornia_tidy.camera.samples import BYTES_A_VALUE, BYTES_OF_TILES, Sample, check_light, cropped, survey_defocus
from kornia_tidy.render.bands import padded_band
from kornia_tidy.render.borders import check_border
from kornia_tidy.runtime.tracing import is_followed
from kornia_tidy.sensor.noise import STRIP


def rows_at_once(camera: Any, sample: Sample) -> int | None:
    """Return how many rows fit the memory allowed; None where all do, or where the whole image is needed."""
    image, depth = sample.image, sample.depth
    learning = torch.is_grad_enabled() and (
        image.requires_grad or depth.requires_grad or any(p.requires_grad for p in camera.parameters())
    )
    spread = camera.fidelity.stray_light == "veil"
    # Beyond a zero border there is nothing that hides, which black pixels would.
    unseen = camera.compositing == "occlusion" and camera.border == "zero"
    if learning or is_followed() or spread or unseen or not len(image):
        return None
    if sample.bytes_at_once <= (allowed := image_budget(camera, sample)):
        return None
    row = 3 * BYTES_A_VALUE * sample.dtype.itemsize // 4 * image.shape[0] * image.shape[-1]
    rows = max(STRIP, (allowed - BYTES_OF_TILES) // row // STRIP * STRIP)
    return None if rows >= image.shape[-2] else rows


def capture_in_bands(
    camera: Any,
    sample: Sample,
    rows: int,
    params: Mapping[str, Tensor] | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Take the picture some rows at a time, each with as much of its neighbours as the PSFs reach.

    Args:
        camera: a :class:`~kornia_tidy.TiDyOptics` as it is at one moment.
        sample: image and depth.
        rows: rows of a band, a multiple of those that the sensor's noise is drawn for at once.
        params: noise of the whole capture, drawn before.
        generator: source of the noise.

    Returns:
        The capture. It equals the capture at once but for rounding.
    """
    image, depth, dtype, radius = sample.image, sample.depth, sample.dtype, camera.window // 2
    check_border(camera.border, *image.shape[-2:], camera.window)
    height, width = cropped(image, radius if camera.border == "valid" else 0).shape[-2:]
    if image.device.type != "cpu":
        check_light(image, camera)
    span = survey_defocus((camera.defocus(part.to(dtype)) for part in depth.split(rows, dim=-2)), camera)
    banks = capture_psfs(camera, image.shape[1], dtype, span.reach, span.reach)
    sides = "replicate" if camera.border == "zero" else camera.border  # black has no depth of its own
    coded = image.new_empty(*image.shape[:2], height, width)
    for top in range(0, height, rows):
        band = slice(top, min(top + rows, height))
        light = camera.decode(padded_band(image, band, radius, camera.border).to(dtype))
        defocus = camera.defocus(padded_band(depth, band, radius, sides).to(dtype))
        irradiance = camera.render(light, defocus, banks, "valid")
        own = None if params is None else {name: field[..., band, :] for name, field in params.items()}
        coded[..., band, :] = camera.encode(camera.expose(irradiance, own, generator)).to(image.dtype)
    return coded
