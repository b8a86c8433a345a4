"""Distortion and lateral colour of a real lens: a scene as its rays place it on the sensor, before it is blurred."""

from __future__ import annotations

from typing import Any

import torch
from kornia.geometry.transform import remap
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_float_tensor
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.psf.field import check_centers

_HEIGHTS = 513  # at which rays are looked up; between them ratios of heights are interpolated linearly


def distorted(optics: TiDyOptics, image: Tensor, depth: Tensor, field_center: Any = None) -> tuple[Tensor, Tensor]:
    r"""Distort a scene as the lens of a camera does, each channel by the lateral colour of its light.

    .. math:: I_c(p) = I^0_c\!\left(\frac{p}{1 + D(h)} \frac{h}{|p|}\right), \qquad h + \Delta_c(h) = |p|

    with the distortion D, the lateral colour of a channel :math:`\Delta_c` and pixels p from the axis.

    Args:
        optics: the camera with its lens.
        image: (B, C, H, W) or (C, H, W), as a pinhole at the entrance pupil sees the scene.
        depth: (B, 1, H, W) or (1, H, W) in metres.
        field_center: where the middle of the picture lies from the axis, (2,) or (B, 2), y and x in sensor pixels.
            Default: the camera's.

    Returns:
        Image and depth of the same shapes, for ``optics(image, depth)``: captures are then aligned with both. Images
        are interpolated bilinearly, so that gradients reach them; depths are those of the nearest pixel, at 530 nm.
        Beyond the picture its border is repeated.

    Raises:
        TypeError: if image or depth are not floating-point tensors.
        ValueError: if the camera has no lens, or image and depth do not fit each other or the spectrum.

    Convention:
        - As of things in focus: that images grow a little out of focus is not in it.

    Example:
        >>> from kornia_tidy import NoMask
        >>> optics = TiDyOptics(NoMask(23), lens="single-50mm")
        >>> image, depth = distorted(optics, torch.rand(3, 64, 64), torch.ones(1, 64, 64), field_center=(400.0, 500.0))
        >>> image.shape, depth.shape
        (torch.Size([3, 64, 64]), torch.Size([1, 64, 64]))
    """
    rank = 4 if not isinstance(image, Tensor) or image.ndim != 3 else 3
    check_float_tensor("image", image, rank, "(B, C, H, W) or (C, H, W)")
    check_float_tensor("depth", depth, rank, "(B, 1, H, W) or (1, H, W), as the image is batched or not")
    if optics.lens is None:
        raise ValueError("distortion needs a camera with a lens, got none: give it lens='double-gauss-50mm' or another")
    light, deep = (image, depth) if rank == 4 else (image[None], depth[None])
    if deep.shape[1:] != (1, *light.shape[-2:]) or len(deep) not in (1, len(light)):
        raise ValueError(f"depth must have one map for each image {tuple(image.shape)}, got {tuple(depth.shape)}")
    spectrum, pitch = optics.psf_model.spectrum_of(light.shape[1]), float(optics.camera.pixel_pitch)
    centers = check_centers(optics.field_center if field_center is None else field_center, len(light))
    size = light.shape[-2], light.shape[-1]
    seen, there = [], []
    for i, one in enumerate(light.split(1)):
        center, own = centers[min(i, len(centers) - 1)], deep[min(i, len(deep) - 1)][None]
        *maps, green = _sources(optics.lens, spectrum, pitch, size, center)
        channels = [_taken(one[:, c : c + 1], maps[c], "bilinear") for c in range(one.shape[1])]
        seen.append(torch.cat(channels, 1))
        there.append(_taken(own, green, "nearest"))
    whole = torch.cat(seen), torch.cat(there)
    return whole if rank == 4 else (whole[0][0], whole[1][0])


def _sources(
    lens: Lens, spectrum: Spectrum, pitch: float, size: tuple[int, int], center: tuple[float, float]
) -> list[Tensor]:
    """Return where each pixel of a channel comes from, row and column (2, H, W), and last that of 530 nm."""
    rows, columns = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2 + c for n, c in zip(size, center, strict=True))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    radius = torch.hypot(y, x) * pitch
    landed = torch.linspace(0, max(float(radius.max()), 1e-9), _HEIGHTS, dtype=torch.float64)
    shares = torch.tensor(spectrum.channel_weights, dtype=torch.float64)
    found = []
    for share in [*shares, None]:
        height = landed
        for _ in range(0 if share is None else 3):  # contracts by a thousandth each time
            apart = [lens.lateral_colour(height, wave) for wave in spectrum.wavelengths]
            height = landed - torch.tensordot(share, torch.stack(apart), 1)
        ratio = height / (1 + lens.distortion(height)) / landed.clamp(min=1e-12)
        ratio[0] = ratio[1]
        at = (radius / landed[-1] * (_HEIGHTS - 1)).clamp(max=_HEIGHTS - 1.000001)
        below = at.long()
        scale = torch.lerp(ratio[below], ratio[below + 1], at - below)
        back = zip((y, x), size, center, strict=True)
        found.append(torch.stack([p * scale - c + (n - 1) / 2 for p, n, c in back]))
    return found


def _taken(plane: Tensor, source: Tensor, mode: str) -> Tensor:
    dtype = torch.promote_types(plane.dtype, torch.float32)
    y, x = source.to(plane.device, dtype)[:, None]
    return remap(plane.to(dtype), x, y, mode, "border", align_corners=True).to(plane.dtype)
