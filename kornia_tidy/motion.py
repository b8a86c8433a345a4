"""Motion during the exposure: each state of the modulator sees the scene as it is while that state is shown."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from kornia.geometry import remap
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.multi_shot import linear_through_state
from kornia_tidy.optics.modulator import SpatialLightModulator
from kornia_tidy.optics.switching import Switching
from kornia_tidy.tidy_optics import TiDyOptics


def moving_capture(
    optics: TiDyOptics,
    images: Tensor,
    depths: Tensor,
    params: Mapping[str, Tensor] | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Take one picture of a scene that moves during the exposure.

    .. math:: I = \sum_s w_s \, \mathcal{R}(L_s, z_s, h_s) + \text{noise}

    with the light :math:`L_s` and the depth :math:`z_s` of the scene while state s is shown, rendered through the PSFs
    :math:`h_s` of that state, and its share :math:`w_s` of the exposure. Mask and motion are not independent, so that
    it is not the motion blur of the picture taken at rest.

    Args:
        optics: the camera. Its modulator says how many states there are: K masks, and with
            :class:`~kornia_tidy.optics.switching.Switching` the states between them, which follow after all masks.
        images: (B, S, C, H, W) or (S, C, H, W) in the camera's colour space, one for each state in the modulator's
            order. :func:`state_times` says when each is shown.
        depths: (B, S, 1, H, W) or (S, 1, H, W).
        params: noise drawn before by ``optics.draw(images[:, 0])``.
        generator: source of the noise. Default: the global generator.

    Returns:
        (B, C, H, W) or (C, H, W), encoded as the images and of their type; smaller with ``border="valid"``.

    Raises:
        TypeError: if images or depths are not floating-point tensors.
        ValueError: if there is not one scene for each state, or images and depths do not fit.

    Convention:
        - A scene stands still while one state stands. Where it moves by more than a pixel meanwhile, show each mask
          several times with a share of its dwell time: more states, each with its own scene.
        - A scene that stands still gives the same picture as ``optics(image, depth)``, to rounding, with the
          compositing ``"gather"`` and ``"scatter"`` and ``stray_light`` ``"discard"`` or ``"veil"``, and with
          ``"occlusion"`` where ``Fidelity.occlusion_states`` is ``"each"``. ``"renormalize"`` scales the PSFs of each
          state to a sum of one, not their average: a state that keeps less light in the window weighs a little more.
        - Light is added in linear light; the sensor sees the sum once.
        - Eager: torch.compile cannot trace the copies of the camera that look through one state each.
        - Cost: S captures and the PSFs of S states, instead of one of their average: about S times as long, with
          gradients about S / 2 to 2 S / 3 times (measured with 5 and 9 states, 256 pixels, one core).

    Example:
        >>> from kornia_tidy import PixelwiseMask
        >>> optics = TiDyOptics(PixelwiseMask(2))
        >>> shift = torch.eye(3).repeat(2, 1, 1)
        >>> shift[1, 0, 2] = 4.0  # pixels to the right while the second mask is shown
        >>> image, depth = torch.rand(1, 3, 80, 80), torch.ones(1, 1, 80, 80)
        >>> moving_capture(optics, *scenes_by_homography(image, depth, shift)).shape
        torch.Size([1, 3, 80, 80])
    """
    batched = not isinstance(images, Tensor) or images.ndim != 4
    check_float_tensor("images", images, 5 if batched else 4, "(B, S, C, H, W) or (S, C, H, W)")
    check_float_tensor("depths", depths, images.ndim, "(B, S, 1, H, W) or (S, 1, H, W), as images are batched or not")
    if not batched:
        images, depths = images[None], depths[None]
    optics = optics._now(images)  # all states are of the masks of one moment
    wide = optics.fidelity.double or images.dtype == torch.float64
    dtype = torch.float64 if wide else torch.float32
    with torch.autocast(images.device.type, enabled=False):
        weights = optics.state_weights(dtype)
        for name, scenes in (("images", images), ("depths", depths)):
            if scenes.shape[1] != len(weights):
                raise ValueError(
                    f"{name} must have one scene for each of the {len(weights)} states of the exposure, got "
                    f"{scenes.shape[1]}"
                )
        total, warned, clamped = torch.zeros(()), False, 0
        for state, share in enumerate(weights):
            one = linear_through_state(optics, state)
            one._warned |= warned  # say once what is beyond the camera's range
            light = one(optics.decode(images[:, state].to(dtype)), depths[:, state]) * share
            total, warned = light if state == 0 else total + light, one._warned
            clamped += one.clamped_pixels
        optics._clamped = torch.tensor(clamped)
        if optics.sensor is not None:
            total = optics.sensor(total, params=params, generator=generator)
        coded = optics.encode(total).to(images.dtype)
    return coded if batched else coded[0]


def state_times(optics: TiDyOptics) -> Tensor:
    """Return when each state of the exposure is shown: its middle, as a share of the exposure in [0, 1].

    Args:
        optics: the camera. States of :class:`~kornia_tidy.optics.switching.Switching` are known to be the masks and
            then what lies between them; those of any other modulator are taken to follow one another.

    Returns:
        (S,) float32 or better, in the modulator's order.

    Example:
        >>> from kornia_tidy import DwellTimes, PixelwiseMask
        >>> state_times(TiDyOptics(PixelwiseMask(2), modulator=DwellTimes((1, 3))))
        tensor([0.1250, 0.6250])
    """
    phase = optics.masks.phase
    phase = phase.detach().to(torch.promote_types(phase.dtype, torch.float32))
    modulator = optics.modulator
    last = modulator.parts[-1] if isinstance(modulator, SpatialLightModulator) else modulator
    if isinstance(last, Switching):
        return last.middle_times(phase).detach()
    weights = optics.state_weights(phase.dtype).detach()
    return weights.cumsum(0) - weights / 2


