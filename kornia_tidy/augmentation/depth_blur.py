"""Depth-dependent blur of an ordinary lens by geometrical optics: a disc for each pixel, of its depth's radius."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.augmentation.depth_augmentation import DepthAugmentation
from kornia_tidy.augmentation.lens_argument import lens_parts
from kornia_tidy.augmentation.ranges import Range, checked_range, uniform_draws
from kornia_tidy.augmentation.rows import row_places
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import (
    check_choice,
    check_depth,
    check_float_tensor,
    check_positive,
)
from kornia_tidy.choices import COMPOSITING
from kornia_tidy.kernels.pixel_ops import decode, encode
from kornia_tidy.masks.no_mask import NoMask
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.optics.aperture import disc_cover
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.misread_depth import misread_depth
from kornia_tidy.optics.thin_lens import NEAREST_DEPTH, ThinLensCamera, check_lens
from kornia_tidy.optics.units import check_depth_fits, check_image, warn_of_metres, warn_once
from kornia_tidy.render.compositing import COMPOSITING as RENDERERS

_SHARP = 0.5  # pixels: a disc of this radius, or a smaller one, is a point
# Discs are computed where log(radius + _OFFSET) is evenly spaced, about so many for each factor of e. The larger two
# discs are, the farther apart they may be for the same error of their blend.
_OFFSET, _DENSITY = 1.0, 6.0
COLOR_SPACES = ("srgb", "linear")
_ARGUMENTS = (
    "focus_distance", "f_number", "focal_length", "pixel_pitch", "max_radius", "compositing", "color_space",
)  # fmt: skip


def blur_radius(
    depth: Tensor,
    focus_distance: float | Tensor,
    f_number: float | Tensor,
    focal_length: float = 50e-3,
    pixel_pitch: float = 8e-6,
) -> Tensor:
    r"""Return the radius of the blur disc of a thin lens, in pixels.

    .. math:: r(z) = \frac{f}{2 N p} \, s' \left( \frac{1}{z} - \frac{1}{z_f} \right),
        \qquad s' = \left( \frac{1}{f} - \frac{1}{z_f} \right)^{-1}

    Args:
        depth: distance z in metres, any shape; ``inf`` is allowed. Those below 1e-18 m count as that, with a gradient
            of 0.
        focus_distance: distance z_f in focus, in metres; a tensor must broadcast with the depth.
        f_number: N, focal length over aperture diameter.
        focal_length: f in metres.
        pixel_pitch: p in metres.

    Returns:
        Pixels, of the depth's shape; positive nearer than focus, negative beyond.

    Source: Hecht, Optics, section 5.2; Goodman, Introduction to Fourier Optics, section 6.4.

    Example:
        >>> blur_radius(torch.tensor([0.5, 1.0, torch.inf]), 1.0, 8.0).round(decimals=1)
        tensor([ 20.6000,   0.0000, -20.6000])
    """
    image_distance = 1 / (1 / focal_length - 1 / focus_distance)
    inverse = depth.clamp(min=NEAREST_DEPTH).reciprocal()
    return focal_length / (2 * f_number * pixel_pitch) * image_distance * (inverse - 1 / focus_distance)


def depth_blur(
    image: Tensor,
    depth: Tensor,
    focus_distance: float | Tensor,
    f_number: float | Tensor,
    focal_length: float = 50e-3,
    pixel_pitch: float = 8e-6,
    max_radius: float = 16.0,
    compositing: str = "gather",
    color_space: str = "srgb",
) -> Tensor:
    """Blur each pixel of an image by the disc that an ordinary lens makes at its depth.

    Args:
        image: (B, C, H, W) in [0, 1].
        depth: (B, 1, H, W) or (1, 1, H, W) in metres, positive; ``inf`` is allowed.
        focus_distance: metres, beyond the focal length; one, or one for each image, (B,).
        f_number: focal length over aperture diameter; one, or one for each image, (B,).
        focal_length: metres.
        pixel_pitch: metres.
        max_radius: pixels; larger discs are taken as this one.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``, see :func:`kornia_tidy.render.render`.
        color_space: ``"srgb"`` is decoded to linear light and encoded after; ``"linear"`` is blurred directly.

    Returns:
        The blurred images: shape and type of ``image``, computed in float32 or better. Gradients reach image and depth.

    Raises:
        TypeError: if image or depth are not floating-point tensors.
        ValueError: if shapes do not fit, a depth is not positive, the image has NaN or sRGB values above 16, or a
            setting is out of its range.

    Convention:
        - Geometrical optics: no diffraction. A radius below half a pixel is sharp. For phase masks and diffraction see
          :class:`~kornia_tidy.TiDyOptics`.
        - Discs are computed at 16 radii up to 16 px (see :func:`disc_layer`), with the exact area in each pixel, and
          blended between: the blend differs from the disc in between by at most 0.15 of its light (L1). In a scene of
          leaves that is 7e-4 of full scale (rms), less than 8 bits round.
        - The border is replicated.

    Source: Potmesil and Chakravarty: A lens and aperture camera model for synthetic image generation, SIGGRAPH 1981,
    for blur by discs.

    Example:
        >>> image = torch.rand(2, 3, 32, 32)
        >>> sharp = depth_blur(image, torch.full((2, 1, 32, 32), 1.5), focus_distance=1.5, f_number=2.8)
        >>> torch.allclose(sharp, image, atol=1e-5)
        True
    """
    check_float_tensor("image", image, 4, "(B, C, H, W)")
    check_float_tensor("depth", depth, 4, "(B, 1, H, W) or (1, 1, H, W)")
    if not image.numel():
        return image
    for name, value in (("focus_distance", focus_distance), ("f_number", f_number)):
        if isinstance(value, Tensor) and value.numel() not in (1, len(image)):
            raise ValueError(f"{name} must be one number or one for each of {len(image)} images, got {value.numel()}")
    _check_lens(focus_distance, f_number, focal_length, pixel_pitch, max_radius, compositing, color_space)
    check_depth_fits(depth, image)
    if Mode.GRAPH not in torch_mode():
        check_depth(depth)
        if (said := check_image(image, encoded=color_space == "srgb")) is not None:
            warn_once(None, "image in depth_blur", said)
        _warn_of_unit(depth.detach(), f_number, focal_length, pixel_pitch)
    dtype = torch.promote_types(image.dtype, torch.float32)
    focus, aperture = (
        value.to(depth.device, dtype).reshape(-1, 1, 1, 1) if isinstance(value, Tensor) else value
        for value in (focus_distance, f_number)
    )
    radius = blur_radius(depth.to(dtype), focus, aperture, focal_length, pixel_pitch)
    radius = radius.clamp(-max_radius, max_radius)
    if compositing != "occlusion":
        radius = radius.abs()  # near and far discs are alike: only occlusion needs their order
    layer = disc_layer(radius, max_radius)
    light = decode(image.to(dtype), color_space)
    blurred = RENDERERS[compositing](light, layer, *_discs(layer, image.shape[1], max_radius), border="replicate")
    return encode(blurred, color_space).to(image.dtype)


def _warn_of_unit(depth: Tensor, f_number: float | Tensor, focal_length: float, pixel_pitch: float) -> None:
    """Warn once of depths as sharp as infinity, or in the lens, that the default camera takes for another unit."""
    if not depth.numel():
        return
    ends = torch.stack(torch.aminmax(depth)).float().cpu()
    fastest = f_number.min().cpu() if isinstance(f_number, Tensor) else f_number
    far = blur_radius(ends[0], math.inf, fastest, focal_length, pixel_pitch) < _SHARP
    if far or ends[1] < focal_length:
        said = misread_depth(ThinLensCamera(), *ends.tolist())
        if said is not None:
            warn_once(None, "unit of depth in depth_blur", said, stacklevel=4)


def _check_lens(
    focus_distance: float | Tensor,
    f_number: float | Tensor,
    focal_length: float,
    pixel_pitch: float,
    max_radius: float,
    compositing: str,
    color_space: str,
) -> None:
    """Raise an error unless these settings are those of a lens."""
    check_choice("color_space", color_space, COLOR_SPACES)
    check_choice("compositing", compositing, COMPOSITING)
    check_positive("max_radius", max_radius, "pixels")
    tensors = isinstance(focus_distance, Tensor) or isinstance(f_number, Tensor)
    if tensors and Mode.GRAPH in torch_mode():  # which shows no values
        return
    nearest, fastest = (float(v.detach().min()) if isinstance(v, Tensor) else v for v in (focus_distance, f_number))
    check_lens(focal_length, nearest, fastest, pixel_pitch)
    last = focal_length**2 / (2 * _SHARP * fastest * pixel_pitch)  # whose disc is a point where infinity is in focus
    warn_of_metres(["focus_distance"], [nearest], focal_length, last)


def disc_layer(radius: Tensor, max_radius: float) -> Tensor:
    r"""Return where radii lie between the computed discs: the number of a disc, and fractions between two.

    .. math:: k(r) = n \, \mathrm{sign}(r) \, \log \frac{\max(|r|, r_0) + b}{r_0 + b} \Big/ \log \frac{R + b}{r_0 + b}

    with points up to :math:`r_0` = 0.5 px, b = 1 px, the largest radius R and n discs larger than a point.

    Args:
        radius: r in pixels, any shape, at most R in magnitude.
        max_radius: R in pixels.

    Returns:
        k, of the radius' shape: 0 is a point, n the largest disc. Negative for negative radii.

    Example:
        >>> disc_layer(torch.tensor([0.0, 1.0, 16.0]), 16.0).round(decimals=1)
        tensor([ 0.0000,  1.8000, 15.0000])
    """
    scale = _discs_each_e(max_radius)
    return ((radius.abs().clamp(min=_SHARP) + _OFFSET) / (_SHARP + _OFFSET)).log() * (radius.sign() * scale)


def disc_radius(layer: int, max_radius: float) -> float:
    """Return the radius of a computed disc in pixels, the inverse of :func:`disc_layer`; 0 for a point.

    Example:
        >>> round(disc_radius(15, 16.0), 6), round(disc_radius(-1, 16.0), 6)
        (16.0, 0.763526)
    """
    if layer == 0:
        return 0.0
    return (_SHARP + _OFFSET) * math.exp(abs(layer) / _discs_each_e(max_radius)) - _OFFSET


def _discs_each_e(max_radius: float) -> float:
    """Return the number of discs for each factor of e: at least ``_DENSITY``, and the largest disc is one of them."""
    logarithm = math.log((max(max_radius, _SHARP) + _OFFSET) / (_SHARP + _OFFSET))
    return math.ceil(_DENSITY * logarithm) / logarithm if logarithm else 0.0


def _discs(layer: Tensor, channels: int, max_radius: float) -> tuple[Tensor, Tensor]:
    """Return the layers around those of a scene, (D,), and their discs, (D, C, P, P)."""
    if Mode.GRAPH in torch_mode():  # which shows no values
        last = disc_layer(torch.tensor(max_radius, dtype=torch.float64), max_radius)
        ends = -last, last
    else:
        ends = torch.aminmax(layer.detach())
    first, last = (round(float(end), 4) for end in ends)  # the largest may be off by rounding
    numbers = range(math.floor(first), math.ceil(last) + 1)
    radii = [disc_radius(number, max_radius) for number in numbers]
    side = 2 * math.ceil(round(max(radii), 4)) + 1
    made = _disc if torch.compiler.is_compiling() else disc  # the compiler warns of caches
    psfs = torch.stack([made(radius, side) for radius in radii]).to(layer)
    nodes = layer.new_tensor(list(numbers))
    return nodes, psfs[:, None].expand(-1, channels, -1, -1)


@lru_cache(maxsize=1024)
def disc(radius: float, side: int) -> Tensor:
    """Return a disc as a PSF: the share of its area in each pixel.

    Args:
        radius: pixels; 0 is a point.
        side: of the PSF in pixels, odd.

    Returns:
        (side, side) float64 that sums to one. It is remembered, and must not be changed.

    Example:
        >>> disc(0.5, 3)[1, 1], disc(1.5, 3)[1]
        (tensor(1., dtype=torch.float64), tensor([0.1375, 0.1415, 0.1375], dtype=torch.float64))
    """
    with torch.device("cpu"):  # for any default device
        return _disc(radius, side)


def _disc(radius: float, side: int) -> Tensor:
    area = disc_cover(side, 1.0, max(radius, 0.1))
    return area / area.sum()


class DepthBlur(nn.Module):
    """Blur by an ordinary lens. See :func:`depth_blur` for arguments, shapes and conventions.

    Example:
        >>> DepthBlur(1.0, 4.0)(torch.rand(1, 3, 32, 32), torch.full((1, 1, 32, 32), 2.0)).shape
        torch.Size([1, 3, 32, 32])
    """

    def __init__(
        self,
        focus_distance: float,
        f_number: float,
        focal_length: float = 50e-3,
        pixel_pitch: float = 8e-6,
        max_radius: float = 16.0,
        compositing: str = "gather",
        color_space: str = "srgb",
    ) -> None:
        super().__init__()
        _check_lens(focus_distance, f_number, focal_length, pixel_pitch, max_radius, compositing, color_space)
        self.focus_distance, self.f_number = focus_distance, f_number
        self.focal_length, self.pixel_pitch, self.max_radius = focal_length, pixel_pitch, max_radius
        self.compositing, self.color_space = compositing, color_space

    def forward(self, image: Tensor, depth: Tensor) -> Tensor:
        """Return the blurred images."""
        return depth_blur(image, depth, **{name: getattr(self, name) for name in _ARGUMENTS})

    def extra_repr(self) -> str:
        """Return a one-line description of the lens."""
        return f"{self.focal_length * 1e3:g} mm f/{self.f_number:g}, focus at {self.focus_distance:g} m"


class RandomDepthBlur(DepthAugmentation):
    """Blur images by an ordinary lens, focused at a random distance, with a random f-number.

    Args:
        focus_distance: range in metres, beyond the focal length.
        f_number: range of focal length over aperture diameter.
        focal_length: metres.
        pixel_pitch: metres.
        max_radius: pixels; larger discs are taken as this one.
        compositing: as in :func:`depth_blur`.
        color_space: as in :func:`depth_blur`.
        same_on_batch: one draw for the whole batch.
        p: probability of each image to be blurred. Images that are not are not computed.
        keepdim: return (C, H, W) for (C, H, W).
        holes: ``"fill"`` fills holes of the depth from the nearest known pixel, as :func:`kornia_tidy.data.fill_holes`
            does; ``"error"`` refuses them.
        lens: a real lens instead, or its name: PSFs with aberrations and diffraction, which vary over the picture, at
            the lens's own focus and f-number. Each image is a crop from a place that is drawn over its field.

    Shape:
        - As :class:`~kornia_tidy.augmentation.DepthAugmentation`.

    Raises:
        TypeError: if a range is not two numbers.
        ValueError: if a range is empty or impossible for a lens; on use, as :func:`depth_blur`.

    Convention:
        - Values are uniform in their ranges, and held in ``_params`` for ``params=``. Nothing else is random.

    Example:
        >>> augmentation = RandomDepthBlur(focus_distance=(0.5, 2.0), f_number=(2.0, 4.0), p=1.0)
        >>> augmentation(torch.rand(2, 3, 48, 48), torch.full((2, 1, 48, 48), 1.0)).shape
        torch.Size([2, 3, 48, 48])
    """

    def __init__(
        self,
        focus_distance: Range = (0.5, 5.0),
        f_number: Range = (2.0, 16.0),
        focal_length: float = 50e-3,
        pixel_pitch: float = 8e-6,
        max_radius: float = 16.0,
        compositing: str = "gather",
        color_space: str = "srgb",
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
        holes: str = "error",
        lens: Lens | str | None = None,
    ) -> None:
        super().__init__(same_on_batch=same_on_batch, p=p, keepdim=keepdim, holes=holes)
        nearest, farthest = checked_range("focus_distance", focus_distance, "metres")
        stops = checked_range("f_number", f_number)
        _check_lens(nearest, stops[0], focal_length, pixel_pitch, max_radius, compositing, color_space)
        self._param_generator = uniform_draws({"focus_distance": (nearest, farthest), "f_number": stops})
        self.flags = {
            "focal_length": focal_length,
            "pixel_pitch": pixel_pitch,
            "max_radius": max_radius,
            "compositing": compositing,
            "color_space": color_space,
        }
        own = (nearest, farthest), stops, focal_length, max_radius
        self.optics = None if lens is None else _lens_camera(lens, pixel_pitch, compositing, color_space, own)

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Return the draws of a batch: focus and f-number, or behind a real lens the places in its field."""
        if self.optics is None:
            return super().generate_parameters(batch_shape)
        return {"field_center": row_places(batch_shape, self.optics, self.same_on_batch)}

    def change(self, image: Tensor, depth: Tensor, params: Mapping[str, Tensor]) -> Tensor:
        """Return blurred images. See :meth:`DepthAugmentation.change`."""
        if self.optics is not None:
            return self.optics(image, depth, field_center=params["field_center"])
        return depth_blur(image, depth, params["focus_distance"], params["f_number"], **self.flags)


_DISCS = {"focus_distance": (0.5, 5.0), "f_number": (2.0, 16.0), "focal_length": 50e-3, "max_radius": 16.0}
_CELLS = 23  # of a pupil without masks that a lens's own stop cuts


def _lens_camera(
    lens: Lens | str, pixel_pitch: float, compositing: str, color_space: str, given: Sequence[Any]
) -> TiDyOptics:
    """Return a camera without masks and noise behind a real lens; refuse options that only discs have."""
    for (name, usual), value in zip(_DISCS.items(), given, strict=True):
        if value != usual:
            raise ValueError(f"a real lens has its own focus, f-number and blur: leave {name} out, got {value}")
    settings = {"compositing": compositing, "color_space": color_space, "border": "replicate", "sensor": None}
    return TiDyOptics(NoMask(_CELLS), **lens_parts(lens, pixel_pitch), **settings)
