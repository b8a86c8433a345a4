"""Motion during the exposure: at each moment the modulator's states see the scene of that moment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from kornia.geometry import remap
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.camera.samples import check_light, compute_dtype, read_sample
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_float_tensor, check_part
from kornia_tidy.optics.units import check_depth_fits


def moving_capture(
    optics: TiDyOptics,
    images: Tensor,
    depths: Tensor,
    params: Mapping[str, Tensor] | None = None,
    generator: torch.Generator | None = None,
    field_center: Any = None,
) -> Tensor:
    r"""Take one picture of a scene that moves during the exposure.

    .. math:: I = \sum_m t_m \, \mathcal{R}(L_m, z_m, h_m) + \text{noise}

    with the light :math:`L_m` and the depth :math:`z_m` of the scene at moment m, rendered through the PSFs :math:`h_m`
    of the states shown then, and its share :math:`t_m` of the exposure. Mask and motion are not independent, so that it
    is not the motion blur of the picture taken at rest.

    Args:
        optics: the camera. Its modulator gives the number of moments: K masks, and with
            :class:`~kornia_tidy.modulator.switching.Switching` the transitions, which follow after all masks.
            Simultaneous states, as with :class:`~kornia_tidy.modulator.modulator.DiffractionEfficiency`, are of one
            moment and see one scene.
        images: (B, M, C, H, W) or (M, C, H, W) in the camera's colour space, one for each moment in the modulator's
            order. :func:`moment_times` says when they are.
        depths: (B, M, 1, H, W) or (M, 1, H, W).
        params: noise drawn before by ``optics.draw(images[:, 0])``.
        generator: source of the noise. Default: the global generator.
        field_center: where the middle of the picture lies from the axis of a lens, (2,), or of each item, (B, 2): y and
            x in sensor pixels. Default: the camera's.

    Returns:
        (B, C, H, W) or (C, H, W), encoded as the images and of their type; smaller with ``border="valid"``.

    Raises:
        TypeError: if ``optics`` is no camera, or images or depths are not floating-point tensors.
        ValueError: if there is not one scene for each moment, or images and depths do not fit.

    Convention:
        - A scene stands still within a moment. Where it moves by more than a pixel meanwhile, show each mask
          several times with a share of its dwell time: more moments, each with its own scene.
        - A scene that stands still gives the same picture as ``optics(image, depth)``, to rounding, with the
          compositing ``"gather"`` and ``"scatter"`` and ``stray_light`` ``"discard"`` or ``"veil"``, and with
          ``"occlusion"`` where ``Fidelity.occlusion_states`` is ``"each"``. ``"renormalize"`` scales the PSFs of each
          moment to a sum of one, not their average: one that keeps less light in the window weighs a little more.
        - Light is added in linear light; the sensor sees the sum once.
        - Eager: torch.compile cannot trace the copies of the camera that look at one moment each.
        - Cost: M captures and the PSFs of M moments, instead of one of their average: about M times as long, with
          gradients about M / 2 to 2 M / 3 times (measured with 5 and 9 moments, 256 pixels, one core).

    Example:
        >>> from kornia_tidy import PixelwiseMask
        >>> optics = TiDyOptics(PixelwiseMask(2))
        >>> shift = torch.eye(3).repeat(2, 1, 1)
        >>> shift[1, 0, 2] = 4.0  # pixels to the right while the second mask is shown
        >>> image, depth = torch.rand(1, 3, 80, 80), torch.ones(1, 1, 80, 80)
        >>> moving_capture(optics, *scenes_by_homography(image, depth, shift)).shape
        torch.Size([1, 3, 80, 80])
    """
    check_part("optics", optics, TiDyOptics, "a camera such as TiDyOptics(PixelwiseMask(5))")
    batched = not isinstance(images, Tensor) or images.ndim != 4
    check_float_tensor("images", images, 5 if batched else 4, "(B, M, C, H, W) or (M, C, H, W)")
    check_float_tensor("depths", depths, images.ndim, "(B, M, 1, H, W) or (M, 1, H, W), as images are batched or not")
    check_light(images, optics)
    if not batched:
        images, depths = images[None], depths[None]
    dtype = compute_dtype(images.dtype, optics.fidelity, images.device)
    with torch.autocast(images.device.type, enabled=False):
        durations = optics.timeline(dtype).durations
        for name, scenes in (("images", images), ("depths", depths)):
            if scenes.shape[1] != len(durations):
                raise ValueError(
                    f"{name} must have one scene for each of the {len(durations)} moments of the exposure, got "
                    f"{scenes.shape[1]}"
                )
        total, clamped = torch.zeros(()), 0
        for moment, share in enumerate(durations * optics.psf_model.relative_light(dtype)):
            sample = read_sample(images[:, moment], depths[:, moment], optics, field_center=field_center)
            (light,) = optics.irradiance(sample, [optics.through_moment(moment)])
            total = light * share if moment == 0 else total + light * share
            clamped += optics.clamped_pixels
        optics.notes.clamped = clamped
        if optics.sensor is not None:
            total = optics.sensor(total, params=params, generator=generator)
        coded = optics.encode(total).to(images.dtype)
    return coded if batched else coded[0]


def moment_times(optics: TiDyOptics) -> Tensor:
    """Return the middle of each moment of the exposure, as a share of the exposure in [0, 1].

    Args:
        optics: the camera. Moments are those of :meth:`~kornia_tidy.psf.psf_model.PSFModel.timeline`; the states
            of a modulator that does not say when it shows them are taken to follow one another.

    Returns:
        (M,) float32 or better, in the modulator's order: what :func:`moving_capture` wants scenes for.

    Example:
        >>> from kornia_tidy import DwellTimes, PixelwiseMask
        >>> moment_times(TiDyOptics(PixelwiseMask(2), modulator=DwellTimes((1, 3))))
        tensor([0.1250, 0.6250])
    """
    dtype = torch.promote_types(optics.masks.phase.dtype, torch.float32)
    return optics.timeline(dtype).moment_times().detach()


def scenes_by_homography(image: Tensor, depth: Tensor, homographies: Tensor) -> tuple[Tensor, Tensor]:
    """Move a scene by a homography for each moment, such as a camera's turn or shift during the exposure.

    Args:
        image: (B, C, H, W).
        depth: (B, 1, H, W) or (1, 1, H, W).
        homographies: (M, 3, 3) or (B, M, 3, 3): from pixels (x, y, 1) of the image to where they are at each moment.

    Returns:
        Images (B, M, C, H, W) and depths (B, M, 1, H, W).

    Raises:
        ValueError: if shapes do not fit.

    Convention:
        - Images are interpolated bilinearly without decoding: give linear light to interpolate light. Depths are
          those of the nearest pixel, so that no depth appears that the scene does not have; their values stay.
        - Pixels that come into view repeat the nearest pixel of the border.

    Example:
        >>> shift = torch.eye(3).repeat(2, 1, 1)
        >>> shift[1, 0, 2] = 1.0
        >>> images, _ = scenes_by_homography(torch.arange(4.0).view(1, 1, 1, 4), torch.ones(1, 1, 1, 4), shift)
        >>> images.flatten(2)
        tensor([[[0., 1., 2., 3.],
                 [0., 0., 1., 2.]]])
    """
    pixels = _pixels(image, depth)
    if homographies.ndim not in (3, 4) or tuple(homographies.shape[-2:]) != (3, 3):
        raise ValueError(f"homographies must have shape (M, 3, 3) or (B, M, 3, 3), got {tuple(homographies.shape)}")
    there = pad(pixels, (0, 1), value=1).to(homographies)
    back = torch.linalg.inv(homographies)
    came = (back[..., None, None, :, :] @ there[..., None])[..., 0]
    return _warped(image, depth, came[..., :2] / came[..., 2:])


def scenes_by_flow(image: Tensor, depth: Tensor, flows: Tensor) -> tuple[Tensor, Tensor]:
    """Move a scene by an optical flow for each moment.

    Args:
        image: (B, C, H, W).
        depth: (B, 1, H, W) or (1, 1, H, W).
        flows: (M, 2, H, W) or (B, M, 2, H, W), pixels (x, y): the motion since the image of the point at a pixel *at
            the moment*; a point seen at p then was at p - flow(p) in the image.

    Returns:
        Images (B, M, C, H, W) and depths (B, M, 1, H, W).

    Raises:
        ValueError: if shapes do not fit.

    Convention:
        - As :func:`scenes_by_homography`. The background that an object uncovers is unknown: the flow there chooses its
          pixels.

    Example:
        >>> flow = torch.tensor([1.0, 0.0])[None, :, None, None].expand(1, 2, 1, 4)
        >>> scenes_by_flow(torch.arange(4.0).view(1, 1, 1, 4), torch.ones(1, 1, 1, 4), flow)[0].flatten()
        tensor([0., 0., 1., 2.])
    """
    pixels, (height, width) = _pixels(image, depth), image.shape[-2:]
    if flows.ndim not in (4, 5) or tuple(flows.shape[-3:]) != (2, height, width):
        raise ValueError(
            f"flows must have shape (M, 2, {height}, {width}) or (B, M, 2, {height}, {width}), got {tuple(flows.shape)}"
        )
    return _warped(image, depth, pixels.to(flows) - flows.movedim(-3, -1))


def _pixels(image: Tensor, depth: Tensor) -> Tensor:
    """Return the pixels (x, y) of a scene, (H, W, 2), or raise ``TypeError`` or ``ValueError`` unless its parts fit."""
    check_float_tensor("image", image, 4, "(B, C, H, W)")
    check_float_tensor("depth", depth, 4, "(B, 1, H, W)")
    check_depth_fits(depth, image)
    y, x = torch.meshgrid(*map(torch.arange, image.shape[-2:]), indexing="ij")
    return torch.stack([x, y], -1)


def _warped(image: Tensor, depth: Tensor, came: Tensor) -> tuple[Tensor, Tensor]:
    """Take image and depth from pixels (x, y), (M, H, W, 2) or (B, M, H, W, 2)."""
    batch = image.shape[0]
    if came.ndim == 5 and came.shape[0] != batch:
        raise ValueError(f"motion must be that of {batch} images, got {came.shape[0]}")
    came = came.expand(batch, *came.shape[-4:])
    moments, places = came.shape[1], came.flatten(0, 1)

    def taken(plane: Tensor, mode: str) -> Tensor:
        dtype = torch.promote_types(plane.dtype, torch.float32)
        repeated = plane.to(dtype).repeat_interleave(moments, 0)
        x, y = places.to(dtype).unbind(-1)
        moved = remap(repeated, x, y, mode, "border", align_corners=True)
        return moved.unflatten(0, (batch, moments)).to(plane.dtype)

    return taken(image, "bilinear"), taken(depth.expand(batch, -1, -1, -1), "nearest")