def scenes_by_homography(image: Tensor, depth: Tensor, homographies: Tensor) -> tuple[Tensor, Tensor]:
    """Move a scene by a homography for each state, such as a camera's turn or shift during the exposure.

    Args:
        image: (B, C, H, W).
        depth: (B, 1, H, W).
        homographies: (S, 3, 3) or (B, S, 3, 3): from pixels (x, y, 1) of the image to where they are in each state.

    Returns:
        Images (B, S, C, H, W) and depths (B, S, 1, H, W).

    Raises:
        ValueError: if shapes do not fit.

    Convention:
        - Images are interpolated bilinearly, as they are given: give linear light to interpolate light. Depths are
          those of the nearest pixel, so that no depth appears that the scene does not have; their values stay.
        - What comes into view repeats the nearest pixel of the border.

    Example:
        >>> shift = torch.eye(3).repeat(2, 1, 1)
        >>> shift[1, 0, 2] = 1.0
        >>> images, _ = scenes_by_homography(torch.arange(4.0).view(1, 1, 1, 4), torch.ones(1, 1, 1, 4), shift)
        >>> images.flatten(2)
        tensor([[[0., 1., 2., 3.],
                 [0., 0., 1., 2.]]])
    """
    _check_scene(image, depth)
    if homographies.ndim not in (3, 4) or tuple(homographies.shape[-2:]) != (3, 3):
        raise ValueError(f"homographies must have shape (S, 3, 3) or (B, S, 3, 3), got {tuple(homographies.shape)}")
    height, width = image.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    there = torch.stack([x, y, torch.ones_like(x)], -1).to(homographies)
    back = torch.linalg.inv(homographies)
    came = (back[..., None, None, :, :] @ there[..., None])[..., 0]
    return _warped(image, depth, came[..., :2] / came[..., 2:])


def scenes_by_flow(image: Tensor, depth: Tensor, flows: Tensor) -> tuple[Tensor, Tensor]:
    """Move a scene by an optical flow for each state.

    Args:
        image: (B, C, H, W).
        depth: (B, 1, H, W).
        flows: (S, 2, H, W) or (B, S, 2, H, W), pixels (x, y): how far what is seen at a pixel *in the state* has moved
            since the image; a point seen at p in the state was at p - flow(p) in the image.

    Returns:
        Images (B, S, C, H, W) and depths (B, S, 1, H, W).

    Raises:
        ValueError: if shapes do not fit.

    Convention:
        - As :func:`scenes_by_homography`. What an object uncovers is not known: the flow there decides what is seen.

    Example:
        >>> flow = torch.tensor([1.0, 0.0])[None, :, None, None].expand(1, 2, 1, 4)
        >>> scenes_by_flow(torch.arange(4.0).view(1, 1, 1, 4), torch.ones(1, 1, 1, 4), flow)[0].flatten()
        tensor([0., 0., 1., 2.])
    """
    _check_scene(image, depth)
    height, width = image.shape[-2:]
    if flows.ndim not in (4, 5) or tuple(flows.shape[-3:]) != (2, height, width):
        raise ValueError(
            f"flows must have shape (S, 2, {height}, {width}) or (B, S, 2, {height}, {width}), got {tuple(flows.shape)}"
        )
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return _warped(image, depth, torch.stack([x, y], -1).to(flows) - flows.movedim(-3, -1))


def _check_scene(image: Tensor, depth: Tensor) -> None:
    check_float_tensor("image", image, 4, "(B, C, H, W)")
    check_float_tensor("depth", depth, 4, "(B, 1, H, W)")
    if depth.shape[1] != 1 or depth.shape[0] != image.shape[0] or depth.shape[-2:] != image.shape[-2:]:
        raise ValueError(
            f"depth must have shape {(image.shape[0], 1, *image.shape[-2:])} to fit the image, got {tuple(depth.shape)}"
        )


def _warped(image: Tensor, depth: Tensor, came: Tensor) -> tuple[Tensor, Tensor]:
    """Take image and depth from pixels (x, y), (S, H, W, 2) or (B, S, H, W, 2)."""
    batch = image.shape[0]
    if came.ndim == 5 and came.shape[0] != batch:
        raise ValueError(f"motion must be that of {batch} images, got {came.shape[0]}")
    came = came.expand(batch, *came.shape[-4:])
    states, places = came.shape[1], came.flatten(0, 1)

    def taken(plane: Tensor, mode: str) -> Tensor:
        dtype = torch.promote_types(plane.dtype, torch.float32)
        repeated = plane.to(dtype).repeat_interleave(states, 0)
        x, y = places.to(dtype).unbind(-1)
        moved = remap(repeated, x, y, mode, "border", align_corners=True)
        return moved.unflatten(0, (batch, states)).to(plane.dtype)

    return taken(image, "bilinear"), taken(depth, "nearest")
